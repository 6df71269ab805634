"""Servos of any make in SI units: states, one bus, several buses that work at the same time."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Protocol, TypeVar

import numpy as np

from elastic_env.core.signals import Array, BoolArray
from elastic_env.hardware.errors import BusGoneError, HardwareError, ReplyError

TEMPERATURE_CYCLES = 25
"""Cycles from one reading of the temperatures to the next: 0.1 s at 250 Hz."""

T = TypeVar("T")
_ARRAYS = ("position", "velocity", "current", "is_fresh", "has_alert", "temperature")


@dataclass(frozen=True)
class States:
    """Replies of the servos in one cycle, (n,) each, in the order of their ids.

    Where a servo's reply is missing its numbers are nan, never old ones.
    """

    position: Array
    """[rad], in the servo's own zero and sign."""
    velocity: Array
    """[rad/s]"""
    current: Array
    """Signed motor current [A]."""
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


class Bus(Protocol):
    """A port with its attached servos, as the supervisor needs it.

    Every method raises `BusGoneError` where the port is gone. Those with an id wait for the servo's
    confirmation and raise `ReplyError` where it does not come, or the servo refuses.
    """

    name: str
    reply_timeout_s: float
    """How long to wait for a reply, beside its time on the wire [s]."""

    @property
    def ids(self) -> tuple[int, ...]:
        """Ids of the attached servos, in order."""
        ...

    def write_goals(self, angles: Array) -> None:
        """Command all servos at once, (n,) [rad]; nobody confirms."""

    def read_states(self, timeout_s: float) -> States:
        """States of all servos; waits for all replies together for at most a time [s]."""
        ...

    def write_goal(self, servo_id: int, angle: float) -> None:
        """Command one servo [rad]."""

    def read_position(self, servo_id: int) -> float:
        """Present position [rad]."""
        ...

    def read_condition(self, servo_id: int) -> Condition:
        """Velocity, temperature and hardware error."""
        ...

    def write_torque(self, servo_id: int, is_on: bool) -> None:
        """Switch the torque of one servo."""

    def write_watchdog(self, servo_id: int, is_on: bool) -> None:
        """Set or clear the bus watchdog of a servo that has one."""

    def torque_off(self) -> None:
        """Switch all torque off at once, also after a read that was interrupted.

        Nobody confirms.
        """

    def confirm_torque_off(self) -> list[str]:
        """Names of the servos that do not say that their torque is off, after some tries each."""
        ...


class BusGroup:
    """Several buses as one. Each has a reader of its own, so that they work at the same time.

    Args:
        buses: With their servos attached; an array of all servos has theirs in this order.
    """

    def __init__(self, buses: Sequence[Bus]) -> None:
        self.buses = tuple(buses)
        self._readers = [ThreadPoolExecutor(1, bus.name) for bus in buses[1:]]

    @property
    def servos(self) -> list[tuple[Bus, int]]:
        """Bus and id of each servo."""
        return [(bus, servo_id) for bus in self.buses for servo_id in bus.ids]

    @property
    def names(self) -> list[str]:
        """The servos' names in messages."""
        return [servo_name(bus, servo_id) for bus, servo_id in self.servos]

    def write_goals(self, angles: Array) -> None:
        """Command all servos, (n,) [rad]."""
        ends = np.cumsum([len(bus.ids) for bus in self.buses])[:-1]
        parts = zip(self.buses, np.split(angles, ends), strict=True)
        self._call_all([partial(bus.write_goals, part) for bus, part in parts])

    def read_states(self, timeout_s: float) -> States:
        """States of all servos; waits for at most a time [s]."""
        if len(self.buses) == 1:  # nothing to join, in what a control cycle waits for
            return self.buses[0].read_states(timeout_s)
        calls = [partial(bus.read_states, timeout_s) for bus in self.buses]
        return States.join(self._call_all(calls))

    def torque_off(self, when_sent: Callable[[], None] = lambda: None) -> HardwareError | None:
        """Switch all torque off, at every bus before any servo is asked whether it is.

        A lost bus keeps no other on.

        Args:
            when_sent: Called in between; servos that do not answer make the rest last.

        Returns:
            What is not certain: a `BusGoneError` where a bus is gone, else a `ReplyError`; None if
            all is off.
        """
        self._call_all([partial(_call, bus.torque_off) for bus in self.buses])
        when_sent()
        calls = [partial(_call, bus.confirm_torque_off) for bus in self.buses]
        answers = self._call_all(calls)
        errors = [answer for answer in answers if isinstance(answer, HardwareError)]
        lists = [answer for answer in answers if isinstance(answer, list)]
        silent = [name for names in lists for name in names]
        problems = [str(error) for error in errors]
        if silent:
            problems.append(
                f"torque off was sent, but not confirmed by {', '.join(silent)}: switch the"
                " power off"
            )
        if not problems:
            return None
        pairs = zip(self.buses, answers, strict=True)
        off = [bus.name for bus, answer in pairs if answer == []]
        if off:
            problems.append(f"torque is off at {', '.join(off)}")
        is_gone = any(isinstance(error, BusGoneError) for error in errors)
        return (BusGoneError if is_gone else ReplyError)("; ".join(problems))

    def _call_all(self, calls: Sequence[Callable[[], T]]) -> list[T]:
        """Call one function for each bus, the first in this thread.

        All of them are done when an error is raised.
        """
        pairs = zip(self._readers, calls[1:], strict=True)
        others = [reader.submit(call) for reader, call in pairs]
        try:
            first = calls[0]()
        finally:
            wait(others)
        return [first, *(future.result() for future in others)]


def servo_name(bus: Bus, servo_id: int) -> str:
    """A servo's name in messages."""
    return f"servo {servo_id} at {bus.name}"


def _call(function: Callable[[], T]) -> T | HardwareError:
    """The result of a call, or its error."""
    try:
        return function()
    except HardwareError as error:
        return error
