"""The walker's truth, measurements and scores: one row per world, fields by name.

NumPy's structured types, which Numba compiles as they stand: `row.theta[i]` in a kernel, `rows["theta"]` in NumPy.
Truth is what the physics did, measurements are what sensors show of it, and nothing is in both.
"""

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.rows import Rows
from elastic_env.core.signals import Array
from elastic_env.robots.thormang.model import LEG_JOINTS
from elastic_env.robots.thormang.tables import GROUPS
from elastic_env.runtime.robot_model import WalkerModel

Records: TypeAlias = npt.NDArray[Any]
"""An array of one of these types, one row per world."""

REAL, WHOLE = np.float64, np.int64
NUM_JOINTS = len(LEG_JOINTS)


def record_type(*fields: tuple[Any, ...]) -> np.dtype[Any]:
    """A structured type whose rows have their fields as attributes, compiled or not."""
    return np.dtype((np.record, list(fields)))


_FEET_WRENCH = (2, 2, 3)  # feet, force and moment, axes

TRUTH = record_type(
    ("step", WHOLE),  # control steps since the start of the episode
    ("theta", REAL, NUM_JOINTS), ("theta_dot", REAL, NUM_JOINTS),  # motor side [rad], [rad/s]
    ("q", REAL, NUM_JOINTS), ("q_dot", REAL, NUM_JOINTS),  # link side [rad], [rad/s]
    ("servo_torque", REAL, NUM_JOINTS),  # [N·m]
    ("stiffness", REAL, NUM_JOINTS),  # true K [N·m/rad]
    ("damping", REAL, NUM_JOINTS), ("backlash", REAL, NUM_JOINTS),  # true D [N·m·s/rad], dead band [rad]
    ("offset", REAL, NUM_JOINTS), ("command", REAL, NUM_JOINTS),  # a, and θ_cmd = q_ref + a [rad]
    ("command_rate", REAL),  # rms over the joints of the change of a [rad/s]
    ("pelvis", REAL, 3), ("quaternion", REAL, 4),  # position [m], orientation w, x, y, z
    ("pelvis_velocity", REAL, 3),  # of its origin, where the IMU is, in the world [m/s]
    ("pelvis_rate", REAL, 3),  # in the frame of the pelvis [rad/s]
    ("roll", REAL), ("pitch", REAL), ("tilt", REAL),  # of yaw, pitch, roll; angle from the vertical [rad]
    ("ankles", REAL, (2, 3)),  # positions [m]
    ("wrench", REAL, _FEET_WRENCH),  # of the feet on the legs, in the frames of the feet [N], [N·m]
    ("force", REAL, 2),  # vertical force of the ground on the feet [N]
    ("zmp", REAL, 2),  # [m], nan where the feet are not loaded
    ("contact_since", WHOLE),  # step of the first touch in the second half of the swing, -1 before it
)  # fmt: skip
"""What the physics did in a control step."""

MEASURED = record_type(
    ("encoder", REAL, NUM_JOINTS), ("encoder_before", REAL, NUM_JOINTS),  # now and one control step ago [rad]
    ("imu_attitude", REAL, 2), ("imu_rate", REAL, 3),  # roll and pitch [rad], as pelvis_rate [rad/s]
    ("wrench", REAL, _FEET_WRENCH),  # as in the truth
    # within an inertial IMU: vertical in its frame by its filter [1], rate by its gyroscope [rad/s]
    ("imu_up", REAL, 3), ("imu_gyro", REAL, 3),
)  # fmt: skip
"""What the sensors show, and what one of them keeps."""

NOISE = record_type(*((group.name, REAL, group.shape) for group in GROUPS if group.noise is not None))
"""Standard normal samples of a control step [1], or their standard deviations in the units of the signals."""

BIAS = record_type(
    ("encoder", REAL, NUM_JOINTS), ("imu_attitude", REAL, 2),  # of homing and mounting [rad]
    ("gyro", REAL, 3), ("specific_force", REAL, 3),  # within an inertial IMU [rad/s], [m/s²]
    ("fit", WHOLE),  # row of CONSTANTS that has the sensors which are fitted
)  # fmt: skip
"""Errors that are drawn per episode, and the sensors that have them."""

SCORES = record_type(("tilt", REAL), ("zmp", REAL), ("effort", REAL), ("smoothness", REAL), ("fall", REAL))
"""Weighted terms of the reward."""

STEP = record_type(("truth", TRUTH), ("measured", MEASURED), ("scores", SCORES))
"""A control step of a world."""

ROW_OF_PLAN = record_type(
    ("q", REAL, NUM_JOINTS), ("q_dot", REAL, NUM_JOINTS), ("q_ddot", REAL, NUM_JOINTS),  # [rad], [rad/s], [rad/s²]
    ("clock", REAL, 3), ("share", REAL), ("zmp", REAL, 2),  # time, swing, support; μ; [m]
    ("half_of_swing", WHOLE), ("swing_foot", WHOLE),
    ("imu_is_due", np.bool_), ("weight", REAL),  # factor of tilt and zmp in the reward
)  # fmt: skip
"""What a control step needs of the plan."""

INERTIAL = record_type(("is_fitted", np.bool_), ("time_constant_s", REAL), ("gravity_m_s2", REAL))
"""An inertial IMU, one row beside every row of `CONSTANTS`.

Where none is fitted, the attitude comes with the errors that `QUALITY` has for it.
"""

QUALITY = record_type(
    ("count_rad", REAL),  # of the encoders, 0 for none
    ("noise", NOISE),  # standard deviations
    ("imu_bias_rad", REAL), ("imu_sine_error_rad", REAL),
)  # fmt: skip
"""Quality of the sensors: noise and constant errors."""

RULES = record_type(
    ("control_period_s", REAL), ("is_delayed", np.bool_),  # whether measurements are shown a step late
    ("lowest_pelvis_m", REAL), ("highest_tilt_rad", REAL),  # beyond them the robot has fallen
    ("highest_rad_s", REAL),  # beyond it the simulation has diverged
    ("loaded_n", REAL),  # vertical force of a loaded foot
    ("zmp_n", REAL),  # least vertical force for a ZMP
    ("weights", SCORES),
)  # fmt: skip
"""Numbers that judge a control step."""

ADDRESSES = record_type(
    ("theta", WHOLE, NUM_JOINTS), ("q", WHOLE, NUM_JOINTS),  # in qpos
    ("theta_dot", WHOLE, NUM_JOINTS), ("q_dot", WHOLE, NUM_JOINTS),  # in qvel
    ("ankles", WHOLE, 2),  # among the sites
)  # fmt: skip
"""Where the joints stand in the physics; the pelvis comes first."""

CONSTANTS = record_type(
    ("at", ADDRESSES),
    ("foot_com", REAL, (2, 3)), ("foot_weight", REAL, (2, 3)),  # from the ankle [m], in the world [N]
    ("quality", QUALITY), ("rules", RULES),
)  # fmt: skip
"""What does not change."""

OBSERVED = record_type(*((group.name, REAL, group.shape) for group in GROUPS))
"""Columns of the observation, see `elastic_env.robots.thormang.tables`."""


def one(kind: np.dtype[Any], **values: Any) -> Records:
    """One row with these values, (1,)."""
    row = np.zeros(1, kind)
    for name in row.dtype.names or ():
        row[name] = values.pop(name)
    assert not values
    row.flags.writeable = False
    return row


@dataclass(frozen=True, slots=True)
class WalkSample(Rows):
    """What a control step is scored by.

    Attributes:
        rows: Of `STEP`, (n,).
    """

    rows: Records


@dataclass(frozen=True)
class WalkTruth:
    """Noise-free state of the walker and its true parameters, one row per world. For scoring and the oracle.

    Attributes:
        theta, theta_dot, q, q_dot: Motor and link side, (num_worlds, 12) [rad], [rad/s].
        pelvis: Position of the pelvis, (num_worlds, 3) [m].
        pelvis_R: Orientation of the pelvis, (num_worlds, 3, 3).
        ankles: Positions of the ankles, (num_worlds, 2, 3) [m].
        stiffness: True K, (num_worlds, 12) [N·m/rad].
        models: The true joints and masses of the worlds of each scenario, what is drawn aside.
    """

    theta: Array
    theta_dot: Array
    q: Array
    q_dot: Array
    pelvis: Array
    pelvis_R: Array
    ankles: Array
    stiffness: Array
    models: tuple[WalkerModel, ...]

    @property
    def model(self) -> WalkerModel:
        """The true joints and masses of all worlds.

        Raises:
            ConfigurationError: The worlds have several scenarios.
        """
        model, *others = self.models
        if others:
            raise ConfigurationError(
                f"the worlds of {len(self.models)} scenarios have no true model in common; make an environment for each"
            )
        return model
