"""One attitude of the link, and which ones no IMU that works can send."""

from dataclasses import dataclass
from math import pi
from typing import Literal

from elastic_env.hardware.safety.bounds import is_outside

Axis = Literal["roll", "pitch", "yaw"]

_ENDS: dict[Axis, float] = {"roll": pi, "pitch": pi / 2.0, "yaw": pi}
_ROUNDING_RAD = 1e-4  # the IMU sends 32 bits


@dataclass(frozen=True)
class Attitude:
    """One sample: Euler angles of the maker's north-east-down convention [rad], and when it came in [s, monotonic]."""

    time_s: float
    roll: float
    pitch: float
    yaw: float


class PlausibleAttitudes:
    """Looks at the attitudes that come, one after the other, for what cannot have been measured.

    An IMU marks as valid what its filter has computed, right or not. A filter that stands still goes on sending its
    last angles. Those of a working one should not be equal in all bits: a gyroscope of some 0.005 °/s/√Hz turns an
    angle by about 10 µrad from packet to packet at 100 Hz, and a bit is at most 0.24 µrad. So three angles that stay
    the same are no newer than when they first came, and have the age at which any attitude counts as missing.

    Args:
        oldest_s: Age at which an attitude counts as missing [s].
    """

    def __init__(self, oldest_s: float) -> None:
        self._oldest_s = oldest_s
        self._first: Attitude | None = None  # of those with the angles of the last one

    def problem(self, sample: Attitude) -> str:
        """What is wrong with a sample, the newest so far, and what to look at; "" if nothing."""
        for name, end in _ENDS.items():
            angle = getattr(sample, name)
            if is_outside(angle, -end - _ROUNDING_RAD, end + _ROUNDING_RAD):
                return (
                    f"sends {name} = {angle:g} rad and calls it valid; it must lie between {-end:.4f} and {end:.4f} "
                    "rad: switch the IMU off and on, and look at the settings of its filter"
                )
        if self._first is None or _angles(sample) != _angles(self._first):
            self._first = sample
        same_s = sample.time_s - self._first.time_s
        if is_outside(same_s, 0.0, self._oldest_s):
            return (
                f"has sent the same attitude in all bits for {1e3 * same_s:.0f} ms, {1e3 * self._oldest_s:.0f} ms are "
                "allowed (imu_oldest_s): its filter stands still; switch the IMU off and on"
            )
        return ""


def _angles(sample: Attitude) -> tuple[float, float, float]:
    return sample.roll, sample.pitch, sample.yaw
