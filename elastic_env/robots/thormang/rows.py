"""The walker's records beside its joints: truth, measurements, scores, plan, constants."""

from dataclasses import dataclass

import numpy as np

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.robots.thormang.tables import GROUPS, MEASURED
from elastic_env.world.robot_model import WalkerModel
from elastic_env.world.rows import COURSE, REAL, WHOLE, reals, record_type

_FEET_WRENCH = (2, 2, 3)  # feet, force and moment, axes

TRUTH = record_type(
    *COURSE,
    *reals("servo_torque"),  # rms over the joints [N·m]
    *reals("pelvis", 3),  # position [m]
    *reals("quaternion", 4),  # orientation w, x, y, z
    # of its origin, where the IMU is, in the world [m/s]; in the frame of the pelvis [rad/s]
    *reals("pelvis_velocity pelvis_rate", 3),
    *reals("roll pitch tilt"),  # of yaw, pitch, roll; angle from the vertical [rad]
    *reals("ankles", (2, 3)),  # positions [m]
    # of the feet on the legs, in the frames of the feet [N], [N·m]
    *reals("wrench", _FEET_WRENCH),
    # vertical force of the ground on the feet [N]; ZMP, and drift of the feet that stand against
    # the plan [m], nan where the feet are not loaded
    *reals("force zmp drift", 2),
    # step of the first touch in the second half of the swing, -1 before it
    ("contact_since", WHOLE),
)
"""True state after a control step."""

SHOWN = record_type(
    *reals("imu_attitude", 2),  # roll and pitch [rad]
    *reals("imu_rate", 3),  # as pelvis_rate [rad/s]
    *reals("wrench", _FEET_WRENCH),  # as in the truth
    # within an inertial IMU: vertical in its frame by its filter [1], rate by its gyroscope [rad/s]
    *reals("imu_up imu_gyro", 3),
)
"""Measurements, and the state of an inertial IMU."""

NOISE = record_type(
    *((group.name, REAL, group.shape) for group in GROUPS if group.name in MEASURED)
)
"""Standard normal samples of a control step [1], or their standard deviations in the units of
the signals.
"""

BIAS = record_type(
    *reals("imu_attitude", 2),  # of mounting [rad]
    *reals("gyro specific_force", 3),  # within an inertial IMU [rad/s], [m/s²]
    # of the feet's sensors, as in `elastic_env.world.foot_sensors`
    ("has_foot_errors", np.bool_),
    *reals("wrench wrench_rate", _FEET_WRENCH),  # [N], [N·m]; [N/s], [N·m/s]
    *reals("cross_talk", (2, 6, 6)),
    ("skipped", WHOLE),  # control steps of the plan that the walk leaves out
    # of the robot, where nothing measures them: load [kg] and its moments [kg·m], slope of the
    # ground forward and to the left [rad], friction over the assumed one [1]
    *reals("load", 3),
    *reals("slope", 2),
    *reals("friction"),
)
"""Errors of the sensors, length of the walk, and more that is drawn per episode."""

SCORES = record_type(*reals("tilt zmp zmp_in_feet foot_drift effort smoothness fall"))
"""Weighted terms of the reward."""

WORLD = record_type(("truth", TRUTH), ("shown", SHOWN), ("scores", SCORES))
"""A control step of a world."""

ROW_OF_PLAN = record_type(
    *reals("clock", 3),  # time, swing, support
    *reals("share"),  # μ
    *reals("zmp", 2),  # [m]
    *reals("ankles", (2, 3)),  # [m]
    ("half_of_swing", WHOLE),
    ("swing_foot", WHOLE),
    ("imu_is_due", np.bool_),
    *reals("weight"),  # factor of tilt and zmp in the reward
)
"""The plan as a control step needs it."""

INERTIAL = record_type(("is_fitted", np.bool_), *reals("time_constant_s gravity_m_s2"))
"""An inertial IMU, one row beside every row of `CONSTANTS`.

Where none is fitted, the attitude comes with the errors that these have for it.
"""

CONSTANTS = record_type(
    ("ankles", WHOLE, 2),  # among the sites
    *reals("foot_com foot_weight", (2, 3)),  # from the ankle [m], in the world [N]
    ("noise", NOISE),  # standard deviations
    *reals("imu_bias_rad imu_sine_error_rad"),
    *reals("lowest_pelvis_m highest_tilt_rad"),  # beyond them the robot has fallen
    # vertical force of a loaded foot, and least one for a ZMP
    *reals("loaded_n zmp_n"),
    # control step from which a shorter walk goes on further behind
    ("skips_at", WHOLE),
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
