"""The process that owns the servos' ports: it relays, keeps the limits, and switches torque off when it must.

It lives in a session of its own, so that neither Ctrl-C nor the death of the program that started it ends it before
torque is off. Torque goes off when

* the program ends, however it ends: its end of the channel closes;
* no command comes for `SafetyLimits.hang_s`: the program hangs;
* the `Guard` finds a reason in what is measured;
* it is itself asked to end (SIGTERM, SIGHUP, SIGINT), also during a read.
"""

import signal
import socket
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from elastic_env.hardware.bus import Bus, Buses, States
from elastic_env.hardware.channel import Channel
from elastic_env.hardware.checks import check_bus
from elastic_env.hardware.control_table import explain_errors
from elastic_env.hardware.errors import BusGoneError, FaultError, HardwareError, ReplyError
from elastic_env.hardware.realtime import prefer_realtime, sleep_until
from elastic_env.hardware.safety import Guard, SafetyLimits

_LONGEST_WAIT_S = 0.02
_REPLY_TIMEOUT_S = 0.003
_WATCHDOG_COUNTS = 3  # of 20 ms
_WATCHDOG_CLEAR = 0


class Supervisor:
    """Answers a program's requests for servos on one port or several.

    Args:
        channel: To the program.
        buses: Open, without servos attached.
    """

    def __init__(self, channel: Channel, buses: list[Bus]) -> None:
        self._channel = channel
        self._bus = Buses(buses)
        self._guard: Guard | None = None
        self._commanded_s = 0.0
        self._fault = ""

    def run(self) -> None:
        """Serve until the program is gone; then torque is off."""
        try:
            while (request := self._next()) is not None:
                self._channel.send({"number": request["number"], **self._answer(request)})
        except OSError:
            pass  # the program is gone
        finally:
            self._let_go()

    def _next(self) -> dict[str, Any] | None:
        """The next request; a program that hangs loses its torque meanwhile."""
        while True:
            limit = None if self._guard is None else self._guard.limits.hang_s
            if self._channel.is_waiting(limit):
                return self._channel.receive()
            self._stop(f"no command for {1e3 * (limit or 0.0):.0f} ms: the program hangs")

    def _answer(self, request: dict[str, Any]) -> dict[str, Any]:
        actions: dict[str, Callable[..., dict[str, Any]]] = {
            "attach": self._attach, "enable": self._enable, "exchange": self._exchange, "read": self._read,
            "disable": self._disable,
        }  # fmt: skip
        try:
            return actions[request["do"]](**request["with"])
        except BusGoneError as error:
            self._let_go()  # at the other buses, if there are any
            return {"error": "BusGoneError", "message": str(error)}
        except HardwareError as error:
            if self._guard is not None:  # torque is still on
                self._stop(str(error))
                return {"error": "FaultError", "message": self._fault}
            return {"error": type(error).__name__, "message": str(error)}

    def _attach(self, ids: list[list[int]]) -> dict[str, Any]:
        for bus, own in zip(self._bus.buses, ids, strict=True):
            wrong = [check for check in check_bus(bus, own) if check.is_vital and not check.is_good]
            if wrong:
                problems = "; ".join(f"{check.what} is {check.value}: {check.cure}" for check in wrong)
                raise HardwareError(f"nothing can move at {bus.name} yet: {problems}")
        return {"models": [[model.number for model in bus.models.values()] for bus in self._bus.buses]}

    def _enable(self, limits: dict[str, Any]) -> dict[str, Any]:
        """Torque on, with every servo's goal where it stands."""
        self._disable()
        for bus in self._bus.buses:
            for servo_id in bus.ids:
                self._require_healthy(bus, servo_id)
        measured = np.array([bus.position(servo_id) for bus in self._bus.buses for servo_id in bus.ids])
        guard = Guard(SafetyLimits(**limits), measured, self._bus.names)
        self._fault = ""
        try:
            self._write("bus_watchdog", _WATCHDOG_CLEAR)
            self._bus.write_goals(measured)
            self._write("torque_enable", 1)
            self._bus.write_goals(measured)
            self._write("bus_watchdog", _WATCHDOG_COUNTS)
        except BaseException:
            self._let_go()
            raise
        self._guard, self._commanded_s = guard, time.monotonic()
        for bus in self._bus.buses:
            bus.port.reply_timeout_s = _REPLY_TIMEOUT_S
        return {"position": measured.tolist()}

    def _write(self, name: str, value: int) -> None:
        """Write a register of every servo that has it, each with its confirmation."""
        for bus in self._bus.buses:
            for servo_id, model in bus.models.items():
                if name in model.table:
                    bus.write(servo_id, name, value)

    def _exchange(self, goals: list[float], at: float) -> dict[str, Any]:
        """Command, wait for a moment, read; the moment is on the monotonic clock, which both processes share."""
        guard = self._require_motion()
        now = time.monotonic()
        if at - now > _LONGEST_WAIT_S:
            raise FaultError(f"a cycle may wait {_LONGEST_WAIT_S} s, asked for {at - now:.3f} s")
        allowed, is_limited = guard.command(np.array(goals), min(now - self._commanded_s, _LONGEST_WAIT_S))
        was_holding = guard.is_holding
        self._bus.write_goals(allowed)
        self._commanded_s = now
        sleep_until(at)
        begin = time.monotonic()
        states = self._bus.read_states(_REPLY_TIMEOUT_S)
        reason = guard.take(states)
        if reason:
            self._stop(reason)
            raise FaultError(self._fault + self._alerts(states))
        return {
            **_plain(states), "goals": allowed.tolist(), "limited": is_limited.tolist(), "held": was_holding,
            "late_s": begin - at,
        }  # fmt: skip

    def _read(self) -> dict[str, Any]:
        """States without any command; while torque is on this counts as none."""
        return _plain(self._bus.read_states(max(bus.port.reply_timeout_s for bus in self._bus.buses)))

    def _disable(self) -> dict[str, Any]:
        """Torque off, confirmed."""
        self._guard = None
        said = self._let_go()
        if said:
            raise ReplyError(said)
        return {}

    def _require_motion(self) -> Guard:
        if self._guard is None:
            raise FaultError(self._fault or "torque is off; it must be enabled first")
        return self._guard

    def _require_healthy(self, bus: Bus, servo_id: int) -> None:
        status = bus.read(servo_id, "hardware_error_status")
        if status:
            raise FaultError(
                f"servo {servo_id} at {bus.name} reports {explain_errors(status) or f'error {status}'}; remove the "
                "cause, then switch its power off and on"
            )

    def _alerts(self, states: States) -> str:
        """What the servos that raised the alert bit say is wrong."""
        if not states.has_alert.any():
            return ""
        said, column = [], 0
        for bus in self._bus.buses:
            for servo_id in bus.ids:
                if states.has_alert[column]:
                    try:
                        status = bus.read(servo_id, "hardware_error_status")
                        said.append(f"servo {servo_id} at {bus.name}: {explain_errors(status) or f'error {status}'}")
                    except ReplyError as error:
                        said.append(str(error))
                column += 1
        return f" ({'; '.join(said)})"

    def _stop(self, reason: str) -> None:
        """End the motion for a reason, which the program hears with its next request."""
        self._guard = None
        said = self._let_go()
        self._fault = f"{reason}; {said or 'torque is off'}"

    def _let_go(self) -> str:
        """Torque off at once, then confirmed; what is not certain about it, "" if nothing."""
        self._guard = None
        try:
            self._bus.torque_off()
            self._bus.torque_off()  # nobody confirms a packet to all; a second one costs nothing
            unconfirmed = self._bus.confirm_torque_off()
        except HardwareError as error:
            return str(error)
        if unconfirmed:
            return f"torque off was sent, but not confirmed by {', '.join(unconfirmed)}: switch the power off"
        return ""


def _plain(states: States) -> dict[str, Any]:
    return {
        "position": states.position.tolist(), "velocity": states.velocity.tolist(), "current": states.current.tolist(),
        "is_fresh": states.is_fresh.tolist(), "has_alert": states.has_alert.tolist(), "time_s": states.time_s,
    }  # fmt: skip


def _end(signal_number: int, _: Any) -> None:
    raise SystemExit(128 + signal_number)


def main(ports: list[str], baudrate: int, channel: Channel) -> None:
    """Open the ports, say how that went, and serve."""
    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        signal.signal(number, _end)
    prefer_realtime()
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
    Supervisor(channel, buses).run()


if __name__ == "__main__":
    main(sys.argv[3:], int(sys.argv[2]), Channel(socket.socket(fileno=int(sys.argv[1]))))
