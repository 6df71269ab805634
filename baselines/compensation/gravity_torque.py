"""Gravity torque of the assumed rigid model, which the compensators turn into a deflection.

`gravity_torque(q)` and its gradient on (..., n) joint angles, for a whole batch at once: in closed
form for one hinge, link by link for a tree of them. Both agree to rounding.
"""

from typing import Any, Literal, Protocol, get_args

import numpy as np

from baselines.compensation.contact_torque import ContactGravity, ContactMethod
from elastic_env.core.errors import ConfigurationError, require_known
from elastic_env.core.signals import Array
from elastic_env.rigid.rigid_body import RigidBody, needs_more_than_gravity
from elastic_env.world.robot_model import RobotModel, WalkerModel

GravityMethod = Literal["hinge", "tree", "com", "ankle", "lumped"]


class GravityModel(Protocol):
    """Torque that holds the robot at rest, and its gradient."""

    def gravity_torque(self, q: Array) -> Array:
        """τ_g, (..., n) [rad] to (..., n) [N·m]."""
        ...

    def gravity_gradient(self, q: Array) -> Array:
        """∂τ_g/∂q, (..., n) [rad] to (..., n, n) [N·m/rad]."""
        ...


def make_gravity(model: RobotModel, method: GravityMethod | None = None) -> Any:
    """Make the gravity torque of a robot by a chosen method.

    A robot on a fixed base has "hinge" (default for one joint) and "tree" (default for several),
    and its gravity torque is a `GravityModel`. A walker has the methods of
    `baselines.compensation.contact_torque`: "com" (default), "ankle" and "lumped". Its gravity
    torque is a `GravityModel` after `at(observations)`.

    Raises:
        ConfigurationError: The method does not exist, or not for this robot.
    """
    if isinstance(model, WalkerModel):
        chosen: Any = method or "com"
        require_known("gravity method of a walker", [chosen], get_args(ContactMethod))
        return ContactGravity(model, chosen)
    is_more_than_gravity = needs_more_than_gravity(model.rigid)
    is_plain_hinge = len(model.joint_names) == 1 and not is_more_than_gravity
    chosen = method or ("hinge" if is_plain_hinge else "tree")
    require_known("gravity method", [chosen], ("hinge", "tree"))
    if chosen == "tree":
        return RigidBody(model.rigid, model.joint_names)
    if is_more_than_gravity:
        raise ConfigurationError(
            "gravity method 'hinge' has gravity only, but this model has springs of"
            " joints or gravcomp; choose tree"
        )
    return HingeTorque(model)


class HingeTorque:
    r"""Torque of a robot with one hinge in closed form, fitted to three states of `RigidBody`.

    .. math:: \tau = I \ddot q + a \cos q + b \sin q

    Args:
        model: Robot with one joint, about which its inertia I is always the same.

    Raises:
        ConfigurationError: The robot has more joints.
    """

    def __init__(self, model: RobotModel) -> None:
        names = model.joint_names
        if len(names) != 1:
            got = f"got {len(names)}: {', '.join(names)}; choose tree"
            raise ConfigurationError(f"gravity method 'hinge' needs one joint, {got}")
        body = RigidBody(model.rigid, names)
        zero = np.zeros(1)
        self._a = body.gravity_torque(zero)
        self._b = body.gravity_torque(zero + np.pi / 2)
        self._inertia = body.inverse_dynamics(zero, zero, np.ones(1)) - self._a

    def gravity_torque(self, q: Array) -> Array:
        """τ_g, (..., 1) [rad] to (..., 1) [N·m]."""
        return self._a * np.cos(q) + self._b * np.sin(q)

    def gravity_gradient(self, q: Array) -> Array:
        """∂τ_g/∂q, (..., 1) [rad] to (..., 1, 1) [N·m/rad]."""
        return (self._b * np.cos(q) - self._a * np.sin(q))[..., None]

    def inverse_dynamics(self, q: Array, q_dot: Array, q_ddot: Array) -> Array:  # noqa: ARG002
        """Torque of a motion without friction, from (..., 1) [rad], [rad/s], [rad/s²] to [N·m]."""
        return self._inertia * q_ddot + self.gravity_torque(q)
