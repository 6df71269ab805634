"""Posture feedback: signs by kinematics, its response in closed form, and what it does to a walk."""

from typing import Any

import gymnasium
import numpy as np
import pytest

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.compensation.policy import Zero
from baselines.walking.posture import PostureFeedback, PostureGains
from elastic_env.core.signals import Array
from elastic_env.dynamics.leg_kinematics import foot_pose
from tests.test_walk_policies import PERIOD_S, first, scalar

GAINS = PostureGains(proportional=1.5, integral=2.0, derivative=0.1, leak_s=0.5, limit_rad=0.2)


def turned(attitude: Array, rate: Array, seconds: float, gains: PostureGains = GAINS) -> Array:
    """Offsets under a constant attitude and rate of the IMU, (steps, 12)."""
    env = scalar()
    model = env.unwrapped.assumed_model
    table, observation = model.observation_table, first(env)
    policy = PostureFeedback(Zero(table), model, gains, ramp_s=PERIOD_S)
    observation[table.group("imu_attitude")] = attitude
    observation[table.columns("imu_rate.x", "imu_rate.y")] = rate
    state, actions = None, []
    for step in range(round(seconds / PERIOD_S)):
        action, state = policy.predict(observation, state, step == 0)
        actions.append(action)
    return np.array(actions, dtype=np.float64)


def test_a_tilted_pelvis_is_turned_back() -> None:
    """Catches a wrong sign or joint: on feet that stay where they are the pelvis turns against its tilt."""
    env = scalar()
    model = env.unwrapped.assumed_model
    turn = turned(np.array([0.01, 0.02]), np.zeros(2), 0.4)[-1]
    for leg in range(2):
        planned = model.plan.q[0].reshape(2, 6)[leg]
        _, before = foot_pose(model.biped.leg, planned)
        _, after = foot_pose(model.biped.leg, planned + turn.reshape(2, 6)[leg])
        pelvis = before @ after.T  # orientation of the pelvis over a foot that keeps its own
        roll, pitch = np.arctan2(pelvis[2, 1], pelvis[2, 2]), -np.arcsin(pelvis[2, 0])
        assert roll < -0.01
        assert pitch < -0.02


def test_the_response_is_that_of_the_equation() -> None:
    """A constant tilt: k_p φ + k_i φ T (1 − exp(−t/T)) once the filter has settled; a rate adds k_d ω."""
    gains = GAINS.replace(filter_s=1e-4)
    seconds, tilt = 0.6, 0.01
    found = turned(np.array([tilt, 0.0]), np.zeros(2), seconds, gains)[-1].reshape(2, 6)
    integral = tilt * gains.leak_s * (1.0 - np.exp(-seconds / gains.leak_s))
    expected = gains.proportional * tilt + gains.integral * integral
    np.testing.assert_allclose(found[:, 1], expected, rtol=0.01)
    assert not found[:, [0, 2, 3, 4, 5]].any()
    with_rate = turned(np.array([tilt, 0.0]), np.array([0.05, 0.0]), seconds, gains)[-1].reshape(2, 6)
    np.testing.assert_allclose(with_rate[:, 1] - found[:, 1], gains.derivative * 0.05, rtol=1e-4)


def test_nothing_exceeds_the_limit() -> None:
    """Catches an integral that winds up behind the bound: it lets go within a leak's time."""
    gains = GAINS.replace(limit_rad=0.03)
    assert np.abs(turned(np.array([0.5, -0.5]), np.zeros(2), 0.4, gains)).max() == pytest.approx(0.03)


def pelvis_error(name: str, scenario: str, **options: Any) -> float:
    """Pelvis error rms of a walk of two fast steps [rad]."""
    env = gymnasium.make("elastic_env/WalkInPlace-v0", step_period=1.6, num_steps=2, scenario=scenario)
    policy = baselines.make(name, env, **options)
    (observation, info), state, over = env.reset(seed=0), None, False
    while not over:
        action, state = policy.predict(observation, state)
        observation, _, terminated, truncated, info = env.step(action)
        over = terminated or truncated
    assert not info["episode_metrics"]["fell"]
    return float(info["episode_metrics"]["pelvis_error_rms_rad"])


def test_posture_and_adaptation_lower_the_pelvis_error_on_soft_joints() -> None:
    """Catches either of them without effect, or with the wrong sign."""
    plain, adaptive = pelvis_error("input_output", "ideal+soft"), pelvis_error("adaptive", "ideal+soft")
    posture, both = pelvis_error("posture", "ideal+soft"), pelvis_error("adaptive_posture", "ideal+soft")
    assert adaptive < 0.6 * plain
    assert posture < 0.5 * plain
    assert both < 0.35 * plain
