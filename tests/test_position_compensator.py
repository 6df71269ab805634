"""The compensator of live robots: its torque against MuJoCo, its commands in a simulation, and
what it refuses."""

import math
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import baselines
from baselines import PositionCompensator
from baselines.compensation.compensators import input_offset, newton_link_angle
from baselines.compensation.gravity_torque import make_gravity
from elastic_env.core.errors import ActionError, ConfigurationError, ElasticError
from elastic_env.core.signals import Array
from elastic_env.joint.elastic_joint import ElasticJoint, Servo
from elastic_env.joint.joint_names import JointAddresses
from elastic_env.joint.make_elastic import make_elastic
from tests.trees import ORDER, TREE, tree

# Three hinges and a gripper that slides; a spring in the shoulder, and gravity compensation on two
# bodies.
ARM = """<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="base" pos="0 0 0.4" gravcomp="1">
      <joint name="turn" axis="0.2 0 1" range="-3 3"/>
      <inertial mass="3" pos="0.05 0 0.1" diaginertia="0.02 0.02 0.02"/>
      <body name="upper" pos="0 0 0.2" euler="0.1 0.2 0">
        <joint name="shoulder" axis="0 1 0" stiffness="12" springref="0.3" range="-2 2"/>
        <inertial mass="2.5" pos="0.2 0.02 0" diaginertia="0.02 0.03 0.03"/>
        <body name="lower" pos="0.4 0 0" gravcomp="0.4">
          <joint name="elbow" axis="0 1 0.1" pos="0.01 0 0" ref="0.2"/>
          <inertial mass="1.5" pos="0.15 0 0.01" diaginertia="0.01 0.01 0.01"/>
          <body name="finger" pos="0.3 0 0">
            <joint name="slide" type="slide" axis="1 0.2 0" ref="0.01"/>
            <inertial mass="0.4" pos="0.02 0 0" diaginertia="0.001 0.001 0.001"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <keyframe><key qpos="0 0 0.2 0.05"/></keyframe>
</mujoco>"""
JOINTS = ["elbow", "turn", "shoulder"]  # not the order of the model
STIFFNESS = {"*": 400.0, "shoulder": 900.0}

INERTIAL = """<inertial><mass value="{}"/><origin xyz="{} 0 0"/>
<inertia ixx="0.02" iyy="0.03" izz="0.03" ixy="0" ixz="0" iyz="0"/></inertial>"""
URDF = f"""<robot name="arm">
  <link name="world"/>
  <link name="upper">
    {INERTIAL.format(2, 0.2)}
    <visual><geometry><mesh filename="package://nowhere/upper.stl"/></geometry></visual>
    <collision><geometry><mesh filename="package://nowhere/upper.dae"/></geometry></collision>
  </link>
  <link name="lower">{INERTIAL.format(1, 0.1)}</link>
  <link name="tool"/>
  <joint name="shoulder" type="revolute">
    <parent link="world"/><child link="upper"/><origin xyz="0 0 0.5"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="10" velocity="3"/>
  </joint>
  <joint name="elbow" type="continuous">
    <parent link="upper"/><child link="lower"/><origin xyz="0.4 0 0"/><axis xyz="0 1 0"/>
  </joint>
  <joint name="flange" type="fixed"><parent link="lower"/><child link="tool"/><origin xyz="0.3 0 0"/></joint>
</robot>"""


def model() -> mujoco.MjModel:
    """The arm."""
    return mujoco.MjModel.from_xml_string(ARM)


def arm(**options: Any) -> PositionCompensator:
    """Its compensator."""
    return PositionCompensator.from_model(model(), STIFFNESS, **{"joints": JOINTS, **options})


def needed(
    compiled: mujoco.MjModel, q: Array, q_dot: Array, q_ddot: Array, joints: Sequence[str] = JOINTS
) -> Array:
    """Torque on joints by MuJoCo's inverse dynamics, with its springs and its gravity
    compensation, (n,) [N·m]."""
    data = mujoco.MjData(compiled)
    data.qpos[:] = compiled.key_qpos[0]
    at = JointAddresses.of(compiled, joints)
    data.qpos[at.q] = q
    data.qvel[at.q_dot] = q_dot
    data.qacc[at.q_dot] = q_ddot
    compiled.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    mujoco.mj_inverse(compiled, data)
    return data.qfrc_inverse[at.q_dot].copy()


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000))
def test_the_torque_is_that_of_mujoco(seed: int) -> None:
    """Catches an ignored spring or gravcomp, a held joint at the wrong place, and joints in the
    order of the model."""
    q, q_dot, q_ddot = np.random.default_rng(seed).uniform(-1.5, 1.5, (3, 3))
    compensator = arm()
    expected = needed(model(), q, q_dot, q_ddot)
    np.testing.assert_allclose(compensator.torque(q, q_dot, q_ddot), expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        compensator.torque(q), needed(model(), q, np.zeros(3), np.zeros(3)), rtol=0, atol=1e-9
    )


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000), elbow=st.floats(-2.0, 2.0))
def test_a_hinge_that_is_not_commanded_stays_where_the_keyframe_has_it(
    seed: int, elbow: float
) -> None:
    """Catches a turn about the origin of the body in the place of the hinge's anchor, and a
    forgotten reference."""
    held = mujoco.MjModel.from_xml_string(
        ARM.replace('qpos="0 0 0.2 0.05"', f'qpos="0 0 {elbow} 0.05"')
    )
    joints = ["shoulder", "turn"]
    q, q_dot, q_ddot = np.random.default_rng(seed).uniform(-1.5, 1.5, (3, 2))
    compensator = PositionCompensator.from_model(held, STIFFNESS, joints=joints)
    expected = needed(held, q, q_dot, q_ddot, joints)
    np.testing.assert_allclose(compensator.torque(q, q_dot, q_ddot), expected, rtol=0, atol=1e-9)


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000), mass=st.floats(0.0, 5.0))
def test_a_payload_is_a_mass_at_its_place(seed: int, mass: float) -> None:
    """Catches a place in the frame of the wrong body, and a payload that is added to the last
    one."""
    spec = mujoco.MjSpec.from_string(ARM)
    place = [0.1, -0.05, 0.2]
    spec.body("finger").add_body(
        pos=place, ipos=[0.0] * 3, mass=1e-12 + mass, inertia=[1e-12] * 3, explicitinertial=True
    )
    q, q_dot, q_ddot = np.random.default_rng(seed).uniform(-1.5, 1.5, (3, 3))
    compensator = arm()
    compensator.set_payload(7.0, at=(1.0, 2.0, 3.0), body="upper")
    compensator.set_payload(mass, at=place, body="finger")
    expected = needed(spec.compile(), q, q_dot, q_ddot)
    np.testing.assert_allclose(compensator.torque(q, q_dot, q_ddot), expected, rtol=0, atol=1e-8)


def test_a_payload_at_a_site_is_in_the_frame_of_the_site() -> None:
    """Catches a place in the frame of the body, a turn to the wrong side, and a site that is
    taken for a body."""
    spec = mujoco.MjSpec.from_string(ARM)
    at = [0.1, -0.05, 0.2]
    spec.body("finger").add_site(
        name="flange", pos=[0.02, 0.03, -0.1], quat=[0.8, 0.3, -0.4, 0.33166248]
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    q = np.array([0.3, -0.7, 1.1])
    data.qpos[: len(q)] = q
    mujoco.mj_forward(model, data)
    finger = data.body("finger")
    there = data.site("flange").xpos + data.site("flange").xmat.reshape(3, 3) @ at
    in_body = finger.xmat.reshape(3, 3).T @ (there - finger.xpos)
    torques = []
    for body, place in (("flange", at), ("finger", in_body)):
        compensator = PositionCompensator(model, STIFFNESS)
        compensator.set_payload(2.0, at=place, body=body)
        torques.append(compensator.torque(q))
    np.testing.assert_allclose(*torques, rtol=0, atol=1e-10)


def test_it_agrees_with_the_policies() -> None:
    """Catches another formula than Eqs. 9 and 10 of the compensators, and another order."""
    robot = tree()
    q = np.array([0.3, -0.5, 0.9, 0.2, -1.1, 0.4])
    gravity = make_gravity(robot)
    compensator = PositionCompensator.from_model(
        mujoco.MjModel.from_xml_string(TREE), 1000.0, joints=ORDER
    )
    np.testing.assert_allclose(
        compensator.command(q) - q, input_offset(q, robot.stiffness, gravity), rtol=0, atol=1e-12
    )
    expected = newton_link_angle(q, robot.stiffness, gravity)
    np.testing.assert_allclose(compensator.link_angle(q), expected, rtol=0, atol=1e-10)
    np.testing.assert_allclose(
        compensator.link_angle(compensator.command(q)), q, rtol=0, atol=1e-10
    )


@pytest.mark.parametrize("integral_gain", [0.0, 4000.0], ids=["gives way", "holds"])
def test_links_of_a_simulated_arm_come_to_rest_where_they_should_be(integral_gain: float) -> None:
    """Catches a servo's own sag with the wrong sign or gain, and a spring or gravcomp that is
    counted the wrong way."""
    servo = Servo(
        position_gain=800.0,
        velocity_gain=40.0,
        integral_gain=integral_gain,
        torque_limit=200.0,
        speed_limit=10.0,
    )
    stiffness = {"elbow": 400.0, "turn": 400.0, "shoulder": 900.0}
    elastic = make_elastic(
        mujoco.MjSpec.from_string(ARM),
        {
            name: ElasticJoint(stiffness=value, damping=8.0, rotor_inertia=0.2, servo=servo)
            for name, value in stiffness.items()
        },
    )
    for joint in elastic.joints:
        if joint.name == "slide":
            joint.stiffness = np.array([1e5, 0, 0])
            joint.damping = np.array([500.0, 0, 0])
            joint.springref = 0.05
    compiled = elastic.compile()
    compensator = arm(position_gain=None if integral_gain else 800.0)
    q = np.array([0.4, 0.3, -0.2])
    at = JointAddresses.of(compiled, JOINTS)
    errors = []
    for command in (q, compensator.command(q)):
        data = mujoco.MjData(compiled)
        mujoco.mj_resetDataKeyframe(compiled, data, 0)
        data.qpos[at.q] = data.qpos[at.theta] = q
        for name, value in zip(JOINTS, command, strict=True):
            data.actuator(f"{name}_servo").ctrl = value
        mujoco.mj_step(compiled, data, 5000)
        assert np.abs(data.qvel).max() < 1e-6
        errors.append(np.abs(data.qpos[at.q] - q).max())
        if integral_gain:  # servos that hold show the command
            np.testing.assert_allclose(
                compensator.link_angle(data.qpos[at.theta]), data.qpos[at.q], atol=1e-5
            )
    assert errors[0] > 2e-3
    assert errors[1] < 0.01 * errors[0]


def test_a_urdf_needs_no_meshes(tmp_path: Path) -> None:
    """Catches a model that is refused for its pictures, and a tool that is merged into its link.
    Closed form."""
    path = tmp_path / "arm.urdf"
    path.write_text(URDF)
    compensator = PositionCompensator.from_model(path, {"shoulder": 500.0, "elbow": math.inf})
    assert compensator.joints == ("shoulder", "elbow")
    q = np.array([0.3, 0.5])
    compensator.set_payload(0.5, body="tool")
    g = 9.81
    elbow = -g * (1.0 * 0.1 + 0.5 * 0.3) * np.cos(q.sum())
    shoulder = elbow - g * (2.0 * 0.2 + 1.5 * 0.4) * np.cos(q[0])
    np.testing.assert_allclose(compensator.torque(q), [shoulder, elbow], rtol=1e-9)
    np.testing.assert_allclose(
        compensator.command(q), q + np.array([shoulder / 500.0, 0.0]), rtol=1e-9
    )


def test_offsets_grow_with_the_ramp_and_stay_within_their_limits() -> None:
    """Catches a jump at the start or under a new payload, offsets beyond their bound, commands
    beyond the range."""
    q = np.array([0.2, 0.1, 0.4])
    full = arm().command(q) - q
    gentle = arm(ramp_s=0.1, period_s=0.01)
    shares = np.array([(gentle.command(q) - q)[2] / full[2] for _ in range(12)])
    assert 0.0 < shares[0] < 0.02
    assert (np.diff(shares[:10]) > 0.0).all()
    np.testing.assert_allclose(shares[9:], 1.0, rtol=1e-12)
    gentle.set_payload(2.0)
    loaded = arm()
    loaded.set_payload(2.0)
    target = loaded.command(q)[2]
    offsets = [gentle.command(q)[2] for _ in range(10)]
    steps = np.diff([q[2] + full[2], *offsets])
    np.testing.assert_allclose(steps, (target - q[2] - full[2]) / 10, rtol=1e-6)
    assert offsets[-1] == pytest.approx(target, abs=1e-12)
    bounded = arm(limit_rad=1e-3)
    assert np.abs(bounded.command(q) - q).max() == pytest.approx(1e-3)
    assert bounded.clipped.any()
    at_end = arm()
    assert at_end.command(np.array([0.2, 0.0, 2.0]))[2] <= 2.0
    assert not arm().clipped.any()


@pytest.mark.parametrize(
    ("q", "message"),
    [
        (
            [0.0, 0.0],
            r"q_desired must be 3 numbers \[rad\], of elbow, turn, shoulder; got \[0.0, 0.0\]",
        ),
        ([0.0, np.nan, 0.0], "q_desired must be finite.*see turn"),
        ([0.0, 0.0, np.inf], "see shoulder"),
        ("now", "q_desired must be 3 numbers"),
        (None, "got None"),
        (np.zeros((1, 3)), r"array of shape \(1, 3\)"),
    ],
)
def test_what_is_no_angle_is_refused_and_changes_nothing(q: Any, message: str) -> None:
    """Catches nan in a servo, and a ramp that goes on without a command."""
    compensator = arm(ramp_s=0.1)
    other = arm(ramp_s=0.1)
    with pytest.raises(ActionError, match=message):
        compensator.command(q)
    np.testing.assert_array_equal(compensator.command(np.zeros(3)), other.command(np.zeros(3)))


CRANK = ARM.replace(
    "<keyframe>", '<equality><joint joint1="elbow" joint2="turn"/></equality><keyframe>'
)
GRIPPER = ARM.replace("<keyframe>", '<equality><joint joint1="slide"/></equality><keyframe>')
TENDON = ARM.replace(
    "<keyframe>",
    '<tendon><fixed stiffness="5"><joint joint="turn" coef="1"/></fixed></tendon><keyframe>',
)
FREE = """<mujoco><worldbody><body><freejoint name="root"/><geom size="0.1"/>
  <body><joint name="a"/><geom size="0.1"/></body></body></worldbody></mujoco>"""
FIXED = "<mujoco><worldbody><body><geom size='0.1'/></body></worldbody></mujoco>"


@pytest.mark.parametrize(
    ("xml", "stiffness", "options", "message"),
    [
        (
            ARM,
            {"shoulder": 900.0},
            {},
            "stiffness of joint 'turn' is missing; give 'turn' or a pattern",
        ),
        (
            ARM,
            {"*": 900.0, "sholder": 1.0},
            {},
            "unknown joint or pattern of joints 'sholder'.*Did you mean 'shoulder'",
        ),
        (ARM, 0.0, {}, r"'turn': .*stiffness must be a .*number >= 1e-09 \[N·m/rad\], got 0"),
        (ARM, -5, {}, "must be a finite number >= 1e-09"),
        (ARM, math.nan, {}, "must be a finite number >= 1e-09"),
        (
            ARM,
            "1000",
            {},
            r"stiffness must be numbers .*, got '1000'; give a number for all joints",
        ),
        (ARM, None, {}, "stiffness must be numbers .*, got None; give a number for all joints"),
        (
            ARM,
            {"*": {"stifness": 9.0}},
            {},
            r"stiffness of joint 'turn' is missing beside .*'stifness'.*'stiffness: K'",
        ),
        (ARM, True, {}, "stiffness must be a finite number >= 1e-09 .*, got True"),
        (ARM, [1.0, 2.0], {}, "stiffness must be 3 numbers.*of turn, shoulder, elbow, got 2"),
        (
            ARM,
            900.0,
            {"position_gain": {"*": None}},
            "'turn': .*position_gain must be a .*, got None",
        ),
        (ARM, 900.0, {"joints": ["wrist"]}, "unknown joint 'wrist'"),
        (ARM, 900.0, {"joints": ["turn", "turn"]}, "each once"),
        (ARM, 900.0, {"joints": ["slide"]}, "'slide' of the rigid model is no hinge"),
        (ARM, 900.0, {"limit_rad": 0.0}, "limit_rad must be a finite number > 0"),
        (ARM, 900.0, {"ramp_s": -1.0}, "ramp_s must be a finite number >= 0"),
        (CRANK, 900.0, {}, "equality constraint of elbow and turn"),
        (
            ARM.replace('"12"', '"12 3"'),
            900.0,
            {},
            "joint 'shoulder' has a spring whose torque is not linear",
        ),
        (TENDON, 900.0, {}, "tendons with stiffness"),
        (FREE, 900.0, {}, "'root' is free or a ball joint"),
        (FIXED, 900.0, {}, "no hinge"),
        (
            FIXED.replace("<geom", "<joint/><geom"),
            900.0,
            {},
            "a hinge of the model has no name; give each one",
        ),
    ],
)
def test_models_and_values_that_cannot_be_used_are_refused(
    xml: str, stiffness: Any, options: dict[str, Any], message: str
) -> None:
    """Catches a torque that is silently wrong, and a message that names no value."""
    with pytest.raises(ConfigurationError, match=message):
        PositionCompensator.from_model(mujoco.MjModel.from_xml_string(xml), stiffness, **options)


def test_a_gripper_with_constraints_of_its_own_is_held() -> None:
    """Catches a refusal for what no commanded joint feels."""
    compensator = baselines.PositionCompensator.from_model(
        mujoco.MjModel.from_xml_string(GRIPPER), 900.0
    )
    assert compensator.joints == ("turn", "shoulder", "elbow")


MESH = """<mujoco><asset><mesh name="m" file="{}"/></asset><worldbody><body><joint name="a"/>
  <geom type="mesh" mesh="m"/></body></worldbody></mujoco>"""
LINK = """<robot name="r"><link name="base"/><link name="arm"><inertial><mass value="{}"/>
  <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="a" type="continuous"><parent link="base"/><child link="arm"/></joint></robot>"""


def test_files_that_are_no_model_are_refused(tmp_path: Path) -> None:
    """Catches a traceback of MuJoCo or of an XML parser, and a message that does not say what to
    do."""
    (tmp_path / "there.dae").write_text("<COLLADA/>")
    with pytest.raises(
        ConfigurationError, match=r"a model must be a file of MJCF .*mujoco.MjModel, got None"
    ):
        PositionCompensator.from_model(None, 900.0)  # type: ignore[arg-type]
    for text, message in (
        (None, "no model at"),
        ("{", "is no XML"),
        ("<mujoco><bdy/></mujoco>", "MuJoCo cannot read"),
        (
            "<mujoco><worldbody><body><joint name='a'/></body></worldbody></mujoco>",
            "cannot compile.*needs a mass",
        ),
        (
            MESH.format("lost.stl"),
            "cannot compile.*lost.stl.*; put the mesh where the model names it",
        ),
        (
            MESH.format("there.dae"),
            "cannot compile.*there.dae.*; MuJoCo reads meshes of STL, OBJ and MSH",
        ),
        (LINK.format("0"), "cannot compile.*; every link that moves needs a mass"),
        (LINK.format("heavy"), "cannot read.*mass.*; it must be a number"),
    ):
        path = tmp_path / "m.xml"
        if text is not None:
            path.write_text(text)
        with pytest.raises(ConfigurationError, match=message):
            PositionCompensator.from_model(path, 900.0)


def test_soft_springs_are_solved_where_one_equilibrium_exists() -> None:
    """Catches link angles that are refused, or are no solution of Eq. 10, where m·g·l/K is far
    beyond 1."""
    without_spring = mujoco.MjModel.from_xml_string(ARM.replace('stiffness="12"', ""))
    weak = PositionCompensator.from_model(
        without_spring, {"*": 400.0, "shoulder": 1.5}, joints=JOINTS
    )
    weak.set_payload(5.0)
    K = np.array([400.0, 400.0, 1.5])
    for theta in np.array([[0.0, 0.0, 0.0], [0.9, 0.3, 0.5], [-0.4, -1.0, 0.9]]):
        q = weak.link_angle(theta)
        np.testing.assert_allclose(K * (theta - q), weak.torque(q), atol=1e-8)
        assert np.abs(theta - q).max() > 0.1


UPRIGHT = """<mujoco><compiler angle="radian"/><worldbody><body>
  <joint name="shoulder" axis="0 1 0" range="{0} 2"/><geom type="sphere" size="0.01" pos="0 0 0.3" mass="{1}"/>
  <body pos="0 0 0.3"><joint name="wrist" axis="0 0 1"/><geom size="0.01" mass="0.1"/></body>
</body></worldbody></mujoco>"""


@pytest.mark.parametrize(
    ("theta", "words"), [(0.0, "the link tips over"), (0.1, "bistable: the link can rest at")]
)
def test_a_load_that_overcomes_a_spring_is_said(theta: float, words: str) -> None:
    """Catches an unstable pose, and one of two stable ones, that are given as where the link is."""
    upright = mujoco.MjModel.from_xml_string(UPRIGHT.format(-2, 2))  # 2.1 kg at 0.3 m: 6.2 N·m/rad
    weak = PositionCompensator.from_model(upright, {"shoulder": 4.5, "wrist": math.inf})
    with pytest.raises(
        ElasticError, match=re.escape("stiffness of shoulder (4.5 N·m/rad) too low") + f".*{words}"
    ):
        weak.link_angle([theta, 0.3])
    assert weak.link_angle([1.9, 0.3])[0] > 1.9
    fenced = mujoco.MjModel.from_xml_string(
        UPRIGHT.format(-0.1, 2)
    )  # the other pose is out of its range
    assert PositionCompensator.from_model(fenced, [4.5, math.inf]).link_angle([0.1, 0.0])[0] > 0.5
    firm = PositionCompensator.from_model(upright, {"shoulder": 6.5, "wrist": math.inf})
    q = firm.link_angle([theta, 0.3])
    assert 6.5 * (q[0] - theta) == pytest.approx(-firm.torque(q)[0], abs=1e-9)


def test_servos_of_the_model_that_give_way_are_named() -> None:
    """Catches a sag that stays because nobody said k_p; an infinite one says that the servo
    holds its angle."""
    actuators = (
        '<actuator><position joint="elbow" kp="40" gear="2"/><motor joint="turn"/></actuator>'
    )
    model = ARM.replace("</mujoco>", f"{actuators}</mujoco>")
    spec = mujoco.MjSpec.from_string(model)
    with pytest.warns(
        UserWarning,
        match=re.escape("position_gain={elbow: 160} [N·m/rad], or position_gain=math.inf"),
    ):
        alone = PositionCompensator.from_model(spec, 500.0)
    held = PositionCompensator.from_model(spec, 500.0, position_gain=math.inf)
    np.testing.assert_array_equal(alone.command([0.3, 0.2, 0.1]), held.command([0.3, 0.2, 0.1]))


PENDULUM = """<mujoco><worldbody><body name="a" pos="0 0 1"><joint name="j" axis="0 -1 0" range="-86 183"/>
  <inertial mass="4" pos="0 0 -0.25" diaginertia="0.1 0.1 0.1"/></body></worldbody></mujoco>"""
SOFT = 20.0
"""k_p of its servo [N·m/rad], under a weight of 9.81 N·m."""


def said_by(compensator: Any) -> list[str]:
    """Warnings of a function."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        compensator()
    return [str(one.message) for one in said]


def test_a_limit_that_the_weight_exceeds_is_said_once_with_what_is_enough() -> None:
    """Catches a link that ends 16 degrees short without a word. The need is 9.81/20 rad, in
    closed form."""
    pendulum = mujoco.MjModel.from_xml_string(PENDULUM)
    found = []

    def play(**options: Any) -> None:
        made = PositionCompensator.from_model(pendulum, math.inf, position_gain=SOFT, **options)
        found.append(float(made.command([np.pi / 2])[0] - np.pi / 2))
        made.command([1.5])

    said = said_by(play)
    assert len(said) == 1
    assert "needs an offset of 0.49 rad of joint 'j'" in said[0]
    enough = float(re.findall(r"limit_rad=([0-9.]+) is enough", said[0])[0])
    assert 9.81 / SOFT < enough < 0.6
    assert said_by(lambda: play(limit_rad=enough)) == []
    assert found == pytest.approx([0.2, 9.81 / SOFT])


def test_a_warning_names_the_line_of_the_users_program() -> None:
    """Catches a warning that shows a line of ours, where nothing can be mended."""
    pendulum = mujoco.MjModel.from_xml_string(PENDULUM)
    stiff = PositionCompensator.from_model(pendulum, 100.0)
    for call in (
        lambda: PositionCompensator.from_model(pendulum, math.inf, position_gain=SOFT),
        lambda: PositionCompensator(pendulum, math.inf, position_gain=SOFT),
        lambda: stiff.command([1.0], [0.0], [50.0]),
    ):
        with pytest.warns(UserWarning, match="limit_rad") as said:
            call()
        assert [one.filename for one in said] == [__file__]


def test_a_limit_that_a_payload_or_a_motion_exceeds_is_said_when_it_is_met() -> None:
    """Catches a clip that only the payload or an acceleration brings, in silence; and one that
    is said at each call."""
    pendulum = mujoco.MjModel.from_xml_string(PENDULUM)

    def play() -> None:
        made = PositionCompensator.from_model(pendulum, 100.0)
        made.command([1.0], [0.0], [50.0])
        made.command([1.0], [0.0], [60.0])

    said = said_by(play)
    assert len(said) == 1
    assert re.search(r"offset of 0\.2\d+ rad of joint 'j' now.*limit_rad=0\.\d+ is enough", said[0])


def test_a_joint_range_that_a_command_would_leave_is_said_once() -> None:
    """Catches a link that stays short of the end of its range without a word."""
    pendulum = mujoco.MjModel.from_xml_string(PENDULUM.replace("183", "90"))

    def play() -> None:
        made = PositionCompensator.from_model(pendulum, 100.0)
        made.command([np.pi / 2])
        made.command([np.pi / 2])

    said = said_by(play)
    assert len(said) == 1
    assert re.search(r"'j' needs the command 1.669 rad, beyond its range.*0.098 rad short", said[0])


def test_a_payload_that_jumps_is_said_once_with_a_ramp() -> None:
    """Catches a jump of the command without a word. 9.81 N/kg at 0.25 m over 400 N·m/rad are 6.1
    mrad a kg."""
    pendulum = mujoco.MjModel.from_xml_string(PENDULUM)

    def play(**options: Any) -> None:
        made = PositionCompensator.from_model(pendulum, 400.0, **options)
        made.set_payload(1.0, at=(0.0, 0.0, -0.25))  # before the first command nothing jumps
        made.command([np.pi / 2])
        made.set_payload(4.1, at=(0.0, 0.0, -0.25))
        made.command([np.pi / 2])
        made.set_payload(0.0, at=(0.0, 0.0, -0.25))

    said = said_by(play)
    assert len(said) == 1
    assert re.search(
        r"payload moves the command of joint 'j' by 19 mrad at once; ramp_s=1 takes it over",
        said[0],
    )
    assert said_by(lambda: play(ramp_s=1.0)) == []

    def elsewhere() -> None:
        made = PositionCompensator.from_model(pendulum, 400.0, ramp_s=0.02)
        made.set_payload(3.0, at=(0.0, 0.0, -0.25))
        for _ in range(3):
            made.command([np.pi / 2])
        made.set_payload(3.0, at=(0.0, 0.0, -0.5))

    said = said_by(elsewhere)
    assert len(said) == 1
    assert "set the payload to 0 where it was, and let ramp_s pass" in said[0]


def test_a_pose_that_no_servo_reaches_in_a_period_is_a_pose_and_no_motion() -> None:
    """Catches a servo's lag at 100 rad/s, which turns every joint by the limit when poses follow
    one another; a motion as fast as a servo turns is led."""
    joint = {
        "stiffness": 400.0,
        "coulomb_friction": 0.1,
        "servo": {"position_gain": 200.0, "velocity_gain": 10.0, "speed_limit": 6.0},
    }
    pendulum = mujoco.MjModel.from_xml_string(PENDULUM)

    def led(poses: Sequence[float], **options: Any) -> float:
        made = PositionCompensator.from_model(
            pendulum, {"j": joint}, friction=True, period_s=0.01, limit_rad=0.5, **options
        )
        commands = [made.command([pose]) for pose in poses]
        return float(commands[-1][0] - poses[-1])

    at_rest = led([1.0, 1.0])
    assert led([0.0, 1.0]) == pytest.approx(at_rest, abs=0.02)  # friction's side alone
    moving = led([0.95, 1.0])  # 5 rad/s, 1/20 s behind
    assert moving - at_rest == pytest.approx(0.25, abs=0.02)
