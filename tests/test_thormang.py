"""The humanoid's model against its sources: masses, heights, gravity torques, kinematics."""

import mujoco
import numpy as np
import pytest

from elastic_env.joint.make_elastic import make_elastic
from elastic_env.rigid.leg_kinematics import foot_pose, leg_angles
from elastic_env.rigid.rigid_body import RigidBody
from elastic_env.robots.thormang.model import ANKLE_HEIGHT_M, LEG, LEG_JOINTS, Thormang, rigid_spec


def held(robot: Thormang | None = None) -> mujoco.MjModel:
    """The robot with its pelvis fixed in the air."""
    return rigid_spec(robot or Thormang(), floating=False).compile()


def test_mass_and_center_of_mass_are_those_of_the_sources() -> None:
    """Catches a link left out or counted twice: 57 kg, legs of 11.860 kg, COM 0.054 m over the
    hip axis."""
    model = held()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert model.body_mass.sum() == pytest.approx(57.0, abs=1e-9)
    assert model.body("l_hip_yaw_link").subtreemass[0] == pytest.approx(11.860, abs=1e-9)
    assert data.subtree_com[0, 2] == pytest.approx(0.054, abs=5e-4)


def test_gravity_torques_agree_with_pinocchio() -> None:
    """Catches a wrong frame, axis or inertia in either engine."""
    model = held()
    data = mujoco.MjData(model)
    body = RigidBody(model, LEG_JOINTS)
    columns = [model.joint(name).qposadr[0] for name in LEG_JOINTS]
    for q in np.random.default_rng(0).uniform(-0.6, 0.6, (20, 12)):
        data.qpos[columns] = q
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(
            body.gravity_torque(q), data.qfrc_bias[columns], rtol=0.0, atol=1e-9
        )


@pytest.mark.parametrize("side", [0, 1])
def test_closed_form_kinematics_are_those_of_the_model(side: int) -> None:
    """Catches lengths or axes of the closed form that are not the robot's."""
    model = held()
    data = mujoco.MjData(model)
    rng = np.random.default_rng(1)
    names = LEG_JOINTS[6 * side : 6 * side + 6]
    hip = np.array([0.0, 0.105 * (1 - 2 * side), 0.0])
    for _ in range(20):
        q = rng.uniform(-0.4, 0.4, 6)
        q[3] = rng.uniform(0.1, 1.2)
        for name, angle in zip(names, q, strict=True):
            data.joint(name).qpos = angle
        mujoco.mj_kinematics(model, data)
        foot = data.body(f"{'lr'[side]}_foot")
        position, R = foot_pose(LEG, q)
        np.testing.assert_allclose(hip + position, foot.xpos, rtol=0.0, atol=1e-14)
        np.testing.assert_allclose(R.ravel(), foot.xmat, rtol=0.0, atol=1e-14)
        np.testing.assert_allclose(leg_angles(LEG, position, R), q, rtol=0.0, atol=1e-9)


def test_static_torques_of_figure_1_are_those_of_the_facts() -> None:
    """Left stance, right foot lifted 0.05 m, hip axis at 0.66 m, ZMP under the ankle: 65.5, 36 and
    8.3 N·m.

    Catches a load that is carried by the wrong leg, and an upper body put in the wrong place.
    """
    model = held()
    data = mujoco.MjData(model)
    level = np.eye(3)
    hip_height = 0.66 - ANKLE_HEIGHT_M

    def pose(shift: np.ndarray) -> None:
        for side, lift in ((0, 0.0), (1, 0.05)):
            foot = np.array([0.0, 0.105 * (1 - 2 * side), -hip_height + lift]) - shift
            q = leg_angles(LEG, foot - [0.0, 0.105 * (1 - 2 * side), 0.0], level)
            for name, angle in zip(LEG_JOINTS[6 * side : 6 * side + 6], q, strict=True):
                data.joint(name).qpos = angle
        mujoco.mj_forward(model, data)

    shift = np.zeros(3)
    for _ in range(50):  # bring the COM over the left ankle
        pose(shift)
        shift[:2] += data.body("l_foot").xpos[:2] - data.subtree_com[0, :2]
    np.testing.assert_allclose(data.subtree_com[0, :2], data.body("l_foot").xpos[:2], atol=1e-9)
    # weight on the left foot: torque of joint i is −J_i(foot)ᵀ F + gravity of the links
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jacobian, None, data.body("l_foot").xpos, model.body("l_foot").id)
    torque = data.qfrc_bias - jacobian.T @ [0.0, 0.0, 57.0 * 9.81]
    of = {name: torque[model.joint(name).dofadr[0]] for name in LEG_JOINTS}
    assert abs(of["l_hip_roll"]) == pytest.approx(65.5, abs=0.1)
    assert abs(of["l_knee"]) == pytest.approx(36.0, abs=1.0)
    assert abs(of["l_hip_pitch"]) == pytest.approx(8.3, abs=1.0)
    assert abs(of["l_ankle_roll"]) < 0.6


def test_options_change_what_they_say() -> None:
    """Catches an option that is read and not used."""
    assert held(Thormang(hip_half_spacing=0.072)).body("r_hip_yaw_link").pos[1] == -0.072
    twin = Thormang(twin_knee=True).joints
    assert twin["l_knee"].stiffness == 2002.0
    assert twin["l_hip_roll"].stiffness == 1001.0
    assert twin["r_knee"].servo is not None
    assert twin["r_knee"].servo.torque_limit == 168.0
    loaded = held(Thormang(torso_load_kg=5.0))
    load = loaded.body("load")
    torso = loaded.body("upper_body")
    assert load.mass[0] == 5.0
    np.testing.assert_allclose(load.pos + load.ipos, 2.0 * torso.ipos)  # on the shoulders
    assert load.pos[2] + load.ipos[2] == pytest.approx(0.319)


def test_elastic_robot_compiles_with_rotors_and_servos() -> None:
    """Catches a transform that loses the free pelvis or the soles."""
    robot = Thormang()
    model = make_elastic(rigid_spec(robot), robot.joints).compile()
    assert (model.nv, model.nu) == (6 + 24, 12)
    assert model.body_mass.sum() == pytest.approx(57.0, abs=1e-9)
    data = mujoco.MjData(model)
    data.qpos[2] = 0.6 + ANKLE_HEIGHT_M
    mujoco.mj_step(model, data, 50)
    assert data.ncon >= 6
    assert not data.warning.number.any()
