"""An arm at rest: torques with and without a payload, and the pose of a body of it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from baselines.compensation.position_compensator import PositionCompensator
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.joint.model_joints import held_positions
from elastic_env.rigid.tree.end_effector import EndEffector, outermost_body, site_or_body
from elastic_env.world.robot_model import joint_ranges

_STEP_RAD = 1e-4
"""Step of central differences, for a relative error of 1e-9."""


@dataclass(frozen=True)
class Attitude:
    """Poses of a body or site, and their derivatives by the joint angles.

    Attributes:
        position: Position in the model's world frame, (N, 3) [m].
        rotation: Rotation from its frame to the world's, (N, 3, 3).
        position_gradient: Derivatives of the position, (N, 3, n) [m/rad].
        rotation_gradient: Derivatives of the angular velocity by the joint rates, (N, 3, n).
    """

    position: Array
    rotation: Array
    position_gradient: Array
    rotation_gradient: Array


class StaticArm:
    """Torques and poses of a rigid model at rest.

    Args:
        model: Compiled rigid model on a fixed base.
        joints: Hinges in the order of all arrays; the others are held, see `PositionCompensator`.
        end_effector: Site or body that is measured; None for the outermost named body that the
            joints move.
        payload: Body or site that carries a payload of unknown mass at its origin; None for no
            payload.

    Raises:
        ConfigurationError: The model has no gravity or cannot be used, or a name does not exist.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        joints: Sequence[str],
        end_effector: str | None = None,
        payload: str | None = None,
    ) -> None:
        if not model.opt.gravity.any():
            raise ConfigurationError(
                "the model has no gravity, so nothing bends its joints; set <option gravity=...>"
            )
        self.model = model
        self.joints = tuple(joints)
        # only for its torque, which takes springs, `gravcomp` and held joints into account
        self._bare = PositionCompensator(model, np.inf, joints=joints).constants.body
        self._loaded = None
        if payload is not None:
            body, place, _ = site_or_body(model, payload)
            loaded = PositionCompensator(model, np.inf, joints=joints)
            loaded.set_payload(1.0, place, model.body(body).name)
            self._loaded = loaded.constants.body
        if end_effector is not None:
            site_or_body(model, end_effector)  # checks the name even if it is unused
        self._end_effector = end_effector
        self.ranges = np.column_stack(joint_ranges(model, joints))

    @cached_property
    def end_effector(self) -> str:
        """Site or body that is measured."""
        return self._end_effector or outermost_body(self.model)

    @cached_property
    def _tool(self) -> EndEffector:
        held = held_positions(self.model, self.joints)
        return EndEffector(self.model, self.joints, self.end_effector, held)

    @property
    def up(self) -> Array:
        """Unit vector against gravity in the world frame, (3,)."""
        return -self.model.opt.gravity / np.linalg.norm(self.model.opt.gravity)

    def torque(self, q: Array) -> Array:
        """Torque that holds the arm without payload, (N, n) [rad] to (N, n) [N·m]."""
        return self._bare.gravity_torque(q)

    def payload_torque(self, q: Array) -> Array:
        """Torque that a payload of 1 kg adds, (N, n) [rad] to (N, n) [N·m]; 0 without one."""
        if self._loaded is None:
            return np.zeros(q.shape)
        return self._loaded.gravity_torque(q) - self._bare.gravity_torque(q)

    def torque_gradient(self, q: Array, payload_kg: float = 0.0) -> Array:
        """∂τ/∂q by central differences, (N, n) [rad] to (N, n, n) [N·m/rad]."""
        columns = []
        for step in _STEP_RAD * np.eye(q.shape[-1]):
            change = self.torque(q + step) - self.torque(q - step)
            if payload_kg:
                change += payload_kg * (
                    self.payload_torque(q + step) - self.payload_torque(q - step)
                )
            columns.append(change / (2.0 * _STEP_RAD))
        return np.stack(columns, axis=-1)

    def attitude(self, q: Array) -> Attitude:
        """Poses of the end effector, (N, n) [rad]."""
        return Attitude(*self._tool.pose(q), *self._tool.jacobian(q))
