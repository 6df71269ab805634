"""Attitude packets of a MicroStrain IMU: MIP protocol, estimation filter set.

    75 65  set  length  [field length  field  data ...] ...  checksum (2)

Numbers are big endian; the checksum is Fletcher's, both sums modulo 256 (as the maker's SDK has it).
"""

import struct

FILTER_SET = 0x82
EULER_ANGLES, GPS_TIME = 0x05, 0x11
_VALID = 1


def checksum(data: bytes) -> bytes:
    """Fletcher's checksum of everything before it."""
    first = second = 0
    for byte in data:
        first = (first + byte) & 0xFF
        second = (second + first) & 0xFF
    return bytes([first, second])


def attitude_packet(roll: float, pitch: float, yaw: float, time_s: float) -> bytes:
    """Euler angles [rad] with the device's time [s]."""
    fields = _field(EULER_ANGLES, struct.pack(">fffH", roll, pitch, yaw, _VALID))
    fields += _field(GPS_TIME, struct.pack(">dHH", time_s, 0, _VALID))
    sent = bytes([0x75, 0x65, FILTER_SET, len(fields)]) + fields
    return sent + checksum(sent)


def _field(descriptor: int, data: bytes) -> bytes:
    return bytes([len(data) + 2, descriptor]) + data
