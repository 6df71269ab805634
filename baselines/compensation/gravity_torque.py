"""Gravity torque of the assumed rigid model: what the compensators turn into a deflection.

`gravity_torque(q)` and its gradient on (..., n) joint angles, from Pinocchio (the reference, row by row) or for a whole
batch at once: in closed form for one hinge, from NumPy for a tree of them. All agree to rounding.
"""

from collections.abc import Callable
from typing import Any, Literal, Protocol, get_args

import mujoco
import numpy as np

from baselines.compensation.contact_torque import ContactGravity, ContactMethod, PlannedTorque, WrenchTorque
from elastic_env.core.errors import ConfigurationError, require_known
from elastic_env.core.signals import Array
from elastic_env.dynamics.rigid_body import RigidBody, require_hinge_tree
from elastic_env.dynamics.tree_torque import TreeTorque, needs_more_than_gravity
from elastic_env.runtime.robot_model import RobotModel, WalkerModel

GravityMethod = Literal["hinge", "pinocchio", "batched", "com", "ankle", "lumped"]


class GravityModel(Protocol):
    """Torque that holds the robot at rest, and its gradient."""

    def gravity_torque(self, q: Array) -> Array:
        """τ_g, (..., n) [rad] to (..., n) [N·m]."""
        ...

    def gravity_gradient(self, q: Array) -> Array:
        """∂τ_g/∂q, (..., n) [rad] to (..., n, n) [N·m/rad]."""
        ...


class FixedGravity:
    """Gravity torque of a robot that stands on nothing but its base: the same at every control step."""

    def __init__(self, gravity: GravityModel) -> None:
        self.gravity_torque, self.gravity_gradient = gravity.gravity_torque, gravity.gravity_gradient

    def at(self, rows: Array, level: bool = True) -> "FixedGravity":  # noqa: ARG002  a walker's
        """Itself."""
        return self


class FixedDynamics:
    """Inverse dynamics of a robot on a fixed base."""

    def __init__(self, model: RobotModel) -> None:
        body = HingeTorque(model) if _is_plain_hinge(model) else TreeTorque(model.rigid, model.joint_names)
        self.inverse_dynamics = body.inverse_dynamics

    def at(self, rows: Array) -> "FixedDynamics":  # noqa: ARG002  a walker's
        """Itself."""
        return self


def make_gravity(model: RobotModel, method: GravityMethod | None = None) -> Any:
    """The gravity torque of a robot model by a chosen method; a `GravityModel` after `at(observations)`.

    A robot on a fixed base has "hinge" (default for one joint), "pinocchio" (default for several) and "batched", and is
    a `GravityModel` at once; a walker has the methods of `baselines.compensation.contact_torque`:
    "com" (default), "ankle" and "lumped".

    Raises:
        ConfigurationError: The method does not exist, or not for this robot.
    """
    if isinstance(model, WalkerModel):
        chosen: Any = method or "com"
        require_known("gravity method of a walker", [chosen], get_args(ContactMethod))
        return ContactGravity(model, chosen)
    methods: dict[str, Callable[[RobotModel], GravityModel]] = {
        "hinge": HingeTorque,
        "pinocchio": lambda model: TreeTorque(model.rigid, model.joint_names),
        "batched": BatchedGravity,
    }
    chosen = method or ("hinge" if _is_plain_hinge(model) else "pinocchio")
    require_known("gravity method", [chosen], methods)
    if chosen != "pinocchio" and needs_more_than_gravity(model.rigid):
        raise ConfigurationError(
            f"gravity method {chosen!r} knows gravity alone, and this model has springs of joints or gravcomp; "
            "choose pinocchio"
        )
    return FixedGravity(methods[chosen](model))


def _is_plain_hinge(model: RobotModel) -> bool:
    """Whether the closed form of one hinge holds."""
    return len(model.joint_names) == 1 and not needs_more_than_gravity(model.rigid)


def make_load(model: RobotModel, output: str, gravity: Any) -> Any:
    """The torque that an output compensator takes: of gravity, or of the measured foot wrenches.

    Raises:
        ConfigurationError: The robot has no feet.
    """
    if output != "wrench":
        return gravity
    if not isinstance(model, WalkerModel):
        raise ConfigurationError("the output compensator 'wrench' needs a walker with force-torque sensors at its feet")
    return WrenchTorque(model)


def make_dynamics(model: RobotModel, gravity: Any) -> Any:
    """Inverse dynamics of a robot model: of any motion on a fixed base, of the planned one for a walker."""
    return PlannedTorque(model, gravity) if isinstance(model, WalkerModel) else FixedDynamics(model)


class HingeTorque:
    r"""Torque of a robot with one hinge in closed form, from what Pinocchio says of three states.

    .. math:: \tau = I \ddot q + a \cos q + b \sin q

    Args:
        model: Robot with one joint, about which its inertia I is always the same.

    Raises:
        ConfigurationError: It has more joints.
    """

    def __init__(self, model: RobotModel) -> None:
        names = model.joint_names
        if len(names) != 1:
            raise ConfigurationError(
                f"gravity method 'hinge' needs one joint, got {len(names)}: {', '.join(names)}; choose pinocchio or "
                "batched"
            )
        body, zero = RigidBody(model.rigid, names), np.zeros(1)
        self._a, self._b = body.gravity_torque(zero), body.gravity_torque(zero + np.pi / 2)
        self._inertia = body.inverse_dynamics(zero, zero, np.ones(1)) - self._a

    def gravity_torque(self, q: Array) -> Array:
        """See `GravityModel`."""
        return self._a * np.cos(q) + self._b * np.sin(q)

    def gravity_gradient(self, q: Array) -> Array:
        """See `GravityModel`."""
        return (self._b * np.cos(q) - self._a * np.sin(q))[..., None]

    def inverse_dynamics(self, q: Array, q_dot: Array, q_ddot: Array) -> Array:  # noqa: ARG002  as of a `RigidBody`
        """Torque of a motion without friction, from (..., 1) [rad], [rad/s], [rad/s²] to (..., 1) [N·m]."""
        return self._inertia * q_ddot + self.gravity_torque(q)


class BatchedGravity:
    r"""Gravity torque of a tree of hinges in NumPy, without a loop over the rows of a batch.

    With axis z_i and anchor a_i of joint i, and mass m_i and first moment s_i = Σ m c of all that it carries:

    .. math:: \tau_i = -g \cdot (z_i \times (s_i - m_i a_i)), \quad
              \partial\tau_i/\partial q_j = -g \cdot (z_i \times (z_j \times (s_j - m_j a_j)))

    for j carried by i (the gradient is symmetric, and zero for joints on different branches).
    """

    def __init__(self, model: RobotModel) -> None:
        require_hinge_tree(model.rigid, model.joint_names)
        self._rigid = model.rigid
        self._joints = [model.rigid.joint(name).id for name in model.joint_names]
        self._carried = np.array([[_carries(model.rigid, i, j) for j in self._joints] for i in self._joints])

    def gravity_torque(self, q: Array) -> Array:
        """See `GravityModel`."""
        axes, levers = self._moments(q)
        return -(np.cross(axes, levers) @ self._rigid.opt.gravity)

    def gravity_gradient(self, q: Array) -> Array:
        """See `GravityModel`."""
        axes, levers = self._moments(q)
        turned = np.cross(axes, levers)  # z_j × (s_j − m_j a_j), (..., n, 3)
        below = -np.cross(axes[..., :, None, :], turned[..., None, :, :]) @ self._rigid.opt.gravity
        return np.where(self._carried, below, np.where(self._carried.T, below.swapaxes(-1, -2), 0.0))

    def _moments(self, q: Array) -> tuple[Array, Array]:
        """Axis z_i and lever s_i − m_i a_i of every joint, (..., n, 3) each, in the world frame."""
        m, batch = self._rigid, q.shape[:-1]
        angle = dict(zip(self._joints, np.moveaxis(q, -1, 0), strict=True))
        R_wb, p_wb = {0: np.broadcast_to(np.eye(3), (*batch, 3, 3))}, {0: np.zeros((*batch, 3))}
        axis, anchor = {}, {}
        first_moment = np.zeros((m.nbody, *batch, 3))
        for b in range(1, m.nbody):
            parent = int(m.body_parentid[b])
            R = R_wb[parent] @ _matrix(m.body_quat[b])
            p = p_wb[parent] + R_wb[parent] @ m.body_pos[b]
            for j in range(m.body_jntadr[b], m.body_jntadr[b] + m.body_jntnum[b]):
                anchor[j], axis[j] = p + R @ m.jnt_pos[j], R @ m.jnt_axis[j]
                R = R @ _rotation(m.jnt_axis[j], angle[j] - m.qpos0[m.jnt_qposadr[j]])
                p = anchor[j] - R @ m.jnt_pos[j]
            R_wb[b], p_wb[b] = R, p
            first_moment[b] = m.body_mass[b] * (p + R @ m.body_ipos[b])
        for b in range(m.nbody - 1, 0, -1):  # children come after their parents
            first_moment[m.body_parentid[b]] += first_moment[b]
        body = m.jnt_bodyid
        levers = [first_moment[body[j]] - m.body_subtreemass[body[j]] * anchor[j] for j in self._joints]
        return np.stack([axis[j] for j in self._joints], axis=-2), np.stack(levers, axis=-2)


def _carries(model: mujoco.MjModel, i: int, j: int) -> bool:
    """Whether joint i carries joint j, or is it."""
    if model.jnt_bodyid[i] == model.jnt_bodyid[j]:
        return i <= j
    body = int(model.jnt_bodyid[j])
    while body != 0:
        body = int(model.body_parentid[body])
        if body == model.jnt_bodyid[i]:
            return True
    return False


def _rotation(axis: Array, angle: Array) -> Array:
    """Rotation about a unit axis, (...) [rad] to (..., 3, 3), by Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sine, versine = np.sin(angle)[..., None, None], (1.0 - np.cos(angle))[..., None, None]
    return np.eye(3) + sine * cross + versine * (cross @ cross)


def _matrix(quaternion: Array) -> Array:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)
