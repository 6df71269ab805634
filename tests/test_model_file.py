"""The one reader of models: what it reads, what it refuses, and that all who read models agree."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest

import elastic_env  # noqa: F401  registers the environment
from baselines import PositionCompensator
from elastic_env import ElasticJoint, Servo, make_elastic
from elastic_env.core.errors import ConfigurationError
from elastic_env.joint.default_hinges import coupled_fingers
from elastic_env.joint.model_file import compiled_model, read_model
from elastic_env.robots.robot.model import read_robot
from train.commands.robot import Robot, robot_arguments, write_robot

INERTIAL = (
    '<inertial><origin xyz="0 0 0.15"/><mass value="{}"/>'
    '<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.002"/></inertial>'
)
LINK = f'<link name="{{}}">{INERTIAL.format(1.0)}{{}}</link>'
JOINT = (
    '<joint name="{}" type="revolute"><origin xyz="0 0 {}"/><parent link="{}"/><child'
    ' link="{}"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="60"'
    ' velocity="3"/>{}</joint>'
)
TORQUE = [-3.35464859, -1.23822455]
"""Of the arm below at (0.5, 0.5) rad, by MuJoCo's own inverse dynamics [N·m]."""


def urdf(fore: str = "", also: str = "", second: str = "elbow", head: str = "") -> str:
    links = LINK.format("base", "") + LINK.format("upper", "") + LINK.format("fore", fore)
    joints = JOINT.format("shoulder", 0.1, "base", "upper", "") + JOINT.format(
        second, 0.3, "upper", "fore", ""
    )
    return f'{head}<robot name="arm">{links}{joints}{also}</robot>'


FINGERS = (
    LINK.format("fl", "")
    + LINK.format("fr", "")
    + JOINT.format("finger_l", 0.3, "fore", "fl", "")
    + JOINT.format("finger_r", 0.3, "fore", "fr", '<mimic joint="finger_l" multiplier="-1"/>')
)
ROD = '<geom type="capsule" fromto="0 0 0 0 0 0.3" size="0.02" mass="1"/>'


def mjcf(hand: str = "", also: str = "", first: str = 'name="j1"', head: str = "") -> str:
    return (
        f'<mujoco><compiler angle="radian"/>{head}<worldbody><body name="a" pos="0 0 0.1"><joint'
        f' {first} axis="0 1 0"/>{ROD}<body name="b" pos="0 0 0.3"><joint name="j2" axis="0 1'
        f' 0"/>{ROD}{hand}</body></body></worldbody>{also}</mujoco>'
    )


FINGER = (
    '<body name="{0}" pos="{1} 0 0.3"><joint name="g{0}" axis="0 1 0"/>'
    '<geom type="box" size="0.01 0.01 0.03" pos="0 0 0.03" mass="0.05"/></body>'
)
HAND = FINGER.format("l", 0.03) + FINGER.format("r", -0.03)
LOOP = '<equality><connect body1="l" body2="r" anchor="-0.03 0 0.06"/></equality>'
HELD_HAND = [-3.76815293, -1.51063396]
"""Of the arm with its hand held, at (0.5, 0.5) rad, by MuJoCo [N·m]."""


def tied(*joints: str, attributes: str = "") -> str:
    parts = "".join(f'<joint joint="{joint}" coef="1"/>' for joint in joints)
    return f'<tendon><fixed name="cord" {attributes}>{parts}</fixed></tendon>'


def robot(model: Any, joints: Any = 400.0) -> Any:
    given = joints if isinstance(joints, dict) else {"*": joints}
    return gymnasium.make("elastic_env/Robot-v0", model=model, joints=given)


READERS: list[Callable[[Any], Any]] = [
    robot,
    lambda model: PositionCompensator.from_model(model, 400.0),
]


def refusals(model: Any) -> list[str]:
    """What everybody says of a model."""
    said = []
    for read in READERS:
        with pytest.raises(ConfigurationError) as error:
            read(model)
        said.append(str(error.value))
    return said


LOST_MESH = '<asset><mesh name="lost" file="nowhere.stl"/></asset>'
VISUAL = '<geom type="mesh" mesh="lost" mass="0"/>'


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ('<actuator><motor name="m" joint="nobody"/></actuator>', "unknown transmission target"),
        ('<equality><joint joint1="j2" joint2="j2"/></equality>', "'j2' is repeated in equality"),
        ('<sensor><jointpos joint="nobody"/></sensor>', "unrecognized name 'nobody'"),
        (tied("nobody"), "joint 'nobody' not found in tendon"),
        ('<contact><exclude body1="a" body2="nobody"/></contact>', "'nobody' not found"),
    ],
)
@pytest.mark.parametrize("lost", [True, False])
def test_an_element_that_refers_to_nothing_is_refused(part: str, message: str, lost: bool) -> None:
    """Catches a drive or a loop that MuJoCo leaves out of a copy without a word, beside a mesh
    that is missing and in a specification."""
    model: Any = mjcf(VISUAL if lost else "", part, head=LOST_MESH if lost else "")
    if not lost:
        model = mujoco.MjSpec.from_string(model)
    first, second = refusals(model)
    assert first == second
    assert message in first
    with pytest.raises(ConfigurationError, match=message):
        make_elastic(model, {"j2": ElasticJoint(stiffness=400.0, damping=2.0, rotor_inertia=0.05)})


SLIDES = mjcf(first='name="j1" type="slide"').replace('name="j2"', 'name="j2" type="slide"')
SLIDES_AND_A_HINGE = SLIDES.replace('name="j2" type="slide"', "")
FLOATS = mjcf(first='type="free"').replace('axis="0 1 0"', "", 1)


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (SLIDES, "the model has no hinge"),
        (SLIDES_AND_A_HINGE, "a hinge of the model has no name"),
        (FLOATS, "free or a ball joint.*Without compensation elastic_env.make_elastic takes it"),
    ],
)
@pytest.mark.parametrize("joints", [{"*": 400.0}, {"nobody": 400.0}, "nowhere.yaml"])
def test_what_no_joint_of_a_model_can_cure_is_said_first(
    model: str, message: str, joints: Any
) -> None:
    """Catches two readers that name different faults, such as "unknown joint '*'" of a model
    without hinges."""
    with pytest.raises(ConfigurationError, match=message) as one:
        gymnasium.make("elastic_env/Robot-v0", model=model, joints=joints)
    with pytest.raises(ConfigurationError, match=message) as other:
        PositionCompensator.from_model(model, joints)
    assert str(one.value) == str(other.value)


ELASTIC = ElasticJoint(stiffness=400.0, damping=2.0, rotor_inertia=0.05)


@pytest.mark.parametrize("model", [SLIDES, SLIDES.replace('name="j1" type="slide"', "")])
def test_a_model_without_a_named_hinge_is_refused_by_all_three(model: str) -> None:
    """Catches an elastic model without elastic joints."""
    (refused,) = set(refusals(model))
    with pytest.raises(ConfigurationError) as error:
        make_elastic(model, {})
    assert str(error.value) == refused


@pytest.mark.parametrize("flag", ["spring", "damper"])
def test_a_flag_that_turns_elastic_joints_off_is_refused_by_all_three(flag: str) -> None:
    """Catches links that hang on no spring, or swing for ever, without a word."""
    model = mjcf(head=f'<option><flag {flag}="disable"/></option>')
    (refused,) = set(refusals(model))
    assert f'<flag {flag}="disable"/> in <option>' in refused
    with pytest.raises(ConfigurationError) as error:
        make_elastic(model, {"j2": ELASTIC})
    assert str(error.value) == refused


@pytest.mark.parametrize("flag", ["frictionloss", "constraint"])
def test_a_flag_that_turns_friction_off_is_refused_where_joints_have_some(flag: str) -> None:
    """Catches a friction of the joints that is nowhere in the simulation, and a loop that does not
    act and is a reason to refuse."""
    model = mjcf(head=f'<option><flag {flag}="disable"/></option>')
    message = f'<flag {flag}="disable"/> in <option>'
    rubbing = ELASTIC.replace(coulomb_friction=0.5)
    with pytest.raises(ConfigurationError, match=message):
        make_elastic(model, {"j2": rubbing})
    with pytest.raises(ConfigurationError, match=message):
        robot(model, {"*": {"stiffness": 400.0, "coulomb_friction": 0.5}})
    make_elastic(model, {"j2": ELASTIC})
    np.testing.assert_allclose(torque(model), TORQUE, rtol=1e-6)
    if flag == "constraint":
        looped = mjcf(HAND, LOOP, head=f'<option><flag {flag}="disable"/></option>')
        PositionCompensator.from_model(looped, 400.0)


def test_a_servo_needs_actuation() -> None:
    """Catches a servo that is added to a model whose actuators are off."""
    model = mjcf(head='<option><flag actuation="disable"/></option>')
    make_elastic(model, {"j2": ELASTIC})
    servo = Servo(position_gain=500.0, torque_limit=50.0, speed_limit=5.0)
    with pytest.raises(ConfigurationError, match='<flag actuation="disable"/>'):
        make_elastic(model, {"j2": ELASTIC.replace(servo=servo)})


def test_an_arm_whose_bodies_have_no_name_is_played() -> None:
    """Catches an end effector that is only found by name."""
    nameless = mjcf().replace('body name="a"', "body").replace('body name="b"', "body")
    assert [body.name for body in read_robot(nameless).bodies] == ["world", "body_1", "body_2"]
    robot(nameless).close()


LOOPED = mjcf(HAND, LOOP)
DRIVEN = mjcf(also=tied("j1", "j2") + '<actuator><motor name="m" tendon="cord"/></actuator>')
BLOWN = mjcf(head='<option wind="9 0 0" density="1.2"/>')
SPRUNG = mjcf(also=tied("j1", "j2", attributes='stiffness="3"'))
BALL = FLOATS.replace("free", "ball")
WEIGHTLESS = mjcf(head='<option><flag gravity="disable"/></option>')
CURVED = mjcf(first='name="j1" stiffness="3 2"')


@pytest.mark.parametrize("model", [FLOATS, BALL, LOOPED, DRIVEN, BLOWN, SPRUNG, WEIGHTLESS, CURVED])
def test_make_elastic_takes_what_nobody_can_compensate(model: str) -> None:
    """Catches a list of the docs that is not true: MuJoCo computes what is not known in
    advance."""
    for read in (robot, PositionCompensator.from_model):
        with pytest.raises(ConfigurationError):
            read(model, {"*": 400.0})
    joint = ElasticJoint(stiffness=400.0, damping=2.0, rotor_inertia=0.05)
    elastic = make_elastic(model, {"j2": joint}).compile()
    assert elastic.joint("j2_motor").id >= 0


def torque(model: Any, **options: Any) -> list[float]:
    return PositionCompensator.from_model(model, 400.0, **options).torque([0.5, 0.5]).tolist()


@pytest.mark.parametrize(
    "text",
    [
        urdf(also='<drake:group name="g"><drake:member link="fore"/></drake:group>'),
        urdf().replace("<robot", '<robot xmlns="http://drake.mit.edu"'),
        urdf(head="\ufeff<?xml version='1.0'?>\n"),
        urdf(head="\n  <!-- robot_description of ROS -->"),
        urdf().replace('name="arm"', 'name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro"'),
    ],
)
def test_a_model_is_read_as_the_programs_read_it_that_it_was_written_for(
    text: str, tmp_path: Path
) -> None:
    """Catches prefixes without namespace that end as "no XML", and text that only one reader
    takes."""
    file = tmp_path / "arm.urdf"
    file.write_text(text, encoding="utf-8")
    for model in (text, file, str(file)):
        np.testing.assert_allclose(torque(model), TORQUE, rtol=1e-7)
    robot(text).close()


@pytest.mark.parametrize(
    "encoding", ["gbk", "Shift_JIS", "UTF-16", "ISO-8859-1", "utf-8", "UTF-8-SIG"]
)
@pytest.mark.parametrize("kind", ["urdf", "xml"])
def test_a_file_is_read_by_its_own_encoding(encoding: str, kind: str, tmp_path: Path) -> None:
    """Catches encodings of several bytes that end as a ValueError, and MJCF that MuJoCo reads as
    UTF-8 alone."""
    part = "ärm" if encoding == "ISO-8859-1" else "腕"
    declared = "utf-8" if encoding == "UTF-8-SIG" else encoding
    text = f'<?xml version="1.0" encoding="{declared}"?>'
    text += (
        urdf().replace('"fore"', f'"{part}"')
        if kind == "urdf"
        else mjcf().replace('name="b"', f'name="{part}"')
    )
    file = tmp_path / f"arm.{kind}"
    file.write_bytes(text.encode(encoding))
    model = compiled_model(file)
    assert part in {model.body(i).name for i in range(model.nbody)}
    np.testing.assert_allclose(torque(file), TORQUE, rtol=1e-7)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            b'<?xml version="1.0" encoding="no-such"?><robot/>',
            r"encoding 'no-such', which is not known; save.*UTF-8",
        ),
        (
            b'<?xml version="1.0" encoding="zip"?><robot/>',
            r"'zip', which is not known; save the file in UTF-8",
        ),
        (b'<?xml version="1.0" encoding="idna"?><robot/>', r"'idna', which is not known"),
        (
            b'<?xml version="1.0" encoding="gbk"?><robot name="\xff\xff"/>',
            r"not in its encoding, gbk; save .*UTF-8",
        ),
        (b"<robot name='\xe4'/>", r"not in its encoding, utf-8; save the file in UTF-8"),
        (b"", r"is no XML: no element found"),
        (b"<a><b></a>", r"is no XML: mismatched tag"),
        (b"<sdf/>", r"root of .* must be <mujoco> or <robot>, got 'sdf'"),
        (
            b'<!DOCTYPE r [<!ENTITY a "b">]><robot name="&a;"/>',
            r"declares the entity 'a', which is not read",
        ),
        (
            b'<!DOCTYPE r [<!ENTITY a SYSTEM "/etc/passwd">]><robot>&a;</robot>',
            r"declares the entity 'a'",
        ),
        (
            b"<robot>" + b"<link>" * 300 + b"</link>" * 300 + b"</robot>",
            r"at most 200 elements deep",
        ),
    ],
)
def test_what_is_no_model_is_said(content: bytes, message: str, tmp_path: Path) -> None:
    """Catches tracebacks of codecs, of the XML parser and of its recursion, and entities that
    grow or read files."""
    file = tmp_path / "arm.urdf"
    file.write_bytes(content)
    first, second = refusals(file)
    assert first == second
    with pytest.raises(ConfigurationError, match=message):
        compiled_model(file)


@pytest.mark.parametrize(
    "text",
    [
        urdf(also="<xacro:hand/>"),
        urdf(also='<x:hand xmlns:x="nothing"/>').replace(
            "<robot", '<robot xmlns:x="http://wiki.ros.org/xacro"'
        ),
        urdf().replace('<mass value="1.0"/>', '<mass xacro:value="1.0"/>', 1),
        urdf().replace('value="1.0"', 'value="${mass}"', 1),
        urdf().replace('name="arm"', 'name="$(arg name)"'),
        urdf(also='<include filename="hand.urdf"/>'),
        '<robot name="a"><xacro:include filename="arm.xacro"/></robot>',
    ],
)
def test_xacro_has_to_be_expanded_first(text: str) -> None:
    """Catches a hand that is left out without a word, as MuJoCo ignores elements that it does
    not know."""
    for said in refusals(text):
        assert "expand it first: xacro arm.urdf.xacro > arm.urdf" in said


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (
            urdf(second="shoulder"),
            r"has the joint 'shoulder' 2 times; give each joint its own name",
        ),
        (urdf(also=LINK.format("fore", "")), r"has the link 'fore' 2 times"),
        (
            urdf(also=JOINT.format("loop", 0.1, "base", "fore", "")),
            r"link 'fore' .* is the child of two joints",
        ),
        (urdf(also=JOINT.format("loop", 0.1, "fore", "base", "")), r"joined in a circle"),
        (
            urdf(also=JOINT.format("x", 0.1, "base", "lost", "")),
            r"joint 'x' .* needs a child that is a link .*'lost'",
        ),
        (urdf().replace('lower="-2"', 'lower="3"', 1), r"limit"),
        (
            urdf().replace('value="1.0"', 'value="nan"', 1),
            r"value of <mass> .* must be numbers, got 'nan'",
        ),
        (urdf().replace('value="1.0"', 'value="1e999"', 2), r"mass of body|mass"),
        (
            urdf().replace(INERTIAL.format(1.0) + "</link><joint", "</link><joint"),
            r"every link that moves needs a mass",
        ),
        (
            urdf(
                fore='<visual><geometry><mesh filename="package://a/b.stl"/></geometry></visual>'
            ).replace('izz="0.002"', 'izz="0.2"'),
            r"no main value above the sum",
        ),
        (
            mjcf(first='name="j1" armature="-1"'),
            r"armature of joint 'j1' .* must be finite and >= 0, got",
        ),
        (mjcf(first='name="j1" damping="-1"'), r"damping of joint 'j1'"),
        (
            mjcf(first='name="j1" range="1 -1"'),
            r"limits of joint 'j1' .* contradict themselves: 1 to -1",
        ),
        (
            mjcf(first='name="j1" range="1 -1" limited="true"'),
            r"lower limit must be below the upper one",
        ),
        (mjcf(head='<option gravity="0 0 nan"/>'), r"gravity of <option> .* must be numbers"),
        (
            mjcf(head='<option><flag gravity="disable"/></option>'),
            r'<flag gravity="disable"/> .*take the flag out',
        ),
        (mjcf(head='<option><flag spring="disable"/></option>'), r'<flag spring="disable"/>'),
        (mjcf(head='<option wind="9 0 0" density="1.2"/>'), r"has wind, whose force on the links"),
        (mjcf(first='axis2="1"'), r"unrecognized attribute"),
        (
            mjcf(also='<keyframe><key qpos="1 2 3"/></keyframe>'),
            r"invalid qpos size, expected 2, got 3",
        ),
        (
            mjcf(also='<equality><connect body1="a" body2="lost" anchor="0 0 0"/></equality>'),
            r"unknown element 'lost'",
        ),
        (
            mjcf(first='name="j1" axis="0 1 0"/><joint name="j0"'),
            r"that j. and j. move have no inertia.*one axis",
        ),
        (mjcf(first=""), r"a hinge of the model has no name; give each one"),
        (mjcf(first='type="free"').replace('axis="0 1 0"', "", 1), r"free or a ball joint"),
        (b"<robot/>", r"a model must be a file .*, got b'<robot/>'"),
        ("\0", r"no model at"),
        ("x" * 100_000, r"no model at 'xxx"),
        ("{" + "x" * 100_000, r"no model at"),
        (".", r"no model at .: it is no regular file"),
    ],
)
def test_everybody_refuses_a_bad_model_in_the_same_words(model: Any, message: str) -> None:
    """Catches tracebacks of MuJoCo and NumPy, models that one reader takes, and text that floods
    the terminal."""
    first, second = refusals(model)
    assert first == second
    assert len(first) < 700
    with pytest.raises(ConfigurationError, match=message):
        raise ConfigurationError(first)


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (
            mjcf(HAND, LOOP.replace('body1="l"', 'body1="b"').replace('"r"', '"a"')),
            r"equality constraint of b and a",
        ),
        (mjcf(HAND, LOOP), r"equality constraint of l and r.*'gl: held', 'gr: held'"),
        (
            mjcf(HAND, tied("gl", "gr", attributes='stiffness="3"')),
            r"tendon 'cord' has stiffness.*'gl: held'",
        ),
        (mjcf(HAND, tied("gl", "gr", attributes='armature="3"')), r"tendon 'cord' has .*inertia"),
        (
            mjcf(
                also=tied("j1", "j2")
                + '<actuator><position name="s" tendon="cord" kp="30"/></actuator>'
            ),
            (
                r"actuator 's' drives j1, j2 by a tendon, which is not compensated; drive each"
                r" joint .*out of the model$"
            ),
        ),
        (
            mjcf(HAND, tied("j2", "gl") + '<actuator><motor name="m" tendon="cord"/></actuator>'),
            r"actuator 'm' drives j2, gl by a tendon.*'j2: held', 'gl: held'",
        ),
        (
            mjcf(
                '<site name="tip"/>',
                '<actuator><general name="jet" site="tip" gear="1 0 0 0 0 0"/></actuator>',
            ),
            r"actuator 'jet' drives j1, j2 by a site",
        ),
    ],
)
def test_what_acts_beside_the_joints_is_refused_with_its_name(model: str, message: str) -> None:
    """Catches a drive or a constraint that is taken out without a word, and advice that does not
    help."""
    first, second = refusals(model)
    assert first == second
    with pytest.raises(ConfigurationError, match=message):
        raise ConfigurationError(first)


@pytest.mark.parametrize(
    ("model", "expected"),
    [
        (mjcf(HAND, LOOP), HELD_HAND),
        (mjcf(HAND, tied("gl", "gr", attributes='stiffness="3"')), HELD_HAND),
        (
            mjcf(HAND, tied("gl", "gr") + '<actuator><position tendon="cord"/></actuator>'),
            HELD_HAND,
        ),
        (
            mjcf(
                also=(
                    '<equality><connect body1="b" body2="world" anchor="0 0 0.3"'
                    ' active="false"/></equality>'
                )
            ),
            TORQUE,
        ),
        (
            mjcf(
                '<body name="f" pos="0 0 0.3"><joint type="slide"/><geom size=".02"'
                ' mass="1e-9"/></body>'
            ),
            TORQUE,
        ),
    ],
)
def test_what_is_held_is_no_reason_to_refuse(model: str, expected: list[float]) -> None:
    """Catches loops, tendons and slides without a name within a held gripper, and constraints
    that do not act."""
    np.testing.assert_allclose(torque(model, joints=["j1", "j2"]), expected, rtol=1e-6)
    robot(model, {"j*": 400.0}).close()


def test_a_joint_without_a_name_is_held_where_nobody_commands_it() -> None:
    """Catches an empty name as a key. Closed form: elbow alone, whose rod and finger hang from
    it."""
    finger = (
        '<body pos="0 0 0.3"><joint type="slide" axis="0 0 1"/><geom size=".02" mass=".1"/></body>'
    )
    model = (
        '<mujoco><worldbody><body name="a"><joint name="elbow" axis="0 1'
        f' 0"/>{ROD}{finger}</body></worldbody></mujoco>'
    )
    found = PositionCompensator.from_model(model, 400.0).torque([0.3])
    np.testing.assert_allclose(found, [-9.81 * (1.0 * 0.15 + 0.1 * 0.3) * np.sin(0.3)], rtol=1e-9)
    upper = PositionCompensator.from_model(mjcf(first=""), 400.0, joints=["j2"])
    np.testing.assert_allclose(upper.torque([0.3]), [-9.81 * 0.15 * np.sin(0.3)], rtol=1e-9)
    robot(mjcf(first=""), {"j2": 400.0}).close()


def test_fingers_that_mimic_one_another_are_held_unless_they_are_named() -> None:
    """Catches an arm that is refused for its gripper, and coupled joints of the arm that are
    taken for fingers."""
    model = urdf(also=FINGERS)
    with pytest.warns(
        UserWarning, match="finger_l, finger_r are coupled in the model .*, and are held"
    ):
        env = robot(model)
    assert list(env.unwrapped.task.config.joints) == ["shoulder", "elbow"]
    env.close()
    with pytest.warns(UserWarning, match="finger_l, finger_r are coupled"):
        assert PositionCompensator.from_model(model, 400.0).joints == ("shoulder", "elbow")
    named = {"*": 400.0, "finger_r": 20.0}
    for read in (lambda: robot(model, named), lambda: PositionCompensator.from_model(model, named)):
        with pytest.raises(
            ConfigurationError, match=r"of finger_r and finger_l.*: K', .*'finger_r: held'"
        ):
            read()
    couple = '<equality><joint joint1="j1" joint2="j2"/></equality>'
    assert coupled_fingers(mujoco.MjModel.from_xml_string(mjcf(HAND, couple))) == []


SIDE = (
    '<body name="d{0}" pos="{1} 0 0.3"><joint name="g{0}" axis="0 1 0"/>{2}<body name="f{0}"'
    ' pos="0 0 0.04"><joint name="t{0}" axis="0 1 0"/>{2}</body></body><body name="k{0}"'
    ' pos="{3} 0 0.3"><joint name="k{0}" axis="0 1 0"/>{2}</body>'
)
PAD = '<geom type="box" size="0.01 0.01 0.02" pos="0 0 0.02" mass="0.02"/>'
LINKAGE = SIDE.format("l", 0.03, PAD, 0.01) + SIDE.format("r", -0.03, PAD, -0.01)
CLOSED = "".join(
    f'<connect body1="f{side}" body2="k{side}" anchor="0 0 0.02"/>' for side in ("l", "r")
)


def test_a_gripper_whose_linkage_closes_loops_is_held() -> None:
    """Catches an arm that is refused for its gripper: fingers of four bars, left and right coupled.
    Without a coupling they may be a parallelogram that carries the load."""
    model = mjcf(LINKAGE, f'<equality>{CLOSED}<joint joint1="gl" joint2="gr"/></equality>')
    with pytest.warns(UserWarning, match="gl, tl, kl, gr, tr, kr are coupled in the model"):
        env = robot(model)
    assert list(env.unwrapped.task.config.joints) == ["j1", "j2"]
    env.close()
    with pytest.warns(UserWarning, match="gl, tl, kl, gr, tr, kr are coupled in the model"):
        found = PositionCompensator.from_model(model, 400.0)
    assert found.joints == ("j1", "j2")
    assert "equality constraint of" in refusals(mjcf(LINKAGE, f"<equality>{CLOSED}</equality>"))[0]


@pytest.mark.parametrize(
    ("also", "message"),
    [
        (
            '<worldbody><replicate count="100000000"><site/></replicate></worldbody>',
            "at most 20000 elements.*100000",
        ),
        (
            (
                '<worldbody><replicate count="900"><replicate'
                ' count="900"><site/></replicate></replicate></worldbody>'
            ),
            "at most 20000 elements",
        ),
        (f"<worldbody>{'<site/>' * 21_000}</worldbody>", "at most 20000 elements"),
        ("<worldbody>" + "<body/>" * 3_000 + "</worldbody>", "at most 2000 bodies"),
        (
            '<asset><hfield name="h" nrow="50000" ncol="50000" size="1 1 1 1"/></asset>',
            "4000000 nrow times ncol.*2500000000",
        ),
        (
            '<asset><texture name="t" builtin="flat" width="30000" height="30000"/></asset>',
            "at most 4096 width",
        ),
        (
            '<asset><mesh name="m" builtin="supertorus" params="5000 .3 1 1"/></asset>',
            "at most 300 as params",
        ),
        ('<size nuserdata="2000000000"/>', "at most 1000000 nuserdata"),
        ('<size nkey="2000000000"/>', "at most 10000 nkey"),
        ('<size memory="100T"/>', "memory of <size>"),
        ('<option iterations="1000000000"/>', "at most 10000 iterations"),
        ('<sensor><user dim="500000000"/></sensor>', "at most 10000 dim"),
        ('<compiler><lengthrange timestep="1e-9"/></compiler>', "timestep of <lengthrange>"),
        (
            '<worldbody><flexcomp name="f" count="900 900 1"/></worldbody>',
            "deformable body .<flexcomp>.",
        ),
        (
            "<worldbody>" + "<frame>" * 400 + "</frame>" * 400 + "</worldbody>",
            "at most 200 elements deep",
        ),
    ],
)
def test_a_small_file_does_not_ask_for_much(also: str, message: str) -> None:
    """Catches counts that MuJoCo builds for minutes or that fill the memory."""
    start = time.monotonic()
    for said in refusals(mjcf(also=also)):
        with pytest.raises(ConfigurationError, match=message):
            raise ConfigurationError(said)
    assert time.monotonic() - start < 5.0


def test_a_long_chain_of_links_is_refused() -> None:
    """Catches a URDF of hundreds of joints."""
    links = "".join(f'<link name="l{i}"/>' for i in range(601))
    joints = "".join(JOINT.format(f"j{i}", 0.1, f"l{i}", f"l{i + 1}", "") for i in range(600))
    for said in refusals(f'<robot name="r">{links}{joints}</robot>'):
        assert "at most 500 joints" in said or "at most 20000 elements" in said


def test_files_that_a_model_names_are_regular_and_bounded(tmp_path: Path) -> None:
    """Catches a FIFO that waits for ever, links to devices, circles of files, and a picture that
    fills the memory."""
    os.mkfifo(tmp_path / "fifo.xml")
    (tmp_path / "null.stl").symlink_to("/dev/zero")
    (tmp_path / "self.xml").write_text(
        '<mujoco><asset><model name="q" file="self.xml"/></asset></mujoco>'
    )
    (tmp_path / "loop.xml").write_text('<mujoco><include file="loop.xml"/></mujoco>')
    head = b"\x89PNG\r\n\x1a\n" + b"\0\0\0\rIHDR" + (600_000).to_bytes(4, "big") * 2
    (tmp_path / "large.png").write_bytes(head)
    many = '<worldbody><replicate count="1000000"><site/></replicate></worldbody>'
    (tmp_path / "many.xml").write_text(f"<mujoco>{many}</mujoco>")
    for content, message in (
        (mjcf(head='<include file="fifo.xml"/>'), "fifo.xml: it is no regular file"),
        (mjcf(head='<asset><mesh file="null.stl"/></asset>'), "null.stl, which is no regular file"),
        (mjcf(head='<asset><texture file="large.png" type="2d"/></asset>'), "pixels of pictures"),
        (mjcf(head='<include file="many.xml"/>'), "at most 20000 elements"),
    ):
        (tmp_path / "arm.xml").write_text(content)
        for said in refusals(tmp_path / "arm.xml"):
            assert message in said
    for name, message in (
        ("self.xml", "within itself"),
        ("loop.xml", "within itself"),
        ("fifo.xml", "it is no regular file"),
    ):
        for said in refusals(tmp_path / name):
            assert message in said


def test_a_link_to_a_model_is_read(tmp_path: Path) -> None:
    """Catches folders of colcon, in which all models are symbolic links."""
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "arm.urdf").write_text(urdf())
    (tmp_path / "arm.urdf").symlink_to(tmp_path / "own" / "arm.urdf")
    np.testing.assert_allclose(torque(tmp_path / "arm.urdf"), TORQUE, rtol=1e-7)


def test_options_of_mujoco_in_a_urdf_are_used() -> None:
    """Catches an element <mujoco> that is thrown away: it says the gravity, and how inertias are
    mended."""
    model = urdf(also='<mujoco><option gravity="0 0 -1.62"/></mujoco>')
    np.testing.assert_allclose(torque(model), np.multiply(TORQUE, 1.62 / 9.81), rtol=1e-7)


def test_a_shape_that_mujoco_cannot_read_does_not_change_the_judgement(tmp_path: Path) -> None:
    """Catches a robot that one reader takes and the one with pictures does not."""
    (tmp_path / "bad.stl").write_bytes(b"no mesh")
    for shape in ('<mesh filename="bad.stl"/>', '<box size="0 0 0"/>', '<box size="a b"/>'):
        (tmp_path / "arm.urdf").write_text(
            urdf(fore=f"<visual><geometry>{shape}</geometry></visual>")
        )
        np.testing.assert_allclose(torque(tmp_path / "arm.urdf"), TORQUE, rtol=1e-7)
        with pytest.warns(UserWarning, match="rods between the joints"):
            robot(tmp_path / "arm.urdf").close()


def test_make_elastic_reads_the_same_models() -> None:
    """Catches a raw error of MuJoCo, and a reader of its own."""
    joint = ElasticJoint(stiffness=400.0, damping=4.0, rotor_inertia=0.1)
    spec = make_elastic(urdf(), {"elbow": joint})
    assert spec.compile().joint("elbow_motor").name == "elbow_motor"
    for bad in (urdf(second="shoulder"), mjcf(first='name="j1" armature="-1"')):
        with pytest.raises(ConfigurationError) as error:
            make_elastic(bad, {"elbow": joint})
        assert str(error.value) == refusals(bad)[0]
    with pytest.raises(ConfigurationError, match="MuJoCo cannot compile the specification"):
        make_elastic(
            mujoco.MjSpec.from_string(mjcf().replace('mass="1"', 'mass="0"')), {"j1": joint}
        )


def test_everybody_takes_a_specification_and_says_what_a_compiled_model_is_good_for() -> None:
    spec = mujoco.MjSpec.from_string(mjcf())
    np.testing.assert_allclose(torque(spec), TORQUE, rtol=1e-7)
    np.testing.assert_allclose(torque(spec.compile()), TORQUE, rtol=1e-7)
    assert read_model(spec).spec is not spec
    with pytest.raises(
        ConfigurationError, match=r"a compiled model cannot be made elastic; give its file"
    ):
        robot(spec.compile())


LONG = """
import time, mujoco
from elastic_env.joint.compile_model import call_mujoco
text = '<mujoco><worldbody><replicate count="200000"><site/></replicate></worldbody></mujoco>'
print("now", flush=True)
call_mujoco(lambda: mujoco.MjSpec.from_string(text), "the model", "read")
"""


@pytest.mark.slow
def test_ctrl_c_reaches_a_long_compilation() -> None:
    """Catches MuJoCo in the main thread, which hears no signal for minutes."""
    process = subprocess.Popen(
        [sys.executable, "-c", LONG], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert process.stdout is not None
    process.stdout.readline()
    time.sleep(0.3)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=20.0)
    assert b"KeyboardInterrupt" in said
    assert process.returncode != 0


def test_warnings_of_mujoco_write_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches MUJOCO_LOG.TXT in the folder of a user."""
    monkeypatch.chdir(tmp_path)
    compiled_model(
        urdf(also=FINGERS.replace('"finger_r" type="revolute"', '"finger_r" type="fixed"'))
    )
    assert list(tmp_path.iterdir()) == []


def test_the_command_takes_the_text_of_a_model_and_does_not_print_it(tmp_path: Path) -> None:
    """Catches a mark or a declared encoding that the written file does not have, and a flood on
    the terminal."""
    text = urdf(head='\ufeff<?xml version="1.0" encoding="gbk"?>\n')
    arguments = robot_arguments(Robot(model=text, stiffness=400.0))
    file = write_robot(arguments, tmp_path)
    np.testing.assert_allclose(torque(tmp_path / "model.xml"), TORQUE, rtol=1e-7)
    assert file.name == "robot.yaml"
    with pytest.raises(ConfigurationError) as error:
        robot_arguments(Robot(model="x" * 5_000, stiffness=400.0))
    assert len(str(error.value)) < 700


def test_more_elastic_joints_than_can_be_simulated_are_refused() -> None:
    """Catches eigenvalues of a matrix that takes minutes."""
    bodies = "".join(f'<body><joint name="k{i}" axis="0 1 0"/>{ROD}</body>' for i in range(90))
    model = f'<mujoco><worldbody><body name="a"/>{bodies}</worldbody></mujoco>'
    joint = ElasticJoint(stiffness=400.0, damping=4.0, rotor_inertia=0.1)
    said = refusals(model)
    with pytest.raises(ConfigurationError) as error:
        make_elastic(model, {f"k{i}": joint for i in range(90)})
    assert {*said, str(error.value)} == {
        "at most 80 joints can be elastic, got 90; name those that matter"
    }
