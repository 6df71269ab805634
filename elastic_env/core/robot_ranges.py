"""Ranges that robots are drawn from: domain randomisation, one closed interval per quantity.

A bank of robots is a Latin hypercube of the ranges [McKay1979]: every quantity takes one value in
each of n intervals of equal width, so that few robots cover all of them. Every quantity has
generators of its own. So a range that is changed leaves the draws of the others as they are.

[McKay1979] M. D. McKay, R. J. Beckman, W. J. Conover, "A Comparison of Three Methods for Selecting
Values of Input Variables in the Analysis of Output from a Computer Code", Technometrics 21(2).
"""

from collections.abc import Iterator, Sequence
from typing import Any, Self, TypeAlias

import numpy as np
from pydantic import Field, model_validator

from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, BoolArray

Interval: TypeAlias = tuple[float, float]
"""Lowest and highest value, both included."""


def interval(unit: str, nominal: float, *, description: str, bounds: Interval) -> Any:
    """An interval of a `Model`.

    Args:
        unit: SI unit as it appears in error messages and tables, "1" for a pure number.
        nominal: Value where nothing is drawn, the default of both ends.
        description: One line for documentation.
        bounds: What the ends must lie within.
    """
    extra: dict[str, Any] = {"unit": unit, "bounds": bounds}
    return Field((nominal, nominal), description=f"{description} [{unit}]", json_schema_extra=extra)


class RobotRanges(Model):
    """What robots differ in from the assumed one; by default in nothing."""

    stiffness: Interval = interval(
        "1", 1.0, bounds=(0.05, 20), description="factor on K, of all joints together"
    )
    joint_stiffness: Interval = interval(
        "1", 1.0, bounds=(0.05, 20), description="further factor on K, of every joint its own"
    )
    damping: Interval = interval(
        "1", 1.0, bounds=(0, 100), description="factor on D, of all joints together"
    )
    friction: Interval = interval(
        "1",
        1.0,
        bounds=(0, 100),
        description="factor on dry and viscous friction, of all joints together",
    )
    backlash_rad: Interval = interval(
        "rad", 0.0, bounds=(0, 0.1), description="further dead band, of all joints together"
    )
    load_kg: Interval = interval("kg", 0.0, bounds=(0, 100), description="load on the torso")
    load_x_m: Interval = interval(
        "m", 0.0, bounds=(-1, 1), description="place of the load before the torso's center of mass"
    )
    load_y_m: Interval = interval(
        "m", 0.0, bounds=(-1, 1), description="the same, to the left of it"
    )
    load_z_m: Interval = interval("m", 0.0, bounds=(-1, 1), description="the same, above it")
    homing_rad: Interval = interval(
        "rad", 0.0, bounds=(-0.1, 0.1), description="error of the encoders, of every joint its own"
    )
    mounting_rad: Interval = interval(
        "rad",
        0.0,
        bounds=(-0.1, 0.1),
        description="error of the IMU, of roll and pitch each its own",
    )
    slope_rad: Interval = interval(
        "rad", 0.0, bounds=(0, 0.5), description="slope of the floor, in any direction"
    )
    push_n: Interval = interval(
        "N", 0.0, bounds=(0, 1000), description="force of a push on the torso"
    )
    push_share: float = quantity("1", 1.0, ge=0, le=1)
    """Share of the robots that are pushed [1]."""
    delay_share: float = quantity("1", 0.0, ge=0, le=1)
    """Share of the robots whose measurements are one control step old [1]."""
    inertial_share: float = quantity("1", 0.0, ge=0, le=1)
    """Share of the robots whose IMU computes its attitude [1]."""

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
        """The same for a robot that does not walk, which has no torso to load or to push, and no
        floor.
        """
        nominal = RobotRanges()
        names = (
            "load_kg",
            "load_x_m",
            "load_y_m",
            "load_z_m",
            "slope_rad",
            "push_n",
            "inertial_share",
        )
        return self.replace(**{name: getattr(nominal, name) for name in names})

    def intervals(self) -> Iterator[tuple[str, Interval]]:
        """Quantities with an interval, by name."""
        for name in type(self).model_fields:
            value = getattr(self, name)
            if isinstance(value, tuple):
                yield name, value


class RobotDraw(Model):
    """A robot as it was drawn: what of it differs from the plant that its scenario describes,
    and its conditions.
    """

    stiffness_factor: tuple[float, ...]
    """Of every joint."""
    encoder_bias_rad: tuple[float, ...]
    """Of every joint."""
    damping_factor: float = quantity("1", 1.0, ge=0)
    """Factor on D of all joints [1]."""
    friction_factor: float = quantity("1", 1.0, ge=0)
    """Factor on the friction of all joints [1]."""
    backlash_rad: float = quantity("rad", 0.0, ge=0)
    """Further dead band of all joints [rad]."""
    load_kg: float = quantity("kg", 0.0, ge=0)
    """Load on the torso [kg]."""
    load_place_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Of the load, from the torso's center of mass; x forward, y left, z up."""
    imu_bias_rad: tuple[float, float] = (0.0, 0.0)
    """Of roll and pitch."""
    slope_rad: float = quantity("rad", 0.0, ge=0)
    """Slope of the floor [rad]."""
    slope_direction_rad: float = quantity("rad", 0.0)
    """Direction in which the floor rises [rad]."""
    push_n: float = quantity("N", 0.0, ge=0)
    """Force of a push on the torso [N]."""
    is_delayed: bool = False
    """Whether measurements are one control step old."""
    is_inertial: bool = False
    """Whether the IMU computes its attitude."""

    def record(self) -> dict[str, float]:
        """The robot in figures, by name with unit, for the records of episodes; of joints mean
        and rms.
        """
        x, y, z = self.load_place_m
        roll, pitch = self.imu_bias_rad
        return {
            "robot_stiffness": float(np.mean(self.stiffness_factor)),
            "robot_damping": self.damping_factor,
            "robot_friction": self.friction_factor,
            "robot_backlash_rad": self.backlash_rad,
            "robot_load_kg": self.load_kg,
            "robot_load_x_m": x,
            "robot_load_y_m": y,
            "robot_load_z_m": z,
            "robot_homing_rms_rad": float(np.sqrt(np.mean(np.square(self.encoder_bias_rad)))),
            "robot_mounting_roll_rad": roll,
            "robot_mounting_pitch_rad": pitch,
            "robot_slope_rad": self.slope_rad,
            "robot_slope_direction_rad": self.slope_direction_rad,
            "robot_push_n": self.push_n,
            "robot_is_delayed": float(self.is_delayed),
            "robot_is_inertial": float(self.is_inertial),
        }


def draw_robots(
    ranges: Sequence[RobotRanges], number: int, joints: int, seed: Sequence[int]
) -> list[RobotDraw]:
    """Robots of ranges, in equal shares where there are several of these; the same in every
    process.

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
        for robot in _drawn(own, ends[index + 1] - ends[index], joints, (*seed, index))
    ]


def draw_robot(
    ranges: Sequence[RobotRanges], joints: int, generator: np.random.Generator
) -> RobotDraw:
    """One robot of ranges, which have equal chances where there are several."""
    own = ranges[int(generator.integers(len(ranges)))]
    (robot,) = _drawn(own, 1, joints, [int(generator.integers(2**63))])
    return robot


def latin_hypercube(number: int, columns: int, generator: np.random.Generator) -> Array:
    """Points in the unit cube, (number, columns): each column has one value in each of `number`
    equal intervals.
    """
    strata = generator.permuted(np.tile(np.arange(number), (columns, 1)), axis=1)
    points: Array = (strata + generator.random((columns, number))).T / number
    return points


def _drawn(
    ranges: RobotRanges, number: int, joints: int, seed: Sequence[int]
) -> Iterator[RobotDraw]:
    """Robots of one set of ranges."""
    names = type(ranges).model_fields

    def unit(name: str, columns: int = 1) -> Array:
        own = np.random.default_rng([*seed, [*names, "slope_direction"].index(name)])
        return latin_hypercube(number, columns, own)

    def within(name: str, columns: int = 1) -> Array:
        low, high = getattr(ranges, name)
        # not low + u (high - low), which may end beyond high by rounding
        return np.clip(low + unit(name, columns) * (high - low), low, high)

    def has(name: str) -> BoolArray:
        return unit(name)[:, 0] < getattr(ranges, name)

    stiffness = within("stiffness") * within("joint_stiffness", joints)
    homing = within("homing_rad", joints)
    mounting = within("mounting_rad", 2)
    place = np.hstack([within("load_x_m"), within("load_y_m"), within("load_z_m")])
    push = within("push_n")[:, 0] * has("push_share")
    direction = 2.0 * np.pi * unit("slope_direction")[:, 0]
    delayed = has("delay_share")
    inertial = has("inertial_share")
    one_each = {
        "damping_factor": "damping",
        "friction_factor": "friction",
        "backlash_rad": "backlash_rad",
        "load_kg": "load_kg",
        "slope_rad": "slope_rad",
    }
    columns = {field: within(name)[:, 0] for field, name in one_each.items()}
    for i in range(number):
        yield RobotDraw(
            stiffness_factor=tuple(stiffness[i].tolist()),
            encoder_bias_rad=tuple(homing[i].tolist()),
            imu_bias_rad=mounting[i],
            load_place_m=place[i],
            push_n=push[i],
            slope_direction_rad=direction[i],
            is_delayed=bool(delayed[i]),
            is_inertial=bool(inertial[i]),
            **{name: values[i] for name, values in columns.items()},
        )
