"""The walker's truth and measurements, one row per world: which column of an array is what."""

import math
from dataclasses import dataclass

import numpy as np

from elastic_env.compiled import compiled
from elastic_env.robots.robot_model import WalkerModel
from elastic_env.robots.thormang import LEG_JOINTS
from elastic_env.rows import Rows
from elastic_env.signals import Array, IntArray

JOINTS = len(LEG_JOINTS)


def _begins(*widths: int) -> list[int]:
    """Where groups of columns begin that stand side by side, and where the last one ends."""
    return [sum(widths[:i]) for i in range(len(widths) + 1)]


# Columns where groups begin, as single numbers: compiled code takes them for constants. What is not said here is said
# by the properties of `WalkRecord`.
#   state        THETA to Q_DOT, PELVIS [m], QUATERNION, PELVIS_RATE (in its frame, [rad/s]), ATTITUDE, ANKLES,
#                WRENCH (of both feet on the legs, in the frames of the feet, [N], [N·m]), FORCE, ZMP, SERVO_TORQUE
#   of the step  STIFFNESS, OFFSET (commanded, [rad]), COMMAND (q_ref + offset, [rad]), COMMAND_RATE, STEP,
#                CONTACT_SINCE
#   measured     ENCODER, ENCODER_BEFORE (one step) [rad], IMU_ATTITUDE (roll, pitch, [rad]), GYRO (as PELVIS_RATE),
#                SENSORS (as WRENCH)
THETA, Q, PELVIS, QUATERNION, POSITION_END = _begins(JOINTS, JOINTS, 3, 4)
THETA_DOT, Q_DOT, PELVIS_RATE, VELOCITY_END = (POSITION_END + i for i in _begins(JOINTS, JOINTS, 3))
ATTITUDE, ANKLES, WRENCH, FORCE, ZMP, SERVO_TORQUE, STATE_END = (
    VELOCITY_END + i for i in _begins(3, 6, 12, 2, 2, JOINTS)
)
STIFFNESS, OFFSET, COMMAND, COMMAND_RATE, STEP, CONTACT_SINCE, TRUTH_END = (
    STATE_END + i for i in _begins(JOINTS, JOINTS, JOINTS, 1, 1, 1)
)
ENCODER, ENCODER_BEFORE, IMU_ATTITUDE, GYRO, SENSORS, SCORES = (
    TRUTH_END + i for i in _begins(JOINTS, JOINTS, 2, 3, 12)
)
REWARD_TERMS = ("tilt", "zmp", "effort", "smoothness", "fall")
RECORD_END = SCORES + len(REWARD_TERMS)


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
class WalkRecord(Rows):
    """What is true of a control step, what is measured, and how it scores, n rows.

    Attributes:
        values: (n, RECORD_END), see the properties.
    """

    values: Array

    @property
    def theta(self) -> Array:
        """Motor side, (n, 12) [rad]."""
        return self._joints(THETA)

    @property
    def q(self) -> Array:
        """Link side, (n, 12) [rad]."""
        return self._joints(Q)

    @property
    def pelvis(self) -> Array:
        """Position of the pelvis, (n, 3) [m]."""
        return self.values[:, PELVIS:QUATERNION]

    @property
    def quaternion(self) -> Array:
        """Orientation of the pelvis, w, x, y, z, (n, 4)."""
        return self.values[:, QUATERNION:POSITION_END]

    @property
    def theta_dot(self) -> Array:
        """Rate of the motor side, (n, 12) [rad/s]."""
        return self._joints(THETA_DOT)

    @property
    def q_dot(self) -> Array:
        """Rate of the link side, (n, 12) [rad/s]."""
        return self._joints(Q_DOT)

    @property
    def attitude(self) -> Array:
        """Roll, pitch and tilt of the pelvis, (n, 3) [rad]."""
        return self.values[:, ATTITUDE:ANKLES]

    @property
    def ankles(self) -> Array:
        """Positions of the ankles, (n, 2, 3) [m]."""
        return self.values[:, ANKLES:WRENCH].reshape(-1, 2, 3)

    @property
    def force(self) -> Array:
        """Vertical force of the ground on both feet, (n, 2) [N]."""
        return self.values[:, FORCE:ZMP]

    @property
    def zmp(self) -> Array:
        """ZMP, (n, 2) [m], nan where the feet are not loaded."""
        return self.values[:, ZMP:SERVO_TORQUE]

    @property
    def servo_torque(self) -> Array:
        """Torque of the servos, (n, 12) [N·m]."""
        return self._joints(SERVO_TORQUE)

    @property
    def stiffness(self) -> Array:
        """True K, (n, 12) [N·m/rad]."""
        return self._joints(STIFFNESS)

    @property
    def command_rate(self) -> Array:
        """Rate of change of the command offsets, rms over the joints, (n,) [rad/s]."""
        return self.values[:, COMMAND_RATE]

    @property
    def step(self) -> IntArray:
        """Control steps since the start of the episode, (n,)."""
        return self.values[:, STEP].astype(np.int64)

    @property
    def contact_since(self) -> IntArray:
        """Step in which the swing foot first touched in the second half of its swing, (n,); negative if it has not."""
        return self.values[:, CONTACT_SINCE].astype(np.int64)

    @property
    def scores(self) -> Array:
        """Terms of the reward by `REWARD_TERMS`, (n, 5)."""
        return self.values[:, SCORES:RECORD_END]

    def _joints(self, begin: int) -> Array:
        return self.values[:, begin : begin + JOINTS]


def highest(values: Array) -> Array:
    """Maximum over the last axis of (n, m); NumPy is several times as fast over a first axis."""
    return values.T.copy().max(axis=0)


@compiled
def rms(values: Array) -> Array:
    """Root of the mean square over the last axis of (n, m)."""
    found = np.zeros(len(values))
    for row in range(len(values)):
        for value in values[row]:
            found[row] += value * value
        found[row] = math.sqrt(found[row] / values.shape[1])
    return found


def rotation_of(quaternion: Array) -> Array:
    """Rotation of unit quaternions w, x, y, z, (n, 4) to (n, 3, 3)."""
    w, x, y, z = quaternion.T
    R = np.empty((len(quaternion), 3, 3))
    R[:, 0, 0], R[:, 0, 1], R[:, 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    R[:, 1, 0], R[:, 1, 1], R[:, 1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    R[:, 2, 0], R[:, 2, 1], R[:, 2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return R


@compiled
def attitude_of(quaternion: Array) -> Array:
    """Roll and pitch (of yaw, pitch, roll) and the angle between z axis and vertical, (n, 4) to (n, 3) [rad]."""
    attitude = np.empty((len(quaternion), 3))
    for row in range(len(quaternion)):
        w, x, y, z = quaternion[row, 0], quaternion[row, 1], quaternion[row, 2], quaternion[row, 3]
        # the vertical in the frame of the pelvis
        up_x, up_y, up_z = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)
        attitude[row, 0] = math.atan2(up_y, up_z)
        attitude[row, 1] = math.asin(min(max(-up_x, -1.0), 1.0))
        attitude[row, 2] = math.atan2(math.hypot(up_x, up_y), up_z)
    return attitude
