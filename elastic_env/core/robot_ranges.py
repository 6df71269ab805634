"""Ranges that robots are drawn from: domain randomisation, one closed interval per quantity.

A bank of robots is a Latin hypercube of the ranges [McKay1979]: every quantity takes one value in
each of n intervals of equal width, so that few robots cover all of them. Every quantity has
generators of its own. So a range that is changed leaves the draws of the others as they are.

[McKay1979] M. D. McKay, R. J. Beckman, W. J. Conover, "A Comparison of Three Methods for Selecting
Values of Input Variables in the Analysis of Output from a Computer Code", Technometrics 21(2).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Self, TypeAlias

import numpy as np
from pydantic import Field, model_validator

from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array

Interval: TypeAlias = tuple[float, float]
"""Lowest and highest value, both included."""

FOOT_ERRORS = (
    "force_bias_n",
    "moment_bias_nm",
    "force_drift_n_s",
    "moment_drift_nm_s",
    "cross_talk",
)
"""Errors of the feet's force-torque sensors, see `elastic_env.world.foot_sensors`."""
CROSS_TALK_ENTRIES = 30
"""Of a foot's sensor: six axes on the five others."""
_OF_BOTH_FEET = dict.fromkeys(FOOT_ERRORS, 6) | {"cross_talk": 2 * CROSS_TALK_ENTRIES}


def interval(unit: str, nominal: float, bounds: Interval) -> Any:
    """An interval of a `Model`.

    Args:
        unit: SI unit as it appears in error messages and tables, "1" for a pure number.
        nominal: Value where nothing is drawn, the default of both ends.
        bounds: What the ends must lie within.
    """
    extra: dict[str, Any] = {"unit": unit, "bounds": bounds}
    return Field((nominal, nominal), json_schema_extra=extra)


class RobotRanges(Model):
    """Intervals of the quantities in which robots differ from the assumed one; by default none.

    The draws depend on the order of these fields, see `draw_robots`.
    """

    stiffness: Interval = interval("1", 1.0, bounds=(0.05, 20))
    """Factor on K, of all joints together [1]."""
    joint_stiffness: Interval = interval("1", 1.0, bounds=(0.05, 20))
    """Further factor on K, of every joint its own [1]."""
    damping: Interval = interval("1", 1.0, bounds=(0, 100))
    """Factor on D, of all joints together [1]."""
    friction: Interval = interval("1", 1.0, bounds=(0, 100))
    """Factor on dry and viscous friction, of all joints together [1]."""
    backlash_rad: Interval = interval("rad", 0.0, bounds=(0, 0.1))
    """Further dead band, of all joints together [rad]."""
    load_kg: Interval = interval("kg", 0.0, bounds=(0, 100))
    """Load on the torso [kg]."""
    load_x_m: Interval = interval("m", 0.0, bounds=(-1, 1))
    """Place of the load before the torso's center of mass [m]."""
    load_y_m: Interval = interval("m", 0.0, bounds=(-1, 1))
    """The same, to the left of it [m]."""
    load_z_m: Interval = interval("m", 0.0, bounds=(-1, 1))
    """The same, above it [m]."""
    homing_rad: Interval = interval("rad", 0.0, bounds=(-0.1, 0.1))
    """Error of the encoders, of every joint its own [rad]."""
    mounting_rad: Interval = interval("rad", 0.0, bounds=(-0.1, 0.1))
    """Error of the IMU, of roll and pitch each its own [rad]."""
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
    """Bias of a foot's force sensor, of every foot and axis its own [N]."""
    moment_bias_nm: Interval = interval("N·m", 0.0, bounds=(-100, 100))
    """Bias of its moments, likewise [N·m]."""
    force_drift_n_s: Interval = interval("N/s", 0.0, bounds=(-100, 100))
    """Rate at which the bias of its forces changes, likewise [N/s]."""
    moment_drift_nm_s: Interval = interval("N·m/s", 0.0, bounds=(-10, 10))
    """Rate at which the bias of its moments changes, likewise [N·m/s]."""
    cross_talk: Interval = interval("1", 0.0, bounds=(-1, 1))
    """Share of the full scale of an axis that shows on another one, of every foot and pair of axes
    its own [1]."""

    @model_validator(mode="after")
    def _intervals_are_in_order(self) -> Self:
        for name, (low, high) in self.intervals():
            extra: Any = type(self).model_fields[name].json_schema_extra
            lowest, highest = extra["bounds"]
            if not lowest <= low <= high <= highest:
                raise ValueError(
                    f"{name} must be [lowest, highest] within {lowest:g} to {highest:g} "
                    f"[{extra['unit']}], got [{low:g}, {high:g}]"
                )
        return self

    def on_fixed_base(self) -> Self:
        """The same without what only a walker has: load, push, floor, its IMU and its feet."""
        of_walkers = ("load_", "slope_rad", "push_n", "inertial_share", *FOOT_ERRORS)
        fields = type(self).model_fields
        left_out = [name for name in fields if name.startswith(of_walkers)]
        return self.replace(**{name: fields[name].default for name in left_out})

    def intervals(self) -> Iterator[tuple[str, Interval]]:
        """Quantities with an interval, by name."""
        for name, value in self:
            if isinstance(value, tuple):
                yield name, value


@dataclass(frozen=True, kw_only=True)
class DrawnRobot:
    """A value for every quantity of `RobotRanges`, under its name, on top of the scenario's plant.

    Attributes:
        stiffness: Factor on K of every joint [1].
        homing_rad: Error of the encoder of every joint [rad].
        mounting_rad: Error of roll and pitch by the IMU [rad].
        slope_direction_rad: Direction in which the floor rises [rad].
        is_delayed: True if measurements are one control step old.
        is_inertial: True if the IMU computes its attitude.
        force_bias_n, moment_bias_nm, force_drift_n_s, moment_drift_nm_s: Of left and right foot,
            three axes each.
        cross_talk: Of left and right foot, by rows of their matrices without the diagonals [1].
    """

    stiffness: tuple[float, ...]
    damping: float = 1.0
    friction: float = 1.0
    backlash_rad: float = 0.0
    load_kg: float = 0.0
    load_x_m: float = 0.0
    load_y_m: float = 0.0
    load_z_m: float = 0.0
    homing_rad: tuple[float, ...]
    mounting_rad: tuple[float, float] = (0.0, 0.0)
    slope_rad: float = 0.0
    slope_direction_rad: float = 0.0
    push_n: float = 0.0
    is_delayed: bool = False
    is_inertial: bool = False
    force_bias_n: tuple[float, ...] = (0.0,) * _OF_BOTH_FEET["force_bias_n"]
    moment_bias_nm: tuple[float, ...] = (0.0,) * _OF_BOTH_FEET["moment_bias_nm"]
    force_drift_n_s: tuple[float, ...] = (0.0,) * _OF_BOTH_FEET["force_drift_n_s"]
    moment_drift_nm_s: tuple[float, ...] = (0.0,) * _OF_BOTH_FEET["moment_drift_nm_s"]
    cross_talk: tuple[float, ...] = (0.0,) * _OF_BOTH_FEET["cross_talk"]

    def record(self) -> dict[str, float]:
        """The robot in figures, by name with unit, for the records of episodes."""
        roll, pitch = self.mounting_rad
        rms = {
            name: np.sqrt(np.mean(np.square(getattr(self, name))))
            for name in ("homing_rad", *FOOT_ERRORS)
        }
        of_several = {
            "stiffness": {"stiffness": np.mean(self.stiffness)},
            "homing_rad": {"homing_rms_rad": rms["homing_rad"]},
            "force_bias_n": {"force_bias_rms_n": rms["force_bias_n"]},
            "moment_bias_nm": {"moment_bias_rms_nm": rms["moment_bias_nm"]},
            "force_drift_n_s": {"force_drift_rms_n_s": rms["force_drift_n_s"]},
            "moment_drift_nm_s": {"moment_drift_rms_nm_s": rms["moment_drift_nm_s"]},
            "cross_talk": {"cross_talk_rms": rms["cross_talk"]},
            "mounting_rad": {"mounting_roll_rad": roll, "mounting_pitch_rad": pitch},
        }
        return {
            f"robot_{name}": float(figure)
            for quantity_, value in vars(self).items()
            for name, figure in of_several.get(quantity_, {quantity_: value}).items()
        }


def draw_robots(
    ranges: Sequence[RobotRanges], number: int, joints: int, seed: Sequence[int]
) -> list[DrawnRobot]:
    """Robots of ranges, the same in every process; equal shares of each of several ranges.

    Args:
        ranges: One or several.
        number: How many robots.
        joints: How many joints each has.
        seed: Of the generators; other seeds, other robots.
    """
    ends = np.linspace(0, number, len(ranges) + 1).round().astype(int).tolist()
    return [
        robot
        for index, own in enumerate(ranges)
        for robot in _draw(own, ends[index + 1] - ends[index], joints, (*seed, index))
    ]


def draw_robot(
    ranges: Sequence[RobotRanges], joints: int, generator: np.random.Generator
) -> DrawnRobot:
    """One robot of ranges, which have equal chances where there are several."""
    own = ranges[int(generator.integers(len(ranges)))]
    (robot,) = _draw(own, 1, joints, [int(generator.integers(2**63))])
    return robot


def latin_hypercube(number: int, columns: int, generator: np.random.Generator) -> Array:
    """Points in the unit cube, (number, columns), one of each column in each of equal intervals."""
    strata = generator.permuted(np.tile(np.arange(number), (columns, 1)), axis=1)
    return (strata + generator.random((columns, number))).T / number


_LOAD = ("load_kg", "load_x_m", "load_y_m", "load_z_m")
_OF_ONE = ("damping", "friction", "backlash_rad", *_LOAD, "slope_rad")
"""Quantities of which a robot has one value, under the name of their range."""


def _draw(
    ranges: RobotRanges, number: int, joints: int, seed: Sequence[int]
) -> Iterator[DrawnRobot]:
    """Robots of one set of ranges."""
    width = {"joint_stiffness": joints, "homing_rad": joints, "mounting_rad": 2, **_OF_BOTH_FEET}
    names = [name for name in RobotRanges.model_fields if name not in FOOT_ERRORS]
    # in this order, so that the draws of the first stay as they were
    names += ["slope_direction", *FOOT_ERRORS]
    unit: dict[str, Array] = {}
    for index, name in enumerate(names):
        generator = np.random.default_rng([*seed, index])
        unit[name] = latin_hypercube(number, width.get(name, 1), generator)
    # not low + u (high - low), which may end beyond high by rounding
    drawn = {
        name: np.clip(low + unit[name] * (high - low), low, high)
        for name, (low, high) in ranges.intervals()
    }
    stiffness = drawn["stiffness"] * drawn["joint_stiffness"]
    for i in range(number):
        is_pushed = unit["push_share"][i, 0] < ranges.push_share
        roll, pitch = drawn["mounting_rad"][i].tolist()
        feet: dict[str, Any] = {name: tuple(drawn[name][i].tolist()) for name in FOOT_ERRORS}
        yield DrawnRobot(
            stiffness=tuple(stiffness[i].tolist()),
            homing_rad=tuple(drawn["homing_rad"][i].tolist()),
            mounting_rad=(roll, pitch),
            slope_direction_rad=float(2.0 * np.pi * unit["slope_direction"][i, 0]),
            push_n=float(drawn["push_n"][i, 0]) if is_pushed else 0.0,
            is_delayed=bool(unit["delay_share"][i, 0] < ranges.delay_share),
            is_inertial=bool(unit["inertial_share"][i, 0] < ranges.inertial_share),
            **{name: float(drawn[name][i, 0]) for name in _OF_ONE},
            **feet,
        )
