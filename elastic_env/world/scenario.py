"""Named conditions: what the true plant has that the assumed model does not know of.

Two grounds, `ideal` (linear springs, no friction, exact sensors) and `nominal` (the paper's robot:
friction, sensor noise, encoder counts), and changes on top of either. A change alone is meant on
top of `nominal`; `ideal+soft` puts it on `ideal`, and changes can be joined: `soft+payload`.

[AndradeChavez2019] F. J. Andrade Chavez, S. Traversaro, D. Pucci, "Six-Axis Force Torque Sensor
Model-Based In Situ Calibration Method and Its Impact in Floating-Based Robot Dynamic Performance",
Sensors 19(24), 5521.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self

from pydantic import Field, model_validator

from elastic_env.core.config import Model, Title, quantity
from elastic_env.core.errors import ConfigurationError, unknown_name
from elastic_env.core.robot_ranges import FOOT_ERRORS, DrawnRobot, RobotRanges
from elastic_env.core.signals import Array
from elastic_env.joint.dynamixel import BACKLASH_BOUND_RAD, H54_200_S500_R
from elastic_env.world.sensors import AttitudeSensor, InertialSensor

MOST_RANGES = 100
"""Ranges that the robots of a scenario come from."""


class Scenario(Model):
    """Difference between the true plant and the assumed model, and the quality of the sensors."""

    name: Title = "custom"
    stiffness_scale: float = quantity("1", 1.0, gt=0)
    """True over assumed stiffness of every joint [1]."""
    friction_scale: float = quantity("1", 1.0, ge=0)
    """Share of the joints' friction that acts, 0 for none [1]."""
    backlash_rad: float = quantity("rad", 0.0, ge=0)
    """Dead band of every joint, unknown to the compensator [rad]."""
    stiffness_spread: float = quantity("1", 0.0, ge=0, lt=1)
    """Half-width of a further factor on every joint's stiffness, drawn per robot [1]."""
    pendulum_mass_scale: float = quantity("1", 1.0, gt=0)
    """Testbed: true over assumed mass of pendulum [1]."""
    torso_load_kg: float = quantity("kg", 0.0, ge=0)
    """Walker: mass on the torso, not in the model [kg]."""
    push_n: float = quantity("N", 0.0, ge=0)
    """Walker: force of a push on the torso, anywhere in the walk [N]."""
    push_s: float = quantity("s", 0.1, gt=0, le=600)
    """Walker: duration of the push [s]."""
    slope_rad: float = quantity("rad", 0.0, ge=0, lt=0.5)
    """Walker: slope of the floor, direction drawn [rad]."""
    floor_friction: float | None = quantity("1", None, gt=0)
    """Walker: friction of soles and floor, None for that of the robot [1]."""
    encoder_counts: bool = True
    """True if the encoders have whole counts."""
    encoder_bias_rad: float = quantity("rad", 0.0, ge=0)
    """Half-width of the encoders' homing error [rad]."""
    imu: AttitudeSensor = AttitudeSensor()
    """IMU on the link of the testbed."""
    pelvis_imu: AttitudeSensor = AttitudeSensor(rate_hz=500.0)
    """IMU in the pelvis of the walker, the same for roll and pitch."""
    inertial: InertialSensor | None = None
    """IMU in the walker's pelvis or on the testbed's link that computes its attitude; None for one
    that shows the true one with the noise of `pelvis_imu` or `imu`. Other errors of these are then
    those of the mounting."""
    gyro_noise_rad_s: float = quantity("rad/s", 0.0, ge=0)
    """Walker: standard deviation of the gyroscope [rad/s]."""
    force_noise_n: float = quantity("N", 0.0, ge=0)
    """Walker: standard deviation of the foot forces [N]."""
    moment_noise_nm: float = quantity("N·m", 0.0, ge=0)
    """Walker: standard deviation of the foot moments [N·m]."""
    force_bias_n: float = quantity("N", 0.0, ge=0)
    """Walker: half-width of a bias of the foot forces, of every foot and axis its own [N]."""
    moment_bias_nm: float = quantity("N·m", 0.0, ge=0)
    """Walker: the same of the foot moments [N·m]."""
    force_drift_n_s: float = quantity("N/s", 0.0, ge=0)
    """Walker: half-width of the rate at which the bias of the forces changes [N/s]."""
    moment_drift_nm_s: float = quantity("N·m/s", 0.0, ge=0)
    """Walker: the same of the moments [N·m/s]."""
    cross_talk: float = quantity("1", 0.0, ge=0, le=1)
    """Walker: half-width of the share of the full scale of an axis of a foot sensor that shows on
    another one [1]."""
    sensor_noise: float = quantity("1", 0.0, ge=0)
    """Factor on the errors of further sensors [1]."""
    delay_steps: int = quantity("control steps", 0, ge=0, le=1)
    """Age of the measurements [control steps]."""
    ranges: tuple[RobotRanges, ...] = Field(default=(), max_length=MOST_RANGES)
    """Ranges that every episode's robot is drawn from, in equal shares where there are several;
    none for the robot that the other fields describe. What is drawn comes on top of what they
    say."""

    @model_validator(mode="after")
    def _ranges_say_all_that_is_drawn(self) -> Self:
        fixed = [name for name in _LEFT_TO_RANGES if getattr(self, name)]
        if self.imu.bias_spread_rad + self.pelvis_imu.bias_spread_rad > 0.0 and not fixed:
            fixed = ["bias_spread_rad of pelvis_imu"]
        if self.ranges and fixed:
            raise ValueError(
                f"ranges say what is drawn; leave out {', '.join(fixed)}, or give the ranges an"
                " interval for it"
            )
        return self

    def with_ranges(self, changes: Mapping[str, Any] | Sequence[Mapping[str, Any]]) -> Self:
        """The scenario with other intervals.

        One that draws from none, or from several ranges, stays as it is.

        Args:
            changes: Fields of `RobotRanges` that differ from the scenario's; of several such
                mappings each makes ranges of its own, which have equal shares of the robots.
        """
        if not changes or len(self.ranges) != 1:
            return self
        each = [changes] if isinstance(changes, Mapping) else changes
        return self.replace(ranges=[self.ranges[0].replace(**own) for own in each])

    def make_robot(self, stiffness: Array, homing_rad: Array, **drawn: Any) -> DrawnRobot:
        """A robot of the scenario without its ranges.

        Args:
            stiffness: Factor on K of every joint, (n,) [1].
            homing_rad: Error of the encoder of every joint, (n,) [rad].
            **drawn: Other quantities that were drawn.
        """
        return DrawnRobot(
            stiffness=tuple(stiffness.tolist()),
            homing_rad=tuple(homing_rad.tolist()),
            slope_rad=self.slope_rad,
            push_n=self.push_n,
            is_delayed=self.delay_steps > 0,
            is_inertial=self.inertial is not None,
            **drawn,
        )

    @property
    def draws_robots(self) -> bool:
        """True if episodes of the same motion differ in more than noise.

        That is in joints, offsets of sensors, push or slope.
        """
        spreads = (self.imu.bias_spread_rad, self.pelvis_imu.bias_spread_rad)
        drawn = [getattr(self, name) for name in _DRAWN]
        return bool(self.ranges) or self.inertial is not None or any([*drawn, *spreads])

    @property
    def is_random(self) -> bool:
        """True if episodes of the same motion differ, be it by noise alone."""
        noise = (self.gyro_noise_rad_s, self.force_noise_n, self.moment_noise_nm)
        imus = (self.imu.is_random, self.pelvis_imu.is_random)
        return self.draws_robots or any(noise + imus)

    @property
    def homing_width_rad(self) -> float:
        """Half-width of the homing error of link encoders; of ranges their largest error."""
        drawn = [abs(end) for own in self.ranges for end in own.homing_rad]
        return max([self.encoder_bias_rad, *drawn])


_DRAWN = ("stiffness_spread", "push_n", "slope_rad", "encoder_bias_rad", *FOOT_ERRORS)
_LEFT_TO_RANGES = (*_DRAWN, "inertial", "delay_steps")
"""Parameters that `RobotRanges` has, too, for each robot its own."""

_IMU = AttitudeSensor(noise_rad=0.2e-3, bias_rad=-1.7e-3)
# the same sensor in the pelvis, whose offset can be zeroed while the robot hangs; its filter runs
# at 500 Hz
_PELVIS_IMU = AttitudeSensor(noise_rad=0.2e-3, rate_hz=500.0)
# 3DM-GX4-25: 8.73e-5 rad/s/√Hz (KumarRobotics/imu_3dm_gx4) at half the control rate of 250 Hz
_GYRO_NOISE_RAD_S = 1.0e-3
# an assumption for the six-axis sensors of the feet, whose data were not found
_FORCE_NOISE_N = 1.0
_MOMENT_NOISE_NM = 0.05
# assumptions: a six-axis sensor as it is sold is accurate to 2 % of 200 N and 8 N·m (RealMan), that
# is 4 N and 0.16 N·m. THORMANG3 tares its feet in the air (thormang3_feet_ft_module), and from then
# on the temperature of strain gauges makes them drift [AndradeChavez2019]: 1.2 N a minute. Good
# sensors have up to 2 % of the full scale in cross-talk
_FOOT_ERRORS = {
    "force_bias_n": 5.0,
    "moment_bias_nm": 0.15,
    "force_drift_n_s": 0.02,
    "moment_drift_nm_s": 0.0006,
    "cross_talk": 0.01,
}
_FOOT_INTERVALS: dict[str, Any] = {name: (-width, width) for name, width in _FOOT_ERRORS.items()}
# an assumption: homing by hand to about 0.1 degree, and an IMU mounted as accurately
_HOMING_ERROR_RAD = 2e-3

GROUNDS: dict[str, Scenario] = {
    "ideal": Scenario(name="ideal", friction_scale=0.0, encoder_counts=False),
    "nominal": Scenario(
        name="nominal",
        imu=_IMU,
        pelvis_imu=_PELVIS_IMU,
        gyro_noise_rad_s=_GYRO_NOISE_RAD_S,
        force_noise_n=_FORCE_NOISE_N,
        moment_noise_nm=_MOMENT_NOISE_NM,
        sensor_noise=1.0,
    ),
}

_LONGEST_JOINED = 1000
"""Characters of a joined name that are looked at."""

ScenarioChange = Callable[[Scenario], dict[str, Any]]

CHANGES: dict[str, ScenarioChange] = {
    "soft": lambda _: {"stiffness_scale": 0.7},
    "stiff": lambda _: {"stiffness_scale": 1.3},
    "spread": lambda _: {"stiffness_spread": 0.3},
    "payload": lambda _: {"pendulum_mass_scale": 1.2, "torso_load_kg": 5.0},
    "backlash": lambda _: {"backlash_rad": BACKLASH_BOUND_RAD},
    "sensor": lambda ground: {
        "encoder_bias_rad": _HOMING_ERROR_RAD,
        "imu": ground.imu.replace(bias_spread_rad=_HOMING_ERROR_RAD),
        "pelvis_imu": ground.pelvis_imu.replace(bias_spread_rad=_HOMING_ERROR_RAD),
        "delay_steps": 1,
        **_FOOT_ERRORS,
    },
    "imu": lambda _: {"inertial": InertialSensor(), "delay_steps": 1},
    "push": lambda _: {"push_n": 50.0},
    "slope": lambda _: {"slope_rad": math.radians(1.0)},
    "foot_sensors": lambda _: _FOOT_ERRORS,
    "slip": lambda _: {"floor_friction": 0.3},
}
"""Parameters that a change sets on its ground."""

_MOST_FRICTION = 8.0 / H54_200_S500_R.coulomb_friction
TRAINING_RANGES = RobotRanges(
    stiffness=(0.75, 1.25),
    joint_stiffness=(0.8, 1.12),
    damping=(0.5, 2.0),
    friction=(0.0, _MOST_FRICTION),
    backlash_rad=(0.0, 2e-3),
    load_kg=(0.0, 8.0),
    load_x_m=(-0.1, 0.1),
    load_y_m=(-0.1, 0.1),
    load_z_m=(-0.15, 0.15),
    homing_rad=(-_HOMING_ERROR_RAD, _HOMING_ERROR_RAD),
    mounting_rad=(-_HOMING_ERROR_RAD, _HOMING_ERROR_RAD),
    slope_rad=(0.0, math.radians(1.5)),
    push_n=(0.0, 50.0),
    push_share=0.5,
    delay_share=0.5,
    **_FOOT_INTERVALS,
)
"""Ranges of `drawn`: K within ±40 % in all, friction up to 8 N·m. They hold the values of the named
changes but `stiff`'s on all joints at once."""
_BEYOND: tuple[dict[str, Any], ...] = (
    {"stiffness": (0.6, 0.7)},
    {"stiffness": (1.3, 1.5)},
    {"friction": (_MOST_FRICTION, 11.0 / H54_200_S500_R.coulomb_friction)},
    {"backlash_rad": (2e-3, 3e-3)},
    {"load_kg": (8.0, 11.0)},
    {"homing_rad": (_HOMING_ERROR_RAD, 1.5 * _HOMING_ERROR_RAD)},
    {"mounting_rad": (_HOMING_ERROR_RAD, 2.0 * _HOMING_ERROR_RAD)},
    {"slope_rad": (math.radians(1.5), math.radians(2.5))},
    {"push_n": (50.0, 80.0), "push_share": 1.0},
)
"""Intervals beyond those of `drawn`, each of a ninth of the robots of `drawn_beyond`."""

DISTRIBUTIONS: dict[str, ScenarioChange] = {
    "drawn": lambda _: {"ranges": [TRAINING_RANGES]},
    "drawn_beyond": lambda _: {"ranges": [TRAINING_RANGES.replace(**own) for own in _BEYOND]},
}
"""Changes that draw every episode's robot from ranges: those to learn from, and for tests robots
that have one quantity beyond these."""


WALKER_FIELDS = ("push_n", "slope_rad", "floor_friction", *FOOT_ERRORS)
"""Parameters that only a robot that walks knows."""
WALKER_ONLY = tuple(
    name
    for name, change in CHANGES.items()
    if change(GROUNDS["nominal"]).keys() <= {*WALKER_FIELDS}
)
"""Changes that set these alone."""


def scenario_names(walks: bool = True) -> list[str]:
    """Named conditions without joined names and distributions.

    On request only those of robots that do not walk.
    """
    return [*GROUNDS, *(name for name in CHANGES if walks or name not in WALKER_ONLY)]


def make_scenario(name: "str | Scenario", walks: bool = True) -> Scenario:
    """The scenario of a name such as "nominal", "soft", "ideal+soft" or "soft+payload".

    Args:
        name: Name, or the scenario itself.
        walks: Whether the robot walks. One that does not has no feet, so `sensor` leaves them out,
            and an unknown name is answered without the changes of walkers.

    Raises:
        ConfigurationError: A part of the name does not exist, a ground stands behind another part,
            or two changes set the same parameter.
    """
    if isinstance(name, Scenario):
        return name
    changes = str(name)[:_LONGEST_JOINED].split("+")
    ground = GROUNDS[changes.pop(0) if changes[0] in GROUNDS else "nominal"]
    known = CHANGES | DISTRIBUTIONS
    parameters: dict[str, Any] = {}
    for change in changes:
        if change in GROUNDS:
            raise ConfigurationError(
                f"scenario {name!r}: {change!r} is a ground and can only stand first"
            )
        if change not in known:
            choices = [*scenario_names(walks), *DISTRIBUTIONS]
            raise unknown_name("scenario", change, choices)
        added = known[change](ground)
        if not walks and change not in WALKER_ONLY:
            added = {field: value for field, value in added.items() if field not in WALKER_FIELDS}
        twice = sorted(parameters.keys() & added.keys())
        if twice:
            raise ConfigurationError(
                f"scenario {name!r}: {change!r} sets {', '.join(twice)} a second time"
            )
        parameters |= added
    return ground.replace(**parameters, name=str(name))
