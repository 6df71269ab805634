"""Servos on one port or several: registers, goals in one packet, states in another.

A state is read as one block per servo. A request asks for a length (`ServoModel.blocks`) that none
of the last ones still awaits. So a reply that comes late is known as old and left out. Temperatures
may lie farther off and change slowly: only every 25th request is for a block that reaches as far.

What differs from make to make is in `dynamixel_bus` and `feetech_bus`: packets, who answers a ping,
and the meaning of a status.
"""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import partial
from typing import Any, ClassVar, NamedTuple, Self, TypeVar

import numpy as np

from elastic_env.core.signals import Array
from elastic_env.hardware.buses import packets, servo_models
from elastic_env.hardware.buses import port as ports
from elastic_env.hardware.buses.bus import TEMPERATURE_CYCLES, Condition, ServoInfo, States
from elastic_env.hardware.buses.packets import Packet
from elastic_env.hardware.buses.port import bus_gone
from elastic_env.hardware.buses.servo_models import Protocol, ServoModel
from elastic_env.hardware.errors import BusGoneError, HardwareError, ReplyError

_TRIES = 3
_QUIET_S = 0.03
_REPLY_TIMEOUT_S = 0.05
_WATCHDOG_COUNTS = 3  # of 20 ms
_PING_S = 3e-3
"""Time that each possible servo has to answer a ping to all [s]."""
_LOWER_S = 0.02
"""Between two steps of the torque when it is lowered [s]."""

T = TypeVar("T")


class Status(NamedTuple):
    """A servo's reply."""

    servo_id: int
    error: int
    """Why it refuses, 0 if it does not."""
    has_alert: bool
    """True where it reports a hardware error."""
    data: bytes
    is_intact: bool = True
    """False where the line has damaged it; the rest is then of no use."""


DAMAGED = Status(servo_id=-1, error=0, has_alert=False, data=b"", is_intact=False)
"""A reply that is not intact."""
STRANGE = DAMAGED._replace(is_intact=True)
"""A packet that is no reply."""


class ServoBus(ABC):
    """Servos of one protocol on a port.

    Args:
        port: Device, such as /dev/ttyUSB0.
        baudrate: Bits per second; None for `rates[0]`.

    Attributes:
        models: Types of the attached servos, by id.
        num_retries: Requests that were sent again because no reply came, or none that was intact.
    """

    protocol: ClassVar[Protocol]
    rates: ClassVar[tuple[int, ...]]
    """Usual rates, the likeliest first [bit/s]."""
    packet: ClassVar[Callable[[int, int, bytes], bytes]]
    """An instruction as it goes over the wire, of id, number and parameters."""
    parser: ClassVar[type[packets.Parser]]
    """Finds replies in what comes back."""
    position_mode: ClassVar[int]
    """Operating mode in which a servo follows goal positions."""
    full_replies: ClassVar[int]
    """Status return level of a servo that answers every instruction."""
    status_bytes: ClassVar[int]
    """Length of a reply without data."""

    word_bytes: ClassVar[int]
    """Length of an address, and of a length, in an instruction."""

    ping_bytes: ClassVar[int]
    """Length of the data in the answer to a ping."""
    patience_s: ClassVar[float]
    """How long replies in motion may take beyond the time on the wire [s]."""
    slowest_trip_s: ClassVar[float]
    """Round trip of a ping from which on nothing may move [s]."""

    def __init__(self, port: str, baudrate: int | None = None) -> None:
        self.name = port
        self.port = ports.Port(port, baudrate or self.rates[0])
        self.models: dict[int, ServoModel] = {}
        self.reply_timeout_s = _REPLY_TIMEOUT_S
        self.num_retries = 0
        self._cycles_without_temperature = TEMPERATURE_CYCLES
        self._awaited: deque[range | None] = deque(maxlen=servo_models.NUM_BLOCKS - 1)
        """Blocks that the last requests asked for; None where all servos answered."""
        self._torque_lines: Array = np.zeros((2, 0))
        """Torque per current [N·m/A] and what is lost [N·m], (2, n)."""
        self._parser = self.parser()
        self._received: deque[Packet] = deque()
        self._is_noise = False
        """True where bytes have come that make no packet."""
        self._full_efforts: dict[int, int] = {}
        """Largest value of the register that limits the torque, by id [count]."""

    def open(self) -> None:
        """Open and lock the port.

        Raises:
            PortError: It cannot be had.
        """
        self.port.open()

    def close(self) -> None:
        """Give the port back."""
        self.port.closePort()

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def ids(self) -> tuple[int, ...]:
        """Ids of the attached servos, in order."""
        return tuple(self.models)

    def scan(self) -> list[ServoInfo]:
        """All servos that answer a ping to all, by id."""
        self._transmit(packets.BROADCAST, packets.PING, b"")
        wire_ms = self.port.tx_time_per_byte * (self.status_bytes + self.ping_bytes)
        self.port.setPacketTimeoutMillis(packets.LARGEST_ID * (wire_ms + 1e3 * _PING_S))
        answers: dict[int, bytes] = {}
        while (reply := self._receive()) is not None:
            if reply.is_intact and len(reply.data) == self.ping_bytes:
                answers[reply.servo_id] = reply.data
        return [self._identify(*answer) for answer in sorted(answers.items())]

    def ping(self, servo_id: int) -> ServoInfo:
        """Model number and firmware of one servo.

        Raises:
            ReplyError: It does not answer.
        """
        return self._identify(servo_id, self.knock(servo_id))

    def knock(self, servo_id: int) -> bytes:
        """One request and its answer, as short as there are.

        Raises:
            ReplyError: It does not answer.
        """
        return self._request(servo_id, packets.PING, b"", length=self.ping_bytes)

    @abstractmethod
    def _identify(self, servo_id: int, answer: bytes) -> ServoInfo:
        """Who a servo is, by its answer to a ping."""

    @abstractmethod
    def _status(self, packet: Packet) -> Status:
        """What an intact packet says."""

    def _transmit(self, servo_id: int, instruction: int, data: bytes) -> None:
        """Send an instruction, and forget what has come before."""
        wire = type(self).packet(servo_id, instruction, data)
        self._parser = self.parser()
        self._received.clear()
        self._is_noise = False
        with bus_gone(self.name):
            self.port.clearPort()
            sent = self.port.writePort(wire)
        if sent != len(wire):
            taken = f"{sent} of {len(wire)} bytes were taken"
            raise ReplyError(f"cannot send at {self.name}: {taken}")

    def _receive(self) -> Status | None:
        """The next reply; None if none comes in time."""
        with bus_gone(self.name):
            while not self._received:
                if self.port.isPacketTimeout():
                    was_noise = self._is_noise
                    self._is_noise = False
                    return DAMAGED if was_noise else None
                data = self.port.readPort(4096)
                self._is_noise |= bool(data)
                self._received.extend(self._parser.parse(data))
        self._is_noise = False
        found = self._received.popleft()
        return self._status(found) if found.is_intact else DAMAGED

    def _place(self, *numbers: int) -> bytes:
        """Address of registers, and their length, as an instruction names them."""
        return b"".join(number.to_bytes(self.word_bytes, "little") for number in numbers)

    def attach(self, ids: Sequence[int]) -> None:
        """Take servos into the cycle; each is asked for its model, which decides on its registers.

        Raises:
            ConfigurationError: Ids that no servo can have, or one twice.
            ReplyError: A servo does not answer.
            HardwareError: Its model is not known.
        """
        packets.require_ids(ids)
        self.attach_known({i: self.ping(i).model_number for i in ids})

    def attach_known(self, numbers: Mapping[int, int]) -> None:
        """Take servos into the cycle without asking them anything.

        Args:
            numbers: Model numbers by id.

        Raises:
            HardwareError: A model is not known, or they do not go together.
        """
        kinds = {i: servo_models.servo_model(number) for i, number in numbers.items()}
        for servo_id, model in kinds.items():
            if model.protocol != self.protocol:
                raise HardwareError(
                    f"servo {servo_id} at {self.name} is a {model.name}, which speaks the protocol"
                    f" {model.protocol!r}, and the bus {self.protocol!r}: set protocol"
                )
        self.models = kinds
        lines = [(model.torque_per_ampere, model.loss) for model in kinds.values()]
        self._torque_lines = np.array(lines).reshape(-1, 2).T
        if len({model.blocks for model in self.models.values()}) > 1:
            names = ", ".join(f"{i}: {model.name}" for i, model in self.models.items())
            raise HardwareError(
                f"the servos of one bus must have one control table, at {self.name} are {names}"
            )

    def read_register(self, servo_id: int, name: str) -> int:
        """A register [count].

        Raises:
            ReplyError: No answer in three tries, or a refusal.
        """
        register = self.models[servo_id].table[name]
        place = self._place(register.address, register.size)
        data = self._request(servo_id, packets.READ, place, register.size)
        return register.decode(data)

    def write_register(self, servo_id: int, name: str, value: int) -> None:
        """Write a register [count].

        Raises:
            ReplyError: No answer in three tries, or a refusal, with the servo's reason.
        """
        register = self.models[servo_id].table[name]
        data = self._place(register.address) + register.encode(value)
        self._request(servo_id, packets.WRITE, data, length=0)

    def write_all(self, name: str, values: Mapping[int, int]) -> None:
        """Write a register of several servos, by id [count], in one packet, which nobody confirms.

        Raises:
            BusGoneError: The port is gone.
        """
        if not values:
            return
        register = self.models[next(iter(values))].table[name]
        data = self._place(register.address, register.size)
        for servo_id, value in values.items():
            data += bytes([servo_id]) + register.encode(value)
        self._transmit(packets.BROADCAST, packets.SYNC_WRITE, data)

    def read_position(self, servo_id: int) -> float:
        """Present position of one servo [rad]."""
        count = self.read_register(servo_id, "present_position")
        return self.models[servo_id].angle(count)

    def read_condition(self, servo_id: int) -> Condition:
        """Velocity, temperature and hardware error of one servo."""
        counts = self.read_register(servo_id, "present_velocity")
        temperature = float(self.read_register(servo_id, "present_temperature"))
        highest = float(self.read_register(servo_id, "temperature_limit"))
        status = self.read_register(servo_id, "hardware_error_status")
        model = self.models[servo_id]
        error = model.explain_errors(status)
        return Condition(counts * model.velocity_unit, temperature, highest, error)

    def write_goal(self, servo_id: int, angle: float) -> None:
        """Command one servo [rad], which confirms it.

        Raises:
            ReplyError: As `write`.
        """
        count = self.models[servo_id].count(angle)
        self.write_register(servo_id, "goal_position", count)

    def write_goals(self, angles: Array) -> None:
        """Command all servos at once.

        Args:
            angles: Goal positions in the order of `ids`, (n,) [rad].
        """
        servos = zip(self.models.items(), angles.tolist(), strict=True)
        counts = {servo_id: model.count(angle) for (servo_id, model), angle in servos}
        self.write_all("goal_position", counts)

    def write_torque(self, servo_id: int, is_on: bool) -> None:
        """Switch the torque of one servo, which confirms it."""
        self.write_register(servo_id, "torque_enable", int(is_on))

    def write_watchdog(self, servo_id: int, is_on: bool) -> None:
        """Set the bus watchdog of a servo to 60 ms, or clear it.

        Nothing on models that have none.
        """
        if self.models[servo_id].has_watchdog:
            counts = _WATCHDOG_COUNTS if is_on else 0
            self.write_register(servo_id, "bus_watchdog", counts)

    def restore_effort(self) -> None:
        """Let the servos give all the torque that their settings allow; each confirms it.

        Nothing on models whose torque cannot be limited at once.
        """
        for servo_id, model in self.models.items():
            if model.effort_register:
                full = self.read_register(servo_id, model.effort_maximum)
                self._full_efforts[servo_id] = full
                self.write_register(servo_id, model.effort_register, full)

    @property
    def can_limit_effort(self) -> bool:
        """True if the torque of its servos can be limited at once."""
        return bool(self._full_efforts)

    def limit_effort(self, share: float) -> None:
        """Limit the torque of all servos to a share of what their settings allow.

        Nobody confirms it. Nothing on models that have no such limit.
        """
        efforts = {i: round(share * full) for i, full in self._full_efforts.items()}
        if efforts:
            self.write_all(self.models[next(iter(efforts))].effort_register, efforts)

    def torque_off(self) -> None:
        """Switch all torque off; also after a read that was interrupted.

        Raises:
            BusGoneError: The port is gone.
        """
        # nobody confirms a packet to all; a second one costs nothing
        for _ in range(2):
            self.write_all("torque_enable", dict.fromkeys(self.ids, 0))
        # the next program must not find a servo without strength
        self.limit_effort(1.0)

    def confirm_torque_off(self) -> list[str]:
        """Names of the servos that do not say that their torque is off, after some tries each."""
        return [servo_name(self, i) for i in self.ids if not self._is_off(i)]

    def _is_off(self, servo_id: int) -> bool:
        try:
            if self.read_register(servo_id, "torque_enable") != 0:
                self.write_torque(servo_id, False)
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
        asked = self._place(block.start, len(block)) + bytes(self.ids)
        self._transmit(packets.BROADCAST, packets.SYNC_READ, asked)
        length = len(self.ids) * (self.status_bytes + len(block))
        longest_ms = self.port.tx_time_per_byte * length + 1e3 * timeout_s
        self.port.setPacketTimeoutMillis(longest_ms)
        replies: dict[int, bytes] = {}
        alerts: set[int] = set()
        while len(replies) < len(self.ids):
            reply = self._receive()
            if reply is None:
                if self.port.getTimeSinceStart() >= longest_ms:
                    break
                continue
            if not reply.is_intact:
                continue
            if reply.has_alert:
                alerts.add(reply.servo_id)
            is_good = reply.error == 0 and len(reply.data) == len(block)
            if is_good and reply.servo_id in self.models:
                replies[reply.servo_id] = reply.data
        if len(replies) == len(self.ids):
            self._awaited[-1] = None
        states = self._decode(block, replies, alerts)
        self._cycles_without_temperature += 1
        if not np.isnan(states.temperature).any():
            self._cycles_without_temperature = 0
        return states

    def _next_block(self) -> range:
        """The shortest block that no reply is awaited for, with the temperature if that is due."""
        model = next(iter(self.models.values()))
        free = [block for block in model.blocks if block not in self._awaited]
        if self._cycles_without_temperature + 1 < TEMPERATURE_CYCLES:
            return free[0]
        return next(filter(model.has_temperature, free), free[0])

    def _decode(self, block: range, replies: dict[int, bytes], alerts: Any) -> States:
        values = np.full((len(self.ids), 4), np.nan)
        for row, (servo_id, model) in enumerate(self.models.items()):
            if servo_id in replies:
                values[row] = model.decode_block(block, replies[servo_id])
        angle, velocity, current, temperature = values.T.copy()
        torque = servo_models.torque_of_current(current, *self._torque_lines)
        now = self.port.clock.monotonic()
        is_fresh = np.array([servo_id in replies for servo_id in self.ids])
        has_alert = np.array([servo_id in alerts for servo_id in self.ids])
        return States(angle, velocity, torque, is_fresh, has_alert, now, temperature)

    def _request(self, servo_id: int, kind: int, data: bytes, length: int) -> bytes:
        """The data of a reply.

        A few tries, with silence in between so that no late reply answers the next one.
        """
        problem = "does not answer"
        for _ in range(_TRIES):
            self._transmit(servo_id, kind, data)
            wire_ms = self.port.tx_time_per_byte * (self.status_bytes + length)
            self.port.setPacketTimeoutMillis(wire_ms + 1e3 * self.reply_timeout_s)
            while (reply := self._receive()) is not None:
                if not reply.is_intact:
                    problem = "answers with damaged packets, as two servos with one id do,"
                    break
                if reply.servo_id != servo_id:
                    continue
                if reply.error:
                    reason = packets.explain_error(reply.error)
                    if reply.error != packets.CRC_ERROR:
                        raise ReplyError(f"{servo_name(self, servo_id)} refuses: {reason}")
                    problem = f"says that {reason}"
                    break
                if len(reply.data) == length:
                    return reply.data
            self._wait_for_silence()
            self.num_retries += 1
        raise ReplyError(
            f"{servo_name(self, servo_id)} {problem} in {_TRIES} tries ({self.port.baudrate} "
            "bit/s); check power, wiring, id and baud rate, and whether this is the port of the "
            f"servos and not the IMU's, see: elastic hardware scan {self.name}"
        )

    def _wait_for_silence(self) -> None:
        with bus_gone(self.name):
            deadline = self.port.clock.monotonic() + 10 * _QUIET_S
            end = self.port.clock.monotonic() + _QUIET_S
            while self.port.clock.monotonic() < min(end, deadline):
                if self.port.readPort(256):
                    end = self.port.clock.monotonic() + _QUIET_S


class BusGroup:
    """Several buses as one. Each has a reader of its own, so that they work at the same time.

    Args:
        buses: With their servos attached; an array of all servos has theirs in this order.
    """

    def __init__(self, buses: Sequence[ServoBus]) -> None:
        self.buses = tuple(buses)
        self._readers = [ThreadPoolExecutor(1, bus.name) for bus in buses[1:]]

    @property
    def servos(self) -> list[tuple[ServoBus, int]]:
        """Bus and id of each servo."""
        return [(bus, servo_id) for bus in self.buses for servo_id in bus.ids]

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

    def restore_effort(self) -> None:
        """Let all servos give the torque that their settings allow, see `ServoBus`."""
        self._call_all([bus.restore_effort for bus in self.buses])

    def lower(self, duration_s: float) -> None:
        """Let the torque of all servos fall to nothing within a time [s], so that an arm sinks.

        What a bus does not take is left to `torque_off`. Nothing where no servo can limit it.
        """
        if not any(bus.can_limit_effort for bus in self.buses):
            return
        clock = self.buses[0].port.clock
        begin = clock.monotonic()
        share = 1.0
        while share > 0.0:
            clock.sleep(_LOWER_S)
            share = max(1.0 - (clock.monotonic() - begin) / duration_s, 0.0)
            # most of the torque is not needed to hold the arm: cubed, it is gone early
            limits = [partial(bus.limit_effort, share**3) for bus in self.buses]
            answers = self._call_all([partial(_call, limit) for limit in limits])
            if all(isinstance(answer, HardwareError) for answer in answers):
                return

    def torque_off(self, when_sent: Any = None) -> HardwareError | None:
        """Switch all torque off, at every bus before any servo is asked whether it is.

        A lost bus keeps no other on.

        Args:
            when_sent: Called in between; servos that do not answer make the rest last.

        Returns:
            What is not certain: a `BusGoneError` where a bus is gone, else a `ReplyError`; None if
            all is off.
        """
        self._call_all([partial(_call, bus.torque_off) for bus in self.buses])
        if when_sent is not None:
            when_sent()
        calls = [partial(_call, bus.confirm_torque_off) for bus in self.buses]
        answers = self._call_all(calls)
        errors = [answer for answer in answers if isinstance(answer, HardwareError)]
        lists = [answer for answer in answers if isinstance(answer, list)]
        silent = [name for names in lists for name in names]
        problems = [str(error) for error in errors]
        if silent:
            who = f"{', '.join(silent)}: switch the power off"
            problems.append(f"torque off was sent, but not confirmed by {who}")
        if not problems:
            return None
        pairs = zip(self.buses, answers, strict=True)
        if off := [bus.name for bus, answer in pairs if answer == []]:
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


def servo_name(bus: ServoBus, servo_id: int) -> str:
    """A servo's name in messages."""
    return f"servo {servo_id} at {bus.name}"


def _call(function: Callable[[], T]) -> T | HardwareError:
    """The result of a call, or its error."""
    try:
        return function()
    except HardwareError as error:
        return error
