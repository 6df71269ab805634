"""Where the feet are by reckoning, and the ZMP with them, against the simulation."""

from typing import Any

import gymnasium
import numpy as np
import pytest

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.odometry import LegOdometry
from elastic_env.signals import Array

PERIOD_S = 0.1


def walked(policy: str, num_steps: int = 2, **arguments: Any) -> dict[str, Array]:
    """Estimates over two fast steps, (decisions, worlds, 7), and the errors of the ZMP that the simulation knows."""
    env: Any = gymnasium.make_vec(
        "elastic_env/WalkInPlace-v0", num_envs=2, vectorization_mode="vector_entry_point", num_threads=1,
        step_period=1.6, num_steps=num_steps, **arguments,
    )  # fmt: skip
    commands, odometry = baselines.make(policy, env), LegOdometry(env.unwrapped.assumed_model, PERIOD_S)
    (observation, info), state, memory = env.reset(seed=3), None, odometry.begin(2)
    estimates, errors = [], []
    for step in range(env.unwrapped.task.num_steps - 1):
        if step % 25 == 0:
            estimate, memory = odometry.observe(observation, memory)
            if step > 0:
                estimates.append(estimate)
                errors.append(np.stack([info[f"zmp_deviation_{axis}"] for axis in "xy"], axis=1))
        action, state = commands.predict(observation, state, np.full(2, step == 0))
        observation, _, _, _, info = env.step(action)
    return {"estimates": np.array(estimates), "zmp": np.array(errors)}


def rms(values: Array) -> Array:
    """Over decisions and worlds, by axis."""
    return np.sqrt(np.mean(np.square(values), axis=(0, 1)))


def test_zmp_is_that_of_the_simulation() -> None:
    """Catches a sign, a frame, the weight of the feet left out, and the wrong foot."""
    seen = walked("input_output", num_steps=1, scenario="ideal")
    assert rms(seen["zmp"]).min() > 5e-3
    np.testing.assert_allclose(rms(seen["estimates"][..., 4:6] - seen["zmp"]), 0.0, atol=2e-3)
    assert rms(seen["estimates"][..., 6:]) < 0.1  # half of the weight and more on the wrong foot


@pytest.mark.parametrize(("scenario", "axis"), [("payload", 0), ("ideal+soft", 1)])
def test_feet_that_land_beside_their_footholds_are_followed(scenario: str, axis: int) -> None:
    """Catches a displacement of the wrong foot, sign or axis: forward under a load, outward on soft hips.

    Forward on soft knees it is not followed: there the bending hardly shows.
    """
    seen = walked("input_output", scenario=scenario)
    displaced, zmp = seen["estimates"][..., :4].reshape(-1, 2, 2, 2)[..., axis], seen["estimates"][..., 4 + axis]
    assert np.abs(displaced[-1]).max() > 0.008
    np.testing.assert_array_equal(displaced[:8], 0.0)  # stands for 0.8 s and more
    last, true = slice(-8, None), seen["zmp"][..., axis]  # stands again, where it has come to
    np.testing.assert_allclose(zmp[last], true[last], atol=5e-3)
    on_footholds = zmp[last] - displaced[last].mean(axis=2)
    assert np.abs(on_footholds - true[last]).max() > 2.0 * np.abs(zmp[last] - true[last]).max()


def test_landed_feet_are_reckoned_from_those_that_carried() -> None:
    """Left, right, left: each is off by what the other was, and by the distance that is too much between them."""
    at = np.zeros((1, 2, 2))
    at = LegOdometry._reckoned(at, np.array([[False, True]]), np.array([[0.01, 0.002]]))
    np.testing.assert_allclose(at[0], [[0.0, 0.0], [0.01, 0.002]])
    at = LegOdometry._reckoned(at, np.array([[True, False]]), np.array([[-0.01, 0.001]]))
    np.testing.assert_allclose(at[0], [[0.02, 0.001], [0.01, 0.002]])
    at = LegOdometry._reckoned(at, np.array([[False, False]]), np.array([[1.0, 1.0]]))
    np.testing.assert_allclose(at[0], [[0.02, 0.001], [0.01, 0.002]])
