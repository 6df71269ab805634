r"""An arm of LeRobot with its compensator: actions and observations, in LeRobot's own units.

LeRobot counts from the middle of a motor's calibrated range, (min + max)/2 in counts. With N counts
a turn, a count is 2π/N rad. Its three units are

========  =======================================  ==============================
unit      value                                    angle from the middle [rad]
========  =======================================  ==============================
degrees   (counts − middle) 360/(N − 1)            value (N − 1)/N π/180
range     −100 to 100 over the calibrated range    value (max − min)/200 · 2π/N
percent   0 to 100 over it                         (value − 50)(max − min)/100 · 2π/N
========  =======================================  ==============================

Two entries of the calibration do not enter. `homing_offset` is in the motor's register, so that
counts have it already. `drive_mode` turns the sign of values on Feetech's bus, outside of degrees;
angles here have the sign of the value, whatever it came from. Motors without counts (Damiao) are
read in degrees from their own zero. All this is `MotorsBus._normalize` of lerobot 0.4.4,
`src/lerobot/motors/motors_bus.py`.

Where a joint of the model is at q, LeRobot's angle is direction · q + `zero_rad`.
"""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from baselines.compensation.position_compensator import PositionCompensator
from baselines.lerobot.settings import GRIPPER, ArmSettings, JointPlace, Motor, MotorCalibration
from elastic_env.core.config import read_mapping
from elastic_env.core.errors import ActionError, ConfigurationError, choices_listed, quote
from elastic_env.core.signals import Array
from elastic_env.joint.joint_settings import HELD, RIGID, key_of
from elastic_env.joint.model_file import compiled_model
from elastic_env.joint.model_joints import hinges_of

_CENTRE = {"degrees": 0.0, "range": 0.0, "percent": 50.0}
_WIDTH = {"range": 200.0, "percent": 100.0}
"""Values from one end of the calibrated range to the other."""


@dataclass(frozen=True)
class JointUnits:
    """Angle = slope · (value − centre) + offset, for n joints.

    Attributes:
        slope: Angle of the joint per unit of LeRobot's value, negative where it runs against it,
            (n,) [rad].
        centre: Value in the middle of the calibrated range, (n,).
        offset: Angle of the model's joint there, (n,) [rad].
        lowest: Least value that LeRobot takes, infinite without a range, (n,).
        highest: Largest one.
    """

    slope: Array
    centre: Array
    offset: Array
    lowest: Array
    highest: Array

    def angle(self, value: Array) -> Array:
        """Angles of the model's joints, (..., n) [rad]."""
        return self.slope * (value - self.centre) + self.offset

    def value(self, angle: Array) -> Array:
        """LeRobot's values for angles, (..., n) [rad]; not cut to its ranges."""
        return (angle - self.offset) / self.slope + self.centre

    @property
    def ends(self) -> tuple[Array, Array]:
        """Angles at the ends of LeRobot's ranges, lower and upper, (n,) each [rad]."""
        ends = np.sort([self.angle(self.lowest), self.angle(self.highest)], axis=0)
        return ends[0], ends[1]


def units_of(
    motors: Sequence[Motor],
    places: Sequence[JointPlace],
    calibration: dict[str, MotorCalibration],
) -> JointUnits:
    """Units of some motors.

    Args:
        motors: Motors with their units.
        places: What each of them moves.
        calibration: By the names of motors; those without counts need none.

    Raises:
        ConfigurationError: A motor has no calibration.
    """
    rows = [
        _row(motor, place, calibration.get(motor.name))
        for motor, place in zip(motors, places, strict=True)
    ]
    slope, centre, offset, lowest, highest = np.array(rows).T
    return JointUnits(slope, centre, offset, lowest, highest)


def _row(
    motor: Motor, place: JointPlace, known: MotorCalibration | None
) -> tuple[float, float, float, float, float]:
    """Slope, centre, offset, lowest and highest value of a motor."""
    turn = math.radians(1.0)
    lowest = -math.inf
    highest = math.inf
    centre = _CENTRE[motor.units]
    if motor.counts_per_turn is not None:
        if known is None:
            raise ConfigurationError(
                f"the calibration lacks the motor {motor.name!r}; give the JSON file that LeRobot"
                " wrote for this arm"
            )
        span = known.range_max - known.range_min
        per_count = 2.0 * math.pi / motor.counts_per_turn
        if motor.units == "degrees":
            turn *= (motor.counts_per_turn - 1) / motor.counts_per_turn
            highest = 0.5 * span * per_count / turn
            lowest = -highest
        else:
            width = _WIDTH[motor.units]
            turn = span * per_count / width
            lowest = centre - 0.5 * width
            highest = centre + 0.5 * width
    offset = -place.direction * place.zero_rad
    return place.direction * turn, centre, offset, lowest, highest


_FAR_RAD = 0.35
"""Distance from which the middle of a calibrated range is not that of the model's range."""
_TURN_RAD = 6.0
"""Width from which a calibrated range is a whole turn, and not that of the joint."""
_BEYOND = 1.3
"""Share of LeRobot's range beyond which the first value has another unit."""


class LeRobotArm:
    """Compensates what LeRobot sends to an arm, and corrects what it reads.

    Motors that move no joint of the model keep their values, and so do the gripper, unless a place
    says which joint it moves, and the motors of joints that are held.

    Attributes:
        settings: With the content of the files of joints and calibration in place of their names.
        compensator: In rad, for the joints of `motors`.
        motors: Names of the motors that are compensated, as in actions, (n,).
        units: LeRobot's values and angles of these.

    Args:
        settings: The arm.

    Raises:
        ConfigurationError: A file, a name or a value cannot be used.

    Warns:
        UserWarning: The calibrated range of a motor is far from the middle of its joint's range; or
            as `PositionCompensator` says.
    """

    def __init__(self, settings: ArmSettings) -> None:
        calibration = settings.content_of_calibration
        joints = settings.joints
        content = read_mapping(Path(joints)) if isinstance(joints, str) else joints
        self.settings = settings.replace(calibration=calibration, joints=_without_infinity(content))
        model = compiled_model(settings.model)
        moved = _moved(settings, hinges_of(model), content)
        self.motors = tuple(f"{settings.prefix}{motor.name}" for motor, _ in moved)
        places = [place for _, place in moved]
        self.units = units_of([motor for motor, _ in moved], places, calibration)
        self.compensator = PositionCompensator(
            model,
            content,
            joints=[str(place.joint) for place in places],
            position_gain=settings.position_gain,
            limit_rad=settings.limit_rad,
            ramp_s=settings.ramp_s,
            period_s=settings.period_s,
            friction=settings.friction,
        )
        self._keys = [f"{name}.pos" for name in self.motors]
        self._is_checked = False
        self._warn_of_zeros(places)

    def reset(self) -> None:
        """Begin anew: the ramp starts at zero."""
        self.compensator.reset()

    def command(self, action: Mapping[str, Any]) -> dict[str, Any]:
        """Action that brings the links to where an action wants them.

        Args:
            action: Values by names such as elbow_flex.pos; others are handed on.

        Returns:
            The same with compensated values, within LeRobot's ranges.

        Raises:
            ActionError: A value is missing, or no finite number, or the first one has another unit;
                nothing changes.
        """
        wanted = self._values("action", action)
        found = self.units.value(self.compensator.command(self.units.angle(wanted)))
        within = np.clip(found, self.units.lowest, self.units.highest)
        return {**action, **dict(zip(self._keys, within.tolist(), strict=True))}

    def link_angles(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        """Observation with the angles of the links in the place of those of the encoders, at rest.

        Arguments, result and errors are as of `command`.

        Raises:
            ElasticError: The load overcomes a spring.
        """
        shown = self._values("observation", observation)
        found = self.units.value(self.compensator.link_angle(self.units.angle(shown)))
        return {**observation, **dict(zip(self._keys, found.tolist(), strict=True))}

    def _values(self, what: str, given: Mapping[str, Any]) -> Array:
        """Values of the motors, (n,)."""
        missing = [key for key in self._keys if key not in given]
        if missing:
            raise ActionError(
                f"the {what} lacks {missing[0]!r}: put this step where LeRobot has the positions of"
                f" motors, it has {quote(list(given))}"
            )
        try:
            values = np.array([float(given[key]) for key in self._keys])
        except (TypeError, ValueError):
            raise ActionError(
                f"the {what} must hold numbers at {', '.join(self._keys)}, got"
                f" {quote([given[key] for key in self._keys])}"
            ) from None
        if not self._is_checked:
            self._require_units(values)
            self._is_checked = bool(np.isfinite(values).all())
        return values

    def _require_units(self, values: Array) -> None:
        """Refuse values that are so far beyond LeRobot's range that they have another unit."""
        middle = self.units.centre
        beyond = np.abs(values - middle) / (self.units.highest - middle)
        worst = int(np.argmax(beyond))
        if beyond[worst] > _BEYOND:
            raise ActionError(
                f"{self._keys[worst]} is {values[worst]:.4g}, and LeRobot's range is"
                f" {self.units.lowest[worst]:.4g} to {self.units.highest[worst]:.4g}: say"
                " use_degrees as the robot's configuration does"
            )

    def _warn_of_zeros(self, places: Sequence[JointPlace]) -> None:
        """Warn of calibrated ranges that do not lie over the model's."""
        lower, upper = self.units.ends
        known = self.compensator.constants
        middle = 0.5 * (known.lowest + known.highest)
        off = np.abs(self.units.offset - middle)
        has_range = np.isfinite(off) & (upper - lower < _TURN_RAD)
        for joint in np.flatnonzero(has_range & (off > _FAR_RAD)):
            place = places[int(joint)]
            warnings.warn(
                f"LeRobot's zero of {self.motors[joint]} is the middle of the calibrated range, and"
                f" the model's range has its middle at {middle[joint]:.3g} rad: is zero_rad"
                f" {-place.direction * middle[joint]:.3g} in the place of {place.zero_rad:.3g}?",
                stacklevel=2,
            )


def _moved(
    settings: ArmSettings, hinges: Sequence[str], content: Any
) -> list[tuple[Motor, JointPlace]]:
    """Motors that are compensated, with the joints that they move."""
    found: list[tuple[Motor, JointPlace]] = []
    for motor in settings.motors:
        default = None if motor.name == GRIPPER else JointPlace()
        place = settings.places.get(motor.name, default)
        if place is None:
            continue
        joint = place.joint or motor.name
        if place.joint is None and motor.joint is not None and joint not in hinges:
            joint = motor.joint.replace("*", f"{settings.side}_" if settings.side else "")
        if joint not in hinges:
            raise ConfigurationError(
                f"the model has no joint {joint!r} for the motor {motor.name!r}; name it by"
                f" places={{{motor.name!r}: {{'joint': NAME}}}}, give None for a motor that keeps"
                f" its goal, or say side where the model has two arms;"
                f" {choices_listed(joint, hinges)}"
            )
        if not _is_held(content, joint):
            found.append((motor, place.replace(joint=joint)))
    names = [place.joint for _, place in found]
    if twice := [name for name in names if names.count(name) > 1]:
        raise ConfigurationError(f"two motors move the joint {twice[0]!r}; correct `places`")
    if not found:
        raise ConfigurationError("no motor is left to compensate; correct `places` or `joints`")
    return found


def _is_held(content: Any, joint: str) -> bool:
    if not isinstance(content, Mapping):
        return False
    key = key_of(content, joint)
    return key is not None and content[key] == HELD


def _without_infinity(content: Any) -> Any:
    """Content of a file of joints for JSON, which knows no infinite number."""
    if isinstance(content, Mapping):
        return {str(key): _without_infinity(value) for key, value in content.items()}
    return RIGID if content == np.inf else content
