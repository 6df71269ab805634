"""Torque that the joints of a rigid tree have to deliver: gravity, inertia, springs of joints,
less `gravcomp`.
"""

from collections.abc import Mapping, Sequence

import mujoco

from elastic_env.core.signals import Array
from elastic_env.rigid.rigid_body import RigidBody


class TreeTorque:
    r"""What MuJoCo's links ask of the joints that move them, on (..., n) arrays.

    .. math:: \tau = M \ddot q + c(q, \dot q) + \tau_g(q) - \tau_{gravcomp}(q) + k_s (q - q_s)

    k_s and q_s are stiffness and reference of the springs that the model's joints have. Damping and
    friction of the model are not in it.

    Args:
        model: Compiled rigid model on a fixed base.
        joints: Hinges of the model, in the order of the last axis.
        held: Position of every other joint by name or number, a hinge [rad] or a slide [m].

    Raises:
        ConfigurationError: A joint is no hinge, does not exist, or is left out.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        joints: Sequence[str],
        held: Mapping[str, float] | Mapping[int, float] | None = None,
    ) -> None:
        self._body = RigidBody(model, joints, held, gravcomp=True)
        at = [int(model.joint(name).id) for name in joints]
        self._spring = model.jnt_stiffness[at].copy()
        self._spring_rest = model.qpos_spring[model.jnt_qposadr[at]].copy()
        self.has_springs = bool(self._spring.any())

    def gravity_torque(self, q: Array) -> Array:
        """Torque at rest, from (..., n) [rad] to (..., n) [N·m]; springs and `gravcomp` are in
        it.
        """
        return self._with_springs(self._body.gravity_torque(q), q)

    def gravity_gradient(self, q: Array) -> Array:
        """Its gradient, from (..., n) [rad] to (..., n, n) [N·m/rad]."""
        gradient = self._body.gravity_gradient(q)
        if self.has_springs:
            gradient.reshape(-1, gradient.shape[-1] ** 2)[:, :: gradient.shape[-1] + 1] += (
                self._spring
            )
        return gradient

    def inverse_dynamics(self, q: Array, q_dot: Array, q_ddot: Array) -> Array:
        """Torque of a motion, from (..., n) [rad], [rad/s], [rad/s²] to (..., n) [N·m]."""
        return self._with_springs(self._body.inverse_dynamics(q, q_dot, q_ddot), q)

    def set_load(self, body: int, mass: float, place: Array) -> None:
        """Let a body carry one point mass; arguments as of `RigidBody.set_load`."""
        self._body.set_load(body, mass, place)

    def _with_springs(self, torque: Array, q: Array) -> Array:
        return torque + self._spring * (q - self._spring_rest) if self.has_springs else torque


def needs_more_than_gravity(model: mujoco.MjModel) -> bool:
    """Whether springs of joints or `gravcomp` act on the links of a model."""
    return bool(model.jnt_stiffness.any() or model.body_gravcomp.any())
