"""Static equilibrium: the true plant stays where it was settled, its springs carry what statics
asks of them."""

import copy
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
import pytest

from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array
from elastic_env.joint.elastic_joint import ElasticJoint
from elastic_env.joint.joint_names import JointAddresses
from elastic_env.robots.thormang.model import LEG_JOINTS, SIDES, Thormang, biped, elastic_spec
from elastic_env.robots.thormang.standing import Equilibrium, settle
from tests.legs import foot_frames, holding_torque

ROBOT = Thormang()
BIPED = biped(ROBOT)
PELVIS = np.array([-0.0246, 0.0, 0.66])
UNEQUAL = {
    name: joint.replace(stiffness=joint.stiffness * factor)
    for (name, joint), factor in zip(
        ROBOT.joints.items(), np.linspace(0.75, 1.3, 12).tolist(), strict=True
    )
}


def posture(shift: float = 0.0) -> tuple[Array, Array]:
    """Pelvis and joint angles with flat soles, the pelvis shifted towards the left foot."""
    pelvis = PELVIS + np.array([0.0, shift, 0.0])
    ankles = np.pad(BIPED.footholds, ((0, 0), (0, 1)), constant_values=BIPED.ankle_height)
    return pelvis, BIPED.joint_angles(pelvis, ankles)


def settled(
    joints: dict[str, ElasticJoint], shift: float = 0.0, offset: float = 0.0
) -> tuple[mujoco.MjModel, Equilibrium, Array]:
    """The plant, where it came to rest, and what its servos were told."""
    model = elastic_spec(ROBOT, joints).compile()
    pelvis, q = posture(shift)
    command = q + offset * np.random.default_rng(0).uniform(-1.0, 1.0, 12)
    return model, settle(model, LEG_JOINTS, pelvis, q, command), command


def placed(model: mujoco.MjModel, rest: Equilibrium, command: Array) -> mujoco.MjData:
    """The plant at rest there."""
    data = mujoco.MjData(model)
    data.qpos[:] = rest.qpos
    data.act[:] = rest.act
    data.qacc_warmstart[:] = rest.warmstart
    data.ctrl[:] = command
    return data


CASES = {
    "paper": (ROBOT.joints, 0.0, 0.0),
    "left foot": (ROBOT.joints, 0.05, 0.0),
    "unequal springs": (UNEQUAL, 0.0, 0.0),
    "other command": (ROBOT.joints, 0.0, 0.01),
    "without friction": (
        {n: j.replace(coulomb_friction=0.0) for n, j in ROBOT.joints.items()},
        0.0,
        0.0,
    ),
    "backlash": ({n: j.replace(backlash=0.00175) for n, j in ROBOT.joints.items()}, 0.0, 0.0),
}


SOME = [
    pytest.param(name, marks=[pytest.mark.slow] * (name in ("left foot", "without friction")))
    for name in CASES
]


@cache
def case(name: str) -> tuple[mujoco.MjModel, Equilibrium, Array]:
    """A case, settled once."""
    return settled(*CASES[name])


@pytest.mark.parametrize("name", SOME)
def test_the_true_plant_stays_where_it_was_settled(name: str) -> None:
    """Catches a rest that is one only with strong dampers or without friction, and a servo that
    must still wind up."""
    model, rest, command = case(name)
    data = placed(model, rest, command)
    at = JointAddresses.of(model, LEG_JOINTS)
    assert model.tendon_damping.max() == 10.0
    for _ in range(6):
        mujoco.mj_step(model, data, 50)
        for columns in (at.q, at.theta, slice(0, 7)):
            np.testing.assert_allclose(data.qpos[columns], rest.qpos[columns], rtol=0.0, atol=1e-4)
    assert not data.warning.number.any()


def forces_on_the_feet(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[Array, Array]:
    """MuJoCo's contact forces in the world, summed for each foot, and their moments about the
    ankles, (2, 3) each."""
    feet = [model.body(f"{side}_foot").id for side in SIDES]
    force, moment = np.zeros((2, 2, 3))
    wrench = np.zeros(6)
    for number in range(data.ncon):
        contact = data.contact[number]
        bodies = [int(model.geom_bodyid[geom]) for geom in contact.geom]
        [foot] = [side for side in range(2) if feet[side] in bodies]
        mujoco.mj_contactForce(model, data, number, wrench)
        sign = 1.0 if bodies[1] == feet[foot] else -1.0  # MuJoCo's acts on the second geom
        frame = contact.frame.reshape(3, 3)
        push = sign * wrench[:3] @ frame
        force[foot] += push
        moment[foot] += (
            np.cross(contact.pos - data.xpos[feet[foot]], push) + sign * wrench[3:] @ frame
        )
    return force, moment


@pytest.mark.parametrize("name", SOME)
def test_springs_at_rest_carry_the_holding_torque(name: str) -> None:
    """Catches a robot that is placed with undeflected springs, or with those of another
    stiffness."""
    joints, _, _ = CASES[name]
    model, rest, command = case(name)
    model = copy.copy(model)
    model.dof_frictionloss[:] = 0.0  # nothing but the springs
    data = placed(model, rest, command)
    at = JointAddresses.of(model, LEG_JOINTS)
    mujoco.mj_forward(model, data)
    R = data.body("pelvis").xmat.reshape(3, 3)
    deflection = rest.qpos[at.theta] - rest.qpos[at.q]
    dead = np.array([joint.backlash for joint in joints.values()]) / 2.0
    stiffness = np.array([joint.stiffness for joint in joints.values()])
    spring = stiffness * np.sign(deflection) * np.maximum(np.abs(deflection) - dead, 0.0)
    legs = rest.qpos[at.q].reshape(2, 6)
    ankles, _ = foot_frames(BIPED.chains, legs)
    force, moment = forces_on_the_feet(model, data)
    expected = holding_torque(
        BIPED.chains, legs, model.opt.gravity @ R, force @ R, ankles, moment @ R
    )
    np.testing.assert_allclose(spring, expected.ravel(), rtol=0.0, atol=0.03)
    assert np.abs(spring).max() > 15.0
    np.testing.assert_allclose(force[:, 2].sum(), 57.0 * 9.81, rtol=0.0, atol=0.2)


@pytest.mark.parametrize("stiffness", [50.0, 150.0])
def test_a_robot_that_cannot_stand_is_an_error(stiffness: float) -> None:
    """Catches an episode that begins with a fall, and a message that does not say what is wrong."""
    soft = {name: joint.replace(stiffness=stiffness) for name, joint in ROBOT.joints.items()}
    with pytest.raises(
        ElasticError,
        match=(
            r"does not stand: pelvis at -?0\.\d+ m \(planned 0\.660 m\).*is a joint too soft for"
            r" the load\?$"
        ),
    ):
        settled(soft)


def test_joints_too_stiff_for_the_physics_step_are_an_error_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches advice to stiffen a joint whose stiffness is what makes the simulation diverge."""
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings there
    stiff = {
        name: j.replace(stiffness=1e6 if name == "l_knee" else 9e5)
        for name, j in ROBOT.joints.items()
    }
    with pytest.raises(
        ElasticError, match=r"largest K of 1e\+06 N·m/rad.*too stiff.*timestep_s = 0\.001 s; lower"
    ) as error:
        settled(stiff)
    assert "nan" not in str(error.value)
    assert "soft" not in str(error.value)


def test_the_plant_itself_is_not_changed() -> None:
    """Catches friction that stays off and dampers that stay strong after the robot has come to
    rest."""
    model = elastic_spec(ROBOT, ROBOT.joints).compile()
    before = [
        array.copy() for array in (model.tendon_damping, model.dof_frictionloss, model.opt.gravity)
    ]
    settle(model, LEG_JOINTS, *posture(), posture()[1])
    for array, old in zip(
        (model.tendon_damping, model.dof_frictionloss, model.opt.gravity), before, strict=True
    ):
        np.testing.assert_array_equal(array, old)
    assert before[1].max() == 5.4
