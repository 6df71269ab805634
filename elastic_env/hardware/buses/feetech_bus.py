"""Feetech servos of the series STS and SMS, such as STS3215 and STS3250."""

from collections import deque

from typing_extensions import override

from elastic_env.hardware.buses import feetech_packets, packets
from elastic_env.hardware.buses.bus import ServoInfo
from elastic_env.hardware.buses.packets import Packet
from elastic_env.hardware.buses.port import bus_gone
from elastic_env.hardware.buses.servo_bus import DAMAGED, ServoBus, Status
from elastic_env.hardware.buses.servo_models import servo_models
from elastic_env.hardware.errors import ReplyError

_WHO = ("firmware_version", "model_number")
_PING_S = 3e-3
"""Time that each possible servo has to answer a ping to all [s]."""


class FeetechBus(ServoBus):
    """Feetech servos of the series STS and SMS on a port, see `ServoBus`.

    A status has no error of its own: it shows the bits of `hardware_error_status`.
    """

    protocol = "feetech"
    rates = feetech_packets.RATES
    position_mode = 0
    full_replies = 1
    status_bytes = 6
    word_bytes = 1
    ping_bytes = 0
    patience_s = 0.006
    slowest_trip_s = 5e-3

    def __init__(self, port: str, baudrate: int | None = None) -> None:
        super().__init__(port, baudrate)
        self._parser = feetech_packets.Parser()
        self._received: deque[Packet] = deque()
        self._is_noise = False
        """True where bytes have come that make no packet."""
        known = [model for model in servo_models().values() if model.protocol == "feetech"]
        first, last = (known[0].table[name] for name in _WHO)
        self._who = range(first.address, last.end)

    @override
    def scan(self) -> list[ServoInfo]:
        self._transmit(packets.BROADCAST, packets.PING, b"")
        self.port.setPacketTimeoutMillis(1e3 * _PING_S * packets.LARGEST_ID)
        found = set()
        while (reply := self._receive()) is not None:
            if reply.is_intact:
                found.add(reply.servo_id)
        return [self.ping(servo_id) for servo_id in sorted(found)]

    @override
    def ping(self, servo_id: int) -> ServoInfo:
        self.knock(servo_id)
        place = self._place(self._who.start, len(self._who))
        reply = self._request(servo_id, packets.READ, place, len(self._who))
        return ServoInfo(servo_id, int.from_bytes(reply[-2:], "little"), reply[0])

    @override
    def _transmit(self, servo_id: int, instruction: int, data: bytes) -> None:
        wire = feetech_packets.packet(servo_id, instruction, data)
        self._parser = feetech_packets.Parser()
        self._received.clear()
        self._is_noise = False
        with bus_gone(self.name):
            self.port.release()
            self.port.clearPort()
            sent = self.port.writePort(wire)
        if sent != len(wire):
            taken = f"{sent} of {len(wire)} bytes were taken"
            raise ReplyError(f"cannot send at {self.name}: {taken}")

    @override
    def _receive(self) -> Status | None:
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
        if not found.is_intact:
            return DAMAGED
        return Status(found.servo_id, 0, bool(found.instruction), found.parameters)
