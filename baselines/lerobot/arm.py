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

Two entries of the calibration are not used. `homing_offset` is in the motor's register, so that
counts already include it. `drive_mode` reverses the sign of values on Feetech's bus, except in
degrees; angles here always have the sign of the value. Motors without counts (Damiao) are read in
degrees from their own zero. All this is `MotorsBus._normalize` of lerobot 0.4.4,
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
"""Value in the middle of the calibrated range."""
_WIDTH = {"range": 200.0, "percent": 100.0}
"""Values from one end of the calibrated range to the other."""


@dataclass(frozen=True)
class JointUnits:
    """Angle = slope · (value − centre) + offset, for n joints.

    Attributes:
        slope: Angle of the joint per unit of LeRobot's value, negative where both have opposite
            signs, (n,) [rad].
        centre: Value in the middle of the calibrated range, (n,).
        offset: Angle of the model's joint at this value, (n,) [rad].
        lowest: Least value that LeRobot accepts, infinite without a range, (n,).
        highest: Largest value that LeRobot accepts, infinite without a range, (n,).
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
        """LeRobot's values for angles, (..., n) [rad]; not clipped to its ranges."""
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
        places: Joint that each of them moves.
        calibration: Calibration by the names of motors; motors without counts need none.

    Raises:
        ConfigurationError: A motor has no calibration.
    """
    rows = [
        _motor_units(motor, place, calibration.get(motor.name))
        for motor, place in zip(motors, places, strict=True)
    ]
    slope, centre, offset, lowest, highest = np.array(rows).T
    return JointUnits(slope, centre, offset, lowest, highest)


def _motor_units(
    motor: Motor, place: JointPlace, calibration: MotorCalibration | None
) -> tuple[float, float, float, float, float]:
    """Slope, centre, offset, lowest and highest value of a motor."""
    per_value = math.radians(1.0)
    lowest = -math.inf
    highest = math.inf
    centre = _CENTRE[motor.units]
    if motor.counts_per_turn is not None:
        if calibration is None:
            raise ConfigurationError(
                f"the calibration lacks the motor {motor.name!r}; give the JSON file that LeRobot"
                " wrote for this arm"
            )
        span = calibration.range_max - calibration.range_min
        per_count = 2.0 * math.pi / motor.counts_per_turn
        if motor.units == "degrees":
            per_value *= (motor.counts_per_turn - 1) / motor.counts_per_turn
            highest = 0.5 * span * per_count / per_value
            lowest = -highest
        else:
            width = _WIDTH[motor.units]
            per_value = span * per_count / width
            lowest = centre - 0.5 * width
            highest = centre + 0.5 * width
    offset = -place.direction * place.zero_rad
    return place.direction * per_value, centre, offset, lowest, highest


_LARGEST_MIDDLE_ERROR_RAD = 0.35
"""Largest distance between the middles of a calibrated range and of the model's range."""
_WHOLE_TURN_RAD = 6.0
"""Width from which a calibrated range is a whole turn, and not the range of the joint."""
_LARGEST_RANGE_RATIO = 1.3
"""Ratio of the first value to LeRobot's range above which the value has another unit."""


class LeRobotArm:
    """Compensates the actions that LeRobot sends to an arm, and corrects its observations.

    Some motors keep their values: motors that move no joint of the model, motors of joints that are
    held, and the gripper, unless `places` gives the joint that it moves.

    Attributes:
        settings: Settings with the content of the files of joints and calibration.
        compensator: Compensator in rad, for the joints of `motors`.
        motors: Names of the motors that are compensated, as in actions, (n,).
        units: LeRobot's values and angles of these motors.

    Args:
        settings: The arm.

    Raises:
        ConfigurationError: A file, a name or a value cannot be used.

    Warns:
        UserWarning: The middle of a motor's calibrated range is far from the middle of its joint's
            range; or a reason of `PositionCompensator`.
    """

    def __init__(self, settings: ArmSettings) -> None:
        calibration = settings.content_of_calibration
        joints = settings.joints
        content = read_mapping(Path(joints)) if isinstance(joints, str) else joints
        self.settings = settings.replace(calibration=calibration, joints=_without_infinity(content))
        model = compiled_model(settings.model)
        pairs = _compensated_motors(settings, hinges_of(model), content)
        motors = [motor for motor, _ in pairs]
        places = [place for _, place in pairs]
        self.motors = tuple(f"{settings.prefix}{motor.name}" for motor in motors)
        self.units = units_of(motors, places, calibration)
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
        """Restart the ramp at zero."""
        self.compensator.reset()

    def command(self, action: Mapping[str, Any]) -> dict[str, Any]:
        """Action that brings the links to the positions of an action.

        Args:
            action: Values by names such as elbow_flex.pos; other entries are passed on.

        Returns:
            The same entries with compensated values, within LeRobot's ranges.

        Raises:
            ActionError: A value is missing, or no finite number, or the first one has another unit;
                nothing changes.
        """
        desired = self._values("action", action)
        command = self.units.value(self.compensator.command(self.units.angle(desired)))
        clipped = np.clip(command, self.units.lowest, self.units.highest)
        return {**action, **dict(zip(self._keys, clipped.tolist(), strict=True))}

    def link_angles(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        """Observation with the angles of the links instead of those of the encoders, at rest.

        Arguments, result and errors are those of `command`.

        Raises:
            ElasticError: The load overcomes a spring.
        """
        measured = self._values("observation", observation)
        link = self.units.value(self.compensator.link_angle(self.units.angle(measured)))
        return {**observation, **dict(zip(self._keys, link.tolist(), strict=True))}

    def _values(self, kind: str, entries: Mapping[str, Any]) -> Array:
        """Values of the motors in an action or observation, (n,)."""
        missing = [key for key in self._keys if key not in entries]
        if missing:
            raise ActionError(
                f"the {kind} lacks {missing[0]!r}: put this step where LeRobot has the positions of"
                f" motors, it has {quote(list(entries))}"
            )
        try:
            values = np.array([float(entries[key]) for key in self._keys])
        except (TypeError, ValueError):
            raise ActionError(
                f"the {kind} must hold numbers at {', '.join(self._keys)}, got"
                f" {quote([entries[key] for key in self._keys])}"
            ) from None
        if not self._is_checked:
            self._require_units(values)
            self._is_checked = bool(np.isfinite(values).all())
        return values

    def _require_units(self, values: Array) -> None:
        """Refuse values that are so far beyond LeRobot's range that they have another unit."""
        middle = self.units.centre
        ratio = np.abs(values - middle) / (self.units.highest - middle)
        worst = int(np.argmax(ratio))
        if ratio[worst] > _LARGEST_RANGE_RATIO:
            raise ActionError(
                f"{self._keys[worst]} is {values[worst]:.4g}, and LeRobot's range is"
                f" {self.units.lowest[worst]:.4g} to {self.units.highest[worst]:.4g}: say"
                " use_degrees as the robot's configuration does"
            )

    def _warn_of_zeros(self, places: Sequence[JointPlace]) -> None:
        """Warn of calibrated ranges whose middles differ from those of the model's ranges."""
        lower, upper = self.units.ends
        constants = self.compensator.constants
        middle = 0.5 * (constants.lowest + constants.highest)
        error = np.abs(self.units.offset - middle)
        has_range = np.isfinite(error) & (upper - lower < _WHOLE_TURN_RAD)
        for joint in np.flatnonzero(has_range & (error > _LARGEST_MIDDLE_ERROR_RAD)):
            place = places[int(joint)]
            warnings.warn(
                f"LeRobot's zero of {self.motors[joint]} is the middle of the calibrated range, and"
                f" the model's range has its middle at {middle[joint]:.3g} rad: is zero_rad"
                f" {-place.direction * middle[joint]:.3g} in the place of {place.zero_rad:.3g}?",
                stacklevel=2,
            )


def _compensated_motors(
    settings: ArmSettings, hinges: Sequence[str], content: Any
) -> list[tuple[Motor, JointPlace]]:
    """Motors that are compensated, with the joints that they move."""
    pairs: list[tuple[Motor, JointPlace]] = []
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
            pairs.append((motor, place.replace(joint=joint)))
    names = [place.joint for _, place in pairs]
    if repeated := [name for name in names if names.count(name) > 1]:
        raise ConfigurationError(f"two motors move the joint {repeated[0]!r}; correct `places`")
    if not pairs:
        raise ConfigurationError("no motor is left to compensate; correct `places` or `joints`")
    return pairs


def _is_held(content: Any, joint: str) -> bool:
    key = key_of(content, joint) if isinstance(content, Mapping) else None
    return key is not None and content[key] == HELD


def _without_infinity(content: Any) -> Any:
    """Content of a file of joints for JSON, which has no infinite numbers."""
    if isinstance(content, Mapping):
        return {str(key): _without_infinity(value) for key, value in content.items()}
    return RIGID if content == np.inf else content
