"""Settings of an arm on a bus: which servo moves which joint, signs, zeros, limits."""

import math
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from pydantic import field_validator

from elastic_env.core.config import Model, quantity
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.hardware.buses.packets import LARGEST_ID, RANGE_OF_RATES
from elastic_env.hardware.buses.servo_models import Protocol
from elastic_env.hardware.settings import SafetyLimits

ARM_LIMITS = SafetyLimits(
    lowest_rad=-math.pi,
    highest_rad=math.pi,
    slew_rad_s=2.0,
    following_error_rad=0.6,
    patience_cycles=5,
    hang_s=0.09,
    release_s=1.5,
)
"""Limits of arms where a mounting gives no others: their servos sag, and must not drop the arm."""


class ServoPlace(Model):
    """The servo of one joint."""

    id: int = quantity("1", ge=0, le=LARGEST_ID)
    """Id of the servo [1]."""
    direction: Literal[1, -1] = 1
    """Sign of the joint's angle against the servo's."""
    zero_rad: float = quantity("rad", 0.0, gt=-math.pi, lt=math.pi)
    """Servo angle where the joint of the model is at zero [rad]; 0 is the middle of a turn."""
    model: str | None = None
    """Name of the servo, such as STS3215, checked at the start; None for any."""


class ArmSettings(Model):
    """An arm on a bus: port, servos, limits, and the pace of its loop."""

    port: str
    """Port of the servos, such as /dev/ttyACM0; on the command line --port."""
    protocol: Protocol = "feetech"
    """Protocol of the servos: feetech (STS, SMS) or dynamixel (2.0)."""
    baudrate: int | None = quantity("bit/s", None, **RANGE_OF_RATES)
    """Rate of the bus; default the usual one of the protocol [bit/s]."""
    joints: dict[str, ServoPlace]
    """Servos by the names of the model's joints."""
    rate_hz: float = quantity("Hz", 100.0, ge=50, le=200)
    """Control cycles per second [Hz]."""
    speed_rad_s: float = quantity("rad/s", 0.5, ge=0.01, le=2)
    """Largest speed of a joint on the way to a target [rad/s]."""
    acceleration_rad_s2: float = quantity("rad/s²", 2.0, ge=0.01, le=20)
    """Largest acceleration on that way [rad/s²]."""
    confirm: bool = True
    """True if somebody at the terminal must agree before the first motion."""
    limits: SafetyLimits = ARM_LIMITS
    """Limits of goals and measurements; each joint also keeps to its range in the model."""

    @field_validator("limits", mode="before")
    @classmethod
    def _add_default_limits(cls, limits: Any) -> Any:
        return ARM_LIMITS.model_dump() | limits if isinstance(limits, dict) else limits

    def _check(self) -> None:
        first: dict[int, str] = {}
        for name, place in self.joints.items():
            if place.id in first:
                raise ValueError(
                    f"joints {first[place.id]} and {name} both have the id {place.id};"
                    " every servo needs an id of its own"
                )
            first[place.id] = name

    def servos(self, joints: Sequence[str]) -> "ServoMap":
        """Servos of some joints, in the order of the joints.

        Raises:
            ConfigurationError: A joint has no servo.
        """
        for name in joints:
            if name not in self.joints:
                raise ConfigurationError(
                    f"joint {name!r} has no servo: give its id under `joints` of the"
                    f" mounting, or write {name}: held in the file of joints; there are"
                    f" ids of {', '.join(self.joints)}"
                )
        return ServoMap(tuple(joints), [self.joints[name] for name in joints])


class ServoMap:
    """Converts angles of joints to those of their servos, and back.

    Args:
        joints: Names of the joints, (n,).
        places: Their servos, (n,).
    """

    def __init__(self, joints: tuple[str, ...], places: Sequence[ServoPlace]) -> None:
        self.joints = joints
        self.ids = [place.id for place in places]
        self.models = [place.model for place in places]
        self.direction: Array = np.array([float(place.direction) for place in places])
        self.zero: Array = np.array([place.zero_rad for place in places])

    def servo_angle(self, joint: Array) -> Array:
        """Angles in the servos' zeros and signs, (..., n) [rad]."""
        return self.direction * joint + self.zero

    def joint_angle(self, servo: Array) -> Array:
        """Angles of the joints' motor sides θ, (..., n) [rad]."""
        return self.direction * (servo - self.zero)

    def servo_ranges(self, lowest: Array, highest: Array, limits: SafetyLimits) -> Array:
        """Ranges of the servos' goals, (n, 2) [rad].

        Args:
            lowest: Lowest angles of the joints in the model, (n,) [rad].
            highest: Highest angles, (n,) [rad].
            limits: Further limits of all joints.

        Raises:
            ConfigurationError: A joint has no range left within the servo's turn.
        """
        lowest = np.maximum(lowest, limits.lowest_rad)
        ends = np.stack([lowest, np.minimum(highest, limits.highest_rad)])
        ranges = np.sort(self.servo_angle(ends), axis=0).clip(-math.pi, math.pi)
        for joint in np.flatnonzero((ends[0] >= ends[1]) | (ranges[0] >= ranges[1])):
            low, high = ends[:, joint]
            raise ConfigurationError(
                f"joint {self.joints[joint]!r} has no range: from {low:.4g} to {high:.4g} rad by"
                " model and limits, and within a turn of its servo; correct zero_rad or the limits"
            )
        return ranges.T
