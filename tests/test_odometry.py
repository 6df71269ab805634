"""Where the feet are by reckoning, against where the simulation has them."""

from typing import Any

import gymnasium
import numpy as np
import pytest

import baselines
from baselines.odometry import LegOdometry, reckoned
from elastic_env.signals import Array

PERIOD_S = 0.1


def walked(**arguments: Any) -> tuple[Array, Array]:
    """Displacements over two fast steps by reckoning and as they are, (decisions, 4) each [m]."""
    env: Any = gymnasium.make("elastic_env/WalkInPlace-v0", step_period=1.6, num_steps=2, **arguments)
    task = env.unwrapped.task
    policy, odometry = baselines.make("input_output", env), LegOdometry(task.assumed_model, PERIOD_S)
    (observation, _), state, memory = env.reset(seed=3), None, odometry.begin(1)
    estimates, true = [], []
    for step in range(task.num_steps):
        if step % 25 == 0:
            estimate, memory = odometry.observe(observation[None], memory)
            estimates.append(estimate[0])
            true.append((env.unwrapped.truth().ankles[0, :, :2] - task.assumed_model.biped.footholds).ravel())
        action, state = policy.predict(observation, state)
        observation = env.step(action)[0]
    return np.array(estimates), np.array(true)


@pytest.mark.parametrize(
    ("scenario", "axis", "bound_m"), [("ideal", 1, 2e-3), ("payload", 0, 3e-3), ("ideal+soft", 1, 3e-3)]
)
def test_feet_that_land_beside_their_footholds_are_followed(scenario: str, axis: int, bound_m: float) -> None:
    """Catches a displacement of the wrong foot, sign or axis: forward under a load, outward on soft hips."""
    estimates, true = walked(scenario=scenario)
    np.testing.assert_array_equal(estimates[:8], 0.0)  # stands for 0.8 s and more
    stands = slice(-8, None)  # again, where it has come to
    np.testing.assert_allclose(estimates[stands, axis::2], true[stands, axis::2], rtol=0.0, atol=bound_m)
    if scenario != "ideal":
        assert np.abs(true[stands, axis::2]).max() > 2.5 * bound_m


def test_landed_feet_are_reckoned_from_those_that_carried() -> None:
    """Left, right, left: each is off by what the other was, and by the distance that is too much between them."""
    at = np.zeros((1, 2, 2))
    at = reckoned(at, np.array([[False, True]]), np.array([[0.01, 0.002]]))
    np.testing.assert_allclose(at[0], [[0.0, 0.0], [0.01, 0.002]])
    at = reckoned(at, np.array([[True, False]]), np.array([[-0.01, 0.001]]))
    np.testing.assert_allclose(at[0], [[0.02, 0.001], [0.01, 0.002]])
    at = reckoned(at, np.array([[False, False]]), np.array([[1.0, 1.0]]))
    np.testing.assert_allclose(at[0], [[0.02, 0.001], [0.01, 0.002]])
