"""Leg kinematics: inverse against forward, forward against MuJoCo."""

import mujoco
import numpy as np
import pytest

from elastic_env.core.errors import ElasticError
from elastic_env.rigid.leg_kinematics import LegGeometry, foot_pose, leg_angles, rotation_of_tilt

LEG = LegGeometry(thigh=0.3, shank=0.28)
CHAIN = """<mujoco><compiler angle="radian"/><worldbody><body name="hip">
  <joint axis="0 0 1"/><joint axis="1 0 0"/><joint axis="0 1 0"/><geom size="0.01"/>
  <body pos="0 0 -0.3"><joint axis="0 1 0"/><geom size="0.01"/>
    <body name="foot" pos="0 0 -0.28"><joint axis="0 1 0"/><joint axis="1 0 0"/><geom size="0.01"/></body></body>
</body></worldbody></mujoco>"""


def random_angles(rows: int) -> np.ndarray:
    """Angles of a leg with the knee bent backwards and the hip above the plane of the sole."""
    q = np.random.default_rng(0).uniform(-0.7, 0.7, (rows, 6))
    q[:, 3] = 2.0 * np.abs(q[:, 3]) + 0.05
    return q


def test_forward_kinematics_agrees_with_mujoco() -> None:
    """Catches a wrong axis, order or sign."""
    model = mujoco.MjModel.from_xml_string(CHAIN)
    data = mujoco.MjData(model)
    q = random_angles(50)
    position, R = foot_pose(LEG, q)
    for row in range(50):
        data.qpos[:] = q[row]
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(position[row], data.body("foot").xpos, rtol=0.0, atol=1e-14)
        np.testing.assert_allclose(R[row].ravel(), data.body("foot").xmat, rtol=0.0, atol=1e-14)


def test_inverse_kinematics_returns_the_angles() -> None:
    """Catches any slip in the closed form (issue: 1e-9 rad round trip)."""
    q = random_angles(2000)
    np.testing.assert_allclose(leg_angles(LEG, *foot_pose(LEG, q)), q, rtol=0.0, atol=1e-9)


def test_a_batch_of_any_shape_is_its_rows() -> None:
    """Catches a formula that is right for one shape only."""
    q = random_angles(12).reshape(3, 4, 6)
    angles = leg_angles(LEG, *foot_pose(LEG, q))
    assert angles.shape == (3, 4, 6)
    np.testing.assert_allclose(
        angles[1, 2], leg_angles(LEG, *foot_pose(LEG, q[1, 2])), rtol=0.0, atol=1e-12
    )


def test_a_tilt_is_a_roll_and_then_a_pitch_as_mujoco_turns() -> None:
    """Catches the other order, a sign, and the inverse."""
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint axis="0 1 0"/><joint axis="1 0 0"/><geom'
        ' size="0.01"/></body></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    attitude = np.random.default_rng(1).uniform(-1.5, 1.5, (20, 2))
    R = rotation_of_tilt(attitude)
    for row, (roll, pitch) in enumerate(attitude):
        data.qpos[:] = pitch, roll
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(R[row].ravel(), data.xmat[1], rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("distance", [0.5801, 0.0199])
def test_a_target_out_of_reach_says_how_far(distance: float) -> None:
    """Catches arccos of more than one, which is nan, and a leg longer than it is."""
    with pytest.raises(ElasticError, match=r"out of reach of a leg of 0.3 m \+ 0.28 m"):
        leg_angles(LEG, np.array([0.0, 0.0, -distance]), np.eye(3))
