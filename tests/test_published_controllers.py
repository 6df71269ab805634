"""What other teams published for their walkers: hip roll in single support, balance by the feet,
hip roll by torque."""

from functools import cache
from typing import Any

import gymnasium
import numpy as np
import pytest

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.policies import Track, sensors_needed, track
from baselines.walking.talos import HipTorque, HipTorqueGains, limit_rate, low_pass
from baselines.walking.thormang import (
    FootBalance,
    FootBalanceGains,
    StanceRoll,
    StanceRollGains,
    stance_roll,
)
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.rigid.leg_kinematics import foot_pose, rotation_x

ID = "elastic_env/WalkInPlace-v0"
SHORT = [0.3, 0.5, 0.3]
LONGER = [0.4, 0.6, 0.4]
PERIOD_S = 0.004
ROLLS = [1, 7]


def made(**arguments: Any) -> Any:
    given = {"step_period": SHORT, "num_steps": 1, "scenario": "ideal", **arguments}
    return gymnasium.make_vec(ID, num_envs=1, vectorization_mode="vector_entry_point", **given)


def rolls(policy: Any, env: Any) -> Array:
    """True roll of the pelvis in the middle of single support, positive to the swing side, (T,)
    [rad]."""
    observation, _ = env.reset(seed=0)
    state = None
    found = []
    timing = env.unwrapped.assumed_model.plan.timing
    middle = np.flatnonzero(np.abs(timing.swing[1:] - 0.5) < 0.2)
    for step in range(middle[-1] + 1):
        action, state = policy.predict(observation, state, np.array([step == 0]))
        observation, _, _, _, info = env.step(action)
        found.append(info["pelvis_roll"][0])
    # where left stands the right side falls: positive about x
    side = np.where(timing.support == 0, 1.0, -1.0)[1:]
    return side[middle] * np.array(found)[middle]


@cache
def rolls_of_nothing() -> Array:
    """`rolls` of the uncompensated walk."""
    env = made(step_period=LONGER)
    return rolls(baselines.make("uncompensated", env), env)


def test_the_stance_hip_turns_outwards_and_the_swing_hip_the_other_way() -> None:
    """Catches a leg, a sign or a share: +φ left where left stands, −φ right where right stands,
    −0.35 of it beside."""
    offsets = stance_roll(
        np.array([0.5, 0.5]), np.array([0.0, 1.0]), StanceRollGains(angle_rad=0.02)
    )
    np.testing.assert_allclose(offsets[0, ROLLS], [0.02, -0.35 * 0.02])
    np.testing.assert_allclose(offsets[1, ROLLS], [0.35 * 0.02, -0.02])
    assert np.count_nonzero(offsets) == 4


def test_the_stance_hip_starts_and_ends_at_rest() -> None:
    """Catches an offset in double support, and a kink: s(1/2) = 1/2 at a quarter of the swing,
    no rate at its ends."""
    swing = np.array([0.0, 1e-3, 0.25, 0.5, 0.75, 1.0 - 1e-3, 1.0])
    angle = stance_roll(swing, np.zeros(7), StanceRollGains(angle_rad=1e-1))[:, 1]
    np.testing.assert_allclose(
        angle, [0.0, 0.1 * 10 * 8e-9, 0.05, 0.1, 0.05, 0.1 * 10 * 8e-9, 0.0], rtol=0.01, atol=1e-15
    )


def test_the_feedforward_lifts_the_swing_side() -> None:
    """Catches the wrong sign at the robot: the pelvis, which falls to the swing side, rolls less
    in single support."""
    env = made(step_period=LONGER)
    controller = baselines.make("uncompensated", env)
    model = env.unwrapped.assumed_model
    without = rolls_of_nothing()
    lifted = rolls(StanceRoll(controller, model, StanceRollGains(angle_rad=0.02)), env)
    assert without.mean() > 0.02
    assert 0.005 < (without - lifted).mean() < 0.03


def balance(**gains: float) -> tuple[FootBalance, Any]:
    """A balance with these gains alone, all there from the first step, and the model."""
    zero = dict.fromkeys(
        ("gyro_s", "attitude", "force_horizontal", "force_vertical", "moment"), 0.0
    )
    high = {"imu_cutoff_hz": 1e9, "wrench_cutoff_hz": 1e9}
    env = made()
    model = env.unwrapped.assumed_model
    return FootBalance(model, FootBalanceGains(**{**zero, **high, **gains}), ramp_s=PERIOD_S), env


def feet(env: Any, q: Array) -> tuple[Array, Array]:
    """Middles of the soles, (2, 3) [m], and orientations, (2, 3, 3), in a frame with the axes of
    the pelvis."""
    biped = env.unwrapped.assumed_model.biped
    position, R = foot_pose(biped.leg, q.reshape(2, 6))
    hips = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]) * biped.footholds[0, 1]
    return position + hips - biped.ankle_height * R[..., 2], R


def moved(policy: Any, env: Any, **columns: float) -> tuple[Array, Array]:
    """How soles move and turn for an observation with these values, forces and moments else as
    wanted."""
    table = env.unwrapped.task.observation_table
    row, _ = env.reset(seed=0)
    for name in table.names:
        if name.startswith(("imu_", "wrench.")):
            row[:, table.names.index(name)] = 0.0
    row[:, table.columns("wrench.l_fz", "wrench.r_fz")] = policy._wanted_force[0, :, 2]
    for name, value in columns.items():
        row[:, table.names.index(name.replace("__", "."))] += value
    action, _ = policy.predict(row, None, np.array([True]))
    q_ref = row[0, table.group("reference_angle")]
    before, R_before = feet(env, q_ref)
    after, R_after = feet(env, q_ref + action[0])
    return after - before, R_after @ R_before.swapaxes(-1, -2)


def test_feet_turn_with_the_tilt_of_the_pelvis_about_their_middle() -> None:
    """Catches the sign and the frame: a pelvis that rolls by φ is turned back by feet that turn
    by φ as one body."""
    policy, env = balance(attitude=1.0)
    shift, turn = moved(policy, env, imu_attitude__roll=0.02)
    half = env.unwrapped.assumed_model.biped.footholds[0, 1]
    np.testing.assert_allclose(turn, np.tile(rotation_x(np.array(0.02)), (2, 1, 1)), atol=1e-6)
    np.testing.assert_allclose(
        shift, [[0, 0, half * np.sin(0.02)], [0, 0, -half * np.sin(0.02)]], atol=1e-6
    )
    policy, env = balance(gyro_s=0.05)
    _, turn = moved(policy, env, imu_rate__x=0.4)
    np.testing.assert_allclose(turn[0], rotation_x(np.array(0.02)), atol=1e-6)


@pytest.mark.parametrize(
    ("gains", "columns", "shift", "roll"),
    [
        ({"force_vertical": 1e-5}, {"wrench__l_fz": 200.0}, [[0, 0, 2e-3], [0, 0, 0]], 0.0),
        ({"force_horizontal": 1e-4}, {"wrench__r_fy": -20.0}, [[0, 0, 0], [0, -2e-3, 0]], 0.0),
        ({"force_horizontal": 1e-4}, {"wrench__l_fx": 20.0}, [[2e-3, 0, 0], [0, 0, 0]], 0.0),
        ({"moment": 1e-3}, {"wrench__l_mx": 10.0}, [[0, 0, 0], [0, 0, 0]], 0.01),
    ],
)
def test_feet_give_way_to_what_the_ground_does(
    gains: Any, columns: Any, shift: Any, roll: float
) -> None:
    """Catches a foot that pushes back, the other foot, and a turn about the ankle instead of the
    sole."""
    policy, env = balance(**gains)
    moves, turn = moved(policy, env, **columns)
    np.testing.assert_allclose(moves, shift, atol=1e-6)
    np.testing.assert_allclose(turn[0], rotation_x(np.array(roll)), atol=1e-6)


def test_forces_wanted_are_those_of_the_plan() -> None:
    """Catches a share of the wrong foot and a missing acceleration: in sum they are m (g + a)."""
    policy, env = balance()
    model = env.unwrapped.assumed_model
    total = policy._wanted_force.sum(axis=1)
    mass = model.biped.weight / model.biped.gravity
    np.testing.assert_allclose(total[:, 2], model.biped.weight)
    pendulum = model.plan.omega**2 * (model.plan.com - model.plan.zmp)
    np.testing.assert_allclose(total[5:-5, 1] / mass, pendulum[5:-5, 1], atol=0.15)
    single = model.plan.share == 1.0
    np.testing.assert_array_equal(policy._wanted_force[single, 0], 0.0)


def test_a_foot_out_of_reach_comes_as_near_as_the_leg_allows() -> None:
    """Catches an exception in the midst of a walk."""
    policy, env = balance(force_vertical=1e-3)
    shift, _ = moved(policy, env, wrench__l_fz=-800.0)
    assert -0.05 < shift[0, 2] < -0.01


def test_the_low_pass_is_first_order() -> None:
    """Catches a cut-off in rad/s and a period left out: after 1/(2π f) a step has reached 1 −
    1/e."""
    value = np.zeros(1)
    steps = round(1.0 / (2.0 * np.pi * 1.0 * PERIOD_S))
    for _ in range(steps):
        value = low_pass(value, np.ones(1), 1.0, PERIOD_S)
    assert value[0] == pytest.approx(1.0 - np.exp(-2.0 * np.pi * PERIOD_S * steps), rel=1e-12)
    assert value[0] == pytest.approx(1.0 - np.exp(-1.0), abs=5e-3)


def test_the_rate_limit_is_of_the_offset() -> None:
    """Catches a limit per step instead of per time, and one that holds in one direction alone."""
    values = np.array([0.01, -0.01, 5e-6])
    np.testing.assert_allclose(
        limit_rate(np.zeros(3), values, 0.003, PERIOD_S), [12e-6, -12e-6, 5e-6]
    )


class Still:
    """Commands nothing."""

    def predict(self, observation: Array, *_: Any, **__: Any) -> tuple[Array, None]:
        return np.zeros((*observation.shape[:-1], 12), dtype=np.float32), None


def torques(gains: HipTorqueGains, torque: float, swing: float, steps: int) -> Array:
    """Offsets under a torque of both hips, after zero torque, (steps, 12) [rad]."""
    env = made(sensors=["joint_torque"])
    table = env.unwrapped.task.observation_table
    row, _ = env.reset(seed=0)
    row[:, table.group("joint_torque")] = 0.0
    row[:, table.group("clock")] = [[0.0, swing, 0.0]]
    policy = HipTorque(Still(), env.unwrapped.assumed_model, gains)
    _, state = policy.predict(row, None, np.array([True]))
    row[:, table.columns("joint_torque.l_hip_roll", "joint_torque.r_hip_roll")] = [torque, -torque]
    offsets = []
    for _ in range(steps):
        action, state = policy.predict(row, state, np.array([False]))
        offsets.append(action[0])
    return np.array(offsets)


def test_the_hip_leads_by_its_filtered_torque_over_k() -> None:
    """Catches a sign, another K, another joint: τ/K (1 − e^{−2π f t}) without bound and rate
    limit."""
    gains = HipTorqueGains(limit_rad=1.0, rate_rad_s=100.0)
    offsets = torques(gains, 20.0, 0.5, 100)
    time = PERIOD_S * np.arange(1, 101)
    np.testing.assert_allclose(
        offsets[:, 1], 20.0 / 1001.0 * (1.0 - np.exp(-2.0 * np.pi * time)), rtol=1e-5
    )
    np.testing.assert_array_equal(offsets[:, 7], -offsets[:, 1])
    assert np.count_nonzero(np.delete(offsets, ROLLS, axis=1)) == 0


def test_the_hip_is_bounded_and_limit_rate() -> None:
    """Catches a bound before the division, and a limit that is left out: 0.003 rad/s up to 0.01
    rad."""
    quick = torques(HipTorqueGains(cutoff_hz=1e3), 60.0, 0.5, 1000)[:, 1]
    time = PERIOD_S * np.arange(1, 1001)
    np.testing.assert_allclose(quick, np.minimum(0.003 * time, 0.01), rtol=1e-5)


def test_the_hip_waits_for_single_support() -> None:
    """Catches a phase that is read the other way round."""
    assert not torques(HipTorqueGains(), 20.0, 0.0, 20).any()
    assert not torques(HipTorqueGains(), 20.0, 1.0, 20).any()
    assert torques(HipTorqueGains(in_double_support=True), 20.0, 0.0, 20)[-1, 1] > 0.0


def test_the_hip_rises_at_the_robot() -> None:
    """Catches a torque sensor of the other sign: with wide limits the pelvis rolls less than
    uncompensated."""
    env = made(step_period=LONGER, sensors=["joint_torque"])
    quick = HipTorqueGains(cutoff_hz=5.0, limit_rad=0.03, rate_rad_s=0.3)
    without = rolls_of_nothing()
    led = rolls(baselines.make("talos", env, hip_torque=quick), env)
    assert without.mean() > 0.02
    assert led.mean() < 0.8 * without.mean()


def test_tracks_and_sensors_are_said() -> None:
    """Catches a policy on the track of the standard sensors that reads others."""
    assert (track("thormang"), sensors_needed("thormang")) == (Track.STANDARD, ())
    assert (track("talos"), sensors_needed("talos")) == (Track.TORQUE_SENSORS, ("joint_torque",))
    with pytest.raises(ConfigurationError, match="make it with sensors="):
        baselines.make("talos", made())


@pytest.mark.parametrize("name", ["thormang", "talos"])
def test_worlds_are_apart_and_episodes_begin_anew(name: str) -> None:
    """Catches memory that leaks from world to world or from one episode to the next."""
    sensors = list(sensors_needed(name))
    arguments: dict[str, Any] = {
        "step_period": SHORT,
        "num_steps": 1,
        "sensors": sensors,
        "scenario": "nominal",
    }
    env = gymnasium.make_vec(
        ID, num_envs=2, vectorization_mode="vector_entry_point", num_threads=1, **arguments
    )
    policy = baselines.make(name, env)
    recorded = []
    state = None
    observation, _ = env.reset(seed=5)
    for step in range(120):
        action, state = policy.predict(observation, state, np.full(2, step == 0))
        recorded.append((observation, action))
        observation, *_ = env.step(action)
    state = None
    for step, (observation, action) in enumerate(
        recorded
    ):  # one world alone, started anew in the state of another
        alone, state = policy.predict(observation[1], state, step == 0)
        np.testing.assert_array_equal(alone, action[1])
    again, _ = policy.predict(recorded[0][0][1], state, True)
    np.testing.assert_array_equal(again, recorded[0][1][1])
