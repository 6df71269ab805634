"""Friction fed forward, and the disturbance observer with the IMU of the link, on robots of one
joint."""

from typing import Any

import gymnasium
import numpy as np
import pytest

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.adaptation.disturbance_observer import DisturbanceObserver, ObserverGains
from baselines.compensation.compensators import Motion
from baselines.compensation.dry_friction import PRESLIDING_RAD, presliding_friction
from baselines.compensation.dynamic_compensator import DynamicCompensator
from baselines.policies import Track, sensors_needed, track
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from tests.three_joints import ARM

ID = "elastic_env/Testbed-v0"
PERIOD_S = 0.004
HANGING = {"kind": "sine", "amplitude": 1e-6, "duration_s": 2.0, "onset_s": 0.5}
K = 1001.0
FRICTION = 5.4


def made(worlds: int = 1, **arguments: Any) -> Any:
    given = {"reference": HANGING, "scenario": "ideal", "sensors": ["link_imu"], **arguments}
    return gymnasium.make_vec(ID, num_envs=worlds, vectorization_mode="vector_entry_point", **given)


def played(
    policy: Any, env: Any, steps: int | None = None, seed: int = 0
) -> tuple[Array, list[Any], Any]:
    """True link error, (T, num_worlds) [rad], states, and the last `info` of an episode."""
    observation, info = env.reset(seed=seed)
    state = None
    errors = []
    states = []
    for step in range(steps or env.unwrapped.task.num_steps):
        action, state = policy.predict(observation, state, np.full(len(observation), step == 0))
        observation, _, _, _, info = env.step(action)
        errors.append(info["link_error"])
        states.append(state)
    return np.array(errors), states, info


def test_friction_turns_round_over_a_displacement() -> None:
    """Catches a sign and a displacement of another unit: from −F, F (1 − 2 e^{−x/x₀}); at rest
    it stays."""
    friction = np.array([-FRICTION])
    coulomb = np.array([FRICTION])
    for _ in range(50):
        friction = presliding_friction(friction, np.array([1e-5]), coulomb)
    assert friction[0] == pytest.approx(
        FRICTION * (1.0 - 2.0 * np.exp(-50 * 1e-5 / PRESLIDING_RAD)), rel=1e-9
    )
    np.testing.assert_array_equal(presliding_friction(friction, np.zeros(1), coulomb), friction)


@pytest.mark.parametrize("rate", [0.2, -0.2])
def test_at_constant_speed_the_command_leads_by_friction_over_k(rate: float) -> None:
    """Catches a friction that pushes, and one that a servo with an integrator is led for for
    ever."""
    model = made().unwrapped.assumed_model
    offsets = []
    for knows in (True, False):
        compensator = DynamicCompensator(model, friction=knows)
        q = np.zeros((1, 1))
        dot = np.full((1, 1), rate)
        offset = np.zeros((1, 1))
        memory = compensator.begin(Motion(q, dot, 0.0 * dot))
        for _ in range(500):
            q = q + rate * PERIOD_S
            offset, memory = compensator.offset(Motion(q, dot, 0.0 * dot), memory)
        offsets.append(offset[0, 0])
    assert offsets[0] - offsets[1] == pytest.approx(np.sign(rate) * FRICTION / K, rel=1e-6)


def test_friction_fed_forward_leaves_less_error() -> None:
    """Catches a friction of the wrong sign at the robot, which would double the error."""
    arguments = {
        "reference": {"kind": "sine", "duration_s": 1.0},
        "scenario": "nominal",
        "sensors": [],
    }
    env = made(**arguments)
    figures = []
    for name in ("dynamic", "friction"):
        _, _, info = played(baselines.make(name, env), env)
        figures.append(info["episode_metrics"]["link_error_rms_rad"][0])
    assert figures[1] < 0.4 * figures[0]


def rows_of_a_link(env: Any, torque: Array) -> Array:
    """Observations of a motor that stands and a link under disturbances that hold it back, (T,
    m): its own ODE."""
    table = env.unwrapped.task.observation_table
    model = env.unwrapped.assumed_model
    damping = float(model.damping[0])
    per_rad = 60.0
    inertia = 10.0 * ((60.0 / 98.1) ** 2 + 0.1**2)
    row, _ = env.reset(seed=0)
    rows = []
    q = 0.0
    q_dot = 0.0
    fine = 200
    for d in torque:
        for _ in range(fine):
            q_ddot = (-K * q - damping * q_dot - per_rad * np.sin(q) - d) / inertia
            q_dot += q_ddot * PERIOD_S / fine
            q += q_dot * PERIOD_S / fine
        shown = row.copy()
        shown[:, table.names.index("encoder_angle")] = 0.0
        shown[:, table.names.index("link_angle_imu")] = q
        rows.append(shown)
    return np.array(rows)


class Still:
    """Commands nothing."""

    def predict(self, observation: Array, *_: Any, **__: Any) -> tuple[Array, None]:
        return np.zeros((len(observation), 1), dtype=np.float32), None


def test_the_observer_finds_a_torque_of_known_size_in_the_stated_time() -> None:
    """Catches a sign, an inertia, a term that lags behind the others: two filters in series, T and
    that of the rate.

    The link swings on its spring meanwhile, by as much as it gives way: what is not consistent
    rings in the estimate.
    """
    gains = ObserverGains(time_constant_s=0.3, rate_filter_s=0.03, zero_s=0.0, friction=False)
    env = made()
    torque = np.where(np.arange(500) < 100, 0.0, 6.0)
    action = np.zeros((1, 1))
    policy = DisturbanceObserver(Still(), env.unwrapped.assumed_model, gains)
    state = None
    found = []
    for step, row in enumerate(rows_of_a_link(env, torque)):
        action, state = policy.predict(row, state, np.array([step == 0]))
        found.append(state.joints.disturbance[0, 0])
    T = 0.3
    T_v = 0.03
    time = PERIOD_S * (np.arange(100, 500) - 99)
    expected = 6.0 * (1.0 - (T * np.exp(-time / T) - T_v * np.exp(-time / T_v)) / (T - T_v))
    np.testing.assert_allclose(found[:100], 0.0, atol=1e-9)
    np.testing.assert_allclose(found[100:], expected, atol=0.02 * 6.0)
    np.testing.assert_allclose(found[200:], 6.0 * (1.0 - np.exp(-time[100:] / T)), atol=0.1 * 6.0)
    assert action[0, 0] == pytest.approx(found[-1] / K, rel=1e-5)  # the ramp is over


def test_the_link_returns_from_a_torque_that_holds_it_back() -> None:
    """Catches a lead of the wrong sign or K: 6 N·m bend the joint by 6/1061 rad, of which
    nothing stays."""
    env = made(
        reference={**HANGING, "duration_s": 2.0}, joint={"damping": 60.0}
    )  # else it rings for long
    task = env.unwrapped.task
    address = task.model.joint("joint").dofadr[0]

    def disturb() -> None:
        is_late = task.sample().worlds["truth"]["step"][0] >= 200
        task.simulation.bind("qfrc_applied")[:, address] = -6.0 if is_late else 0.0

    task._disturb = disturb
    errors, states, _ = played(
        baselines.make("disturbance_observer", env, observer=ObserverGains(friction=False)), env
    )
    uncompensated, _, _ = played(baselines.make("dynamic", env), env, steps=400)
    assert uncompensated[-1, 0] == pytest.approx(6.0 / 1061.0, rel=0.02)
    assert abs(errors[-1, 0]) < 0.02 * uncompensated[-1, 0]
    assert states[-1].joints.disturbance[0, 0] == pytest.approx(6.0, rel=0.02)


def test_the_estimate_is_bounded_and_does_not_wind_up() -> None:
    """Catches an integral behind the bound: it leaves the bound as soon as the torque does."""
    gains = ObserverGains(limit_nm=2.0, zero_s=0.0, friction=False)
    env = made()
    torque = np.where(np.arange(400) < 200, 20.0, 0.0)
    policy = DisturbanceObserver(Still(), env.unwrapped.assumed_model, gains)
    state = None
    found = []
    for step, row in enumerate(rows_of_a_link(env, torque)):
        _, state = policy.predict(row, state, np.array([step == 0]))
        found.append(state.joints.disturbance[0, 0])
    assert max(found) == 2.0
    assert abs(found[-1]) < 0.3


def test_at_rest_what_friction_can_hold_is_no_disturbance() -> None:
    """Catches an observer that winds up against a link that sticks: of 6 N·m only what is beyond
    5.4 counts."""
    gains = ObserverGains(zero_s=0.0)
    env = made()
    policy = DisturbanceObserver(Still(), env.unwrapped.assumed_model, gains)
    state = None
    for step, row in enumerate(rows_of_a_link(env, np.full(100, FRICTION - 0.1))):
        _, state = policy.predict(row, state, np.array([step == 0]))
    assert abs(state.joints.disturbance[0, 0]) < 1.0


@pytest.mark.parametrize(("middle", "expected"), [(0.0, 1.7e-3), (0.5, 0.0)])
def test_the_imu_is_zeroed_where_the_joint_hangs(middle: float, expected: float) -> None:
    """Catches a load that is taken for an offset, and an offset of the wrong sign."""
    env = made(reference={**HANGING, "middle": middle}, scenario="nominal")
    _, states, _ = played(baselines.make("disturbance_observer", env), env, steps=200)
    assert states[-1].joints.offset[0, 0] == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize(
    "scenario",
    [
        "soft+backlash+sensor",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("nominal", "soft", "stiff", "payload", "backlash", "sensor")
        ),
    ],
)
def test_the_observer_is_stable_in_every_scenario(scenario: str) -> None:
    """Catches a loop through the resonance: after quick steps the link is still, in the last
    half second of a rest."""
    steps = {"kind": "steps", "amplitude": 0.3, "moves": 1, "move_s": 0.8, "rest_s": 2.0}
    env = made(reference=steps, scenario=scenario)
    errors, _, _ = played(baselines.make("disturbance_observer", env), env)
    assert np.ptp(errors[-125:]) < 2e-3
    assert np.abs(errors).max() < 0.1


def test_the_link_imu_is_a_sensor() -> None:
    """Catches other columns than `observe_link` has, and an observation that changes where
    nobody asks."""
    tables = [
        made(sensors=given).unwrapped.task.observation_table.names for given in (["link_imu"], [])
    ]
    asked = made(sensors=[], observe_link=True).unwrapped.task.observation_table.names
    assert list(tables[0]) == list(asked) == [*tables[1], "link_angle_imu"]
    with_both = made(
        sensors=["joint_torque", "link_imu"], observe_link=True
    ).unwrapped.task.observation_table.names
    assert list(with_both) == [*asked, "joint_torque"]
    with pytest.raises(ConfigurationError, match="one joint, and arm has 3"):
        ARM.robot.make(sensors=["link_imu"])


def test_tracks_and_sensors_are_said() -> None:
    """Catches a policy on the track of the standard sensors that reads others."""
    assert (track("friction", False), sensors_needed("friction", False)) == (Track.STANDARD, ())
    assert track("disturbance_observer", False) == Track.LINK_ENCODERS
    assert sensors_needed("disturbance_observer", False) == ("link_imu",)
    with pytest.raises(ConfigurationError, match=r"make it with sensors=\['link_imu'\]"):
        baselines.make("disturbance_observer", made(sensors=[]))


def test_worlds_are_apart_and_episodes_begin_anew() -> None:
    """Catches memory that leaks from world to world or from one episode to the next."""
    env = made(
        worlds=2,
        reference={"kind": "sine", "amplitude": 0.1, "duration_s": 1.0, "onset_s": 0.5},
        scenario="nominal",
    )
    policy = baselines.make("disturbance_observer", env)
    recorded = []
    state = None
    observation, _ = env.reset(seed=5)
    for step in range(300):
        action, state = policy.predict(observation, state, np.full(2, step == 0))
        recorded.append((observation, action))
        observation, *_ = env.step(action)
    state = None
    for step, (observation, action) in enumerate(recorded):
        alone, state = policy.predict(observation[1], state, step == 0)
        np.testing.assert_array_equal(alone, action[1])
    again, _ = policy.predict(recorded[0][0][1], state, True)
    np.testing.assert_array_equal(again, recorded[0][1][1])
