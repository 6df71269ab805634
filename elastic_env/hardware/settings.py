"""Settings of a real testbed with units and bounds: safety limits, ports, wiring, mounting."""

import math
import os
from typing import Any, Literal, Self

from pydantic import model_validator

from elastic_env.core.config import Model, quantity
from elastic_env.hardware.buses.packets import HIGHEST_RATE, LARGEST_ID, LOWEST_RATE
from elastic_env.hardware.buses.servo_models import LARGEST_TORQUE_NM

_PI = math.pi
_TURN = 2.0 * math.pi
_LEAST_RANGE_RAD = 0.01


def _within(unit: str, default: float, least: float, most: float, description: str) -> Any:
    """A quantity between two bounds; the calls below are a table."""
    return quantity(unit, default, ge=least, le=most, description=description)


class SafetyLimits(Model):
    """Limits of commands, and of measurements that stop the motion.

    Angles as the servo has them.
    """

    lowest_rad: float = _within("rad", -1.6, -_TURN, _TURN, "lowest goal")
    highest_rad: float = _within("rad", 1.6, -_TURN, _TURN, "highest goal")
    margin_rad: float = _within("rad", 0.05, 0, 0.5, "how far beyond that range a position may lie")
    slew_rad_s: float = _within("rad/s", 3.0, 0.01, 10, "fastest change of the goal")
    speed_rad_s: float = _within("rad/s", 4.5, 0.01, 10, "measured speed that stops the motion")
    following_error_rad: float = _within(
        "rad", 0.35, 1e-3, 1.5, "distance from the goal that stops it"
    )
    temperature_c: float = _within("°C", 80.0, 1, 80, "temperature above which the motion stops")
    torque_nm: float = _within(
        "N·m", LARGEST_TORQUE_NM, 0.1, LARGEST_TORQUE_NM, "torque, by the current, that stops it"
    )
    patience_cycles: int = _within("1", 3, 1, 10, "cycles without a reply, or too much torque")
    hang_s: float = _within("s", 0.05, 0.005, 0.09, "time without a command that stops the motion")

    @model_validator(mode="after")
    def _range_is_ordered(self) -> Self:
        if self.highest_rad - self.lowest_rad < _LEAST_RANGE_RAD:
            raise ValueError(
                f"lowest_rad must be below highest_rad, by at least {_LEAST_RANGE_RAD} rad, got "
                f"{self.lowest_rad} and {self.highest_rad}"
            )
        return self


class HardwareSettings(Model):
    """Ports, wiring and mounting of a real testbed.

    The angles of its limits are those of the joint.
    """

    port: str
    """Port of the servo, such as /dev/ttyUSB0, or of an emulator; on the command line --port."""
    servo_id: int = _within("1", 1, 0, LARGEST_ID, "id of the servo")
    baudrate: int = _within(
        "bit/s", 3_000_000, LOWEST_RATE, HIGHEST_RATE, "rate of the servo's bus"
    )
    direction: Literal[1, -1] = 1
    """Sign of the joint angle against the servo's."""
    zero_rad: float = quantity("rad", 0.0, gt=-_PI, lt=_PI)
    """Servo angle where the pendulum hangs [rad]."""
    imu_port: str | None = None
    """Port of the IMU on the link; without one everything that needs the link angle is nan."""
    imu_baudrate: int = _within(
        "bit/s", 115_200, LOWEST_RATE, HIGHEST_RATE, "rate of the IMU's port"
    )
    imu_oldest_s: float = _within("s", 0.05, 0.01, 1, "age at which an attitude counts as missing")
    imu_axis: Literal["roll", "pitch", "yaw"] = "roll"
    """Euler angle that turns with the joint."""
    imu_sign: Literal[1, -1] = 1
    """Sign of the joint angle against that Euler angle."""
    imu_offset_rad: float = quantity("rad", 0.0, gt=-_PI, lt=_PI)
    """What it shows where q is 0 [rad]."""
    largest_deflection_rad: float = _within("rad", 0.2, 1e-3, 1, "bend that stops it, by the IMU")
    approach_rad_s: float = _within(
        "rad/s", 0.2, 0.01, 2, "peak speed to the start and back to rest"
    )
    confirm: bool = True
    """True if somebody at the terminal must agree before the first motion."""
    limits: SafetyLimits = SafetyLimits()

    @model_validator(mode="after")
    def _ports_differ(self) -> Self:
        if self.imu_port is not None and os.path.realpath(self.imu_port) == os.path.realpath(
            self.port
        ):
            raise ValueError(
                f"servo and IMU each have a port of their own, got {self.port} for both"
            )
        return self

    @model_validator(mode="after")
    def _limits_are_a_turn(self) -> Self:
        low, high = self._servo_range()
        if low < -_TURN or high > _TURN:
            raise ValueError(
                f"lowest_rad {self.limits.lowest_rad:g} and highest_rad "
                f"{self.limits.highest_rad:g} with zero_rad {self.zero_rad:g} are {low:.2f} to "
                f"{high:.2f} rad of the servo, which has ±{_TURN:.2f}"
            )
        return self

    def servo_angle(self, joint: float) -> float:
        """Angle in the servo's zero and sign [rad]."""
        return self.direction * joint + self.zero_rad

    def joint_angle(self, servo: float) -> float:
        """Angle of the joint's motor side θ [rad]."""
        return self.direction * (servo - self.zero_rad)

    @property
    def servo_limits(self) -> SafetyLimits:
        """The limits in the servo's zero and sign."""
        low, high = self._servo_range()
        return self.limits.replace(lowest_rad=low, highest_rad=high)

    def _servo_range(self) -> list[float]:
        return sorted(map(self.servo_angle, (self.limits.lowest_rad, self.limits.highest_rad)))
