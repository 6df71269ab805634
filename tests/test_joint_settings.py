"""Files of joints: one meaning for the environment and for the compensator, and what a model's
drive says."""

import math
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest

from baselines import PositionCompensator
from elastic_env.core.errors import ConfigurationError
from elastic_env.joint.joint_settings import JointSettings, read_joints
from elastic_env.joint.model_servo import position_servo, rotor_inertia
from elastic_env.robots.robot.environment import configure_robot
from tests.played import metrics_of

G = 9.81
LINK = '<geom type="capsule" fromto="0 0 0 0 0 0.3" size="0.02" mass="1"/>'
# Two links that stand upright, and a gripper of two hinges and a slide.
ARM = f"""<mujoco><compiler angle="radian"/><worldbody>
  <body name="a" pos="0 0 0.1"><joint name="j1" axis="0 1 0" range="-2 2"/>{LINK}
    <body name="b" pos="0 0 0.3"><joint name="j2" axis="0 1 0" range="-2 2"/>{LINK}
      <body name="l" pos="0.03 0 0.3"><joint name="gl" axis="0 1 0" range="0 0.8"/>
        <geom type="box" size="0.01 0.01 0.03" pos="0 0 0.03" mass="0.05"/></body>
      <body name="r" pos="-0.03 0 0.3"><joint name="gr" type="slide" axis="1 0 0" range="0 0.1"/>
        <geom type="box" size="0.01 0.01 0.03" pos="0 0 0.03" mass="0.05"/></body>
    </body></body></worldbody></mujoco>"""
POSES = {"kind": "poses", "positions": 1}
TWO = ["j1", "j2"]


def written(folder: Path, text: str) -> Path:
    """A file of joints."""
    file = folder / "joints.yaml"
    file.write_text(text)
    return file


def compensator(joints: Any, **options: Any) -> PositionCompensator:
    """Of the arm."""
    return PositionCompensator.from_model(mujoco.MjModel.from_xml_string(ARM), joints, **options)


def lead(joints: Any, **options: Any) -> float:
    """Of the shoulder over its torque, at a pose [rad/(N·m)]."""
    made = compensator(joints, **options)
    q = np.array([0.5, 0.5])
    return float((made.command(q) - q)[0] / made.torque(q)[0])


def sag(
    joints: Any, policy: str = "uncompensated", scenario: str = "ideal", model: str = ARM
) -> float:
    """Of the end effector at static poses, rms [m]."""
    env = gymnasium.make(
        "elastic_env/Robot-v0", model=model, joints=joints, scenario=scenario, reference=POSES
    )
    return float(metrics_of(env, policy)["end_effector_error_rms_m"])


@pytest.mark.parametrize(
    ("servo", "expected"),
    [
        ("{position_gain: 800}", 1.0 / 400.0 + 1.0 / 800.0),
        ("{position_gain: 800, velocity_gain: 9}", 1.0 / 400.0 + 1.0 / 800.0),
        ("{position_gain: 800, integral_gain: 0}", 1.0 / 400.0 + 1.0 / 800.0),
        ("{position_gain: 800, integral_gain: 5}", 1.0 / 400.0),
        ("{integral_gain: 5}", 1.0 / 400.0),
        ("{torque_limit: 50}", 1.0 / 400.0),
        ("{}", 1.0 / 400.0),
    ],
)
def test_a_servo_means_the_same_to_compensator_and_environment(
    servo: str, expected: float, tmp_path: Path
) -> None:
    """Catches a servo that one of them does not read, and an integrator that nobody gave it."""
    file = written(tmp_path, f'"*": {{stiffness: 400, servo: {servo}}}\n"g*": held\n')
    assert lead(file) == pytest.approx(expected, rel=1e-12)
    plant = (config := configure_robot(ARM, file, scenario="ideal")).robot.plant(config)
    in_series = 1.0 / plant.assumed.rest_stiffness("tendon")
    np.testing.assert_allclose(in_series, expected, rtol=1e-12)


def test_a_position_gain_alone_sags_in_simulation_and_is_taken_back() -> None:
    """Catches an integrator that holds what a P servo lets go. The judge is the balance of
    springs in series."""
    soft = {"*": {"stiffness": 400, "servo": {"position_gain": 800}}, "g*": "held"}
    config = configure_robot(ARM, soft, scenario="ideal", reference=POSES)
    plant = config.robot.plant(config)
    plan = plant.motion.plan(np.random.default_rng(0), 0.004)
    q_ref = plan.q[plan.scored]
    q = q_ref.copy()
    for _ in range(100):
        q = q_ref - plant.static_torque(q) * (1.0 / 400.0 + 1.0 / 800.0)
    assert plant.end_effector is not None
    expected = float(np.sqrt(np.mean(plant.end_effector.errors(q_ref, q)[0] ** 2)))
    assert sag(soft) == pytest.approx(expected, rel=1e-3)
    assert sag(soft, "input") < 0.02 * expected


def test_held_joints_are_left_out_of_the_commands(tmp_path: Path) -> None:
    """Catches a file that the environment takes and the compensator does not; torque in closed
    form."""
    made = compensator(written(tmp_path, '"*": 400\n"g*": held\n'))
    assert made.joints == ("j1", "j2")
    grip = 0.05 * np.array([np.sin(1.0) * 0.33 + np.cos(1.0) * x for x in (0.03, -0.03)])
    elbow = -G * (0.15 * np.sin(1.0) + grip.sum())
    shoulder = elbow - G * (0.15 + 0.3 + 0.03) * np.sin(0.5)
    np.testing.assert_allclose(made.torque([0.5, 0.5]), [shoulder, elbow], rtol=1e-9)
    assert list(configure_robot(ARM, tmp_path / "joints.yaml").joints) == TWO
    with pytest.raises(
        ConfigurationError, match="'gl' is named by `joints`, but held in stiffness"
    ):
        PositionCompensator.from_model(
            mujoco.MjModel.from_xml_string(ARM), {"g*": "held", "j*": 4}, joints=["j1", "gl"]
        )
    with pytest.raises(ConfigurationError, match="all joints are held"):
        compensator({"*": "held"})


def test_what_a_file_leaves_out_is_rigid_and_said(tmp_path: Path) -> None:
    """Catches a file of an identification of some joints, as `--joints` writes it, that the
    compensator refuses."""
    file = written(tmp_path, "j2: {stiffness: 400}\n")
    with pytest.warns(
        UserWarning,
        match="leaves out j1, gl, taken for rigid; write j1: rigid, j1: held or its stiff",
    ):
        made = compensator(file)
    q = np.array([0.5, 0.5, 0.0])
    np.testing.assert_allclose(
        (made.command(q) - q) / made.torque(q), [0.0, 1.0 / 400.0, 0.0], atol=1e-15
    )
    assert list(configure_robot(ARM, file).joints) == ["j2"]
    with pytest.raises(
        ConfigurationError, match="stiffness of joint 'j1' is missing; give 'j1' or a pattern"
    ):
        compensator({"j2": 400.0})
    with pytest.raises(ConfigurationError, match="stiffness of joint 'j1' is missing"):
        compensator(written(tmp_path, "gr: held\n"))


@pytest.mark.parametrize("rigid", ["rigid", ".inf", "{stiffness: rigid}", "{stiffness: .inf}"])
def test_rigid_joints_are_said_by_word_or_number(rigid: str, tmp_path: Path) -> None:
    """Catches a joint without a spring that one reader takes and the other refuses."""
    file = written(tmp_path, f'j1: {rigid}\nj2: 400\n"g*": held\n')
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made = compensator(file)
    assert made.joints == ("j1", "j2")
    q = np.array([0.5, 0.5])
    assert made.command(q)[0] == 0.5
    assert list(configure_robot(ARM, file).joints) == ["j2"]


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        (
            {"*": 400, "gr": 300},
            "unknown joint or pattern of joints 'gr'; choose one of: j1, j2, gl",
        ),
        ({"*": 400, "gx": "held"}, "unknown joint or pattern of joints 'gx'"),
        ({"*": {"stiffness": 400, "colour": 3}}, "joint 'j1':.*colour"),
        ({"*": {"stiffness": 400, "servo": {"kp": 3}}}, "joint 'j1':.*kp"),
        (
            {"*": {"stiffness": 400, "servo": {"integral_gain": 0}}},
            "servo of joint 'j1' gives way.*give its position",
        ),
        ({"*": {"stiffness": "soft"}}, "joint 'j1':.*stiffness"),
        (
            {"*": {"damping": 3}},
            "stiffness of joint 'j1' is missing beside.*'damping'.*elastic identify --robot",
        ),
        ({"*": 1e-320}, "joint 'j1':.*stiffness must be .* >= 1e-09"),
        ({"*": math.nan}, "joint 'j1':.*stiffness"),
        ({"*": "stiff"}, "joint 'j1':.*stiffness"),
        ({0: 400}, "unknown joint or pattern of joints 0"),
    ],
)
def test_both_refuse_the_same_with_the_same_words(joints: Any, message: str) -> None:
    """Catches two readers that judge differently."""
    with pytest.raises(ConfigurationError, match=message):
        compensator(joints)
    with pytest.raises(ConfigurationError, match=message):
        configure_robot(ARM, joints)


def test_what_the_compensator_cannot_use_it_refuses_by_name() -> None:
    """Catches a dead band that stays without a word, and gains that are said twice."""
    with pytest.raises(
        ConfigurationError, match=r"backlash of joint 'j1' is 0.002 rad.*0.001 rad remain"
    ):
        compensator({"*": {"stiffness": 400, "backlash": 2e-3}})
    with pytest.raises(ConfigurationError, match="servo of joint 'j1' is given twice"):
        compensator({"*": {"stiffness": 400, "servo": {"position_gain": 800}}}, position_gain=600.0)
    full = {
        "stiffness": 400,
        "damping": 3,
        "rotor_inertia": 0.1,
        "coulomb_friction": 1.0,
        "viscous_friction": 2.0,
        "encoder_counts_per_turn": 4096,
        "servo": {"velocity_gain": 3.0, "torque_limit": 9.0},
    }
    assert lead({"j*": full, "gl": "held"}) == pytest.approx(1.0 / 400.0)
    rigid = {"*": {"stiffness": math.inf, "servo": {"position_gain": 800}}}
    assert lead(rigid | {"gl": "held"}) == pytest.approx(1.0 / 800.0)
    with pytest.raises(
        ConfigurationError, match="'j1' is rigid and its servo gives way, which is not simulated"
    ):
        configure_robot(ARM, rigid)


def test_names_that_look_like_something_else_are_names(tmp_path: Path) -> None:
    """Catches "0", "no", "null" and a name with brackets, which is no pattern of itself."""
    names = ["0", "no", "null", "1e3", 'a"b', "j[1]", "x*"]
    text = '"0": 1\n"no": 2\n"null": 3\n"1e3": 4\n\'a"b\': 5\n"j[1]": 6\n"x*": 7\n'
    found = read_joints(written(tmp_path, text), names)
    assert {name: own.stiffness for name, own in found.items() if own} == {
        n: k for k, n in enumerate(names, 1)
    }


def test_a_name_goes_before_patterns_and_a_later_pattern_before_an_earlier_one() -> None:
    """Catches another order, and settings that lose their type."""
    own = JointSettings(stiffness=3.0)
    found = read_joints({"j1": own, "*": 1.0, "j*": 2.0, "gl": "held"}, ["j1", "j2", "gl", "other"])
    assert found["j1"] is own
    assert found["gl"] is None
    assert [found[name].stiffness for name in ("j2", "other")] == [2.0, 1.0]  # type: ignore[union-attr]


# The model's drive.

DRIVEN = ARM.replace('<joint name="j1"', '<joint name="j1" armature="0.1" damping="5"').replace(
    '<joint name="j2"', '<joint name="j2" armature="0.1" damping="5"'
)
KV0 = DRIVEN.replace(
    "</mujoco>",
    '<actuator><position joint="j1" kp="100"/><position joint="j2" kp="100"/></actuator></mujoco>',
)


@pytest.mark.parametrize("scenario", ["ideal", pytest.param("nominal", marks=pytest.mark.slow)])
def test_what_damps_a_servo_is_no_friction(scenario: str) -> None:
    """Catches a rotor that swings for minutes in `ideal`, as its only damping is left out with
    the friction."""
    joints = {"j*": 400}
    config = configure_robot(KV0, joints)
    assert [one.servo.velocity_gain for one in config.joints.values() if one.servo] == [5.0, 5.0]
    assert [one.viscous_friction for one in config.joints.values()] == [0.0, 0.0]
    without = sag(joints, model=KV0)
    assert without > 5e-3
    assert sag(joints, "input", scenario, model=KV0) < 1e-5


@pytest.mark.parametrize(
    ("actuators", "gain", "friction"),
    [
        ('<position joint="j1" kp="100" kv="7"/>', 7.0, 5.0),
        ('<position joint="j1" kp="100" kv="2"/>', 7.0, 0.0),
        ('<position joint="j1" kp="100" kv="2" gear="2"/>', 8.0, 5.0),
        ('<position joint="j1" kp="100"/><velocity joint="j1" kv="6"/>', 6.0, 5.0),
        ('<position joint="j1" kp="100"/><motor joint="j1" damping="9"/>', 9.0, 5.0),
    ],
)
def test_the_velocity_gain_is_what_damps_the_servo(
    actuators: str, gain: float, friction: float
) -> None:
    """Catches damping that counts twice, or not at all: gains at the joint, in closed form."""
    model = DRIVEN.replace("</mujoco>", f"<actuator>{actuators}</actuator></mujoco>")
    joint = configure_robot(model, {"j*": 400}).joints["j1"]
    assert joint.servo is not None
    assert (joint.servo.velocity_gain, joint.viscous_friction) == (gain, friction)
    given = configure_robot(
        model, {"j*": {"stiffness": 400, "servo": {"velocity_gain": 3}}}
    ).joints["j1"]
    assert given.servo is not None
    assert (given.servo.velocity_gain, given.viscous_friction) == (3.0, 5.0)


def test_a_servo_that_nothing_damps_is_damped_and_said() -> None:
    """Catches a swing that never ends, and an assumption without its value. Critical damping in
    closed form."""
    model = KV0.replace(' damping="5"', "")
    with pytest.warns(UserWarning, match="velocity_gain of j1 .* N·m·s/rad, critical damping"):
        joint = configure_robot(model, {"j*": 400}).joints["j1"]
    data = mujoco.MjData(compiled := mujoco.MjModel.from_xml_string(model))
    mujoco.mj_forward(compiled, data)
    mass = np.zeros((compiled.nv, compiled.nv))
    mujoco.mj_fullM(compiled, data, mass)
    assert joint.servo is not None
    assert joint.servo.velocity_gain == pytest.approx(2.0 * math.sqrt(100.0 * mass[0, 0]), rel=0.01)
    assert sag({"j*": 400}, "input", model=model) < 1e-5


def test_armature_of_an_actuator_is_rotor_inertia() -> None:
    """Catches a rotor that is counted by the link, or not at all."""
    motor = '<actuator><motor joint="j1" armature="0.02" gear="3"/></actuator></mujoco>'
    model = DRIVEN.replace("</mujoco>", motor)
    compiled = mujoco.MjModel.from_xml_string(model)
    assert rotor_inertia(compiled, "j1") == pytest.approx(0.1 + 9.0 * 0.02)
    assert position_servo(compiled, "j1") is None
    with_motor, without = (
        configure_robot(text, {"j*": 400}).joints["j1"] for text in (model, DRIVEN)
    )
    assert with_motor.rotor_inertia == pytest.approx(0.28)
    assert with_motor.servo is not None
    assert without.servo is not None
    reserve = with_motor.servo.torque_limit - without.servo.torque_limit
    assert reserve == pytest.approx(20.0 * 0.18, rel=1e-6)


def test_a_force_range_that_pushes_one_way_is_refused_by_name() -> None:
    """Catches a limit that is ignored as if there were none."""
    model = ARM.replace(
        "</mujoco>", '<actuator><motor joint="j1" ctrlrange="0 20"/></actuator></mujoco>'
    )
    with pytest.raises(
        ConfigurationError, match=r"force range of joint 'j1' is 0 to 20.*give its torque_limit"
    ):
        configure_robot(model, {"j*": 400})
    given = configure_robot(model, {"j*": {"stiffness": 400, "servo": {"torque_limit": 20}}})
    assert given.joints["j1"].servo is not None
    assert given.joints["j1"].servo.torque_limit == 20.0


DRIVES = """<actuator><dcmotor joint="j1" motorconst="1" resistance="1" input="pos vel"
    controller="5 0 5"/><motor joint="j2" ctrlrange="-12 12" gear="5"/>
    <damper joint="j2" kv="10" ctrlrange="0 1"/></actuator>"""
"""A drive with two commands before others, and a damper, whose command is no force."""


def test_a_limit_is_that_of_its_own_command() -> None:
    """Catches commands that are counted as actuators, and a damper that is taken for a drive of
    one direction."""
    model = ARM.replace("</mujoco>", f"{DRIVES}</mujoco>")
    servo = {"position_gain": 800, "velocity_gain": 9}
    found = configure_robot(model, {"j1": {"stiffness": 400, "servo": servo}, "j2": 400})
    assert found.joints["j2"].servo is not None
    assert found.joints["j2"].servo.torque_limit == 60.0
    with pytest.raises(ConfigurationError, match="joint 'j1' has a dcmotor"):
        PositionCompensator.from_model(model, 400)


# Assumptions.


def test_an_assumed_rotor_is_no_heavier_than_its_links() -> None:
    """Catches a rotor of 10 kg·m² beside a link of 0.35, for want of a number."""
    with pytest.warns(
        UserWarning, match=r"rotor_inertia of j1 0\.\d+ kg·m².*K/\(100 rad/s\)² would be 10"
    ):
        joint = configure_robot(ARM, {"j*": 1e5}).joints["j1"]
    assert 0.2 < joint.rotor_inertia < 0.3
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert configure_robot(ARM, {"j*": 300}).joints["j1"].rotor_inertia == pytest.approx(0.03)
        given = configure_robot(ARM, {"j*": {"stiffness": 1e5, "rotor_inertia": 10.0}})
    assert given.joints["j1"].rotor_inertia == 10.0


@pytest.mark.parametrize(
    "stiffness",
    [*(pytest.param(K, marks=pytest.mark.slow) for K in (400, 60)), {"j1": 4000, "j2": 300}],
)
def test_assumed_joints_come_to_rest_in_the_time_that_poses_settle(stiffness: Any) -> None:
    """Catches damping that fits the lightest link only, and an integrator that lets go for
    seconds."""
    joints = stiffness if isinstance(stiffness, dict) else {"j*": stiffness}
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*does not rest")
        without = sag(joints)
        left = sag(joints, "input")
    assert left < 0.002 * without


def test_joints_that_swing_where_they_are_scored_at_rest_are_named() -> None:
    """Catches a score at rest that is one of a swing, without a word."""
    restless = {"j*": {"stiffness": 400, "damping": 0.05}}
    with pytest.warns(
        UserWarning, match=r"joint 'j\d' does not rest where it is scored.*longer settle_s"
    ) as said:
        sag(restless, "input")
    assert len([one for one in said if "does not rest" in str(one.message)]) == 1


def test_a_servo_that_creeps_without_a_weight_is_said_as_such() -> None:
    """Catches a robot whose model carries its weight, of which a compensator "leaves" 100 %, and
    the advice of more damping for a servo that has too much."""
    drive = '<position name="{0}" joint="{0}" kp="10" kv="10"/>'
    drives = "".join(drive.format(name) for name in TWO)
    model = ARM.replace("</mujoco>", f"<actuator>{drives}</actuator></mujoco>")
    model = model.replace('<body name="', '<body gravcomp="1" name="')
    with pytest.warns(
        UserWarning,
        match=r"joint 'j\d' does not rest.*no weight bends the joints, so that nothing is there to "
        r"compensate.*velocity_gain / position_gain = 1 s.*a settle_s of 8 s, or the servo less",
    ):
        sag({"j*": 400}, "input", model=model)
