"""Records of the walker in addition to its joints: truth, measurements, scores, plan, constants."""

from dataclasses import dataclass

import numpy as np

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.robots.thormang.walk_signals import GROUPS, MEASURED
from elastic_env.world.records import COMMON_TRUTH, REAL, WHOLE, floats, record_type
from elastic_env.world.robot_model import WalkerModel

_WRENCH_SHAPE = (2, 2, 3)  # feet, force and moment, axes

TRUTH = record_type(
    *COMMON_TRUTH,
    *floats("servo_torque"),  # rms over the joints [N·m]
    *floats("pelvis", 3),  # position [m]
    *floats("quaternion", 4),  # orientation w, x, y, z
    # velocity of the origin, where the IMU is, in the world [m/s]; rate in the pelvis frame [rad/s]
    *floats("pelvis_velocity pelvis_rate", 3),
    *floats("roll pitch tilt"),  # of yaw, pitch, roll; angle from the vertical [rad]
    *floats("ankles", (2, 3)),  # positions [m]
    # wrench of the feet on the legs, in the frames of the feet [N], [N·m]
    *floats("wrench", _WRENCH_SHAPE),
    # vertical force of the ground on the feet [N]; ZMP, and drift of the standing feet from the
    # plan [m], nan where the feet are not loaded
    *floats("force zmp drift", 2),
    # step of the first touch-down in the second half of the swing, -1 before it
    ("contact_since", WHOLE),
)
"""True state after a control step."""

MEASUREMENTS = record_type(
    *floats("imu_attitude", 2),  # roll and pitch [rad]
    *floats("imu_rate", 3),  # as pelvis_rate [rad/s]
    *floats("wrench", _WRENCH_SHAPE),  # as in the truth
    # in an inertial IMU: vertical in its frame by its filter [1], rate by its gyroscope [rad/s]
    *floats("imu_up imu_gyro", 3),
)
"""Measurements, and the state of an inertial IMU."""

NOISE = record_type(
    *((group.name, REAL, group.shape) for group in GROUPS if group.name in MEASURED)
)
"""Standard normal samples of a control step [1], or their standard deviations in the units of
the signals.
"""

BIAS = record_type(
    *floats("imu_attitude", 2),  # of mounting [rad]
    *floats("gyro specific_force", 3),  # within an inertial IMU [rad/s], [m/s²]
    # errors of the feet's sensors, as in `elastic_env.world.foot_sensors`
    ("has_foot_errors", np.bool_),
    *floats("wrench wrench_rate", _WRENCH_SHAPE),  # [N], [N·m]; [N/s], [N·m/s]
    *floats("cross_talk", (2, 6, 6)),
    ("skipped", WHOLE),  # control steps of the plan that the walk leaves out
    # properties of the robot that nothing measures: load [kg] and its moments [kg·m], slope of the
    # ground forward and to the left [rad], friction over the assumed friction [1]
    *floats("load", 3),
    *floats("slope", 2),
    *floats("friction"),
)
"""Values drawn per episode: errors of the sensors, length of the walk, and robot."""

SCORES = record_type(*floats("tilt zmp zmp_in_feet foot_drift effort smoothness fall"))
"""Weighted terms of the reward."""

WORLD = record_type(("truth", TRUTH), ("measured", MEASUREMENTS), ("scores", SCORES))
"""A control step of a world."""

PLAN_ROW = record_type(
    *floats("clock", 3),  # time, swing, support
    *floats("share"),  # μ
    *floats("zmp", 2),  # [m]
    *floats("ankles", (2, 3)),  # [m]
    ("half_of_swing", WHOLE),
    ("swing_foot", WHOLE),
    ("imu_is_due", np.bool_),
    *floats("weight"),  # factor of tilt and zmp in the reward
)
"""The walk plan in a control step."""

INERTIAL = record_type(("is_fitted", np.bool_), *floats("time_constant_s gravity_m_s2"))
"""An inertial IMU; every row of `CONSTANTS` has one.

Where none is fitted, the attitude has the errors in `CONSTANTS`.
"""

CONSTANTS = record_type(
    ("ankles", WHOLE, 2),  # among the sites
    *floats("foot_com foot_weight", (2, 3)),  # from the ankle [m], in the world [N]
    ("noise", NOISE),  # standard deviations
    *floats("imu_bias_rad imu_sine_error_rad"),
    *floats("lowest_pelvis_m highest_tilt_rad"),  # beyond these the robot has fallen
    # least vertical force of a loaded foot, and least one of both feet for a ZMP
    *floats("loaded_n zmp_n"),
    # control step from which a shorter walk jumps ahead in the plan
    ("skip_step", WHOLE),
    ("weights", SCORES),
)
"""Constants of a kind of world: feet, quality of the sensors, and rules."""

COLUMNS = ("imu_attitude", "imu_rate", "wrench", "clock", "load_share", "zmp_reference")
"""Groups of the observation that are not the joints'."""


@dataclass(frozen=True)
class WalkTruth:
    """Noise-free state of the walker and its true parameters, one row per world.

    For scoring and the oracle.

    Attributes:
        theta, theta_dot, q, q_dot: Motor and link side, (num_worlds, 12) [rad], [rad/s].
        pelvis: Position of the pelvis, (num_worlds, 3) [m].
        pelvis_R: Orientation of the pelvis, (num_worlds, 3, 3).
        attitude: Roll and pitch of the pelvis, (num_worlds, 2) [rad].
        pelvis_rate: Rate of the pelvis in its own frame, (num_worlds, 3) [rad/s].
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
        models: True joints and masses of the worlds of each scenario, without drawn parameters.
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
        """True joints and masses of all worlds.

        Raises:
            ConfigurationError: The worlds have several scenarios.
        """
        model, *others = self.models
        if others:
            raise ConfigurationError(
                f"the worlds of {len(self.models)} scenarios have no true model in"
                " common; make an environment for each"
            )
        return model
