"""The process that owns the servos' ports: it relays, keeps the limits, and switches torque off when it must.

It lives in a session of its own, so that neither Ctrl-C nor the death of the program that started it ends it before
torque is off. Torque goes off when

* the program ends, however it ends: its end of the channel closes, or Linux says that it is about to;
* no command comes for `SafetyLimits.hang_s`: the program hangs;
* the `Guard` finds a reason in what is measured;
* it is itself asked to end (SIGTERM, SIGHUP, SIGINT), also during a read, also more than once.
"""

import contextlib
import os
import signal
import socket
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from elastic_env.hardware.errors import BusGoneError, FaultError, HardwareError
from elastic_env.hardware.safety.bounds import exceeds
from elastic_env.hardware.safety.channel import LONGEST_WAIT_S, Channel
from elastic_env.hardware.safety.checks import check_bus
from elastic_env.hardware.safety.ending import is_ending
from elastic_env.hardware.safety.limits import Guard, SafetyLimits, too_hot
from elastic_env.hardware.safety.realtime import Priority, prefer_realtime, sleep_until
from elastic_env.hardware.servo_bus.bus import Bus, Buses, States
from elastic_env.hardware.servo_bus.control_table import explain_errors

_REPLY_TIMEOUT_S = 0.003
_GLANCE_S = 0.005
"""Silence after which to look whether the program lives; a command comes every 4 ms [s]."""
_WATCHDOG_COUNTS = 3  # of 20 ms
_WATCHDOG_CLEAR = 0
_REST_RAD_S = 0.2
"""Speed below which a servo counts as at rest [rad/s]; one that gets its torque in motion is stopped with a jerk."""


class Supervisor:
    """Answers a program's requests for servos on one port or several.

    Args:
        channel: To the program.
        buses: Open, without servos attached.
        program: Process id of the program.
    """

    def __init__(self, channel: Channel, buses: list[Bus], program: int) -> None:
        self._channel = channel
        self._program = program
        self._bus = Buses(buses)
        self._guard: Guard | None = None
        self._commanded_s = 0.0
        self._served_s = 0.0
        self._number = 0
        self._fault: HardwareError | None = None

    def run(self) -> None:
        """Serve until the program is gone; then torque is off."""
        try:
            while (request := self._next()) is not None:
                self._number = request["number"]
                self._channel.send({"number": self._number, **self._answer(request)})
        except OSError:
            pass  # the program is gone
        finally:
            try:
                self._let_go()
            except BaseException:  # a signal in this very moment; after it no other comes through
                self._let_go()
                raise

    def _next(self) -> dict[str, Any] | None:
        """The next request; a program that hangs loses its torque meanwhile."""
        while not self._channel.is_waiting(self._glance_s()):
            if is_ending(self._program):
                return None
            if self._patience_s() == 0.0:
                self._stop_hanging()
        request = self._channel.receive()
        if request is not None and request["do"] == "read" and self._patience_s() == 0.0:
            self._stop_hanging()  # reading is not commanding
        return request

    def _glance_s(self) -> float | None:
        """How long to wait before looking whether the program lives [s]; None while nothing moves."""
        patience_s = self._patience_s()
        return None if patience_s is None else min(patience_s, _GLANCE_S)

    def _patience_s(self) -> float | None:
        """How long a command may still be waited for [s]; None while nothing moves."""
        if self._guard is None:
            return None
        return max(self._served_s + self._guard.limits.hang_s - time.monotonic(), 0.0)

    def _stop_hanging(self) -> None:
        limit_s = 0.0 if self._guard is None else self._guard.limits.hang_s
        self._stop(f"no command for {1e3 * limit_s:.0f} ms: the program hangs")

    def _answer(self, request: dict[str, Any]) -> dict[str, Any]:
        actions: dict[str, Callable[..., dict[str, Any]]] = {
            "attach": self._attach, "enable": self._enable, "exchange": self._exchange, "read": self._read,
            "disable": self._disable,
        }  # fmt: skip
        try:
            return actions[request["do"]](**request["with"])
        except HardwareError as error:
            is_gone = isinstance(error, BusGoneError)
            said = error if self._guard is None else self._stop(str(error), is_gone)  # torque is still on
            return {"error": type(said).__name__, "message": str(said)}

    def _attach(self, ids: list[list[int]]) -> dict[str, Any]:
        for bus, own in zip(self._bus.buses, ids, strict=True):
            wrong = [check for check in check_bus(bus, own) if check.is_vital and not check.is_good]
            if wrong:
                problems = "; ".join(f"{check.what} is {check.value}: {check.cure}" for check in wrong)
                raise HardwareError(f"nothing can move at {bus.name} yet: {problems}")
        return {"models": [[model.number for model in bus.models.values()] for bus in self._bus.buses]}

    def _enable(self, limits: dict[str, Any]) -> dict[str, Any]:
        """Torque on, with every servo's goal where it stands."""
        if isinstance(self._fault, BusGoneError):
            raise self._fault.with_traceback(None)  # for good: what is plugged in again is another port
        self._disable()
        for bus, servo_id in self._bus.servos:
            _require_healthy(bus, servo_id)
            _require_rest(bus, servo_id)
        given = SafetyLimits(**limits)
        hottest = np.array([_require_cool(bus, servo_id, given) for bus, servo_id in self._bus.servos])
        measured = np.array([bus.position(servo_id) for bus, servo_id in self._bus.servos])
        guard = Guard(given, measured, self._bus.names, hottest)
        self._fault = None
        try:
            self._write("bus_watchdog", _WATCHDOG_CLEAR)
            for (bus, servo_id), angle in zip(self._bus.servos, measured.tolist(), strict=True):
                bus.write_goal(servo_id, angle)  # confirmed: with torque, a servo may run to the goal it has
            self._write("torque_enable", 1)
            self._bus.write_goals(measured)
            self._write("bus_watchdog", _WATCHDOG_COUNTS)
        except BaseException:
            self._let_go()
            raise
        self._guard, self._commanded_s = guard, time.monotonic()
        self._served_s = self._commanded_s
        for bus in self._bus.buses:
            bus.port.reply_timeout_s = _REPLY_TIMEOUT_S
        return {"position": measured.tolist()}

    def _write(self, name: str, value: int) -> None:
        """Write a register of every servo that has it, each with its confirmation."""
        for bus, servo_id in self._bus.servos:
            if name in bus.models[servo_id].table:
                bus.write(servo_id, name, value)

    def _exchange(self, goals: list[float], at: float) -> dict[str, Any]:
        """Command, wait for a moment, read; the moment is on the monotonic clock, which both processes share."""
        guard = self._require_motion()
        now = time.monotonic()
        if exceeds(at - now, LONGEST_WAIT_S):
            raise FaultError(f"a cycle may wait {LONGEST_WAIT_S} s, asked for {at - now:.3f} s")
        allowed, is_limited = guard.command(np.array(goals), min(now - self._commanded_s, LONGEST_WAIT_S))
        was_holding = guard.is_holding
        self._bus.write_goals(allowed)
        self._commanded_s = now
        sleep_until(at)
        begin = time.monotonic()
        states = self._bus.read_states(_REPLY_TIMEOUT_S)
        reason = guard.take(states)
        if reason:
            fault = self._stop(reason)
            raise type(fault)(f"{fault}{self._alerts(states)}")
        self._served_s = time.monotonic()
        return {
            **_plain(states), "goals": allowed.tolist(), "limited": is_limited.tolist(), "held": was_holding,
            "late_s": begin - at,
        }  # fmt: skip

    def _read(self) -> dict[str, Any]:
        """States without any command; while torque is on this counts as none."""
        return _plain(self._bus.read_states(max(bus.port.reply_timeout_s for bus in self._bus.buses)))

    def _disable(self) -> dict[str, Any]:
        """Torque off, confirmed."""
        problem = self._let_go()
        if problem is not None:
            raise problem
        return {}

    def _require_motion(self) -> Guard:
        if self._guard is not None:
            return self._guard
        if self._fault is not None:
            raise self._fault.with_traceback(None)
        raise FaultError("torque is off; it must be enabled first")

    def _alerts(self, states: States) -> str:
        """What the servos that raised the alert bit say is wrong."""
        if not states.has_alert.any():
            return ""
        said = []
        for (bus, servo_id), has_alert in zip(self._bus.servos, states.has_alert.tolist(), strict=True):
            if has_alert:
                try:
                    said.append(f"servo {servo_id} at {bus.name}: {_hardware_error(bus, servo_id)}")
                except HardwareError as error:
                    said.append(str(error))
        return f" ({'; '.join(said)})"

    def _stop(self, reason: str, is_gone: bool = False) -> HardwareError:
        """End the motion for a reason, which may be that a bus is gone: the error that answers from now on."""
        problem = self._let_go()
        said = "torque is off" if problem is None else str(problem)
        kind = BusGoneError if isinstance(problem, BusGoneError) else FaultError
        is_said = reason in said or (is_gone and kind is BusGoneError)  # by torque off, which met the same
        self._fault = kind(said if is_said else f"{reason}; {said}")
        return self._fault

    def _let_go(self) -> HardwareError | None:
        """Torque off at once, then confirmed; what is not certain about it."""
        self._guard = None
        return self._bus.let_go(self._say_busy)

    def _say_busy(self) -> None:
        """Tell the program, which takes a supervisor that is silent for dead, that torque off takes its time."""
        with contextlib.suppress(OSError):
            self._channel.send({"number": self._number, "busy": True})


def _hardware_error(bus: Bus, servo_id: int) -> str:
    """What a servo says is wrong, "" if nothing."""
    status = bus.read(servo_id, "hardware_error_status")
    return (explain_errors(status) or f"error {status}") if status else ""


def _require_healthy(bus: Bus, servo_id: int) -> None:
    error = _hardware_error(bus, servo_id)
    if error:
        raise FaultError(
            f"servo {servo_id} at {bus.name} reports {error}; remove the cause, then switch its power off and on"
        )


def _require_rest(bus: Bus, servo_id: int) -> None:
    speed = abs(bus.velocity(servo_id))
    if exceeds(speed, _REST_RAD_S):
        raise FaultError(
            f"servo {servo_id} at {bus.name} moves at {speed:.2f} rad/s; torque goes on at rest, below {_REST_RAD_S:g} "
            "rad/s: wait until it hangs still, then try again"
        )


def _require_cool(bus: Bus, servo_id: int, limits: SafetyLimits) -> float:
    """The temperature that a servo may have by the limits and its own setting [°C]; refuse one that is hotter."""
    hottest = min(limits.temperature_c, float(bus.read(servo_id, "temperature_limit")))
    degrees = bus.read(servo_id, "present_temperature")
    if exceeds(degrees, hottest):
        raise FaultError(too_hot(f"servo {servo_id} at {bus.name}: {degrees}", np.array(hottest)))
    return hottest


def _plain(states: States) -> dict[str, Any]:
    return {
        "position": states.position.tolist(), "velocity": states.velocity.tolist(), "current": states.current.tolist(),
        "is_fresh": states.is_fresh.tolist(), "has_alert": states.has_alert.tolist(), "time_s": states.time_s,
        "temperature": states.temperature.tolist(),
    }  # fmt: skip


_SIGNALS = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)


def _end(signal_number: int, _: Any) -> None:
    """End by an exception, once: signals that come on the way out must not keep torque off from being sent."""
    for number in _SIGNALS:
        signal.signal(number, _ignore)
    raise SystemExit(128 + signal_number)


def _ignore(signal_number: int, _: Any) -> None:
    """In the place of SIG_IGN, with which Python would complain of a signal that had come just before."""


def main(ports: list[str], baudrate: int, channel: Channel) -> None:
    """Open the ports, say how that went, and serve."""
    program = os.getppid()
    for number in _SIGNALS:
        signal.signal(number, _end)
    prefer_realtime(Priority.SUPERVISOR, with_threads=True)  # one for each of several buses
    buses = [Bus(port, baudrate) for port in ports]
    opened: list[Bus] = []
    try:
        for bus in buses:
            bus.open()
            opened.append(bus)
    except HardwareError as error:
        for bus in opened:
            bus.close()
        channel.send({"number": 0, "error": "PortError", "message": str(error)})
        return
    channel.send({"number": 0})
    Supervisor(channel, buses, program).run()


if __name__ == "__main__":
    main(sys.argv[3:], int(sys.argv[2]), Channel(socket.socket(fileno=int(sys.argv[1]))))
