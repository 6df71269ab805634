"""The process that owns the servos' ports: it relays commands, limits them, and ends motions.

It has its own session, so that neither Ctrl-C nor the death of the program that started it ends it
before torque is off. Torque goes off when

* the program ends in any way: its end of the channel closes, or Linux reports that it is ending;
* no command comes for `SafetyLimits.hang_s`: the program hangs;
* the `Guard` finds a reason in the measurements;
* the supervisor itself must end (SIGTERM, SIGHUP, SIGINT), also during a read, also repeatedly.
"""

import contextlib
import os
import signal
import socket
import sys
from typing import Any, cast

import numpy as np

from elastic_env.hardware.buses.bus import States
from elastic_env.hardware.buses.bus_group import BusGroup
from elastic_env.hardware.buses.packet_line import REPLY_TIMEOUT_S, servo_name
from elastic_env.hardware.buses.protocols import BUSES
from elastic_env.hardware.buses.servo_bus import ServoBus
from elastic_env.hardware.buses.servo_models import Protocol
from elastic_env.hardware.errors import BusGoneError, FaultError, HardwareError
from elastic_env.hardware.safety import realtime
from elastic_env.hardware.safety.checks import check_bus, require_ready
from elastic_env.hardware.safety.guard import Guard, exceeds
from elastic_env.hardware.safety.processes import Channel, is_ending
from elastic_env.hardware.safety.realtime import LONGEST_WAIT_S
from elastic_env.hardware.settings import SafetyLimits

_GLANCE_S = 0.005
"""Silence after which to check that the program lives; a command comes every 4 ms [s]."""
_ACTIONS = ("attach", "enable", "exchange", "disable")
"""Requests that a program can send."""
_SIGNALS = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)


class Supervisor:
    """Answers a program's requests for servos on one port or several.

    Args:
        channel: Channel to the program.
        buses: Open buses without attached servos.
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
                # a signal came in this very moment; later ones are ignored
                self._torque_off()
                raise

    def _next_request(self) -> dict[str, Any] | None:
        """Wait for the next request, and stop the motion if the program hangs meanwhile.

        Returns:
            The request; None if the program ends.
        """
        while True:
            is_moving = self._guard is not None
            glance_s = min(self._remaining_s(), _GLANCE_S) if is_moving else None
            if self._channel.is_waiting(glance_s):
                return self._channel.receive()
            if is_ending(self._program):
                return None
            if self._guard is not None and self._remaining_s() == 0.0:
                limits = self._guard.limits
                hint = limits.patience_hint("hang_s")
                self._stop(f"no command for {1e3 * limits.hang_s:.0f} ms: the program hangs{hint}")

    def _remaining_s(self) -> float:
        """Time until the program counts as hanging [s]; infinite while nothing moves."""
        if self._guard is None:
            return np.inf
        return max(self._served_s + self._guard.limits.hang_s - self._clock.monotonic(), 0.0)

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """Execute a request.

        Returns:
            Its result, or the error that it met.
        """
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
        """Check the servos of each bus, and attach them."""
        for bus, servo_ids in zip(self._buses, ids, strict=True):
            problems = [
                f"{check.name} is {check.value}: {check.cure}"
                for check in check_bus(bus, servo_ids)
                if check.is_vital and not check.is_good
            ]
            if problems:
                raise HardwareError(f"nothing can move at {bus.name} yet: {'; '.join(problems)}")
        models = [bus.models.values() for bus in self._buses]
        return {"models": [[model.number for model in of_bus] for of_bus in models]}

    def _enable(
        self, limits: dict[str, Any], ranges: list[list[float]] | None = None
    ) -> dict[str, Any]:
        """Switch torque on, with the goal of every servo at its present position."""
        if isinstance(self._fault, BusGoneError):
            # final: an adapter that is plugged in again is another port
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
                # confirmed: when torque goes on, a servo may run to an old goal
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
        """Command the servos, wait until a moment, read.

        The moment is on the monotonic clock, which both processes share.
        """
        guard = self._require_motion()
        now = self._clock.monotonic()
        # rounded like the caller's sum: the difference at - now may round above an allowed wait
        if exceeds(at, now + LONGEST_WAIT_S):
            raise FaultError(f"a cycle may wait {LONGEST_WAIT_S} s, asked for {at - now:.3f} s")
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

    def _disable(self) -> dict[str, Any]:
        """Switch torque off, with confirmation."""
        self._lower()
        problem = self._torque_off()
        if problem is not None:
            raise problem
        return {}

    def _require_motion(self) -> Guard:
        """Return the guard of the motion.

        Raises:
            HardwareError: Torque is off.
        """
        if self._guard is not None:
            return self._guard
        if self._fault is not None:
            raise self._fault.with_traceback(None)
        raise FaultError("torque is off; it must be enabled first")

    def _explain_alerts(self, states: States) -> str:
        """Text of the hardware errors of servos that set the alert bit; "" if none did."""
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
        """End the motion for a reason; return the error that answers later requests."""
        if not is_gone:
            self._lower()
        problem = self._torque_off()
        outcome = "torque is off" if problem is None else str(problem)
        kind = BusGoneError if isinstance(problem, BusGoneError) else FaultError
        # torque off may have met the same loss
        is_repeated = reason in outcome or (is_gone and kind is BusGoneError)
        self._fault = kind(outcome if is_repeated else f"{reason}; {outcome}")
        return self._fault

    def _lower(self) -> None:
        """Let the torque fall within `release_s`, if that is set and the servos can limit it."""
        if self._guard is not None and self._guard.limits.release_s > 0.0:
            self._send_busy()
            self._servos.lower(self._guard.limits.release_s)

    def _torque_off(self) -> HardwareError | None:
        """Switch torque off at once, then ask for confirmation; return what remains uncertain."""
        self._guard = None
        problem = self._servos.torque_off(self._send_busy)
        # what follows has the time that replies have at rest
        for bus in self._buses:
            bus.reply_timeout_s = REPLY_TIMEOUT_S
        return problem

    def _send_busy(self) -> None:
        """Announce to the program that torque off takes longer.

        The program takes a silent supervisor for dead.
        """
        with contextlib.suppress(OSError):
            self._channel.send({"number": self._number, "busy": True})


def _end(signal_number: int, _: Any) -> None:
    """End by an exception, once: a second signal must not interrupt torque off."""
    for number in _SIGNALS:
        signal.signal(number, _ignore)
    raise SystemExit(128 + signal_number)


def _ignore(signal_number: int, _: Any) -> None:
    """Ignore a signal; with SIG_IGN, Python would complain of one that came just before."""


def main(ports: list[str], baudrate: int, protocol: Protocol, channel: Channel) -> None:
    """Open the ports, report success or failure, and serve."""
    program = os.getppid()
    for number in _SIGNALS:
        signal.signal(number, _end)
    # each further bus has a thread
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
