"""Packets of Dynamixel Protocol 2.0 [ROBOTIS e-manual, protocol2]: checksum, stuffing, status.

    FF FF FD 00  id  length (2)  instruction  parameters ...  CRC-16 (2)

In instruction and parameters FF FF FD is sent as FF FF FD FD, so that no header occurs there;
length and checksum refer to the sent bytes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from elastic_env.core.errors import ConfigurationError, quote

HEADER = b"\xff\xff\xfd\x00"
BROADCAST = 0xFE
LARGEST_ID = 0xFC
STATUS = 0x55

PING = 0x01
READ = 0x02
WRITE = 0x03
SYNC_READ = 0x82
SYNC_WRITE = 0x83

ALERT = 0x80
"""Bit of a status that asks to read `hardware_error_status`."""

RESULT_FAIL = 0x01
INSTRUCTION_ERROR = 0x02
CRC_ERROR = 0x03
RANGE_ERROR = 0x04
LENGTH_ERROR = 0x05
LIMIT_ERROR = 0x06
ACCESS_ERROR = 0x07
STATUS_ERRORS = {
    RESULT_FAIL: "it could not process the instruction",
    INSTRUCTION_ERROR: "it does not know the instruction",
    CRC_ERROR: "the instruction arrived damaged",
    RANGE_ERROR: "the value is out of the register's range",
    LENGTH_ERROR: "the length does not fit the register",
    LIMIT_ERROR: "the value is beyond the servo's limit",
    ACCESS_ERROR: "the register cannot be read or written now; EEPROM is locked while torque is on",
}
"""Meaning of the error number in a status."""

RATES = (3_000_000, 1_000_000, 57_600, 115_200, 2_000_000, 4_000_000)
"""Rates that servos, SDK and pseudo-terminals share, the likeliest first [bit/s]."""
RANGE_OF_RATES = {"ge": 9_600, "le": 10_500_000}
"""Bounds of the rates of servos and IMU, by their manuals [bit/s]."""
LONGEST_PACKET = 1024
"""Longest packet that a parser waits for [bytes]."""

_POLYNOMIAL = 0x8005
_STUFFED = b"\xff\xff\xfd"


def require_ids(ids: Sequence[int]) -> None:
    """Check the ids of the servos on a bus.

    Raises:
        ConfigurationError: No id is given, one is given twice, or one is impossible.
    """
    are_ids = all(0 <= servo_id <= LARGEST_ID for servo_id in ids)
    if not ids or len(set(ids)) != len(ids) or not are_ids:
        raise ConfigurationError(
            f"ids must be different numbers from 0 to {LARGEST_ID}, got {quote(list(ids))}"
        )


def _crc_of_byte(byte: int) -> int:
    """CRC-16 of one byte."""
    value = byte << 8
    for _ in range(8):
        value = (value << 1) ^ _POLYNOMIAL if value & 0x8000 else value << 1
    return value & 0xFFFF


_CRC_TABLE = [_crc_of_byte(byte) for byte in range(256)]


def crc16(data: bytes, crc: int = 0) -> int:
    """CRC-16 with polynomial 0x8005, initial value zero, not reflected."""
    for byte in data:
        crc = ((crc << 8) & 0xFFFF) ^ _CRC_TABLE[(crc >> 8) ^ byte]
    return crc


def explain_error(error: int) -> str:
    """Text for the error number in a status."""
    return STATUS_ERRORS.get(error, f"error {error}, which the protocol does not have")


def stuff(body: bytes) -> bytes:
    """Add the byte FD after every FF FF FD of instruction and parameters."""
    return body.replace(_STUFFED, _STUFFED + b"\xfd")


def unstuff(body: bytes) -> bytes:
    """Remove the bytes that `stuff` added to instruction and parameters."""
    return body.replace(_STUFFED + b"\xfd", _STUFFED)


def word(value: int) -> bytes:
    """Encode an address or a length as two bytes, the low one first."""
    return value.to_bytes(2, "little")


def packet(servo_id: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Packet as bytes on the wire."""
    body = stuff(bytes([instruction]) + parameters)
    head = HEADER + bytes([servo_id]) + word(len(body) + 2) + body
    return head + word(crc16(head))


def status(servo_id: int, error: int, parameters: bytes = b"") -> bytes:
    """Reply of a servo as bytes on the wire."""
    return packet(servo_id, STATUS, bytes([error]) + parameters)


@dataclass(frozen=True)
class Packet:
    """A received packet without its stuffing."""

    servo_id: int
    instruction: int
    parameters: bytes
    is_intact: bool = True
    """True if the checksum is right; otherwise only the id is usable."""


class Parser:
    """Finds packets in a stream of bytes that may begin anywhere."""

    def __init__(self) -> None:
        self._bytes = bytearray()

    def parse(self, data: bytes) -> list[Packet]:
        """Add received bytes and return the packets that are now complete, in order."""
        self._bytes += data
        return list(iter(self._next, None))

    def _next(self) -> Packet | None:
        while True:
            start = self._bytes.find(HEADER)
            if start < 0:
                del self._bytes[: max(len(self._bytes) - len(HEADER) + 1, 0)]
                return None
            del self._bytes[:start]
            if len(self._bytes) < 7:
                return None
            length = int.from_bytes(self._bytes[5:7], "little")
            if not 3 <= length <= LONGEST_PACKET:
                del self._bytes[: len(HEADER)]
                continue
            raw = bytes(self._bytes[: 7 + length])
            is_whole = len(raw) == 7 + length
            is_intact = is_whole and word(crc16(raw[:-2])) == raw[-2:]
            # stuffed bytes contain no header, but together with the checksum they may: a header
            # before the end means a lost rest only if the packet is not intact
            inner = self._bytes.find(HEADER, len(HEADER))
            if not is_intact and 0 < inner < 7 + length:
                del self._bytes[:inner]
                continue
            if not is_whole:
                return None
            del self._bytes[: 7 + length]
            body = unstuff(raw[7:-2])
            return Packet(raw[4], body[0], body[1:], is_intact)
