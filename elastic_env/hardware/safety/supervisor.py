"""The process that owns the servos' ports: it relays, keeps limits, and switches torque off.

It lives in a session of its own, so that neither Ctrl-C nor the death of the program that started
it ends it before torque is off. Torque goes off when

* the program ends, however it ends: its end of the channel closes, or Linux says that it is about
  to;
* no command comes for `SafetyLimits.hang_s`: the program hangs;
* the `Guard` finds a reason in what is measured;
* it is itself asked to end (SIGTERM, SIGHUP, SIGINT), also during a read, also more than once.
"""

import contextlib
import os
import signal
import socket
import sys
from typing import Any, cast

import numpy as np

from elastic_env.hardware.buses.bus import Condition, States
from elastic_env.hardware.buses.protocols import BUSES
from elastic_env.hardware.buses.servo_bus import BusGroup, ServoBus, servo_name
from elastic_env.hardware.buses.servo_models import Protocol
from elastic_env.hardware.errors import BusGoneError, FaultError, HardwareError
from elastic_env.hardware.safety import realtime
from elastic_env.hardware.safety.checks import check_bus
from elastic_env.hardware.safety.guard import Guard, exceeds, explain_heat
from elastic_env.hardware.safety.processes import Channel, is_ending
from elastic_env.hardware.safety.realtime import LONGEST_WAIT_S
from elastic_env.hardware.settings import SafetyLimits

_GLANCE_S = 0.005
"""Silence after which to look whether the program lives; a command comes every 4 ms [s]."""
_REST_RAD_S = 0.2
"""Speed below which a servo counts as at rest [rad/s].

One that gets its torque in motion is stopped with a jerk.
"""
_ACTIONS = ("attach", "enable", "exchange", "read", "disable")
"""What a program can ask for."""
_SIGNALS = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)


class Supervisor:
    """Answers a program's requests for servos on one port or several.

    Args:
        channel: To the program.
        buses: Open, without servos attached.
        program: Process id of the program.
    """

    def __init__(self, channel: Channel, buses: list[ServoBus], program: int) -> None:
        self._channel = channel
        self._program = program
        self._buses = buses
        self._servos = BusGroup(buses)
        self._clock = buses[0].port.clock
        self._guard: Guard | None = None
        """Guard of the motion; None while torque is off."""
        self._commanded_s = 0.0
        self._served_s = 0.0
        self._number = 0
        self._fault: HardwareError | None = None

    def run(self) -> None:
        """Serve until the program is gone; then torque is off."""
        try:
            while (request := self._next_request()) is not None:
                self._number = request["number"]
                self._channel.send({"number": self._number, **self.answer(request)})
        except OSError:
            pass  # the program is gone
        finally:
            try:
                self._lower()
                self._torque_off()
            except BaseException:
                # a signal in this very moment; after it no other comes through
                self._torque_off()
                raise

    def _next_request(self) -> dict[str, Any] | None:
        """The next request; a program that hangs loses its torque meanwhile."""
        while True:
            is_moving = self._guard is not None
            glance_s = min(self._patience_s(), _GLANCE_S) if is_moving else None
            if self._channel.is_waiting(glance_s):
                break
            if is_ending(self._program):
                return None
            self._stop_if_hanging()
        request = self._channel.receive()
        if request is not None and request["do"] == "read":
            self._stop_if_hanging()  # reading is not commanding
        return request

    def _patience_s(self) -> float:
        """How long a command may still be waited for [s]; forever while nothing moves."""
        if self._guard is None:
            return np.inf
        return max(self._served_s + self._guard.limits.hang_s - self._clock.monotonic(), 0.0)

    def _stop_if_hanging(self) -> None:
        if self._guard is not None and self._patience_s() == 0.0:
            limits = self._guard.limits
            hint = limits.patience_hint("hang_s")
            self._stop(f"no command for {1e3 * limits.hang_s:.0f} ms: the program hangs{hint}")

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """Do what is asked for; what came of it, or why nothing did."""
        name = request["do"]
        if name not in _ACTIONS:
            choices = ", ".join(_ACTIONS)
            raise HardwareError(f"the supervisor cannot {name!r}; choose from: {choices}")
        action = getattr(self, f"_{name}")
        try:
            return action(**request["with"])
        except HardwareError as error:
            fault = error
            if self._guard is not None:  # torque is still on
                fault = self._stop(str(error), is_gone=isinstance(error, BusGoneError))
            return {"error": type(fault).__name__, "message": str(fault)}

    def _attach(self, ids: list[list[int]]) -> dict[str, Any]:
        for bus, servo_ids in zip(self._buses, ids, strict=True):
            checks = check_bus(bus, servo_ids)
            bad = [check for check in checks if check.is_vital and not check.is_good]
            if bad:
                words = [f"{one.what} is {one.value}: {one.cure}" for one in bad]
                listed = "; ".join(words)
                raise HardwareError(f"nothing can move at {bus.name} yet: {listed}")
        models = [bus.models.values() for bus in self._buses]
        return {"models": [[model.number for model in of_bus] for of_bus in models]}

    def _enable(
        self, limits: dict[str, Any], ranges: list[list[float]] | None = None
    ) -> dict[str, Any]:
        """Torque on, with every servo's goal where it stands."""
        if isinstance(self._fault, BusGoneError):
            # for good: what is plugged in again is another port
            raise self._fault.with_traceback(None)
        self._disable()
        safety_limits = SafetyLimits(**limits)
        servos = self._servos.servos
        names = [servo_name(bus, servo_id) for bus, servo_id in servos]
        conditions = [bus.read_condition(servo_id) for bus, servo_id in servos]
        for name, condition in zip(names, conditions, strict=True):
            require_ready(name, condition, safety_limits.temperature_c)
        hottest = [condition.temperature_limit for condition in conditions]
        positions = np.array([bus.read_position(servo_id) for bus, servo_id in servos])
        strongest = [bus.models[servo_id].largest_torque for bus, servo_id in servos]
        ends = None if ranges is None else np.array(ranges)
        guard = Guard(safety_limits, positions, names, hottest, strongest, ends)
        self._fault = None
        try:
            for bus, servo_id in servos:
                bus.write_watchdog(servo_id, False)
            for (bus, servo_id), angle in zip(servos, positions.tolist(), strict=True):
                # confirmed: with torque, a servo may run to the goal it has
                bus.write_goal(servo_id, angle)
            self._servos.restore_effort()
            for bus, servo_id in servos:
                bus.write_torque(servo_id, True)
            self._servos.write_goals(positions)
            for bus, servo_id in servos:
                bus.write_watchdog(servo_id, True)
        except BaseException:
            self._torque_off()
            raise
        self._guard = guard
        self._commanded_s = self._clock.monotonic()
        self._served_s = self._commanded_s
        for bus in self._buses:
            bus.reply_timeout_s = bus.patience_s
        return {"position": positions.tolist()}

    def _exchange(self, goals: list[float], at: float) -> dict[str, Any]:
        """Command, wait for a moment, read.

        The moment is on the monotonic clock, which both processes share.
        """
        guard = self._require_motion()
        now = self._clock.monotonic()
        # rounded as the caller's sum is: a difference of the two can be above a wait that is not
        if exceeds(at, now + LONGEST_WAIT_S):
            asked = f"asked for {at - now:.3f} s"
            raise FaultError(f"a cycle may wait {LONGEST_WAIT_S} s, {asked}")
        is_held = guard.is_holding
        elapsed_s = min(now - self._commanded_s, LONGEST_WAIT_S)
        allowed, is_limited = guard.command(np.array(goals), elapsed_s)
        self._servos.write_goals(allowed)
        self._commanded_s = now
        realtime.sleep_until(at, self._clock)
        begin = self._clock.monotonic()
        states = self._servos.read_states(self._buses[0].patience_s)
        reason = guard.check(states)
        if reason:
            fault = self._stop(reason)
            raise type(fault)(f"{fault}{self._explain_alerts(states)}")
        self._served_s = self._clock.monotonic()
        commands = {"goals": allowed.tolist(), "is_limited": is_limited.tolist()}
        return {**states.dump(), **commands, "is_held": is_held, "late_s": begin - at}

    def _read(self) -> dict[str, Any]:
        """States without any command; while torque is on this counts as none."""
        timeout_s = max(bus.reply_timeout_s for bus in self._buses)
        return self._servos.read_states(timeout_s).dump()

    def _disable(self) -> dict[str, Any]:
        """Torque off, confirmed."""
        self._lower()
        problem = self._torque_off()
        if problem is not None:
            raise problem
        return {}

    def _require_motion(self) -> Guard:
        if self._guard is not None:
            return self._guard
        if self._fault is not None:
            raise self._fault.with_traceback(None)
        raise FaultError("torque is off; it must be enabled first")

    def _explain_alerts(self, states: States) -> str:
        """Hardware errors of the servos that raised the alert bit, in words."""
        errors: list[str] = []
        for number in np.flatnonzero(states.has_alert):
            bus, servo_id = self._servos.servos[number]
            try:
                error = bus.read_condition(servo_id).error
                errors.append(f"{servo_name(bus, servo_id)}: {error}")
            except HardwareError as error:
                errors.append(str(error))
        return f" ({'; '.join(errors)})" if errors else ""

    def _stop(self, reason: str, is_gone: bool = False) -> HardwareError:
        """End the motion for a reason; returns the error that answers from now on."""
        if not is_gone:
            self._lower()
        problem = self._torque_off()
        outcome = "torque is off" if problem is None else str(problem)
        kind = BusGoneError if isinstance(problem, BusGoneError) else FaultError
        # torque off met the same loss
        is_said = reason in outcome or (is_gone and kind is BusGoneError)
        self._fault = kind(outcome if is_said else f"{reason}; {outcome}")
        return self._fault

    def _lower(self) -> None:
        """Let the torque fall within `release_s`, where the limits say so and the servos can."""
        if self._guard is not None and self._guard.limits.release_s > 0.0:
            self._say_busy()
            self._servos.lower(self._guard.limits.release_s)

    def _torque_off(self) -> HardwareError | None:
        """Torque off at once, then confirmed; returns what is not certain about it."""
        self._guard = None
        return self._servos.torque_off(self._say_busy)

    def _say_busy(self) -> None:
        """Tell the program that torque off takes its time.

        It takes a silent supervisor for dead.
        """
        with contextlib.suppress(OSError):
            self._channel.send({"number": self._number, "busy": True})


def require_ready(name: str, condition: Condition, limit_c: float) -> None:
    """Refuse torque to a servo that reports a hardware error, moves, or is too hot.

    Args:
        name: Of the servo in messages.
        condition: Its condition.
        limit_c: Highest temperature; its own setting holds where that is lower [°C].

    Raises:
        FaultError: It may not get torque, or its speed or temperature is not known.
    """
    if condition.error:
        cure = "remove the cause, then switch its power off and on"
        raise FaultError(f"{name} reports {condition.error}; {cure}")
    speed = abs(condition.velocity)
    if exceeds(speed, _REST_RAD_S):
        moves = f"{name} moves at {speed:.2f} rad/s"
        cure = f"below {_REST_RAD_S:g} rad/s: wait until it hangs still, then try again"
        raise FaultError(f"{moves}; torque goes on at rest, {cure}")
    hottest = min(limit_c, condition.temperature_limit)
    if exceeds(condition.temperature, hottest):
        which = f"{name}: {condition.temperature:g}"
        raise FaultError(explain_heat(which, np.array(hottest)))


def _end(signal_number: int, _: Any) -> None:
    """End by an exception, once: a second signal must not keep torque off from being sent."""
    for number in _SIGNALS:
        signal.signal(number, _ignore)
    raise SystemExit(128 + signal_number)


def _ignore(signal_number: int, _: Any) -> None:
    """In the place of SIG_IGN, with which Python complains of a signal that came just before."""


def main(ports: list[str], baudrate: int, protocol: Protocol, channel: Channel) -> None:
    """Open the ports, say how that went, and serve."""
    program = os.getppid()
    for number in _SIGNALS:
        signal.signal(number, _end)
    # a thread for each of several buses
    realtime.prefer_realtime(realtime.Priority.SUPERVISOR, with_threads=True)
    buses = [BUSES[protocol](port, baudrate) for port in ports]
    try:
        for bus in buses:
            bus.open()
    except HardwareError as error:
        for bus in buses:
            bus.close()
        channel.send({"number": 0, "error": "PortError", "message": str(error)})
        return
    channel.send({"number": 0})
    Supervisor(channel, buses, program).run()


if __name__ == "__main__":
    end = socket.socket(fileno=int(sys.argv[1]))
    main(sys.argv[4:], int(sys.argv[2]), cast("Protocol", sys.argv[3]), Channel(end))
