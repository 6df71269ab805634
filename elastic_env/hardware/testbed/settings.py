"""How the testbed is wired and mounted: ports, ids, signs, zeros, limits."""

import math
import os
from typing import Any, Literal, Self

from pydantic import model_validator

from elastic_env.core.config import Model, quantity
from elastic_env.hardware.safety.limits import SafetyLimits
from elastic_env.hardware.servo_bus.protocol import HIGHEST_RATE, LOWEST_RATE


def _rate(default: int, description: str) -> Any:
    """Bits per second of a port."""
    return quantity("bit/s", default, ge=LOWEST_RATE, le=HIGHEST_RATE, description=description)


class HardwareSettings(Model):
    """What only a real testbed has; the angles of its limits are those of the joint."""

    port: str
    """Port of the servo, such as /dev/ttyUSB0, or of an emulator; on the command line --port."""
    servo_id: int = quantity("1", 1, ge=0, le=252, description="id of the servo")
    baudrate: int = _rate(3_000_000, "rate of the servo's bus")
    direction: Literal[1, -1] = 1
    """Sign of the joint angle against the servo's."""
    zero_rad: float = quantity("rad", 0.0, gt=-math.pi, lt=math.pi, description="servo angle where the pendulum hangs")
    imu_port: str | None = None
    """Port of the IMU on the link; without one everything that needs the link angle is nan."""
    imu_baudrate: int = _rate(115_200, "rate of the IMU's port")
    imu_oldest_s: float = quantity("s", 0.05, ge=0.01, le=1, description="age at which an attitude counts as missing")
    imu_axis: Literal["roll", "pitch", "yaw"] = "roll"
    """Euler angle that turns with the joint."""
    imu_sign: Literal[1, -1] = 1
    """Sign of the joint angle against that Euler angle."""
    imu_offset_rad: float = quantity("rad", 0.0, gt=-math.pi, lt=math.pi, description="what it shows where q is 0")
    largest_deflection_rad: float = quantity("rad", 0.2, ge=1e-3, le=1, description="bend that stops it, by the IMU")
    approach_rad_s: float = quantity(
        "rad/s", 0.2, ge=0.01, le=2, description="peak speed to the start and back to rest"
    )
    confirm: bool = True
    """Whether somebody at the terminal must agree before the first motion."""
    limits: SafetyLimits = SafetyLimits()

    @model_validator(mode="after")
    def _ports_differ(self) -> Self:
        if self.imu_port is not None and os.path.realpath(self.imu_port) == os.path.realpath(self.port):
            raise ValueError(f"servo and IMU each have a port of their own, got {self.port} for both")
        return self

    @model_validator(mode="after")
    def _limits_are_a_turn(self) -> Self:
        ends = sorted(map(self.servo_angle, (self.limits.lowest_rad, self.limits.highest_rad)))
        if ends[0] < -2.0 * math.pi or ends[1] > 2.0 * math.pi:
            raise ValueError(
                f"lowest_rad {self.limits.lowest_rad:g} and highest_rad {self.limits.highest_rad:g} with zero_rad "
                f"{self.zero_rad:g} are {ends[0]:.2f} to {ends[1]:.2f} rad of the servo, which has ±{2 * math.pi:.2f}"
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
        ends = sorted(map(self.servo_angle, (self.limits.lowest_rad, self.limits.highest_rad)))
        return self.limits.replace(lowest_rad=ends[0], highest_rad=ends[1])
