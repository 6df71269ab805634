"""States of servos in SI units."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from elastic_env.core.signals import Array, BoolArray

TEMPERATURE_CYCLES = 25
"""Cycles from one reading of the temperatures to the next: 0.1 s at 250 Hz."""

_ARRAYS = ("position", "velocity", "torque", "is_fresh", "has_alert", "temperature")


@dataclass(frozen=True)
class States:
    """Replies of the servos in one cycle, (n,) each, in the order of their ids.

    The numbers of a servo without a reply are nan, never old ones.
    """

    position: Array
    """[rad], in the servo's own zero and sign."""
    velocity: Array
    """[rad/s]"""
    torque: Array
    """Torque at the output, from the motor's current or load [N·m]; in motion an approximation."""
    is_fresh: BoolArray
    """True where an intact reply to this very request came."""
    has_alert: BoolArray
    """True where the servo reports a hardware error."""
    time_s: float
    """Time at which all replies had come [s, monotonic clock]."""
    temperature: Array = field(default_factory=lambda: np.array(np.nan))
    """[°C]; nan where it was not requested, which does not mean cool.

    A single nan holds for all servos.
    """

    def dump(self) -> dict[str, Any]:
        """Fields as lists, for a message."""
        return {name: np.asarray(value).tolist() for name, value in vars(self).items()}

    @staticmethod
    def load(message: dict[str, Any]) -> "States":
        """States from a message with the fields of `dump`."""
        arrays = {name: np.array(message[name]) for name in _ARRAYS}
        return States(**arrays, time_s=float(message["time_s"]))

    @staticmethod
    def join(parts: Sequence["States"]) -> "States":
        """States of several buses as one; the time is that of the last reply."""
        arrays = {n: np.concatenate([vars(part)[n] for part in parts]) for n in _ARRAYS}
        return States(**arrays, time_s=max(part.time_s for part in parts))


@dataclass(frozen=True)
class ServoInfo:
    """Answer of a servo to a ping."""

    servo_id: int
    model_number: int
    firmware: int


@dataclass(frozen=True)
class Condition:
    """State of one servo that decides whether it may get torque."""

    velocity: float
    """[rad/s]"""
    temperature: float
    """[°C]"""
    temperature_limit: float
    """Highest temperature by the servo's own setting [°C]."""
    error: str
    """Reported hardware error, "" if none."""
