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

    Where a servo's reply is missing its numbers are nan, never old ones.
    """

    position: Array
    """[rad], in the servo's own zero and sign."""
    velocity: Array
    """[rad/s]"""
    torque: Array
    """Torque at the output, by the motor's current or load [N·m]; in motion only about it."""
    is_fresh: BoolArray
    """True where the servo answered this very request, whole and intact."""
    has_alert: BoolArray
    """True where it reports a hardware error."""
    time_s: float
    """When the replies were in, on the monotonic clock."""
    temperature: Array = field(default_factory=lambda: np.array(np.nan))
    """[°C]; nan where this request was not for it, which nobody may take for cool.

    One nan stands for all servos.
    """

    def dump(self) -> dict[str, Any]:
        """The same as lists, for a message."""
        return {name: np.asarray(value).tolist() for name, value in vars(self).items()}

    @staticmethod
    def load(message: dict[str, Any]) -> "States":
        """States from a message that holds `dump`."""
        arrays = {name: np.array(message[name]) for name in _ARRAYS}
        return States(**arrays, time_s=float(message["time_s"]))

    @staticmethod
    def join(parts: Sequence["States"]) -> "States":
        """The states of several buses; the time is that of the last reply."""
        values = [vars(part) for part in parts]
        arrays = {n: np.concatenate([own[n] for own in values]) for n in _ARRAYS}
        return States(**arrays, time_s=max(part.time_s for part in parts))


@dataclass(frozen=True)
class ServoInfo:
    """A servo's answer to a ping."""

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
    """The hardware error that it reports, "" if none."""
