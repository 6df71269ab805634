"""State and measurements of the walkers of a batch, one row per world."""

from dataclasses import dataclass

import numpy as np

from elastic_env.robots.robot_model import WalkerModel
from elastic_env.robots.thormang import LEG_JOINTS
from elastic_env.rows import Rows
from elastic_env.signals import Array, IntArray

_JOINTS, _WRENCHES = len(LEG_JOINTS), 12
ATTITUDE, RATE, WRENCH = slice(0, 2), slice(2, 5), slice(5, 17)
"""Columns of what the body's sensors measure."""


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


@dataclass(frozen=True, slots=True)
class WalkState(Rows):
    """The true state, n rows.

    Attributes:
        position: Motor side, link side, and pose of the pelvis, (n, 31), see the properties.
        velocity: Motor side, link side, and angular velocity of the pelvis, (n, 27), see the properties.
        attitude: Roll, pitch and tilt of the pelvis, (n, 3) [rad].
        ankles: Positions of the ankles, (n, 2, 3) [m].
        wrench: Force and moment of both feet on their legs, in the frames of the feet, (n, 12) [N], [N·m].
        force: Vertical force of the ground on both feet, (n, 2) [N].
        zmp: (n, 2) [m], nan where the feet are not loaded.
        servo_torque: (n, 12) [N·m].
    """

    position: Array
    velocity: Array
    attitude: Array
    ankles: Array
    wrench: Array
    force: Array
    zmp: Array
    servo_torque: Array

    @classmethod
    def zeros(cls, n: int) -> "WalkState":
        """A state to be overwritten."""
        return cls(
            position=np.zeros((n, 2 * _JOINTS + 7)), velocity=np.zeros((n, 2 * _JOINTS + 3)),
            attitude=np.zeros((n, 3)), ankles=np.zeros((n, 2, 3)), wrench=np.zeros((n, _WRENCHES)),
            force=np.zeros((n, 2)), zmp=np.zeros((n, 2)), servo_torque=np.zeros((n, _JOINTS)),
        )  # fmt: skip

    @property
    def theta(self) -> Array:
        """Motor side, (n, 12) [rad]."""
        return self.position[:, :_JOINTS]

    @property
    def q(self) -> Array:
        """Link side, (n, 12) [rad]."""
        return self.position[:, _JOINTS : 2 * _JOINTS]

    @property
    def pelvis(self) -> Array:
        """Position of the pelvis, (n, 3) [m]."""
        return self.position[:, 2 * _JOINTS : 2 * _JOINTS + 3]

    @property
    def quaternion(self) -> Array:
        """Orientation of the pelvis, w, x, y, z, (n, 4)."""
        return self.position[:, 2 * _JOINTS + 3 :]

    @property
    def theta_dot(self) -> Array:
        """Rate of the motor side, (n, 12) [rad/s]."""
        return self.velocity[:, :_JOINTS]

    @property
    def q_dot(self) -> Array:
        """Rate of the link side, (n, 12) [rad/s]."""
        return self.velocity[:, _JOINTS : 2 * _JOINTS]

    @property
    def rate(self) -> Array:
        """Angular velocity of the pelvis in its own frame, (n, 3) [rad/s]."""
        return self.velocity[:, 2 * _JOINTS :]


@dataclass(frozen=True, slots=True)
class WalkMeasurement(Rows):
    """Sensor values, n rows.

    Attributes:
        encoder, encoder_before: Now and a control period earlier, (n, 12) [rad].
        body: IMU attitude and rate, and foot wrenches, (n, 17), in the columns `ATTITUDE`, `RATE` and `WRENCH`.
    """

    encoder: Array
    encoder_before: Array
    body: Array

    @classmethod
    def zeros(cls, n: int) -> "WalkMeasurement":
        """A measurement to be overwritten."""
        encoder, before = np.zeros((2, n, _JOINTS))
        return cls(encoder, before, np.zeros((n, WRENCH.stop)))


@dataclass(frozen=True, slots=True)
class WalkSample(Rows):
    """What a step is scored by, n rows.

    Attributes:
        step: Control steps since the start of the episode, (n,).
        state: The true state.
        offset, offset_before: Command offsets of the last control period and of the one before, (n, 12) [rad].
        stiffness: True K, (n, 12) [N·m/rad].
        contact_since: Step in which the swing foot first touched in the second half of its swing, (n,); negative where
            it has not.
    """

    step: IntArray
    state: WalkState
    offset: Array
    offset_before: Array
    stiffness: Array
    contact_since: IntArray


def highest(values: Array) -> Array:
    """Maximum over the last axis of (n, m); NumPy is several times as fast over a first axis."""
    return values.T.copy().max(axis=0)


def rms(values: Array) -> Array:
    """Root of the mean square over the last axis."""
    return np.sqrt(np.vecdot(values, values) / values.shape[-1])


def rotation_of(quaternion: Array) -> Array:
    """Rotation of unit quaternions w, x, y, z, (n, 4) to (n, 3, 3)."""
    w, x, y, z = quaternion.T
    R = np.empty((len(quaternion), 3, 3))
    R[:, 0, 0], R[:, 0, 1], R[:, 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    R[:, 1, 0], R[:, 1, 1], R[:, 1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    R[:, 2, 0], R[:, 2, 1], R[:, 2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return R


def attitude_of(quaternion: Array) -> Array:
    """Roll and pitch (of yaw, pitch, roll) and the angle between z axis and vertical, (n, 4) to (n, 3) [rad]."""
    w, x, y, z = quaternion.T
    # the vertical in the frame of the pelvis
    up_x, up_y, up_z = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)
    attitude = np.empty((3, len(quaternion)))
    np.arctan2(up_y, up_z, out=attitude[0])
    np.arcsin(np.minimum(np.maximum(-up_x, -1.0), 1.0), out=attitude[1])
    np.arctan2(np.hypot(up_x, up_y), up_z, out=attitude[2])
    return attitude.T
