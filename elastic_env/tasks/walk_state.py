"""State and measurements of the walkers of a batch, one row per world."""

from dataclasses import dataclass, fields
from typing import Self

import numpy as np

from elastic_env.robots.robot_model import WalkerModel
from elastic_env.robots.thormang import LEG_JOINTS
from elastic_env.signals import Array, BoolArray

_JOINTS, _WRENCHES = len(LEG_JOINTS), 12


@dataclass(frozen=True)
class WalkTruth:
    """Noise-free state of the walker and its true parameters, one row per world. For scoring and the oracle.

    Attributes:
        theta, theta_dot, q, q_dot: Motor and link side, (num_worlds, 12) [rad], [rad/s].
        pelvis: Position of the pelvis, (num_worlds, 3) [m].
        pelvis_R: Orientation of the pelvis, (num_worlds, 3, 3).
        ankles: Positions of the ankles, (num_worlds, 2, 3) [m].
        stiffness: True K, (num_worlds, 12) [N·m/rad].
        model: The true joints and masses, a spread of stiffness aside.
    """

    theta: Array
    theta_dot: Array
    q: Array
    q_dot: Array
    pelvis: Array
    pelvis_R: Array
    ankles: Array
    stiffness: Array
    model: WalkerModel


class _Rows:
    """Arrays with one row per world."""

    def with_worlds(self, worlds: BoolArray, other: Self) -> Self:
        """These values with those of another in some worlds, a (num_worlds,) mask."""
        chosen = {}
        for name in (field.name for field in fields(self)):  # type: ignore[arg-type]
            mine = getattr(self, name)
            chosen[name] = np.where(worlds.reshape(-1, *[1] * (mine.ndim - 1)), getattr(other, name), mine)
        return type(self)(**chosen)


@dataclass(frozen=True)
class WalkState(_Rows):
    """The true state, n rows.

    Attributes:
        theta, theta_dot, q, q_dot: Motor and link side, (n, 12).
        pelvis, pelvis_R: Pose of the pelvis, (n, 3), (n, 3, 3).
        attitude: Roll, pitch and tilt of the pelvis, (n, 3) [rad].
        rate: Angular velocity of the pelvis in its own frame, (n, 3) [rad/s].
        ankles: Positions of the ankles, (n, 2, 3) [m].
        wrench: Force and moment of both feet on their legs, in the frames of the feet, (n, 12) [N], [N·m].
        force: Vertical force of the ground on both feet, (n, 2) [N].
        zmp: (n, 2) [m], nan where the feet are not loaded.
        servo_torque: (n, 12) [N·m].
    """

    theta: Array
    theta_dot: Array
    q: Array
    q_dot: Array
    pelvis: Array
    pelvis_R: Array
    attitude: Array
    rate: Array
    ankles: Array
    wrench: Array
    force: Array
    zmp: Array
    servo_torque: Array

    @classmethod
    def zeros(cls, n: int) -> "WalkState":
        """A state to be overwritten."""
        theta, theta_dot, q, q_dot, torque = np.zeros((5, n, _JOINTS))
        return cls(
            theta=theta, theta_dot=theta_dot, q=q, q_dot=q_dot, pelvis=np.zeros((n, 3)), pelvis_R=np.zeros((n, 3, 3)),
            attitude=np.zeros((n, 3)), rate=np.zeros((n, 3)), ankles=np.zeros((n, 2, 3)),
            wrench=np.zeros((n, _WRENCHES)), force=np.zeros((n, 2)), zmp=np.zeros((n, 2)), servo_torque=torque,
        )  # fmt: skip


@dataclass(frozen=True)
class WalkMeasurement(_Rows):
    """Sensor values, n rows; the encoders also a control period earlier. Units and shapes as in `WalkState`."""

    encoder: Array
    encoder_before: Array
    attitude: Array
    rate: Array
    wrench: Array

    @classmethod
    def zeros(cls, n: int) -> "WalkMeasurement":
        """A measurement to be overwritten."""
        encoder, before = np.zeros((2, n, _JOINTS))
        return cls(encoder, before, np.zeros((n, 2)), np.zeros((n, 3)), np.zeros((n, _WRENCHES)))


def rms(values: Array) -> Array:
    """Root of the mean square over the last axis."""
    return np.sqrt(np.einsum("...i,...i", values, values) / values.shape[-1])


def rotation_of(quaternion: Array) -> Array:
    """Rotation of unit quaternions w, x, y, z, (n, 4) to (n, 3, 3)."""
    w, x, y, z = quaternion.T
    R = np.empty((len(quaternion), 3, 3))
    R[:, 0, 0], R[:, 0, 1], R[:, 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    R[:, 1, 0], R[:, 1, 1], R[:, 1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    R[:, 2, 0], R[:, 2, 1], R[:, 2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return R


def attitude_of(R: Array) -> Array:
    """Roll and pitch (of yaw, pitch, roll) and the angle between z axis and vertical, (n, 3, 3) to (n, 3) [rad]."""
    roll = np.arctan2(R[:, 2, 1], R[:, 2, 2])
    pitch = -np.arcsin(np.clip(R[:, 2, 0], -1.0, 1.0))
    tilt = np.arctan2(np.hypot(R[:, 0, 2], R[:, 1, 2]), R[:, 2, 2])
    return np.stack([roll, pitch, tilt], axis=-1)
