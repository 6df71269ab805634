"""Servos on one port, in SI units: registers, the goals of all servos in one packet, their states in another.

A state is read as one block per servo. A request asks for a length (`ServoModel.blocks`) that none of the last ones
still awaits, so that a reply that comes late is known as old and left out, not taken for the present one's.
Temperatures lie farther off, and change slowly: only every 25th request is for a block that reaches as far.
"""

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from elastic_env.core.signals import Array, BoolArray
from elastic_env.hardware.errors import BusGoneError, HardwareError, ReplyError
from elastic_env.hardware.servo_bus import protocol
from elastic_env.hardware.servo_bus.control_table import NUM_BLOCKS, ServoModel, servo_model
from elastic_env.hardware.servo_bus.port import COMM_SUCCESS, DEFAULT_BAUDRATE, PacketHandler, Port, bus_gone

TEMPERATURE_CYCLES = 25
"""Cycles from one reading of the temperatures to the next: 0.1 s at 250 Hz."""

_TRIES = 3
_QUIET_S = 0.03
_TEMPERATURE = "present_temperature"


@dataclass(frozen=True)
class States:
    """What the servos of a bus replied in one cycle, (n,) each, in the order of their ids.

    Where a servo's reply is missing its numbers are nan, never old ones.
    """

    position: Array
    """[rad], in the servo's own zero and sign."""
    velocity: Array
    """[rad/s]"""
    current: Array
    """Signed motor current [A]."""
    is_fresh: BoolArray
    """Whether the servo answered this very request, whole and intact."""
    has_alert: BoolArray
    """Whether it reports a hardware error."""
    time_s: float
    """When the replies were in, on the monotonic clock."""
    temperature: Array = field(default_factory=lambda: np.array(np.nan))
    """[°C]; nan where this request was not for it, which nobody may take for cool. One nan for all of them if none is
    given."""


@dataclass(frozen=True)
class Found:
    """A servo that answered a scan."""

    servo_id: int
    model_number: int
    firmware: int


class Bus:
    """Servos on a port.

    Args:
        port: Device, such as /dev/ttyUSB0.
        baudrate: Bits per second.

    Attributes:
        models: Types of the attached servos, by id.
        num_retries: Requests that were sent again because no reply came, or none that was intact.
    """

    def __init__(self, port: str, baudrate: int = DEFAULT_BAUDRATE) -> None:
        self.name = port
        self.port = Port(port, baudrate)
        self.models: dict[int, ServoModel] = {}
        self.num_retries = 0
        self._handler = PacketHandler()
        self._untold = TEMPERATURE_CYCLES  # cycles since the last one in which all servos told their temperature
        self._awaited: deque[range | None] = deque(maxlen=NUM_BLOCKS - 1)  # by the last requests; None: all answered

    def open(self) -> None:
        """Open and lock the port.

        Raises:
            PortError: It cannot be had.
        """
        self.port.open()

    def close(self) -> None:
        """Give the port back."""
        self.port.closePort()

    def __enter__(self) -> "Bus":
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def ids(self) -> tuple[int, ...]:
        """Ids of the attached servos, in order."""
        return tuple(self.models)

    @property
    def names(self) -> list[str]:
        """How messages call them."""
        return [f"servo {servo_id} at {self.name}" for servo_id in self.ids]

    def scan(self) -> list[Found]:
        """All servos that answer a broadcast ping, by id."""
        with bus_gone(self.name):
            found, _ = self._handler.broadcastPing(self.port)
        return [Found(servo_id, *values) for servo_id, values in sorted(found.items())]

    def ping(self, servo_id: int) -> Found:
        """Model number and firmware of one servo.

        Raises:
            ReplyError: It does not answer.
        """
        reply = self._asked(servo_id, protocol.PING, b"", 3)
        return Found(servo_id, int.from_bytes(reply[:2], "little"), reply[2])

    def attach(self, ids: Sequence[int]) -> None:
        """Take servos into the cycle; each is asked for its model, which decides on its registers.

        Raises:
            ConfigurationError: Ids that no servo can have, or one twice.
            ReplyError: A servo does not answer.
            HardwareError: Its model is not known.
        """
        protocol.require_ids(ids)
        self.attach_known({servo_id: self.ping(servo_id).model_number for servo_id in ids})

    def attach_known(self, numbers: Mapping[int, int]) -> None:
        """Take servos into the cycle without asking them anything.

        Args:
            numbers: Model numbers by id.

        Raises:
            HardwareError: A model is not known, or they do not go together.
        """
        self.models = {servo_id: servo_model(number) for servo_id, number in numbers.items()}
        if len({model.blocks for model in self.models.values()}) > 1:
            names = ", ".join(f"{servo_id}: {model.name}" for servo_id, model in self.models.items())
            raise HardwareError(f"the servos of one bus must have one control table, at {self.name} are {names}")

    def read(self, servo_id: int, name: str) -> int:
        """A register [count].

        Raises:
            ReplyError: No answer in three tries, or a refusal.
        """
        register = self.models[servo_id].table[name]
        asked = register.address.to_bytes(2, "little") + register.size.to_bytes(2, "little")
        return register.decode(self._asked(servo_id, protocol.READ, asked, register.size))

    def write(self, servo_id: int, name: str, value: int) -> None:
        """Write a register [count].

        Raises:
            ReplyError: No answer in three tries, or a refusal, with the servo's reason.
        """
        register = self.models[servo_id].table[name]
        data = register.address.to_bytes(2, "little") + register.encode(value)
        self._asked(servo_id, protocol.WRITE, data, 0)

    def position(self, servo_id: int) -> float:
        """Present position of one servo [rad]."""
        return self.read(servo_id, "present_position") * self.models[servo_id].position_unit

    def velocity(self, servo_id: int) -> float:
        """Present velocity of one servo [rad/s]."""
        return self.read(servo_id, "present_velocity") * self.models[servo_id].velocity_unit

    def write_goal(self, servo_id: int, angle: float) -> None:
        """Command one servo [rad], which confirms it.

        Raises:
            ReplyError: As `write`.
        """
        self.write(servo_id, "goal_position", round(angle / self.models[servo_id].position_unit))

    def write_all(self, name: str, values: Mapping[int, int]) -> None:
        """Write a register of several servos in one packet, which nobody confirms.

        Raises:
            BusGoneError: The port is gone.
        """
        if not values:
            return
        register = self.models[next(iter(values))].table[name]
        data = register.address.to_bytes(2, "little") + register.size.to_bytes(2, "little")
        data += b"".join(bytes([servo_id]) + register.encode(value) for servo_id, value in values.items())
        self._send(protocol.BROADCAST, protocol.SYNC_WRITE, data)
        self.port.release()

    def write_goals(self, angles: Array) -> None:
        """Command all servos at once.

        Args:
            angles: Goal positions in the order of `ids`, (n,) [rad].
        """
        units = np.array([model.position_unit for model in self.models.values()])
        counts = np.rint(angles / units).astype(np.int64).tolist()
        self.write_all("goal_position", dict(zip(self.ids, counts, strict=True)))

    def torque_off(self) -> None:
        """Switch all torque off; also after a read that was interrupted.

        Raises:
            BusGoneError: The port is gone.
        """
        for _ in range(2):  # nobody confirms a packet to all; a second one costs nothing
            self.port.release()
            self.write_all("torque_enable", dict.fromkeys(self.ids, 0))

    def confirm_torque_off(self) -> list[str]:
        """Servos that do not say that their torque is off, after some tries each."""
        return [name for name, i in zip(self.names, self.ids, strict=True) if not self._is_off(i)]

    def _is_off(self, servo_id: int) -> bool:
        try:
            if self.read(servo_id, "torque_enable") == 0:
                return True
            self.write(servo_id, "torque_enable", 0)
        except ReplyError:
            return False
        return True

    def read_states(self, timeout_s: float) -> States:
        """Position, velocity and current of all servos, and now and then their temperature.

        Args:
            timeout_s: How long to wait for all replies together.

        Raises:
            BusGoneError: The port is gone.
        """
        block = self._next_block()
        self._awaited.append(block)
        asked = block.start.to_bytes(2, "little") + len(block).to_bytes(2, "little")
        self._send(protocol.BROADCAST, protocol.SYNC_READ, asked + bytes(self.ids))
        self.port.setPacketTimeoutMillis(1e3 * timeout_s)
        replies: dict[int, bytes] = {}
        alerts: set[int] = set()
        while len(replies) < len(self.ids):
            reply = self._receive()
            if reply is None:
                if self.port.getTimeSinceStart() >= 1e3 * timeout_s:
                    break
                continue
            servo_id, error, data = reply
            if error & protocol.ALERT:
                alerts.add(servo_id)
            if len(data) == len(block) and error & ~protocol.ALERT == 0 and servo_id in self.models:
                replies[servo_id] = data
        if len(replies) == len(self.ids):
            self._awaited[-1] = None
        states = self._states(block, replies, alerts)
        self._untold = self._untold + 1 if np.isnan(states.temperature).any() else 0
        return states

    def _next_block(self) -> range:
        """The shortest block that no reply is awaited for, with the temperature if that is due."""
        model = next(iter(self.models.values()))
        free = [block for block in model.blocks if block not in self._awaited]
        if self._untold + 1 < TEMPERATURE_CYCLES:
            return free[0]
        return next((block for block in free if model.is_in_block(_TEMPERATURE, block)), free[0])

    def _states(self, block: range, replies: Mapping[int, bytes], alerts: set[int]) -> States:
        values = np.full((4, len(self.ids)), np.nan)
        for column, (servo_id, model) in enumerate(self.models.items()):
            if servo_id in replies:
                values[0, column] = model.in_block("present_position", block, replies[servo_id]) * model.position_unit
                values[1, column] = model.in_block("present_velocity", block, replies[servo_id]) * model.velocity_unit
                values[2, column] = model.in_block("present_current", block, replies[servo_id]) * model.current_unit
                if model.is_in_block(_TEMPERATURE, block):
                    values[3, column] = model.in_block(_TEMPERATURE, block, replies[servo_id])
        is_fresh = np.array([servo_id in replies for servo_id in self.ids])
        has_alert = np.array([servo_id in alerts for servo_id in self.ids])
        now = time.monotonic()
        return States(*values[:3], is_fresh=is_fresh, has_alert=has_alert, time_s=now, temperature=values[3])

    def _asked(self, servo_id: int, instruction: int, parameters: bytes, length: int) -> bytes:
        """The data of a reply; a few tries, with silence in between so that no late reply answers the next one."""
        problem = "does not answer"
        for _ in range(_TRIES):
            self._send(servo_id, instruction, parameters)
            self.port.setPacketTimeout(11 + length)
            while (reply := self._receive()) is not None:
                answered, status, data = reply
                error = status & ~protocol.ALERT
                if answered == servo_id and error == protocol.CRC_ERROR:  # it has done nothing: worth another try
                    problem = f"says that {protocol.STATUS_ERRORS[error]}"
                    break
                if answered == servo_id and error:
                    reason = protocol.STATUS_ERRORS.get(error, f"error {error}, which the protocol does not have")
                    raise ReplyError(f"servo {servo_id} at {self.name} refuses: {reason}")
                if answered == servo_id and len(data) == length:
                    return data
            self._wait_for_silence()
            self.num_retries += 1
        raise ReplyError(
            f"servo {servo_id} at {self.name} {problem} in {_TRIES} tries ({self.port.baudrate} bit/s); check "
            "power, wiring, id and baud rate, and whether this is the port of the servos and not the IMU's, see: "
            f"elastic hardware scan {self.name}"
        )

    def _send(self, servo_id: int, instruction: int, parameters: bytes) -> None:
        laid_out = [0] * (10 + len(parameters))
        length = len(parameters) + 3
        laid_out[4:8] = [servo_id, length & 0xFF, length >> 8, instruction]
        laid_out[8:-2] = parameters
        self.port.release()
        with bus_gone(self.name):
            result = self._handler.txPacket(self.port, laid_out)
        if result != COMM_SUCCESS:
            raise ReplyError(f"cannot send at {self.name}: {self._handler.getTxRxResult(result)}")

    def _receive(self) -> tuple[int, int, bytes] | None:
        """Id, error and data of the next status; None if it is damaged, or none comes in time."""
        with bus_gone(self.name):
            received, result = self._handler.rxPacket(self.port, False)
        if result != COMM_SUCCESS:
            return None
        return received[4], received[8], bytes(received[9:-2])

    def _wait_for_silence(self) -> None:
        with bus_gone(self.name):
            self.port.release()
            quiet_since = time.monotonic()
            deadline = quiet_since + 10 * _QUIET_S
            while time.monotonic() - quiet_since < _QUIET_S and time.monotonic() < deadline:
                if self.port.readPort(256):
                    quiet_since = time.monotonic()


class Buses:
    """Several buses as one: each has a reader of its own, so that they work at the same time.

    Args:
        buses: With their servos attached; an array of all servos has theirs in this order.
    """

    def __init__(self, buses: Sequence[Bus]) -> None:
        self.buses = tuple(buses)
        self._readers = [ThreadPoolExecutor(1, thread_name_prefix=bus.name) for bus in buses[1:]]

    @property
    def names(self) -> list[str]:
        """How messages call the servos of all of them."""
        return [name for bus in self.buses for name in bus.names]

    @property
    def servos(self) -> list[tuple[Bus, int]]:
        """Bus and id of each servo."""
        return [(bus, servo_id) for bus in self.buses for servo_id in bus.ids]

    def write_goals(self, angles: Array) -> None:
        """Command all servos, (n,) [rad]."""
        ends = np.cumsum([len(bus.ids) for bus in self.buses])[:-1]
        self._on_each(lambda bus, part: bus.write_goals(part), np.split(angles, ends))

    def read_states(self, timeout_s: float) -> States:
        """The states of all servos; the time is that of the last reply."""
        if len(self.buses) == 1:  # nothing to join, in what a control cycle waits for
            return self.buses[0].read_states(timeout_s)
        parts = self._on_each(lambda bus, _: bus.read_states(timeout_s))
        names = ("position", "velocity", "current", "is_fresh", "has_alert", "temperature")
        joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        return States(**joined, time_s=max(part.time_s for part in parts))

    def let_go(self, when_sent: Callable[[], None] = lambda: None) -> HardwareError | None:
        """Switch all torque off, at every bus before any servo is asked whether it is; a lost bus keeps no other on.

        Args:
            when_sent: Called in between; servos that do not answer make the rest last.

        Returns:
            What is not certain: a `BusGoneError` where a bus is gone, else a `ReplyError`; None if all is off.
        """
        self._on_each(lambda bus, _: _error_of(bus.torque_off))
        when_sent()
        found = self._on_each(lambda bus, _: _unconfirmed(bus))
        errors = [one for one in found if isinstance(one, HardwareError)]
        silent = [name for one in found if isinstance(one, list) for name in one]
        said = [str(error) for error in errors]
        if silent:
            said.append(f"torque off was sent, but not confirmed by {', '.join(silent)}: switch the power off")
        if not said:
            return None
        off = [bus.name for bus, one in zip(self.buses, found, strict=True) if one == []]
        said += [f"torque is off at {', '.join(off)}"] if off else []
        is_gone = any(isinstance(error, BusGoneError) for error in errors)
        return (BusGoneError if is_gone else ReplyError)("; ".join(said))

    def close(self) -> None:
        """Give all ports back."""
        for reader in self._readers:
            reader.shutdown()
        for bus in self.buses:
            bus.close()

    def _on_each(self, function: Callable[[Bus, Any], Any], parts: Sequence[Any] | None = None) -> list[Any]:
        """Call a function for every bus, the first in this thread; all of them are done when an error is raised."""
        given = [None] * len(self.buses) if parts is None else parts
        waiting = [
            reader.submit(function, bus, part)
            for reader, bus, part in zip(self._readers, self.buses[1:], given[1:], strict=True)
        ]
        try:
            first = function(self.buses[0], given[0])
        finally:
            wait(waiting)
        return [first, *(future.result() for future in waiting)]


def _error_of(function: Callable[[], None]) -> HardwareError | None:
    """What a call raises, if anything."""
    try:
        function()
    except HardwareError as error:
        return error
    return None


def _unconfirmed(bus: Bus) -> list[str] | HardwareError:
    """Servos that do not say that their torque is off, or why nobody can be asked."""
    try:
        return bus.confirm_torque_off()
    except HardwareError as error:
        return error
