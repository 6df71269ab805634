"""The walker's records beside its joints: truth, measurements, scores, plan, constants."""

from dataclasses import dataclass

import numpy as np

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.robots.thormang.tables import GROUPS, MEASURED
from elastic_env.world.robot_model import WalkerModel
from elastic_env.world.rows import COURSE, REAL, WHOLE, record_type

_FEET_WRENCH = (2, 2, 3)  # feet, force and moment, axes

TRUTH = record_type(
    *COURSE,
    ("servo_torque", REAL),  # rms over the joints [N·m]
    ("pelvis", REAL, 3),
    ("quaternion", REAL, 4),  # position [m], orientation w, x, y, z
    ("pelvis_velocity", REAL, 3),  # of its origin, where the IMU is, in the world [m/s]
    ("pelvis_rate", REAL, 3),  # in the frame of the pelvis [rad/s]
    ("roll", REAL),
    ("pitch", REAL),
    ("tilt", REAL),  # of yaw, pitch, roll; angle from the vertical [rad]
    ("ankles", REAL, (2, 3)),  # positions [m]
    # of the feet on the legs, in the frames of the feet [N], [N·m]
    ("wrench", REAL, _FEET_WRENCH),
    ("force", REAL, 2),  # vertical force of the ground on the feet [N]
    ("zmp", REAL, 2),  # [m], nan where the feet are not loaded
    ("drift", REAL, 2),  # of the feet that stand, against the plan [m], nan likewise
    # step of the first touch in the second half of the swing, -1 before it
    ("contact_since", WHOLE),
)
"""True state after a control step."""

SHOWN = record_type(
    ("imu_attitude", REAL, 2),
    ("imu_rate", REAL, 3),  # roll and pitch [rad], as pelvis_rate [rad/s]
    ("wrench", REAL, _FEET_WRENCH),  # as in the truth
    # within an inertial IMU: vertical in its frame by its filter [1], rate by its gyroscope [rad/s]
    ("imu_up", REAL, 3),
    ("imu_gyro", REAL, 3),
)
"""Measurements, and the state of an inertial IMU."""

NOISE = record_type(
    *((group.name, REAL, group.shape) for group in GROUPS if group.name in MEASURED)
)
"""Standard normal samples of a control step [1], or their standard deviations in the units of
the signals.
"""

BIAS = record_type(
    ("imu_attitude", REAL, 2),  # of mounting [rad]
    ("gyro", REAL, 3),
    ("specific_force", REAL, 3),  # within an inertial IMU [rad/s], [m/s²]
    # of the feet's sensors, as in `elastic_env.world.foot_sensors`
    ("has_foot_errors", np.bool_),
    ("wrench", REAL, _FEET_WRENCH),  # [N], [N·m]
    ("wrench_rate", REAL, _FEET_WRENCH),  # [N/s], [N·m/s]
    ("cross_talk", REAL, (2, 6, 6)),
    ("skipped", WHOLE),  # control steps of the plan that the walk leaves out
    # of the robot, where nothing measures them: load [kg] and its moments [kg·m], slope of the
    # ground forward and to the left [rad], friction over the assumed one [1]
    ("load", REAL, 3),
    ("slope", REAL, 2),
    ("friction", REAL),
)
"""Errors of the sensors, length of the walk, and more that is drawn per episode."""

_TERMS = ("tilt", "zmp", "zmp_in_feet", "foot_drift", "effort", "smoothness", "fall")
SCORES = record_type(*((term, REAL) for term in _TERMS))
"""Weighted terms of the reward."""

WORLD = record_type(("truth", TRUTH), ("shown", SHOWN), ("scores", SCORES))
"""A control step of a world."""

ROW_OF_PLAN = record_type(
    ("clock", REAL, 3),
    ("share", REAL),
    ("zmp", REAL, 2),  # time, swing, support; μ; [m]
    ("ankles", REAL, (2, 3)),  # [m]
    ("half_of_swing", WHOLE),
    ("swing_foot", WHOLE),
    ("imu_is_due", np.bool_),
    ("weight", REAL),  # factor of tilt and zmp in the reward
)
"""The plan as a control step needs it."""

INERTIAL = record_type(("is_fitted", np.bool_), ("time_constant_s", REAL), ("gravity_m_s2", REAL))
"""An inertial IMU, one row beside every row of `CONSTANTS`.

Where none is fitted, the attitude comes with the errors that these have for it.
"""

CONSTANTS = record_type(
    ("ankles", WHOLE, 2),  # among the sites
    ("foot_com", REAL, (2, 3)),  # from the ankle [m]
    ("foot_weight", REAL, (2, 3)),  # in the world [N]
    ("noise", NOISE),  # standard deviations
    ("imu_bias_rad", REAL),
    ("imu_sine_error_rad", REAL),
    ("lowest_pelvis_m", REAL),
    ("highest_tilt_rad", REAL),  # beyond them the robot has fallen
    ("loaded_n", REAL),  # vertical force of a loaded foot
    ("zmp_n", REAL),  # least vertical force for a ZMP
    ("skips_at", WHOLE),  # control step from which a shorter walk goes on further behind
    ("weights", SCORES),
)
"""Constants of a kind of world: feet, quality of the sensors, and rules."""

COLUMNS = ("imu_attitude", "imu_rate", "wrench", "clock", "load_share", "zmp_reference")
"""Groups of the observation that are not of the joints."""


@dataclass(frozen=True)
class WalkTruth:
    """Noise-free state of the walker and its true parameters, one row per world.

    For scoring and the oracle.

    Attributes:
        theta, theta_dot, q, q_dot: Motor and link side, (num_worlds, 12) [rad], [rad/s].
        pelvis: Position of the pelvis, (num_worlds, 3) [m].
        pelvis_R: Orientation of the pelvis, (num_worlds, 3, 3).
        attitude: Its roll and pitch, (num_worlds, 2) [rad].
        pelvis_rate: Its rate in its own frame, (num_worlds, 3) [rad/s].
        wrench: Force and moment of the feet on the legs in the frames of the feet, (num_worlds, 2,
            2, 3) [N], [N·m].
        ankles: Positions of the ankles, (num_worlds, 2, 3) [m].
        stiffness: True K, (num_worlds, 12) [N·m/rad].
        backlash: True dead bands, (num_worlds, 12) [rad].
        load: Load on the torso beyond the assumed robot [kg], and its moments about the torso
            forward and to the left [kg·m], (num_worlds, 3).
        slope: Slope of the ground, forward and to the left, (num_worlds, 2) [rad].
        friction: True over assumed friction of the joints, (num_worlds,) [1].
        mounting: Error of roll and pitch by the IMU, (num_worlds, 2) [rad].
        models: The true joints and masses of the worlds of each scenario, what is drawn aside.
    """

    theta: Array
    theta_dot: Array
    q: Array
    q_dot: Array
    pelvis: Array
    pelvis_R: Array
    attitude: Array
    pelvis_rate: Array
    wrench: Array
    ankles: Array
    stiffness: Array
    backlash: Array
    load: Array
    slope: Array
    friction: Array
    mounting: Array
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
                f"the worlds of {len(self.models)} scenarios have no true model in common; make an"
                " environment for each"
            )
        return model
