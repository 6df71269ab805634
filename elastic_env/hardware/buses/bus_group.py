"""Several buses as one: commands, states and torque off for all their servos."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import partial
from typing import Any, TypeVar

import numpy as np

from elastic_env.core.signals import Array
from elastic_env.hardware.buses.bus import States
from elastic_env.hardware.buses.servo_bus import ServoBus
from elastic_env.hardware.errors import BusGoneError, HardwareError, ReplyError

_LOWER_S = 0.02
"""Time between two steps of the torque when it is lowered [s]."""

T = TypeVar("T")


class BusGroup:
    """Several buses as one; each has its own thread, so that they work at the same time.

    Args:
        buses: Buses with attached servos; arrays of all servos have them in this order.
    """

    def __init__(self, buses: Sequence[ServoBus]) -> None:
        self.buses = tuple(buses)
        self._readers = [ThreadPoolExecutor(1, bus.name) for bus in buses[1:]]

    @property
    def servos(self) -> list[tuple[ServoBus, int]]:
        """Bus and id of each servo."""
        return [(bus, servo_id) for bus in self.buses for servo_id in bus.ids]

    def write_goals(self, angles: Array) -> None:
        """Command all servos to angles, (n,) [rad]."""
        ends = np.cumsum([len(bus.ids) for bus in self.buses])[:-1]
        parts = zip(self.buses, np.split(angles, ends), strict=True)
        self._call_all([partial(bus.write_goals, part) for bus, part in parts])

    def read_states(self, timeout_s: float) -> States:
        """States of all servos; see `ServoBus.read_states`."""
        if len(self.buses) == 1:  # nothing to join, which saves time in a control cycle
            return self.buses[0].read_states(timeout_s)
        calls = [partial(bus.read_states, timeout_s) for bus in self.buses]
        return States.join(self._call_all(calls))

    def restore_effort(self) -> None:
        """Let all servos give the torque that their settings allow."""
        self._call_all([bus.restore_effort for bus in self.buses])

    def lower(self, duration_s: float) -> None:
        """Let the torque of all servos fall to zero within a time [s], so that an arm sinks.

        Errors are left to `torque_off`. If no servo can limit its torque, nothing happens.
        """
        if not any(bus.can_limit_effort for bus in self.buses):
            return
        clock = self.buses[0].port.clock
        begin = clock.monotonic()
        share = 1.0
        while share > 0.0:
            clock.sleep(_LOWER_S)
            share = max(1.0 - (clock.monotonic() - begin) / duration_s, 0.0)
            # holding the arm needs little of the torque: the cube removes the rest early
            limits = [partial(bus.limit_effort, share**3) for bus in self.buses]
            answers = self._call_all([partial(_call, limit) for limit in limits])
            if all(isinstance(answer, HardwareError) for answer in answers):
                return

    def torque_off(self, when_sent: Any = None) -> HardwareError | None:
        """Switch torque off at every bus, then ask the servos for confirmation.

        A lost bus does not keep torque on at the others.

        Args:
            when_sent: Called before the confirmations, which last long if servos do not answer.

        Returns:
            None if all servos confirm; else the problems, as a `BusGoneError` if a bus is gone, or
            a `ReplyError`.
        """
        self._call_all([partial(_call, bus.torque_off) for bus in self.buses])
        if when_sent is not None:
            when_sent()
        calls = [partial(_call, bus.confirm_torque_off) for bus in self.buses]
        answers = self._call_all(calls)
        errors = [answer for answer in answers if isinstance(answer, HardwareError)]
        silent = [name for names in answers if isinstance(names, list) for name in names]
        problems = [str(error) for error in errors]
        if silent:
            cure = f"{', '.join(silent)}: switch the power off"
            problems.append(f"torque off was sent, but not confirmed by {cure}")
        if not problems:
            return None
        pairs = zip(self.buses, answers, strict=True)
        if off := [bus.name for bus, answer in pairs if answer == []]:
            problems.append(f"torque is off at {', '.join(off)}")
        is_gone = any(isinstance(error, BusGoneError) for error in errors)
        return (BusGoneError if is_gone else ReplyError)("; ".join(problems))

    def _call_all(self, calls: Sequence[Callable[[], T]]) -> list[T]:
        """Call one function for each bus, the first in this thread.

        An error is raised only after all calls have ended.
        """
        pairs = zip(self._readers, calls[1:], strict=True)
        others = [reader.submit(call) for reader, call in pairs]
        try:
            first = calls[0]()
        finally:
            wait(others)
        return [first, *(future.result() for future in others)]


def _call(function: Callable[[], T]) -> T | HardwareError:
    """Call a function and return its result, or its error."""
    try:
        return function()
    except HardwareError as error:
        return error
