"""Settings of a real testbed with units and bounds: safety limits, ports, wiring, mounting."""

import math
import os
from typing import Literal

from elastic_env.core.config import Model, quantity
from elastic_env.hardware.buses.packets import LARGEST_ID, RANGE_OF_RATES
from elastic_env.hardware.buses.servo_models import LARGEST_TORQUE_NM

PATIENT_LIMITS = {"patience_cycles": 10, "hang_s": 0.09}
"""Most patient limits, for emulators: a busy computer delays pseudo-terminals."""
_TURN = 2.0 * math.pi
_LEAST_RANGE_RAD = 0.01


class SafetyLimits(Model):
    """Limits of commands, and of measurements that stop the motion.

    Angles are those of the servo.
    """

    lowest_rad: float = quantity("rad", -1.6, ge=-_TURN, le=_TURN)
    """Lowest goal [rad]."""
    highest_rad: float = quantity("rad", 1.6, ge=-_TURN, le=_TURN)
    """Highest goal [rad]."""
    margin_rad: float = quantity("rad", 0.05, ge=0, le=0.5)
    """Margin beyond that range for positions on the way; no motion begins in it [rad]."""
    slew_rad_s: float = quantity("rad/s", 3.0, ge=0.01, le=10)
    """Largest rate of the goal [rad/s]."""
    speed_rad_s: float = quantity("rad/s", 4.5, ge=0.01, le=10)
    """Measured speed that stops the motion [rad/s]."""
    following_error_rad: float = quantity("rad", 0.35, ge=1e-3, le=1.5)
    """Distance from the goal that stops the motion: the joint is blocked [rad]."""
    temperature_c: float = quantity("°C", 80.0, ge=1, le=80)
    """Temperature that stops the motion, or the servo's own limit if that is lower [°C]."""
    torque_nm: float = quantity("N·m", LARGEST_TORQUE_NM, ge=0.1, le=LARGEST_TORQUE_NM)
    """Torque, from the current, that stops the motion after `patience_cycles` [N·m]."""
    patience_cycles: int = quantity("1", 3, ge=1, le=10)
    """Cycles in a row without a usable reply, or with too much torque, that stop the motion [1]."""
    hang_s: float = quantity("s", 0.05, ge=0.005, le=0.09)
    """Time without a command, or an answer of the supervisor, that stops the motion [s]."""
    release_s: float = quantity("s", 0.0, ge=0, le=5)
    """Time in which torque falls to zero, on servos that can limit it [s]."""

    def _check(self) -> None:
        if self.highest_rad - self.lowest_rad < _LEAST_RANGE_RAD:
            raise ValueError(
                f"lowest_rad must be below highest_rad, by at least {_LEAST_RANGE_RAD}"
                f" rad, got {self.lowest_rad} and {self.highest_rad}"
            )

    def patience_hint(self, name: str) -> str:
        """Hint in an error that a more patient limit would have avoided.

        Args:
            name: Name of the limit, one of `PATIENT_LIMITS`.

        Returns:
            The option that raises the limit, "" if it is already the most patient one.
        """
        is_patient = getattr(self, name) >= PATIENT_LIMITS[name]
        return "" if is_patient else "; for an emulator: --patient"


class HardwareSettings(Model):
    """Ports, wiring and mounting of a real testbed.

    The angles of its limits are those of the joint.
    """

    port: str
    """Port of the servo, such as /dev/ttyUSB0, or of an emulator; on the command line --port."""
    servo_id: int = quantity("1", 1, ge=0, le=LARGEST_ID)
    """Id of the servo [1]."""
    baudrate: int = quantity("bit/s", 3_000_000, **RANGE_OF_RATES)
    """Rate of the servo's bus [bit/s]."""
    direction: Literal[1, -1] = 1
    """Sign of the joint angle against the servo's."""
    zero_rad: float = quantity("rad", 0.0, gt=-math.pi, lt=math.pi)
    """Servo angle where the pendulum hangs [rad]."""
    imu_port: str | None = None
    """Port of the IMU on the link; without one all that needs the link angle is nan."""
    imu_baudrate: int = quantity("bit/s", 115_200, **RANGE_OF_RATES)
    """Rate of the IMU's port [bit/s]."""
    imu_oldest_s: float = quantity("s", 0.05, ge=0.01, le=1)
    """Age at which an attitude counts as missing, and longest time without a change of any bit [s].

    Both end the episode.
    """
    imu_axis: Literal["roll", "pitch", "yaw"] = "roll"
    """Euler angle that turns with the joint."""
    imu_sign: Literal[1, -1] = 1
    """Sign of the joint angle against that Euler angle."""
    imu_offset_rad: float = quantity("rad", 0.0, gt=-math.pi, lt=math.pi)
    """Euler angle at q = 0 [rad]."""
    largest_deflection_rad: float = quantity("rad", 0.2, ge=1e-3, le=1)
    """Angle between link, by the IMU, and servo that stops the motion [rad]."""
    approach_rad_s: float = quantity("rad/s", 0.2, ge=0.01, le=2)
    """Peak speed to the start and back to rest [rad/s]."""
    confirm: bool = True
    """True if somebody at the terminal must agree before the first motion."""
    limits: SafetyLimits = SafetyLimits()
    """Limits of goals, and of measurements that stop the motion."""

    def _check(self) -> None:
        imu = self.imu_port
        if imu is not None and os.path.realpath(imu) == os.path.realpath(self.port):
            raise ValueError(f"servo and IMU need a port of their own, got {self.port} twice")
        low, high = self._servo_range()
        if low < -_TURN or high > _TURN:
            limits = self.limits
            raise ValueError(
                f"lowest_rad {limits.lowest_rad:g} and highest_rad"
                f" {limits.highest_rad:g} with zero_rad {self.zero_rad:g} are {low:.2f}"
                f" to {high:.2f} rad of the servo, which has ±{_TURN:.2f}"
            )

    def servo_angle(self, joint: float) -> float:
        """Angle in the servo's zero and sign [rad]."""
        return self.direction * joint + self.zero_rad

    def joint_angle(self, servo: float) -> float:
        """Angle of the joint's motor side θ [rad]."""
        return self.direction * (servo - self.zero_rad)

    @property
    def servo_limits(self) -> SafetyLimits:
        """Limits in the servo's zero and sign."""
        low, high = self._servo_range()
        return self.limits.replace(lowest_rad=low, highest_rad=high)

    def _servo_range(self) -> list[float]:
        """Lowest and highest goal in the servo's zero and sign [rad]."""
        ends = (self.limits.lowest_rad, self.limits.highest_rad)
        return sorted(map(self.servo_angle, ends))
