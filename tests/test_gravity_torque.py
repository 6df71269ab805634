"""Gravity torques against MuJoCo, finite differences and the closed form of the pendulum."""

import re

import numpy as np
import pytest

from baselines.compensation.gravity_torque import GravityModel, HingeTorque, make_gravity
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.rigid.rigid_body import RigidBody
from elastic_env.world.robot_model import RobotModel
from tests.trees import ORDER, TREE, bias_of_mujoco, pendulum, robot, tree

TOLERANCE_NM = 1e-9

ROBOTS = pytest.mark.parametrize("model", [pendulum(), tree()], ids=["testbed", "tree"])


def postures(model: RobotModel, *shape: int) -> Array:
    """Random joint angles, (*shape, n) [rad]."""
    return np.random.default_rng(7).uniform(-3.0, 3.0, (*shape, len(model.joint_names)))


def central_differences(gravity: GravityModel, q: Array, step: float = 1e-5) -> Array:
    """∂τ_i/∂q_j of one posture, (n, n) [N·m/rad]."""
    columns = [
        gravity.gravity_torque(q + step * e) - gravity.gravity_torque(q - step * e)
        for e in np.eye(len(q))
    ]
    return np.stack(columns, axis=-1) / (2.0 * step)


@ROBOTS
def test_gravity_torque_is_the_bias_force_of_mujoco(model: RobotModel) -> None:
    """Catches a flipped sign, a forgotten anchor or reference, a wrong frame, and joints in the
    order of the model."""
    gravity = make_gravity(model, "tree")
    for q in postures(model, 100):
        np.testing.assert_allclose(
            gravity.gravity_torque(q), bias_of_mujoco(model, q), rtol=0.0, atol=TOLERANCE_NM
        )


@ROBOTS
def test_gradient_is_the_derivative_of_the_torque(model: RobotModel) -> None:
    """Catches a transposed or permuted gradient, and a branch that feels the gravity of another
    branch."""
    gravity = make_gravity(model, "tree")
    for q in postures(model, 20):
        np.testing.assert_allclose(
            gravity.gravity_gradient(q), central_differences(gravity, q), rtol=0.0, atol=2e-8
        )


@pytest.mark.parametrize("name", ORDER)
def test_one_hinge_has_the_closed_form_that_its_tree_says(name: str) -> None:
    """Catches a, b and I of another axis, anchor or reference: each hinge of the tree in turn,
    the rest rigid."""
    model = robot(re.sub(rf'<joint name="(?!{name}")[^>]*/>', "", TREE), [name])
    hinge = HingeTorque(model)
    body = RigidBody(model.rigid, [name])
    q, q_dot, q_ddot = np.random.default_rng(3).uniform(-4.0, 4.0, (3, 50, 1))
    for mine, reference in (
        (hinge.gravity_torque(q), body.gravity_torque(q)),
        (hinge.gravity_gradient(q), body.gravity_gradient(q)),
        (hinge.inverse_dynamics(q, q_dot, q_ddot), body.inverse_dynamics(q, q_dot, q_ddot)),
    ):
        assert np.abs(reference).max() > 0.01
        np.testing.assert_allclose(mine, reference, rtol=0.0, atol=1e-12)


def test_the_closed_form_is_of_one_hinge() -> None:
    """Catches the torque of a tree taken for that of its first joint; what nobody chose suits
    the robot."""
    with pytest.raises(ConfigurationError, match="'hinge' needs one joint, got 6: knee, yaw"):
        make_gravity(tree(), "hinge")
    for model, method in ((tree(), "tree"), (pendulum(), "hinge")):
        q = postures(model, 3)
        chosen = make_gravity(model)
        named = make_gravity(model, method)
        np.testing.assert_array_equal(chosen.gravity_torque(q), named.gravity_torque(q))


def test_joints_on_different_branches_do_not_feel_each_other() -> None:
    """Catches a gradient that couples arm and leg, which no joint of both carries."""
    gradient = make_gravity(tree()).gravity_gradient(postures(tree(), 50))
    elbow = ORDER.index("elbow")
    leg = [ORDER.index(name) for name in ("hip", "knee", "twist")]
    assert np.all(gradient[:, elbow, leg] == 0.0)
    assert np.all(gradient[:, leg, elbow] == 0.0)
    assert (
        np.abs(gradient[:, elbow, ORDER.index("yaw")]).max() > 0.1
    )  # the trunk does carry the arm


@pytest.mark.parametrize("method", ["hinge", "tree"])
def test_pendulum_follows_its_closed_form(method: str) -> None:
    """Catches a cosine for the sine, and q that grows to the wrong side: τ_g = 60 sin q, its
    gradient 60 cos q."""
    gravity = make_gravity(pendulum(), method)
    q = np.linspace(-3.0, 3.0, 61)[:, None]
    np.testing.assert_allclose(gravity.gravity_torque(q), 60.0 * np.sin(q), rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(
        gravity.gravity_gradient(q), 60.0 * np.cos(q)[..., None], rtol=0.0, atol=1e-13
    )


@pytest.mark.parametrize(
    ("model", "method"), [(pendulum(), "hinge"), (pendulum(), "tree"), (tree(), "tree")]
)
def test_rows_of_a_batch_are_the_single_postures_exactly(model: RobotModel, method: str) -> None:
    """Catches results that depend on the size of the batch, which would make scalar and vector
    rollouts differ."""
    gravity = make_gravity(model, method)
    q = postures(model, 3, 5)
    torque = gravity.gravity_torque(q)
    gradient = gravity.gravity_gradient(q)
    n = q.shape[-1]
    assert torque.shape == (3, 5, n)
    assert gradient.shape == (3, 5, n, n)
    for i, j in np.ndindex(3, 5):
        np.testing.assert_array_equal(torque[i, j], gravity.gravity_torque(q[i, j]))
        np.testing.assert_array_equal(gradient[i, j], gravity.gravity_gradient(q[i, j]))


@ROBOTS
def test_gravity_leaves_its_argument_alone(model: RobotModel) -> None:
    """Catches an in-place shift of the angles by their references."""
    gravity = make_gravity(model, "tree")
    q = postures(model, 4)
    before = q.copy()
    gravity.gravity_torque(q)
    gravity.gravity_gradient(q)
    np.testing.assert_array_equal(q, before)


def test_unknown_method_names_itself_and_the_choices() -> None:
    """Catches a silent fallback, and a message that does not help."""
    with pytest.raises(ConfigurationError, match=r"unknown gravity method 'symbolic'.*hinge, tree"):
        make_gravity(pendulum(), "symbolic")


def test_a_hinge_that_is_left_out_is_an_error() -> None:
    """Catches a model that keeps a joint at zero in silence, or fails later with a bare
    KeyError."""
    with pytest.raises(ConfigurationError, match="knee"):
        make_gravity(robot(TREE, [name for name in ORDER if name != "knee"]))


def test_a_joint_that_is_no_hinge_is_an_error() -> None:
    """Catches a slide taken for a hinge, whose torque is then plainly wrong."""
    xml = TREE.replace('<joint name="elbow"', '<joint name="elbow" type="slide"')
    with pytest.raises(ConfigurationError, match="elbow"):
        make_gravity(robot(xml, ORDER))
