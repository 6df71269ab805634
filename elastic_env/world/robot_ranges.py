"""Differences between robots: one closed interval per quantity, and robots drawn from them.

A number is an interval of one point: every robot has exactly this value. A bank of robots is a
Latin hypercube of the ranges [McKay1979]: every quantity takes one value in each of n intervals of
equal width, so that few robots cover the whole range. Every quantity has generators of its own. So
a change of one range leaves the draws of the others as they are.

[McKay1979] M. D. McKay, R. J. Beckman, W. J. Conover, "A Comparison of Three Methods for Selecting
Values of Input Variables in the Analysis of Output from a Computer Code", Technometrics 21(2).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Self, TypeAlias

import numpy as np
from pydantic import BeforeValidator, Field

from elastic_env.core.config import Model, plain_numbers, quantity
from elastic_env.core.errors import quote
from elastic_env.core.signals import Array, BoolArray


def _interval_ends(value: Any) -> Any:
    """Return the ends of an interval; a number is an interval of one point."""
    plain = plain_numbers(value)
    if isinstance(plain, list | tuple):
        return plain
    if isinstance(plain, bool) or not isinstance(plain, int | float):
        raise ValueError(f"must be a number or [lowest, highest], got {quote(value)}")
    return plain, plain


Interval: TypeAlias = Annotated[tuple[float, float], BeforeValidator(_interval_ends)]
"""Lowest and highest value, both included; given as two numbers, or as one for a single point."""

FOOT_ERRORS = (
    "force_bias_n",
    "moment_bias_nm",
    "force_drift_n_s",
    "moment_drift_nm_s",
    "cross_talk",
)
"""Errors of the feet's force-torque sensors, see `elastic_env.world.foot_sensors`."""
CROSS_TALK_ENTRIES = 30
"""Entries of the matrix of a foot's sensor: six axes on the five others."""
LOAD_PLACE = ("load_x_m", "load_y_m", "load_z_m")
"""Place of the load from the torso's center of mass."""
_FOOT_VALUES = dict.fromkeys(FOOT_ERRORS, 6) | {"cross_talk": 2 * CROSS_TALK_ENTRIES}


def interval(unit: str, nominal: float, bounds: Interval) -> Any:
    """Declare an interval of a `Model`.

    Args:
        unit: SI unit as it appears in error messages and tables, "1" for a pure number.
        nominal: Value of the assumed robot, the default of both ends.
        bounds: Lowest and highest value that the ends may have.
    """
    extra: dict[str, Any] = {"unit": unit, "bounds": bounds}
    return Field((nominal, nominal), json_schema_extra=extra)


_SHOULDERS_M = (0.0056, 0.1595)
"""Place of a load on the shoulders before and above the torso's center of mass [m]."""


class RobotRanges(Model):
    """Intervals of the quantities in which robots differ from the assumed one; by default none.

    The draws depend on the order of these fields: add new ones at the end.
    """

    stiffness: Interval = interval("1", 1.0, bounds=(0.05, 20))
    """Factor on K, the same for all joints [1]."""
    joint_stiffness: Interval = interval("1", 1.0, bounds=(0.05, 20))
    """Further factor on K, drawn for each joint [1]."""
    damping: Interval = interval("1", 1.0, bounds=(0, 100))
    """Factor on D, the same for all joints [1]."""
    friction: Interval = interval("1", 1.0, bounds=(0, 100))
    """Factor on dry and viscous friction, the same for all joints [1]."""
    backlash_rad: Interval = interval("rad", 0.0, bounds=(0, 0.1))
    """Additional dead band, the same for all joints [rad]."""
    load_kg: Interval = interval("kg", 0.0, bounds=(0, 100))
    """Load on the torso [kg]."""
    load_x_m: Interval = interval("m", _SHOULDERS_M[0], bounds=(-1, 1))
    """Place of the load before the torso's center of mass; by default on the shoulders [m]."""
    load_y_m: Interval = interval("m", 0.0, bounds=(-1, 1))
    """The same, to the left of it [m]."""
    load_z_m: Interval = interval("m", _SHOULDERS_M[1], bounds=(-1, 1))
    """The same, above it; by default on the shoulders [m]."""
    homing_rad: Interval = interval("rad", 0.0, bounds=(-0.1, 0.1))
    """Error of the encoders, drawn for each joint [rad]."""
    mounting_rad: Interval = interval("rad", 0.0, bounds=(-0.1, 0.1))
    """Error of the IMU, drawn for roll and for pitch [rad]."""
    slope_rad: Interval = interval("rad", 0.0, bounds=(0, 0.5))
    """Slope of the floor, in any direction [rad]."""
    push_n: Interval = interval("N", 0.0, bounds=(0, 1000))
    """Force of a push on the torso [N]."""
    push_share: float = quantity("1", 1.0, ge=0, le=1)
    """Share of the robots that are pushed [1]."""
    delay_share: float = quantity("1", 0.0, ge=0, le=1)
    """Share of the robots whose measurements are one control step old [1]."""
    inertial_share: float = quantity("1", 0.0, ge=0, le=1)
    """Share of the robots whose IMU computes its attitude [1]."""
    force_bias_n: Interval = interval("N", 0.0, bounds=(-1000, 1000))
    """Bias of a foot's force sensor, drawn for each foot and axis [N]."""
    moment_bias_nm: Interval = interval("N·m", 0.0, bounds=(-100, 100))
    """Bias of its moments, likewise [N·m]."""
    force_drift_n_s: Interval = interval("N/s", 0.0, bounds=(-100, 100))
    """Rate at which the bias of its forces changes, likewise [N/s]."""
    moment_drift_nm_s: Interval = interval("N·m/s", 0.0, bounds=(-10, 10))
    """Rate at which the bias of its moments changes, likewise [N·m/s]."""
    cross_talk: Interval = interval("1", 0.0, bounds=(-1, 1))
    """Share of the full scale of an axis that appears on another one, drawn for each foot and
    pair of axes [1]."""
    floor_friction: Interval = interval("1", 1.0, bounds=(1e-6, 10))
    """Factor on the friction of soles and floor [1]."""

    def _check(self) -> None:
        for name, (low, high) in self.intervals():
            extra: Any = type(self).model_fields[name].json_schema_extra
            lowest, highest = extra["bounds"]
            if not lowest <= low <= high <= highest:
                raise ValueError(
                    f"{name} must be a number or [lowest, highest] within {lowest:g} to"
                    f" {highest:g} [{extra['unit']}], got [{low:g}, {high:g}]"
                )

    def without_walker_fields(self) -> Self:
        """Return the ranges with the defaults of `WALKER_FIELDS`."""
        fields = RobotRanges.model_fields
        return self.replace(**{name: fields[name].default for name in WALKER_FIELDS})

    def intervals(self) -> Iterator[tuple[str, Interval]]:
        """Yield the quantities with an interval, by name."""
        for name in RobotRanges.model_fields:
            if isinstance(value := getattr(self, name), tuple):
                yield name, value

    @property
    def changes(self) -> list[str]:
        """Quantities that differ from those of the assumed robot."""
        fields = RobotRanges.model_fields
        return [name for name in fields if getattr(self, name) != fields[name].default]

    def fixed_value(self, name: str) -> float:
        """Return the value of a one-point interval; the assumed robot's where robots differ."""
        default = RobotRanges.model_fields[name].default
        return (default if self.draws(name) else getattr(self, name))[0]

    def draws(self, name: str) -> bool:
        """Return True if robots differ in a quantity; for a share, if only some robots have it."""
        value = getattr(self, name)
        return value[0] < value[1] if isinstance(value, tuple) else 0.0 < value < 1.0

    @property
    def is_one_robot(self) -> bool:
        """True if all robots are the same."""
        is_level = self.slope_rad[1] == 0.0  # a slope may rise in any direction
        return is_level and not any(map(self.draws, RobotRanges.model_fields))


_PUSH = ("push_n", "push_share")
WALKER_FIELDS = ("load_kg", *LOAD_PLACE, "slope_rad", *_PUSH, *FOOT_ERRORS, "floor_friction")
"""Quantities of `RobotRanges` that only a walking robot has."""


@dataclass(frozen=True, kw_only=True)
class DrawnRobot:
    """A robot: a value for every quantity of `RobotRanges`, under its name.

    Attributes:
        stiffness: Factor on K of every joint [1].
        homing_rad: Error of the encoder of every joint [rad].
        mounting_rad: Error of roll and pitch by the IMU [rad].
        slope_direction_rad: Direction in which the floor rises [rad].
        is_delayed: True if measurements are one control step old.
        is_inertial: True if the IMU computes its attitude.
        force_bias_n, moment_bias_nm, force_drift_n_s, moment_drift_nm_s: Errors of the sensors of
            left and right foot, three axes each.
        cross_talk: Of the sensors of left and right foot, by rows of their matrices without the
            diagonals [1].
    """

    stiffness: tuple[float, ...]
    damping: float
    friction: float
    backlash_rad: float
    load_kg: float
    load_x_m: float
    load_y_m: float
    load_z_m: float
    homing_rad: tuple[float, ...]
    mounting_rad: tuple[float, float]
    slope_rad: float
    slope_direction_rad: float
    push_n: float
    is_delayed: bool
    is_inertial: bool
    force_bias_n: tuple[float, ...]
    moment_bias_nm: tuple[float, ...]
    force_drift_n_s: tuple[float, ...]
    moment_drift_nm_s: tuple[float, ...]
    cross_talk: tuple[float, ...]
    floor_friction: float

    def with_exact_sensors(self) -> "DrawnRobot":
        """Return the robot without push and errors of IMU and feet; it rests at the same place."""
        feet: dict[str, Any] = dict.fromkeys(FOOT_ERRORS, (0.0,))
        others = {"push_n": 0.0, "is_delayed": False, "is_inertial": False}
        return replace(self, mounting_rad=(0.0, 0.0), **others, **feet)

    def record(self) -> dict[str, float]:
        """Return the robot as figures, by name with unit, for the records of episodes."""
        roll, pitch = self.mounting_rad
        figures = vars(self) | {"stiffness": np.mean(self.stiffness)}
        figures |= {"mounting_roll_rad": roll, "mounting_pitch_rad": pitch}
        del figures["mounting_rad"]
        for name, title in _RMS_NAMES.items():
            figures[title] = np.sqrt(np.mean(np.square(figures.pop(name))))
        return {f"robot_{name}": float(figure) for name, figure in figures.items()}


_RMS_NAMES = {
    "homing_rad": "homing_rms_rad",
    "force_bias_n": "force_bias_rms_n",
    "moment_bias_nm": "moment_bias_rms_nm",
    "force_drift_n_s": "force_drift_rms_n_s",
    "moment_drift_nm_s": "moment_drift_rms_nm_s",
    "cross_talk": "cross_talk_rms",
}
"""Quantities of several values, and the name of their rms in records."""


def draw_robots(
    ranges: Sequence[RobotRanges], number: int, joints: int, seed: Sequence[int]
) -> list[DrawnRobot]:
    """Draw robots from ranges, the same in every process, with equal shares of several ranges.

    Args:
        ranges: One or several.
        number: Number of robots.
        joints: Number of joints of each.
        seed: Seed of the generators.
    """
    ends = np.linspace(0, number, len(ranges) + 1).round().astype(int).tolist()
    return [
        robot
        for index, part in enumerate(ranges)
        for robot in _draw(part, ends[index + 1] - ends[index], joints, (*seed, index))
    ]


def draw_robot(
    ranges: Sequence[RobotRanges], joints: int, generator: np.random.Generator
) -> DrawnRobot:
    """Draw one robot from ranges; several ranges have equal chances."""
    chosen = ranges[int(generator.integers(len(ranges)))]
    (robot,) = _draw(chosen, 1, joints, [int(generator.integers(2**63))])
    return robot


def latin_hypercube(number: int, columns: int, generator: np.random.Generator) -> Array:
    """Draw points in the unit cube, (number, columns), in each column one per equal interval."""
    strata = generator.permuted(np.tile(np.arange(number), (columns, 1)), axis=1)
    return (strata + generator.random((columns, number))).T / number


_SEVERAL_VALUES = ("stiffness", "homing_rad", "mounting_rad", *FOOT_ERRORS)
"""Quantities with several values per robot."""
_DIRECTION = "slope_direction"


def _draw(
    ranges: RobotRanges, number: int, joints: int, seed: Sequence[int]
) -> Iterator[DrawnRobot]:
    """Draw robots from one set of ranges."""
    width = dict.fromkeys(("joint_stiffness", "homing_rad"), joints)
    width |= {"mounting_rad": 2, **_FOOT_VALUES}
    names = list(RobotRanges.model_fields)
    # a quantity's position seeds its draws: in this order, earlier draws stay as they were
    names.insert(names.index(FOOT_ERRORS[0]), _DIRECTION)

    def draw(name: str, low: float = 0.0, high: float = 1.0) -> Array:
        shape = (number, width.get(name, 1))
        if low == high:
            return np.full(shape, low)
        generator = np.random.default_rng([*seed, names.index(name)])
        unit = latin_hypercube(*shape, generator)
        # not low + u (high - low), which may end beyond high by rounding
        return np.clip(low + unit * (high - low), low, high)

    def has(share: str) -> BoolArray:
        return draw(share)[:, 0] < getattr(ranges, share)

    drawn = {name: draw(name, *ends) for name, ends in ranges.intervals()}
    drawn["stiffness"] = drawn["stiffness"] * drawn.pop("joint_stiffness")
    drawn["push_n"][~has("push_share")] = 0.0
    turns = float(ranges.slope_rad[1] > 0.0)
    drawn["slope_direction_rad"] = 2.0 * np.pi * draw(_DIRECTION, high=turns)
    flags = {"is_delayed": has("delay_share"), "is_inertial": has("inertial_share")}
    for i in range(number):
        values: dict[str, Any] = {name: bool(flag[i]) for name, flag in flags.items()}
        for name, rows in drawn.items():
            row = tuple(rows[i].tolist())
            values[name] = row if name in _SEVERAL_VALUES else row[0]
        yield DrawnRobot(**values)
