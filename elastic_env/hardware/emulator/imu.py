"""Emulated MicroStrain IMU: attitudes of the link as packets of the MIP protocol.

    75 65  set  length  [field length  field  data ...] ...  checksum (2)

Numbers are big endian; the checksum is Fletcher's, both sums modulo 256, as in the maker's SDK.
"""

import math
import struct
from collections import deque

import numpy as np

from elastic_env.hardware.emulator.launch import EmulatorConfig, Faults, flip_bit
from elastic_env.world.sensors import attitude

Angles = tuple[float, float, float]
"""Roll, pitch and yaw [rad]."""

_FILTER_SET = 0x82
_EULER_ANGLES = 0x05
_GPS_TIME = 0x11
_VALID = 1
_WOBBLE_RAD = 1e-5
_IMPOSSIBLE_ANGLE = 8.0


class EmulatedImu:
    """Measures the link angle at its rate, and keeps the packets until they are due.

    Args:
        config: Rate, seed, and through the scenario of the testbed the quality.
        start_s: Time of the clock at the start [s].
    """

    def __init__(self, config: EmulatorConfig, start_s: float) -> None:
        self._quality = config.testbed.scenario.imu
        self._period_s = 1.0 / config.imu_rate_hz
        self._generator = np.random.default_rng([config.seed, 1])
        self._wobble = np.random.default_rng([config.seed, 3])
        self._start_s = start_s
        self._measured_next_s = start_s
        self._angles: Angles = (0.0, 0.0, 0.0)
        self._packets: deque[tuple[float, bytes]] = deque()

    @property
    def next_s(self) -> float:
        """Time of its next measurement or packet [s]."""
        due_s = self._packets[0][0] if self._packets else math.inf
        return min(self._measured_next_s, due_s)

    def measure(self, q: float, now: float, faults: Faults) -> None:
        """Measure the link angle [rad], if a measurement is due."""
        if now < self._measured_next_s:
            return
        self._measured_next_s = max(self._measured_next_s + self._period_s, now)
        if faults.imu_silent:
            return
        noise = self._generator.standard_normal(1)
        roll = attitude(self._quality, np.array([q]), np.zeros(1), noise)
        # a real IMU should never send the same three angles twice; the quality of the roll is that
        # of the scenario
        pitch, yaw = _WOBBLE_RAD * self._wobble.standard_normal(2)
        turn = math.remainder(float(roll[0]), 2.0 * math.pi)
        angles = (turn, float(pitch), float(yaw))
        self._angles = distort(faults, angles, self._angles)
        packet = attitude_packet(*self._angles, now - self._start_s)
        if self._generator.random() < faults.imu_corrupted:
            packet = flip_bit(packet, self._generator)
        self._packets.append((now + faults.imu_late_s, packet))

    def pop_due(self, now: float) -> bytes:
        """Remove and return the packets that are due."""
        due = b""
        while self._packets and self._packets[0][0] <= now:
            due += self._packets.popleft()[1]
        return due


def distort(faults: Faults, angles: Angles, last: Angles) -> Angles:
    """Angles that a faulty IMU sends.

    Args:
        faults: Faults of the IMU.
        angles: Measured angles.
        last: Angles in the previous packet.
    """
    if faults.imu_frozen:
        return last
    roll, pitch, yaw = angles
    if faults.imu_out_of_range:
        roll = _IMPOSSIBLE_ANGLE
    if faults.imu_inf:
        roll = math.inf
    if faults.imu_nan:
        roll = math.nan
    return roll, pitch, yaw


def checksum(data: bytes) -> bytes:
    """Fletcher's checksum of bytes."""
    first = second = 0
    for byte in data:
        first = (first + byte) & 0xFF
        second = (second + first) & 0xFF
    return bytes([first, second])


def attitude_packet(roll: float, pitch: float, yaw: float, time_s: float) -> bytes:
    """Packet with Euler angles [rad] and the device's time [s]."""
    fields = _field(_EULER_ANGLES, struct.pack(">fffH", roll, pitch, yaw, _VALID))
    fields += _field(_GPS_TIME, struct.pack(">dHH", time_s, 0, _VALID))
    packet = bytes([0x75, 0x65, _FILTER_SET, len(fields)]) + fields
    return packet + checksum(packet)


def _field(descriptor: int, data: bytes) -> bytes:
    """Field of a packet, with its length and descriptor."""
    return bytes([len(data) + 2, descriptor]) + data
