"""Packets of Feetech's STS and SMS servos: those of Dynamixel Protocol 1.0.

    FF FF  id  length  instruction or status  parameters ...  checksum

The length counts the bytes after it. The checksum is the inverted sum of all bytes between header
and checksum, modulo 256. There is no byte stuffing. Source: Feetech's protocol manual, and the
packages scservo_sdk (feetech-servo-sdk) and FTServo_Python. We do not use the first package: it has
one version of 2022, a global byte order, and no timeout of replies.

A checksum of eight bits lets one of 256 packets pass that are damaged in more than one bit. A
header with the id and the length of a reply inside another reply means that the first one has lost
its end.
"""

from typing_extensions import override

from elastic_env.hardware.buses import packets
from elastic_env.hardware.buses.packets import LARGEST_ID, Packet

HEADER = b"\xff\xff"
RATES = (1_000_000, 500_000, 115_200, 57_600)
"""Rates that servos, SDK and pseudo-terminals share, the likeliest first [bit/s]."""
LARGEST_LENGTH = 250


def checksum(body: bytes) -> int:
    """Checksum of id, length, instruction and parameters."""
    return ~sum(body) & 0xFF


def packet(servo_id: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Packet as bytes on the wire; a reply has its status instead of the instruction."""
    body = bytes([servo_id, len(parameters) + 2, instruction]) + parameters
    return HEADER + body + bytes([checksum(body)])


class Parser(packets.Parser):
    """Finds packets of this protocol in a stream of bytes that may begin anywhere."""

    @override
    def _next(self) -> Packet | None:
        while True:
            start = self._bytes.find(HEADER)
            if start < 0:
                del self._bytes[: max(len(self._bytes) - 1, 0)]
                return None
            del self._bytes[:start]
            if len(self._bytes) < 4:
                return None
            servo_id, length = self._bytes[2], self._bytes[3]
            if servo_id == 0xFF or not 2 <= length <= LARGEST_LENGTH:
                del self._bytes[0]
                continue
            raw = bytes(self._bytes[: 4 + length])
            inner = self._find_inner_packet(raw)
            if inner:
                del self._bytes[:inner]
                return Packet(servo_id, raw[4], b"", is_intact=False)
            if len(raw) < 4 + length:
                return None
            is_intact = checksum(raw[2:-1]) == raw[-1]
            # the length of a damaged packet may be wrong: search on behind its header
            del self._bytes[: len(raw) if is_intact else len(HEADER)]
            return Packet(servo_id, raw[4], raw[5:-1], is_intact)

    @staticmethod
    def _find_inner_packet(raw: bytes) -> int:
        """Position of another packet of the same length that begins inside; 0 if none does."""
        at = raw.find(HEADER, 2)
        while 0 < at < len(raw) - 3:
            if raw[at + 2] <= LARGEST_ID and raw[at + 3] == raw[3]:
                return at
            at = raw.find(HEADER, at + 1)
        return 0
