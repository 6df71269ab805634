"""A program's side of the supervisor: servos that lose their torque when the program fails."""

import contextlib
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from elastic_env.core.signals import Array, BoolArray
from elastic_env.hardware import errors
from elastic_env.hardware.buses.bus import States
from elastic_env.hardware.buses.packets import require_ids
from elastic_env.hardware.buses.protocols import BUSES
from elastic_env.hardware.buses.servo_models import Protocol
from elastic_env.hardware.clock import Clock
from elastic_env.hardware.errors import FaultError, HardwareError
from elastic_env.hardware.safety.emergency_stop import switch_torque_off
from elastic_env.hardware.safety.processes import Channel, start_child
from elastic_env.hardware.safety.realtime import LONGEST_WAIT_S, schedule_like
from elastic_env.hardware.settings import SafetyLimits

_SUPERVISOR = "elastic_env.hardware.safety.supervisor"
_KEEP_ALIVE_S = 0.008
_ANSWER_S = 0.1
"""Longest silence of a supervisor beyond the wait of a request [s].

After it the supervisor counts as dead, and torque is switched off. In motion the silence is
`SafetyLimits.hang_s`, as for the program: what delays one of the two delays the other too.
"""
_LEAST_ANSWER_S = 0.02
_SLOW_S = 5.0
_SLOW_PER_SERVO_S = 1.0
_START_S = 30.0
_END_S = 5.0


@dataclass(frozen=True)
class Cycle:
    """Result of one control cycle."""

    states: States
    goals: Array
    """Commanded positions, (n,) [rad]."""
    is_limited: BoolArray
    """True where a limit changed the position, (n,)."""
    is_held: bool
    """True if the last command was repeated because a reply was missing."""
    late_s: float
    """Delay of the reading after the requested moment [s]."""

    @classmethod
    def load(cls, answer: dict[str, Any]) -> Self:
        """Cycle from a supervisor's answer."""
        goals, is_limited = (np.array(answer[name]) for name in ("goals", "is_limited"))
        late_s = float(answer["late_s"])
        return cls(States.load(answer), goals, is_limited, bool(answer["is_held"]), late_s)


class SupervisedBus(contextlib.AbstractContextManager["SupervisedBus"]):
    """Servos on one port or several, moved through a supervisor process of their own.

    Args:
        ports: Ids of the servos by port; arrays of all servos have them in this order.
        baudrate: Bits per second; None for the usual rate of the protocol.
        protocol: Protocol of all servos.

    Attributes:
        models: Model numbers of the servos, a list for each port.
        clock: Clock of the readings.

    Raises:
        PortError: A port cannot be opened.
        ConfigurationError: An id is impossible, or given twice.
        ReplyError: A servo does not answer.
        HardwareError: The model of a servo is not known, or its settings forbid motion.
    """

    def __init__(
        self,
        ports: Mapping[str, Sequence[int]],
        baudrate: int | None = None,
        protocol: Protocol = "dynamixel",
    ) -> None:
        for ids in ports.values():
            require_ids(ids)
        self.models: list[list[int]] = []
        self.clock: Clock = time
        self._ports = {port: list(ids) for port, ids in ports.items()}
        self._baudrate = baudrate or BUSES[protocol].rates[0]
        self._protocol: Protocol = protocol
        self._is_enabled = False
        self._number = 0
        self._answer_s = _ANSWER_S
        self._hint = ""
        """Text for an answer that did not come in motion."""
        # for confirmations and checks: several tries for each servo that does not answer
        self._slow_s = _SLOW_S + _SLOW_PER_SERVO_S * sum(map(len, self._ports.values()))
        self._lock = threading.Lock()
        self._keeper: threading.Thread | None = None
        self._is_kept = threading.Event()
        own_end, other_end = Channel.pair()
        self._channel = Channel(own_end)
        with other_end:
            file = other_end.fileno()
            arguments = (str(file), str(self._baudrate), protocol, *ports)
            options = {"pass_fds": [file], "stdin": subprocess.DEVNULL}
            self._process = start_child(_SUPERVISOR, *arguments, **options)
        try:
            self._receive(0, _START_S)
            servos = list(self._ports.values())
            self.models = self._request("attach", self._slow_s, ids=servos)["models"]
        except BaseException:
            self.close()
            raise

    @property
    def process_id(self) -> int:
        """Process id of the supervisor."""
        return self._process.pid

    def enable(self, limits: SafetyLimits | None = None, ranges: Array | None = None) -> Array:
        """Switch torque on at the present positions.

        Args:
            limits: Limits of all servos.
            ranges: Lowest and highest goal of each, (n, 2) [rad]; None for those of the limits.

        Returns:
            The positions, (n,) [rad].

        Raises:
            FaultError: A servo reports a hardware error, moves, or is outside the limits.
            ReplyError: A servo does not answer, or refuses its position as goal.
            BusGoneError: The port is gone.
        """
        limits = limits or SafetyLimits()
        self._is_enabled = True
        ends = None if ranges is None else ranges.tolist()
        arguments = {"limits": limits.model_dump(), "ranges": ends}
        answer = self._request("enable", self._slow_s, **arguments)
        self._answer_s = max(limits.hang_s, _LEAST_ANSWER_S)
        self._hint = limits.patience_hint("hang_s") or "; end what else keeps the computer busy"
        return np.array(answer["position"])

    def exchange(self, goals: Array, at: float) -> Cycle:
        """Run one control cycle: command, wait for a moment of the monotonic clock, read.

        Args:
            goals: Desired positions, (n,) [rad].
            at: Moment of the reading [s]; at most 20 ms ahead.

        Raises:
            FaultError: The motion was stopped, now or since the last cycle; the message says why.
            BusGoneError: The port is gone.
        """
        self.stop_keeping()
        try:
            answer = self._exchange(np.asarray(goals, dtype=np.float64), at)
        except HardwareError:
            self._is_enabled = False  # the message says whether torque is off
            raise
        except BaseException:
            # torque off after an interrupted cycle, for any answer
            with contextlib.suppress(HardwareError, OSError):
                self._request("disable", _ANSWER_S)
            raise
        return Cycle.load(answer)

    def keep(self, goals: Array, limit_s: float = 5.0) -> None:
        """Hold goals from a thread until the next cycle, for at most a time [s].

        If the whole program hangs, so does the thread, and torque goes off as usual.
        """
        self.stop_keeping()
        self._is_kept.set()
        arguments = (goals, time.monotonic() + limit_s, threading.get_native_id())
        self._keeper = threading.Thread(target=self._keep, args=arguments, daemon=True)
        self._keeper.start()

    def stop_keeping(self) -> None:
        """End the holding of goals by `keep`."""
        if self._keeper is not None:
            self._is_kept.clear()
            self._keeper.join()
            self._keeper = None

    def _keep(self, goals: Array, end_s: float, caller: int) -> None:
        schedule_like(caller)
        with contextlib.suppress(HardwareError):
            while self._is_kept.is_set() and time.monotonic() < end_s:
                self._exchange(goals, time.monotonic() + _KEEP_ALIVE_S)

    def _exchange(self, goals: Array, at: float) -> dict[str, Any]:
        # the supervisor refuses to wait longer, or for a moment of nan; max gives 0 for nan as its
        # second value
        wait_s = min(max(0.0, at - time.monotonic()), LONGEST_WAIT_S)
        within_s = wait_s + self._answer_s
        return self._request("exchange", within_s, goals=goals.tolist(), at=at)

    def disable(self) -> None:
        """Switch torque off.

        Raises:
            ReplyError: A servo does not confirm it.
            BusGoneError: The port is gone.
        """
        self.stop_keeping()
        self._is_enabled = False
        self._request("disable", _ANSWER_S)

    def close(self) -> None:
        """Switch torque off and release the ports; a second call does nothing.

        An error or an interrupt that is being handled gets a note that torque is off.

        Raises:
            ReplyError: A servo does not confirm that its torque is off; the ports are released
                all the same.
            BusGoneError: The port is gone.
        """
        try:
            if self._is_enabled:
                self.disable()
                error = sys.exception()
                if error is not None:
                    error.add_note(f"torque at {', '.join(self._ports)} is off")
        finally:
            self._channel.close()
            try:
                self._process.wait(timeout=_END_S)
            except subprocess.TimeoutExpired:
                self._process.terminate()
                self._process.wait(timeout=_END_S)

    def __exit__(self, *_: object) -> None:
        self.close()

    def _request(self, action: str, within_s: float, **arguments: Any) -> Any:
        """Send a request and return its answer, which must come within a time [s]."""
        with self._lock:
            self._number += 1
            request = {"number": self._number, "do": action, "with": arguments}
            try:
                self._channel.send(request)
            except OSError:
                raise self._replace_supervisor() from None
            return self._receive(self._number, within_s)

    def _receive(self, number: int, within_s: float) -> dict[str, Any]:
        """Receive the answer with a number, and skip answers to interrupted requests."""
        end_s = time.monotonic() + within_s
        while self._channel.is_waiting(max(end_s - time.monotonic(), 0.0)):
            answer = self._channel.receive()
            if answer is None:
                raise self._replace_supervisor()
            if "busy" in answer:  # the servos take longer to confirm torque off
                within_s = self._slow_s
                end_s = time.monotonic() + within_s
            elif answer["number"] == number:
                if "error" in answer:
                    raise getattr(errors, answer["error"])(answer["message"])
                return answer
        self._process.kill()
        raise self._replace_supervisor(within_s)

    def _replace_supervisor(self, silent_s: float | None = None) -> FaultError:
        """Switch torque off instead of a supervisor that died, or was silent for a time [s]."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            # its end of the channel closes before its port does
            self._process.wait(timeout=1.0)
        if silent_s is None:
            end = f"ended (exit code {self._process.poll()})"
        else:
            end = f"did not answer within {1e3 * silent_s:.0f} ms and was ended"
        outcome = switch_torque_off(self._ports, self._baudrate, self.models, self._protocol)
        hint = "" if silent_s is None else self._hint
        return FaultError(f"the supervisor process {end}; {outcome}{hint}")
