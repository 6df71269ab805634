"""Rigid-body dynamics of robots on a fixed base, for batches."""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from elastic_env.core.compiled import compile_now
from elastic_env.core.errors import ConfigurationError, ElasticError, require_known
from elastic_env.core.signals import Array
from elastic_env.rigid.tree import kernels
from elastic_env.rigid.tree.links import Held, Tree


class RigidBody:
    r"""Torques of the joints of a fixed-base tree of hinges, on (..., n) arrays.

    .. math:: \tau = M \ddot q + c(q, \dot q) + \tau_g(q) - \tau_{gravcomp}(q) + k_s (q - q_s)

    k_s and q_s are stiffness and reference of the springs of the model's joints. Damping and
    friction of the model are not included.

    Attributes:
        tree: Links without a load.
        spring, spring_rest: k_s and q_s, (n,) each [N·m/rad], [rad].

    Args:
        model: Compiled rigid model.
        joints: Hinges of the model, in the order of the last axis.
        held: Position of every other joint by name or number, a hinge [rad] or a slide [m].

    Raises:
        ConfigurationError: A joint is no hinge, does not exist, or is left out.
    """

    def __init__(
        self, model: mujoco.MjModel, joints: Sequence[str], held: Held | None = None
    ) -> None:
        held = held or {}
        require_hinge_tree(model, joints, but=list(held))
        self.tree = Tree.of(model, joints, held)
        self._links: Any = self.tree.links
        self._loads: Any = np.zeros(1, kernels.loads_type(0))
        self._loads["gravity"] = model.opt.gravity
        self._n = len(joints)
        at = [int(model.joint(name).id) for name in joints]
        self.spring = model.jnt_stiffness[at].copy()
        self.spring_rest = model.qpos_spring[model.jnt_qposadr[at]].copy()
        self._has_springs = bool(self.spring.any())
        # the first command of a live robot cannot wait
        compile_now(self._compile, np.zeros((1, len(joints))))

    def gravity_torque(self, q: Array) -> Array:
        """Torque that holds the robot at rest, (..., n) [rad] to (..., n) [N·m]."""
        rows = self._rows(q)
        torque = np.empty(rows.shape)
        kernels.gravity_torques(self._links, self._loads, rows, torque)
        return self._add_springs(torque, q)

    def gravity_gradient(self, q: Array) -> Array:
        """Gradient of `gravity_torque`, (..., n) [rad] to (..., n, n) [N·m/rad]."""
        rows = self._rows(q)
        gradient = np.empty((*rows.shape, self._n))
        kernels.gravity_gradients(self._links, self._loads, rows, gradient)
        if self._has_springs:
            np.einsum("...ii->...i", gradient)[...] += self.spring
        return gradient.reshape(*q.shape, self._n)

    def inverse_dynamics(self, q: Array, q_dot: Array, q_ddot: Array) -> Array:
        """Torque of a motion without friction, (..., n) [rad], [rad/s], [rad/s²] to [N·m]."""
        if not q.shape == q_dot.shape == q_ddot.shape:
            got = f"got {q.shape}, {q_dot.shape} and {q_ddot.shape}"
            raise ElasticError(f"angles, rates, accelerations must have one shape, {got}")
        motion = (self._rows(q), self._rows(q_dot), self._rows(q_ddot))
        torque = np.empty(motion[0].shape)
        kernels.inverse_dynamics(self._links, self._loads, motion, torque)
        return self._add_springs(torque, q)

    def set_load(self, body: int, mass: float, place: Array) -> None:
        """Let a body carry one point mass, instead of the last one.

        Args:
            body: Number of the body in MuJoCo's model.
            mass: Mass of the load, 0 for none [kg].
            place: Its place in the frame of the body, (3,) [m].
        """
        self._links = self.tree.add_load(body, mass, place)

    def _add_springs(self, torque: Array, q: Array) -> Array:
        torque = torque.reshape(q.shape)
        if self._has_springs:
            torque = torque + self.spring * (q - self.spring_rest)
        return torque

    def _rows(self, values: Array) -> Array:
        """Convert (..., n) to contiguous (rows, n), so that one kernel fits all arrays."""
        if values.shape[-1:] != (self._n,):
            # compiled code does not check bounds
            needed = f"(..., {self._n}), got an array of shape {values.shape}"
            raise ElasticError(f"one value per joint is needed, {needed}")
        return np.ascontiguousarray(values, dtype=np.float64).reshape(-1, self._n)

    def _compile(self, zero: Array) -> None:
        self.gravity_torque(zero)
        self.gravity_gradient(zero)
        self.inverse_dynamics(zero, zero, zero)


def needs_more_than_gravity(model: mujoco.MjModel) -> bool:
    """Return True if springs of joints or `gravcomp` act on the links of a model."""
    return bool(model.jnt_stiffness.any() or model.body_gravcomp.any())


def require_hinge_tree(
    model: mujoco.MjModel, joints: Sequence[str], but: Sequence[str | int] = ()
) -> None:
    """Refuse a model with other moving joints than the named hinges, `but` some joints.

    Raises:
        ConfigurationError: A joint is no hinge, does not exist, or is left out.
    """
    names_of = [(j, model.joint(j).name) for j in range(model.njnt)]
    moving = [(j, name) for j, name in names_of if j not in but and name not in but]
    kinds = {name: model.jnt_type[j] for j, name in moving}
    names = list(kinds)
    for name, kind in kinds.items():
        if kind != mujoco.mjtJoint.mjJNT_HINGE:
            raise ConfigurationError(
                f"joint {name!r} of the rigid model is no hinge; trees of hinges are needed"
            )
    require_known("joint of the rigid model", joints, names)
    if sorted(joints) != sorted(names):
        needed = f"all {len(names)} joints must be named ({', '.join(names)})"
        raise ConfigurationError(f"{needed}, got {len(joints)}: {', '.join(joints)}")
