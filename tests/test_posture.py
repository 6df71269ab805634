"""Posture feedback: signs by kinematics, its response in closed form, and what it does to a
walk."""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import pytest

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.compensation.policy import Zero
from baselines.walking.posture import PostureFeedback, PostureGains
from elastic_env.core.signals import Array
from elastic_env.rigid.leg_kinematics import foot_pose
from tests.test_walk_policies import PERIOD_S, first, scalar

GAINS = PostureGains(proportional=1.5, integral=2.0, derivative=0.1, leak_s=0.5, limit_rad=0.2)


def turned(
    attitude: Array,
    rate: Array,
    seconds: float,
    gains: PostureGains = GAINS,
    ramp_s: float = PERIOD_S,
) -> Array:
    """Offsets under a constant attitude and rate of the IMU, (steps, 12)."""
    env = scalar()
    model = env.unwrapped.assumed_model
    table = model.observation_table
    observation = first(env)
    policy = PostureFeedback(Zero(model), model, gains, ramp_s=ramp_s)
    observation[table.group("imu_attitude")] = attitude
    observation[table.columns("imu_rate.x", "imu_rate.y")] = rate
    state = None
    actions = []
    for step in range(round(seconds / PERIOD_S)):
        action, state = policy.predict(observation, state, step == 0)
        actions.append(action)
    return np.array(actions, dtype=np.float64)


def test_a_tilted_pelvis_is_turned_back() -> None:
    """Catches a wrong sign or joint: on feet that stay where they are the pelvis turns against
    its tilt."""
    env = scalar()
    model = env.unwrapped.assumed_model
    turn = turned(np.array([0.01, 0.02]), np.zeros(2), 0.4)[-1]
    for leg in range(2):
        planned = model.plan.q[0].reshape(2, 6)[leg]
        _, before = foot_pose(model.biped.leg, planned)
        _, after = foot_pose(model.biped.leg, planned + turn.reshape(2, 6)[leg])
        pelvis = before @ after.T  # orientation of the pelvis over a foot that keeps its own
        roll = np.arctan2(pelvis[2, 1], pelvis[2, 2])
        pitch = -np.arcsin(pelvis[2, 0])
        assert roll < -0.01
        assert pitch < -0.02


def test_the_response_is_that_of_the_equation() -> None:
    """A constant tilt: k_p φ + k_i φ T (1 − exp(−t/T)) once the filter has settled; a rate adds
    k_d ω."""
    gains = GAINS.replace(filter_s=1e-4)
    seconds = 0.6
    tilt = 0.01
    found = turned(np.array([tilt, 0.0]), np.zeros(2), seconds, gains)[-1].reshape(2, 6)
    integral = tilt * gains.leak_s * (1.0 - np.exp(-seconds / gains.leak_s))
    expected = gains.proportional * tilt + gains.integral * integral
    np.testing.assert_allclose(found[:, 1], expected, rtol=0.01)
    assert not found[:, [0, 2, 3, 4, 5]].any()
    with_rate = turned(np.array([tilt, 0.0]), np.array([0.05, 0.0]), seconds, gains)[-1].reshape(
        2, 6
    )
    np.testing.assert_allclose(with_rate[:, 1] - found[:, 1], gains.derivative * 0.05, rtol=1e-4)


def test_the_trim_grows_once_the_ramp_has_ended() -> None:
    """Catches a trim that leaks, that learns from the tilt before the policy is at work, or whose
    gain is one per step: it adds k_t φ t."""
    gains = GAINS.replace(trim=3.0)
    tilt = np.array([0.01, -0.02])
    plain = turned(tilt, np.zeros(2), 0.9, ramp_s=0.3)
    trimmed = turned(tilt, np.zeros(2), 0.9, gains, ramp_s=0.3)
    further = (trimmed - plain).reshape(-1, 2, 6)[:, :, 1:3]
    ramp = round(0.3 / PERIOD_S)
    assert not further[: ramp - 1].any()
    np.testing.assert_allclose(further[-1], np.tile(3.0 * 0.6 * tilt, (2, 1)), rtol=0.02)
    rates = np.diff(further[ramp + 20 :], axis=0) / PERIOD_S
    np.testing.assert_allclose(rates, np.broadcast_to(3.0 * tilt, rates.shape), rtol=1e-3)


def test_a_tilt_that_stays_is_taken_off_with_the_named_time_constant() -> None:
    """On legs that follow at once the tilt falls from d / (1 + k_p + k_i T) as
    exp(−k_t t / (1 + k_p + k_i T)); without the trim it stays."""
    gains = GAINS.replace(trim=2.0, leak_s=0.05, filter_s=1e-4, derivative=0.0)
    stiff = 1.0 + gains.proportional + gains.integral * gains.leak_s
    left = []
    for own in (gains.replace(trim=0.0), gains):
        env = scalar()
        model = env.unwrapped.assumed_model
        observation = first(env)
        roll = model.observation_table.columns("imu_attitude.roll")
        policy = PostureFeedback(Zero(model), model, own, ramp_s=PERIOD_S)
        state = None
        tilt = 0.03
        for step in range(round(1.0 / PERIOD_S)):
            observation[roll] = tilt
            action, state = policy.predict(observation, state, step == 0)
            tilt += 0.2 * (0.03 - float(action[1]) - tilt)
        left.append(tilt)
    assert left[0] == pytest.approx(0.03 / stiff, rel=0.01)
    assert left[1] == pytest.approx(left[0] * np.exp(-gains.trim / stiff), rel=0.05)


def test_nothing_exceeds_the_limit() -> None:
    """Catches an integral that winds up behind the bound: it lets go within a leak's time."""
    gains = GAINS.replace(limit_rad=0.03)
    assert np.abs(turned(np.array([0.5, -0.5]), np.zeros(2), 0.4, gains)).max() == pytest.approx(
        0.03
    )


def test_a_leg_in_the_air_keeps_its_pitch_and_follows_slowly() -> None:
    """Catches a swing foot that is moved forth and back: n steps after lift-off (1 − Δt/T)ⁿ of
    the way is left."""
    gains = GAINS.replace(integral=0.0, derivative=0.0, filter_s=1e-4, swing_s=0.5)
    env = scalar()
    model = env.unwrapped.assumed_model
    table = model.observation_table
    observation = first(env)
    policy = PostureFeedback(Zero(model), model, gains, ramp_s=PERIOD_S)
    attitude = table.group("imu_attitude")
    share = table.group("load_share")
    observation[table.columns("imu_rate.x", "imu_rate.y")] = 0.0
    state = None
    action = None
    tilt = np.array([0.01, 0.02])
    later = np.array([0.03, -0.01])

    def played(seconds: float, imu: Array, share_right: float) -> Array:
        nonlocal state, action
        observation[attitude] = imu
        observation[share] = share_right
        for _ in range(round(seconds / PERIOD_S)):
            action, state = policy.predict(observation, state, state is None)
        return np.asarray(action, dtype=np.float64).reshape(2, 6)

    standing = played(0.1, tilt, 0.5)
    np.testing.assert_allclose(
        standing[:, 1:3], gains.proportional * np.tile(tilt, (2, 1)), rtol=1e-5
    )
    swing = played(0.3, later, 0.0)  # the left foot stands alone
    now = gains.proportional * later
    lifted = gains.proportional * tilt
    np.testing.assert_allclose(swing[0, 1:3], now, rtol=1e-5)
    left = (1.0 - PERIOD_S / gains.swing_s) ** (round(0.3 / PERIOD_S) - 1)
    np.testing.assert_allclose(
        swing[1, 1:3], [now[0], now[1] + (lifted[1] - now[1]) * left], rtol=1e-4
    )
    landed = played(PERIOD_S, later, 0.5)
    np.testing.assert_allclose(landed[:, 1:3], np.tile(now, (2, 1)), rtol=1e-5)


def pelvis_errors(names: Sequence[str], scenario: str) -> Array:
    """Pelvis error rms of a walk of one fast step, for each policy [rad]."""
    env = gymnasium.make_vec(
        "elastic_env/WalkInPlace-v0",
        num_envs=len(names),
        vectorization_mode="vector_entry_point",
        num_threads=1,
        step_period=1.6,
        num_steps=1,
        scenario=scenario,
    )
    policies = [baselines.make(name, env) for name in names]
    observation, info = env.reset(seed=0)
    states: list[Any] = [None] * len(names)
    while "episode_metrics" not in info:
        actions = []
        for i, policy in enumerate(policies):
            action, states[i] = policy.predict(observation[i], states[i])
            actions.append(action)
        observation, _, terminated, _, info = env.step(np.array(actions))
        assert not terminated.any()
    return info["episode_metrics"]["pelvis_error_rms_rad"]


def test_posture_and_adaptation_lower_the_pelvis_error_on_soft_joints() -> None:
    """Catches either of them without effect, or with the wrong sign."""
    names = ("input_output", "adaptive", "posture", "adaptive_posture")
    plain, adaptive, posture, both = pelvis_errors(names, "ideal+soft")
    assert adaptive < 0.6 * plain
    assert posture < 0.5 * plain
    assert both < 0.35 * plain
