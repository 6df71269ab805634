"""What the observer of the bending says: against closed forms, a batch regression, and the
springs of the plant."""

from functools import cache
from typing import Any

import gymnasium
import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.estimation.model_error import (
    DISAGREEMENT_RAD,
    MODEL_ERROR,
    OFFSET_RAD,
    BendingObserver,
    update,
)
from elastic_env.core.signals import Array

PLAYED = [
    "ideal",
    "ideal+soft",
    "ideal+payload",
    *(["ideal+slope"] * 2),
]
"""A scenario for every world."""


def walker(scenario: Any, num_envs: int = 2) -> Any:
    """A walk of two fast steps."""
    return gymnasium.make_vec(
        "elastic_env/WalkInPlace-v0",
        num_envs=num_envs,
        vectorization_mode="vector_entry_point",
        num_threads=1,
        scenario=scenario,
        step_period=1.6,
        num_steps=2,
    )


@cache
def all_observed() -> Array:
    """Estimates at the end of a compensated walk in all worlds, (5, 9)."""
    num_envs = len(PLAYED)
    env = walker(PLAYED, num_envs)
    policy = baselines.make("input_output", env)
    observer = BendingObserver(env.unwrapped.assumed_model)
    observation, _ = env.reset(seed=5)
    state = None
    memory = observer.begin(num_envs)
    estimates = np.zeros((num_envs, len(observer.signals)))
    for step in range(env.unwrapped.task.num_steps - 1):
        if step % 25 == 0:
            estimates, memory = observer.observe(observation, memory)
        action, state = policy.predict(observation, state, np.full(num_envs, step == 0))
        observation, *_ = env.step(action)
    return estimates


def observed(scenario: str) -> Array:
    """Those of the worlds of a scenario, (number, 9)."""
    return all_observed()[np.array(PLAYED) == scenario]


@pytest.fixture
def level() -> Array:
    """Estimates on ideal springs and a level floor."""
    return observed("ideal")


def test_springs_that_are_as_assumed_show_no_error(level: Array) -> None:
    """Catches a wrong axis or sign, a torque taken at the motors' angles, a swinging foot that
    counts."""
    np.testing.assert_allclose(level[:, :4], 0.0, atol=0.03)
    assert (level[:, 4:8] < 0.1).all()  # from 0.3
    np.testing.assert_allclose(level[:, 8], 0.0, atol=0.02)


def test_softer_springs_show_by_how_much() -> None:
    """K × 0.7 bends 1 / 0.7 − 1 = 0.43 more, however the load is shared."""
    estimates = observed("ideal+soft")
    np.testing.assert_allclose(estimates[:, [0, 2]], 1.0 / 0.7 - 1.0, atol=0.04)
    assert (estimates[:, [1, 3]] > 0.2).all()


def test_heavier_robots_show_in_the_load() -> None:
    """5 kg on some 54 kg, and no other springs."""
    estimates = observed("ideal+payload")
    np.testing.assert_allclose(estimates[:, 8], 0.09, atol=0.01)
    np.testing.assert_allclose(estimates[:, [0, 2]], 0.0, atol=0.1)


def test_tilted_ground_is_not_taken_for_bending(level: Array) -> None:
    """Catches an offset that leaks into the model's error: one degree of slope, in any
    direction."""
    estimates = observed("ideal+slope")
    np.testing.assert_allclose(estimates[:, :4] - level[0, :4], 0.0, atol=0.05)


def test_soles_of_bent_legs_seem_tilted() -> None:
    """Orientations by SciPy: of the pelvis as the IMU has it, and of the joints one after the
    other."""
    model = walker("ideal").unwrapped.assumed_model
    observer = BendingObserver(model)
    table = model.observation_table
    generator = np.random.default_rng(0)
    rows = np.zeros((6, len(table)))
    theta = 0.3 * generator.normal(size=(6, 12))
    attitude = 0.02 * generator.normal(size=(6, 2))
    rows[:, table.group("encoder_angle")] = theta
    rows[:, table.group("imu_attitude")] = attitude
    seen, _ = observer.disagreement(rows, np.zeros_like(theta))
    pelvis = Rotation.from_euler("xy", attitude)
    for leg in range(2):
        yaw, roll, pitch, knee, ankle_pitch, ankle_roll = theta[:, 6 * leg : 6 * leg + 6].T
        joints = Rotation.from_euler(
            "ZXY", np.stack([yaw, roll, pitch + knee + ankle_pitch], axis=1)
        )
        joints = joints * Rotation.from_euler("X", ankle_roll[:, None])
        normal = (pelvis * joints).apply([0.0, 0.0, 1.0])
        np.testing.assert_allclose(
            seen[:, leg], np.stack([-normal[:, 1], normal[:, 0]], axis=1), atol=1e-12
        )


def test_expected_bending_turns_the_soles_as_its_joints_do() -> None:
    """Finite difference: the tilt of the soles by motors that stand where the links are
    expected, to first order."""
    env = walker("ideal")
    model = env.unwrapped.assumed_model
    observer = BendingObserver(model)
    theta = model.observation_table.group("encoder_angle")
    rows = env.reset(seed=0)[0]
    bent = observer.bending(rows)
    seen, expected = observer.disagreement(rows, bent)
    ahead = rows.copy()
    behind = rows.copy()
    ahead[:, theta] += 1e-3 * bent
    behind[:, theta] -= 1e-3 * bent
    slope = (observer.disagreement(ahead, bent)[0] - observer.disagreement(behind, bent)[0]) / 2e-3
    np.testing.assert_allclose(slope, expected, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(seen, expected, rtol=0.03, atol=5e-4)  # the robot stands


def test_least_squares_are_those_of_a_batch() -> None:
    """Ridge regression over all measurements at once, with the prior as further rows."""
    generator = np.random.default_rng(1)
    expected = np.random.default_rng(2).normal(0.0, 0.04, size=40)
    excess = 0.4 * expected + 0.01 + generator.normal(0.0, DISAGREEMENT_RAD, size=40)
    valid = generator.random(40) < 0.7
    x = np.zeros(2)
    upper = np.array([MODEL_ERROR**2, 0.0, OFFSET_RAD**2])
    for s, e in zip(expected[valid], excess[valid], strict=True):
        update(x, upper, s, s + e, DISAGREEMENT_RAD)
    P = upper[[[0, 1], [1, 2]]]
    rows = np.stack([expected, np.ones(40)], axis=1)[valid] / DISAGREEMENT_RAD
    rows = np.vstack([rows, np.diag([1.0 / MODEL_ERROR, 1.0 / OFFSET_RAD])])
    sought = np.concatenate([excess[valid] / DISAGREEMENT_RAD, [0.0, 0.0]])
    np.testing.assert_allclose(x, np.linalg.lstsq(rows, sought, rcond=None)[0], rtol=1e-9)
    np.testing.assert_allclose(P, np.linalg.inv(rows.T @ rows), rtol=1e-9)
    assert stats.norm.sf(abs(x[0] - 0.4) / np.sqrt(P[0, 0])) > 1e-3


def test_unloaded_feet_say_nothing() -> None:
    """Catches estimates that move while a foot swings."""
    model = walker("ideal").unwrapped.assumed_model
    observer = BendingObserver(model)
    generator = np.random.default_rng(3)
    rows = generator.normal(0.0, 0.02, size=(3, len(model.observation_table)))
    rows[:, model.observation_table.group("wrench")] = 0.0
    estimates, memory = observer.observe(rows, observer.begin(3))
    np.testing.assert_array_equal(estimates[:, :4], 0.0)
    np.testing.assert_array_equal(estimates[:, 4:8], MODEL_ERROR)
    np.testing.assert_array_equal(memory, observer.begin(3))
    np.testing.assert_array_equal(estimates[:, 8], -1.0)
