r"""LeRobot's numbers of joints and the model's angles, both ways.

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
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from baselines.lerobot.settings import JointPlace, Motor, MotorCalibration
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array

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
