"""Faults of an emulated bus, by switch: for trying out what a program does about them."""

from typing import Any

import numpy as np

from elastic_env.core.config import Model, quantity

_SHARE: dict[str, Any] = {"ge": 0, "le": 1}


class Faults(Model):
    """Faults of an emulated bus; all of them off by default.

    Shares are drawn per reply, or per instruction.
    """

    unheard: float = quantity("1", 0.0, **_SHARE)
    """Share of instructions that reach no servo [1]."""
    lost: float = quantity("1", 0.0, **_SHARE)
    """Share of replies that do not come [1]."""
    late: float = quantity("1", 0.0, **_SHARE)
    """Share of replies that come late [1]."""
    late_s: float = quantity("s", 0.006, ge=0, le=1)
    """How late [s]."""
    corrupted: float = quantity("1", 0.0, **_SHARE)
    """Share of replies with a flipped bit [1]."""
    truncated: float = quantity("1", 0.0, **_SHARE)
    """Share of replies that end too early [1]."""
    latency_s: float = quantity("s", 0.0, ge=0, le=1)
    """Delay of every reply: the adapter's latency timer [s]."""
    overload: bool = False
    """The servos report an overload and let go."""
    hot: bool = False
    """The servos are at 95 °C, and report no error."""
    silent: bool = False
    """The servos hear but do not answer."""
    unplugged: bool = False
    """The port is gone."""
    imu_silent: bool = False
    """The IMU sends nothing."""
    imu_late_s: float = quantity("s", 0.0, ge=0, le=1)
    """Delay of the IMU's packets [s]."""
    imu_nan: bool = False
    """The IMU sends nan for the roll, as valid."""
    imu_inf: bool = False
    """The IMU sends an infinite roll, as valid."""
    imu_out_of_range: bool = False
    """The IMU sends a roll that no angle has, as valid."""
    imu_frozen: bool = False
    """The IMU's packets go on, with the angles of the last one before."""
    imu_corrupted: float = quantity("1", 0.0, **_SHARE)
    """Share of IMU packets with a flipped bit [1]."""


def damage(faults: Faults, reply: bytes, generator: Any) -> tuple[bytes, float]:
    """A reply as the line delivers it: its bytes, none if it is lost, and its delay [s]."""
    delay = faults.latency_s
    chance = generator.random(4)
    if faults.silent or chance[0] < faults.lost:
        return b"", 0.0
    if chance[1] < faults.late:
        delay += faults.late_s
    if chance[2] < faults.corrupted:
        reply = flip_bit(reply, generator)
    if chance[3] < faults.truncated:
        reply = reply[: int(generator.integers(1, len(reply)))]
    return reply, delay


def flip_bit(data: bytes, generator: np.random.Generator) -> bytes:
    """The same bytes with one bit inverted."""
    changed = bytearray(data)
    bit = int(generator.integers(8 * len(data)))
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)
