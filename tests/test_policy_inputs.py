"""Inputs of base policies: zero is the base, signs and sizes by what they do to the robot in
MuJoCo, and the mirror."""

import json
import re
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import baselines
from baselines.catalogue import ON_JOINTS, ON_THE_WALKER
from baselines.compensation.contact_torque import shifted_share
from baselines.compensation.inputs import INPUTS, input_signals, inputs_of
from baselines.compensation.policy import PolicyInputs
from baselines.policies import sensors_needed
from baselines.residual.correction import Corrected
from baselines.residual.features import Features
from baselines.residual.mirror import Mirror
from baselines.residual.residual_folder import read_description, shipped_names
from baselines.residual.residual_policy import ResidualPolicy
from baselines.residual.settings import ResidualSettings
from baselines.residual_env import ResidualVectorWrapper
from baselines.walking.controller import follow_zmp
from baselines.walking.zmp_shift import Stances, following_share, move_pelvis
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.rigid.leg_kinematics import foot_pose
from elastic_env.world.robot_model import WalkerModel
from tests.test_residual import QUICK, SINE, TESTBED, WALKER, random_network, vector

ROOT = Path(__file__).parents[1]
WORST = {"walker/adaptive_posture", "walker/talos", "walker/thormang", "walker/oracle"}
"""They act on more once the robot walks, from control step 250 on."""
BASES = [*(f"walker/{name}" for name in ON_THE_WALKER), *(f"testbed/{n}" for n in ON_JOINTS)]
WITHIN_OTHERS = {
    *("walker/zero", "walker/uncompensated_open", "walker/input", "walker/posture"),
    *("walker/adaptive", "walker/hip_sensor"),
}
"""What they do with inputs, others do too: `input_open`, `input_output`, `adaptive_posture`,
`torque_sensor`."""
ALL = dict.fromkeys(INPUTS)


def walker(**options: Any) -> Any:
    """One robot."""
    return gymnasium.make(WALKER, **{**QUICK, **options})


@cache
def played_on(robot: str, sensors: tuple[str, ...], of_1100ms: bool) -> Any:
    """One robot, which all bases of the same sensors walk."""
    needed: dict[str, Any] = {"sensors": list(sensors)} if sensors else {}
    if of_1100ms:
        needed["step_period"] = 1.1
    return walker(**needed) if robot == "walker" else gymnasium.make(TESTBED, **SINE, **needed)


def model_of(env: Any) -> WalkerModel:
    """What is assumed of the walker."""
    return env.unwrapped.assumed_model


@pytest.mark.parametrize(
    "name",
    [
        *(pytest.param(n, marks=[pytest.mark.slow] * (n in WITHIN_OTHERS)) for n in BASES),
    ],
)
def test_zero_is_the_base_to_the_last_bit_for_every_base_and_input(name: str) -> None:
    """Catches an input that rounds where nothing acts, and one that a wrapper loses or takes
    twice."""
    robot, base = name.split("/")
    sensors = tuple(sensors_needed(base, robot == "walker"))
    # the phase table has none for the gait of the others
    env = played_on(robot, sensors, base == "phase_table")
    plain, policy = (baselines.make(base, env) for _ in range(2))
    acts_on = dict.fromkeys(inputs_of(policy))
    corrected = Corrected(policy, env.unwrapped.assumed_model, ResidualSettings(acts_on=acts_on))
    nothing = np.zeros((1, corrected.num_residuals))
    observation, _ = env.reset(seed=3)
    state = kept = None
    for _ in range(275 if name in WORST else 30):
        action, state = plain.predict(observation, state)
        same, kept = corrected.act(observation, nothing, kept)
        np.testing.assert_array_equal(same.reshape(np.shape(action)), action)
        observation, *_ = env.step(action)


ACTED = {"zmp": 0.02, "com": 0.02, "leg_length": 0.01, "hip": 0.02}
SHIFTS = {"zmp.x": 5e-3, "zmp.y": 5e-3, "com.x": 5e-3, "com.y": 5e-3}
TURNS = {"leg_length.difference": 2e-3, "hip.roll": 5e-3, "hip.pitch": 5e-3}


@cache
def walked(base: str, period_s: float, num_steps: int) -> dict[str, Array]:
    """ZMP, center of mass, roll and pitch of a walk under each input alone, less the base's,
    means over the steps."""
    handles = SHIFTS if base == "adaptive_posture" else TURNS
    n = 1 + len(handles)
    env: Any = gymnasium.make_vec(
        WALKER,
        n,
        vectorization_mode="vector_entry_point",
        scenario="ideal",
        step_period=period_s,
        num_steps=num_steps,
    )
    corrected = Corrected(
        baselines.make(base, env), model_of(env), ResidualSettings(acts_on=ACTED, cutoff_hz=1.0)
    )
    residual = np.zeros((n, corrected.num_residuals))
    names = [signal.name for signal in corrected.channels.signals]
    for world, (name, size) in enumerate(handles.items(), start=1):
        residual[world, names.index(name)] = size / ACTED[name.split(".")[0]]
    observation, _ = env.reset(seed=[0] * n)
    state = None
    seen = []
    pelvis = env.unwrapped.simulation.model.body("pelvis").id
    length = env.unwrapped.task.num_steps
    for step in range(length - 1):
        action, state = corrected.act(observation, residual, state)
        observation, *_, info = env.step(action)
        if (
            500 <= step < length - 250
        ):  # when the ramp and the low-pass are over, as long as it steps
            com = env.unwrapped.simulation.bind("subtree_com")[:, pelvis, :2]
            signals = [info[name] for name in ("zmp_x", "zmp_y", "pelvis_roll", "pelvis_pitch")]
            seen.append(np.column_stack([*signals[:2], com, *signals[2:]]))
    mean = np.mean(seen, axis=0)
    return dict(zip(handles, mean[1:] - mean[0], strict=True))


@pytest.mark.parametrize("name", ["zmp", "com"])
def test_zmp_and_center_of_mass_go_where_they_are_told(name: str) -> None:
    """5 mm come as 5 mm, in MuJoCo, of both: means of ZMP and COM differ by Δċ/ω² over the time
    alone.

    Catches a sign, a pelvis that moves by as much as the center of mass should (4 mm), a feedback
    that fights the shift, and springs that are wound for contact forces where they were.
    """
    for axis in range(2):
        found = walked("adaptive_posture", 1.6, 1)[f"{name}.{'xy'[axis]}"]
        np.testing.assert_allclose(found[[axis, 2 + axis]], 5e-3, rtol=0.0, atol=0.5e-3)
        np.testing.assert_allclose(found[[1 - axis, 3 - axis]], 0.0, atol=0.6e-3)


def test_a_pelvis_that_moves_leaves_the_feet_where_they_were() -> None:
    """By forward kinematics, over the whole plan. Catches a leg that is not level, and a shift
    beyond the reach."""
    model = model_of(walker())
    stances = Stances.of(model)
    shift = np.array([0.012, -0.02])
    offset = np.zeros(model.plan.q.shape)
    steps = np.arange(len(offset))
    move_pelvis(stances.legs, stances.rows, steps, np.tile(shift, (len(offset), 1)), offset)
    legs = (model.plan.q + offset).reshape(-1, 2, 6)
    ankle, R = foot_pose(model.biped.leg, legs)
    pelvis = model.plan.pelvis + np.append(shift, 0.0)
    np.testing.assert_allclose(
        pelvis[:, None] + model.biped.hips + ankle, model.plan.ankles, rtol=0.0, atol=1e-9
    )
    np.testing.assert_allclose(R, np.broadcast_to(np.eye(3), R.shape), rtol=0.0, atol=1e-9)
    far = np.zeros((1, 12))
    move_pelvis(stances.legs, stances.rows, steps[:1], np.array([[0.5, 0.0]]), far)
    ankle, _ = foot_pose(model.biped.leg, (model.plan.q[:1] + far).reshape(-1, 2, 6))
    np.testing.assert_allclose(np.linalg.norm(ankle, axis=-1), stances.legs[0].reach, rtol=1e-9)


def test_a_longer_left_leg_lifts_the_left_side() -> None:
    """Roll is positive to the right: the left hip rises. It cannot tilt further than both feet
    on the ground do."""
    roll, pitch = walked("input_output", 1.6, 2)["leg_length.difference"][4:]
    spacing = 2.0 * model_of(walker()).biped.hips[0, 1]
    assert 0.02 * 2e-3 / spacing < roll < 2e-3 / spacing
    assert abs(pitch) < 0.2 * abs(roll) + 1e-4


def test_a_turn_of_the_hips_turns_the_pelvis_the_other_way() -> None:
    """Catches an axis or a sign: on legs that stand −1 of it, less what the springs give way."""
    for axis, name in enumerate(("hip.roll", "hip.pitch")):
        tilt = walked("input_output", 1.6, 2)[name][4:]
        assert -1.2 * 5e-3 < tilt[axis] < -0.5 * 5e-3
        assert abs(tilt[1 - axis]) < 0.2e-3


def test_gains_change_by_the_share_that_they_are_told() -> None:
    """Catches a gain that is set and not multiplied, and one of another feedback: closed form on
    a first step."""
    env = walker()
    observation, _ = env.reset(seed=0)
    table = model_of(env).observation_table
    tilted = observation.copy()
    tilted[table.group("imu_attitude")] += [2e-3, -3e-3]
    tilted[table.columns("imu_rate.x", "imu_rate.y")] = [0.03, -0.02]
    tilted[table.columns("wrench.l_fz")] += 50.0
    instant = {"ramp_s": 0.004}
    for base, name, options in (
        ("posture", "posture_gain", {**instant, "base": "input"}),
        ("uncompensated", "balance_gain", instant),
    ):
        policy = baselines.make(base, env, **options)
        plain, _ = policy.predict(tilted)
        change = np.array([[0.5]])
        without = baselines.make(base, env, **_switched_off(base, options)).predict(tilted)[0]
        values: Any = {name: change}
        changed, _ = policy.predict(tilted, inputs=PolicyInputs(**values))  # type: ignore[attr-defined]
        assert np.abs(plain - without).max() > 1e-5
        np.testing.assert_allclose(changed - without, 1.5 * (plain - without), atol=2e-8, rtol=1e-4)


def _switched_off(base: str, options: dict[str, Any]) -> dict[str, Any]:
    if base == "posture":
        return {**options, "posture": {"proportional": 0.0, "integral": 0.0, "derivative": 0.0}}
    return {**options, "gains": {"force_difference": 0.0, "dcm": 0.0}}


def test_a_shift_of_the_center_of_mass_is_the_bounded_one() -> None:
    """c − c̈/ω² = p with the exact derivatives of an exponential, from rest; and nothing else
    stays bounded."""
    omega = 3.7
    period = 0.004
    p = np.array([0.01, -0.02])
    c = np.zeros(2)
    path = [np.zeros(2)]
    for _ in range(200):
        c = follow_zmp.py_func(c, p, following_share(omega, period))
        path.append(c)
    time = period * np.arange(201)[:, None]
    np.testing.assert_allclose(path, p * (1.0 - np.exp(-omega * time)), atol=1e-15)
    acceleration = -(omega**2) * p * np.exp(-omega * time)
    np.testing.assert_allclose(
        np.array(path) - acceleration / omega**2, np.broadcast_to(p, (201, 2))
    )


def test_two_feet_share_a_shifted_zmp_by_the_lever() -> None:
    """In the middle of double support as statics have it; not in single support, where one foot
    stands."""
    share = np.array([0.0, 0.5, 1.0])
    spacing = 0.2
    p = 0.01
    left = 0.5 * spacing
    right = -0.5 * spacing
    before = (1.0 - share) * left + share * right
    moved = np.array([shifted_share(planned, p, spacing) for planned in share])
    np.testing.assert_allclose(
        (1.0 - moved) * left + moved * right - before, [0.0, p, 0.0], atol=1e-15
    )
    assert shifted_share(0.01, 0.05, spacing) >= 0.0


def test_the_force_difference_control_wants_the_shifted_loads() -> None:
    """A ZMP p to the left loads the left foot by 2 p/w of the weight more; a step integrates
    that to a leg length."""
    env = walker()
    observation, _ = env.reset(seed=0)
    biped = model_of(env).biped
    gain = 8e-4
    shift = 0.005

    def action(force_difference: float, **values: Array) -> Array:
        gains = {"force_difference": force_difference, "dcm": 0.0}
        policy: Any = baselines.make("uncompensated", env, gains=gains, ramp_s=0.004)
        return policy.predict(observation, inputs=PolicyInputs(**values))[0].astype(np.float64)

    zmp = np.array([[0.0, shift]])
    found = (action(gain, zmp=zmp) - action(0.0, zmp=zmp)) - (action(gain) - action(0.0))
    longer = 0.004 * gain * 2.0 * shift / (2.0 * biped.hips[0, 1]) * biped.weight
    expected = action(0.0, leg_length=np.array([[longer]])) - action(0.0)
    assert np.abs(expected).max() > 1e-5
    np.testing.assert_allclose(found, expected, atol=1e-8, rtol=2e-3)


SIGNS = {
    "command.l_hip_roll": ("command.r_hip_roll", -1),
    "command.l_knee": ("command.r_knee", 1),
    "deflection.l_hip_roll": ("deflection.r_hip_roll", 1),
    "zmp.x": ("zmp.x", 1),
    "zmp.y": ("zmp.y", -1),
    "com.x": ("com.x", 1),
    "com.y": ("com.y", -1),
    "leg_length.difference": ("leg_length.difference", -1),
    "hip.roll": ("hip.roll", -1),
    "hip.pitch": ("hip.pitch", 1),
    "posture_gain.all": ("posture_gain.all", 1),
    "balance_gain.all": ("balance_gain.all", 1),
}


def test_what_is_decided_in_the_mirror_is_turned_back() -> None:
    """Catches a sign or a side, by a list written down; and a turn while the left foot is that
    of the step."""
    env = walker()
    policy = baselines.make("adaptive_posture", env)
    corrected = Corrected(policy, model_of(env), ResidualSettings(acts_on=ALL, mirror=True))
    names = [signal.name for signal in corrected.channels.signals]
    rows = np.stack([env.reset(seed=0)[0]] * 2)
    rows[:, model_of(env).observation_table.columns("clock.support")] = [[0.0], [1.0]]
    features = Features(corrected)
    for name, (other, sign) in SIGNS.items():
        residual = np.zeros((2, len(names)))
        residual[:, names.index(name)] = 0.7
        left, right = features.turn_back(rows, residual)
        np.testing.assert_array_equal(left, residual[0])
        expected = np.zeros(len(names))
        expected[names.index(other)] = sign * 0.7
        np.testing.assert_array_equal(right, expected)


@cache
def standing() -> Any:
    """One robot, which stands at the begin of its walks."""
    return walker(scenario="spread")


@pytest.mark.parametrize("name", INPUTS)
def test_a_mirrored_robot_under_a_mirrored_input_acts_in_the_mirror(name: str) -> None:
    """Catches an input that the mirror gives another sign than its effect has; a standing plan
    is its own image."""
    env = standing()
    model = model_of(env)
    generator = np.random.default_rng(0)
    table = model.observation_table
    of_input = Mirror(input_signals(name, model))
    of_rows = Mirror(table.signals)
    of_action = Mirror(table.signals_of("last_command"))
    corrected = [
        Corrected(
            baselines.make("adaptive_posture", env),
            model,
            ResidualSettings(acts_on={name: None}, cutoff_hz=50),
        )
        for _ in range(4)
    ]
    residual = generator.uniform(-1.0, 1.0, (1, corrected[0].num_residuals))
    zero = np.zeros_like(residual)
    observation, _ = env.reset(seed=2)
    states: list[Any] = [None] * 4
    differences = []
    pushed = np.zeros(len(table))
    pushed[table.group("imu_attitude")] = [0.01, 0.005]
    pushed[table.columns("wrench.l_fz")] = 40.0
    for step in range(30):
        seen = (observation + pushed)[None]
        calls = (
            (seen, residual),
            (seen, zero),
            (of_rows(seen), of_input(residual)),
            (of_rows(seen), zero),
        )
        actions = []
        for i, (rows, decided) in enumerate(calls):
            action, states[i] = corrected[i].act(rows, decided, states[i], step == 0)
            actions.append(action.astype(np.float64))
        differences.append((of_action(actions[0] - actions[1]), actions[2] - actions[3]))
        observation, *_ = env.step(actions[1][0].astype(np.float32))
    expected, found = np.swapaxes(np.array(differences), 0, 1)
    size = np.abs(expected).max()
    assert size > 1e-5
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=0.05 * size)


def test_a_policy_plays_what_the_wrapper_decided_in_the_mirror() -> None:
    """Catches a residual that is turned back in one of them alone, or by the foot of another
    moment."""
    settings: dict[str, Any] = {
        "acts_on": {"zmp": 0.02, "hip": 0.02, "deflection": 0.3},
        "mirror": True,
        "observe": ("clock", "encoder_angle"),
    }
    walk = {"step_period": [0.2, 0.3, 0.2], "num_steps": 2}
    wrapped = ResidualVectorWrapper(
        vector("walker", 2, **walk), "posture", decision_period=25, **settings
    )
    env = vector("walker", 2, **walk)
    corrected = Corrected(
        baselines.make("posture", env),
        env.unwrapped.assumed_model,
        ResidualSettings(decision_period=25, **settings),
    )
    network = random_network(corrected, 0.3)
    features, _ = wrapped.reset(seed=4)
    observation, _ = env.reset(seed=4)
    policy = ResidualPolicy(corrected, network)
    state = None
    support = env.unwrapped.task.observation_table.columns("clock.support")
    sides = set()
    for _ in range(20):
        features, *_ = wrapped.step(network(features))
        for _ in range(25):
            action, state = policy.predict(observation, state)
            observation, *_ = env.step(action)
        sides |= set(observation[:, support].ravel())
        np.testing.assert_array_equal(wrapped.unwrapped.truth().q, env.unwrapped.truth().q)  # type: ignore[attr-defined]
    assert sides == {0.0, 1.0}


@pytest.mark.parametrize(
    ("base", "settings", "message"),
    [
        ("zero", {}, r"acts on deflection, which Zero does not have.*it has: command$"),
        (
            "uncompensated",
            {"acts_on": {"posture_gain": 0.5}},
            r"posture_gain.*has: command, zmp, com, leg_length",
        ),
        (
            "thormang",
            {"acts_on": {"zmp": 0.01, "com": 0.01}},
            r"acts on zmp, com, which StanceRoll",
        ),
        ("input", {"acts_on": {"zpm": 0.01}}, r"unknown input 'zpm'.*zmp"),
        (
            "input",
            {"acts_on": {"balance_gain": 1.0}},
            r"balance_gain must be positive and below 1, got 1.0",
        ),
        ("input", {"acts_on": {"zmp": {"x": 0.0}}}, r"bound of zmp must be positive"),
        ("input", {"acts_on": {"hip": {}}}, r"bound of hip must be positive"),
        ("input", {"acts_on": {}}, r"at least 1"),
    ],
)
def test_what_cannot_be_acted_on_says_what_can(
    base: str, settings: dict[str, Any], message: str
) -> None:
    """Catches an input that is dropped in silence, and a bound beyond which a gain changes its
    sign."""
    env = walker()
    with pytest.raises(ConfigurationError, match=message):
        Corrected(baselines.make(base, env), model_of(env), ResidualSettings(**settings))


def test_shipped_residuals_and_written_settings_read_as_what_they_say() -> None:
    """Catches a shipped residual that no longer loads, and settings that change when written."""
    for name in shipped_names():
        description = read_description(Path(name))
        file = ROOT / "baselines" / "trained" / name / "residual.json"
        raw = json.loads(file.read_text())["settings"]
        assert list(description.settings.acts_on) == list(raw["acts_on"])
    again = ResidualSettings(acts_on={"zmp": {"x": 0.01}, "hip": None})
    assert ResidualSettings(**again.model_dump()) == again


def test_every_input_is_documented() -> None:
    """Catches a table in docs/training.md that lacks an input, or says another unit, bound or
    axis."""
    text = (ROOT / "docs" / "training.md").read_text(encoding="utf-8")
    rows = re.findall(
        r"^\| `(\w+)` \| ([^|]+) \| ([^|]+) \| ([^|]+) \| ([^|]+) \|", text, re.MULTILINE
    )
    found = {name: tuple(cell.strip() for cell in cells) for name, *cells in rows if name in INPUTS}
    expected = {
        name: (
            kind.unit,
            (
                "joints"
                if kind.axes is None
                else ", ".join(kind.axes)
                if len(kind.axes) > 1
                else "one"
            ),
            f"{kind.default:g}",
            "any" if kind.limit > 100.0 else f"below {kind.limit:g}",
        )
        for name, kind in INPUTS.items()
    }
    assert found == expected
