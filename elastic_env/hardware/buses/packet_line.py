"""Instructions to servos at a port, and their replies, in the packets of one protocol."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from typing import ClassVar, NamedTuple, Self

from elastic_env.hardware.buses import packets, port
from elastic_env.hardware.buses.bus import ServoInfo
from elastic_env.hardware.buses.packets import Packet
from elastic_env.hardware.buses.servo_models import Protocol
from elastic_env.hardware.errors import ReplyError

_TRIES = 3
_QUIET_S = 0.03
"""Silence after which no late reply is expected [s]."""
REPLY_TIMEOUT_S = 0.05
"""Time that a reply at rest may take beyond that on the wire [s]."""
_PING_S = 3e-3
"""Time that each possible servo has to answer a ping to all [s]."""


class Status(NamedTuple):
    """Reply of a servo."""

    servo_id: int
    error: int
    """Reason of a refusal, 0 if the servo accepts."""
    has_alert: bool
    """True if the servo reports a hardware error."""
    data: bytes
    is_intact: bool = True
    """False if the line has damaged it; the other fields are then without use."""


DAMAGED = Status(servo_id=-1, error=0, has_alert=False, data=b"", is_intact=False)
"""A reply that is not intact."""
STRANGE = DAMAGED._replace(is_intact=True)
"""A packet that is no reply."""


class PacketLine(ABC):
    """A port with servos of one protocol, which answer one instruction after another.

    Args:
        name: Device of the port, such as /dev/ttyUSB0.
        baudrate: Bits per second; None for `rates[0]`.

    Attributes:
        num_retries: Requests that were sent again because no intact reply came.
    """

    protocol: ClassVar[Protocol]
    rates: ClassVar[tuple[int, ...]]
    """Usual rates, the likeliest first [bit/s]."""
    packet: ClassVar[Callable[[int, int, bytes], bytes]]
    """Encodes an instruction for the wire, from id, number and parameters."""
    parser: ClassVar[type[packets.Parser]]
    """Finds replies in the received bytes."""
    status_bytes: ClassVar[int]
    """Length of a reply without data."""
    word_bytes: ClassVar[int]
    """Length of an address, and of a length, in an instruction."""
    ping_bytes: ClassVar[int]
    """Length of the data in the answer to a ping."""

    def __init__(self, name: str, baudrate: int | None = None) -> None:
        self.name = name
        self.port = port.Port(name, baudrate or self.rates[0])
        self.reply_timeout_s = REPLY_TIMEOUT_S
        self.num_retries = 0
        self._parser = self.parser()
        self._received: deque[Packet] = deque()
        self._is_noise = False
        """True if bytes have come that are no packet."""

    def open(self) -> None:
        """Open and lock the port.

        Raises:
            PortError: It cannot be opened.
        """
        self.port.open()

    def close(self) -> None:
        """Release the port."""
        self.port.closePort()

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def scan(self) -> list[ServoInfo]:
        """Servos that answer a ping to all, by id."""
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
        return self._identify(servo_id, self.request_ping(servo_id))

    def request_ping(self, servo_id: int) -> bytes:
        """Ping a servo and return the data of its answer; the shortest request that there is.

        Raises:
            ReplyError: It does not answer.
        """
        return self._request(servo_id, packets.PING, b"", length=self.ping_bytes)

    @abstractmethod
    def _identify(self, servo_id: int, answer: bytes) -> ServoInfo:
        """Model and firmware of a servo, by the data of its answer to a ping."""

    @abstractmethod
    def _status(self, packet: Packet) -> Status:
        """Reply in an intact packet."""

    def _transmit(self, servo_id: int, instruction: int, data: bytes) -> None:
        """Send an instruction, and forget bytes received before it."""
        wire = type(self).packet(servo_id, instruction, data)
        self._parser = self.parser()
        self._received.clear()
        self._is_noise = False
        with port.bus_gone(self.name):
            self.port.clearPort()
            sent = self.port.writePort(wire)
        if sent != len(wire):
            raise ReplyError(f"cannot send at {self.name}: {sent} of {len(wire)} bytes were taken")

    def _receive(self) -> Status | None:
        """Wait for the next reply; None if none comes in time.

        What has come while this process did not run is still read.
        """
        with port.bus_gone(self.name):
            while not self._received:
                is_over = self.port.isPacketTimeout()
                may_read = not is_over or self.port.getBytesAvailable()
                data = self.port.readPort(4096) if may_read else b""
                self._is_noise |= bool(data)
                self._received.extend(self._parser.parse(data))
                if is_over and not self._received:
                    was_noise = self._is_noise
                    self._is_noise = False
                    return DAMAGED if was_noise else None
        self._is_noise = False
        packet = self._received.popleft()
        return self._status(packet) if packet.is_intact else DAMAGED

    def _place(self, *numbers: int) -> bytes:
        """Encode the address of registers, and their length, for an instruction."""
        return b"".join(number.to_bytes(self.word_bytes, "little") for number in numbers)

    def _request(self, servo_id: int, kind: int, data: bytes, length: int) -> bytes:
        """Send an instruction to a servo and return the data of its reply.

        There are a few tries. Silence after a failure, and after a retry, keeps a late reply from
        answering the next request.

        Raises:
            ReplyError: No valid reply comes, or the servo refuses.
        """
        problem = "does not answer"
        for retry in range(_TRIES):
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
                    if retry:  # both tries may be answered, the second one late
                        self._wait_for_silence()
                    return reply.data
            self._wait_for_silence()
            self.num_retries += 1
        raise ReplyError(
            f"{servo_name(self, servo_id)} {problem} in {_TRIES} tries ({self.port.baudrate} "
            "bit/s); check power, wiring, id and baud rate, and whether this is the port of the "
            f"servos and not the IMU's, see: elastic hardware scan {self.name}"
        )

    def _wait_for_silence(self) -> None:
        """Read and drop bytes until none come any more."""
        with port.bus_gone(self.name):
            deadline = self.port.clock.monotonic() + 10 * _QUIET_S
            end = self.port.clock.monotonic() + _QUIET_S
            while self.port.clock.monotonic() < min(end, deadline):
                if self.port.readPort(256):
                    end = self.port.clock.monotonic() + _QUIET_S


def servo_name(line: PacketLine, servo_id: int) -> str:
    """Name of a servo in messages."""
    return f"servo {servo_id} at {line.name}"
