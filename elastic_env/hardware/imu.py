"""Attitude of the link from a MicroStrain IMU, read by a separate process.

A stream that stalls is an error.

The maker's library holds Python's lock while it waits. This would delay the control loop, hence the
process. The newest sample is in shared memory with its time. A counter is odd during each write, so
that a reader never mixes two samples.
"""

import math
import mmap
import os
import struct
import subprocess
import time
from contextlib import AbstractContextManager, ExitStack
from dataclasses import astuple, dataclass
from typing import Any, Literal

from elastic_env.hardware.buses.port_lock import lock_port
from elastic_env.hardware.errors import HardwareError
from elastic_env.hardware.safety.guard import is_outside
from elastic_env.hardware.safety.processes import Process, end_child, start_child

Axis = Literal["roll", "pitch", "yaw"]

_RANGE_RAD = {"roll": math.pi, "pitch": math.pi / 2.0, "yaw": math.pi}
_ROUNDING_RAD = 1e-4  # the IMU sends 32 bits
_COUNTER = struct.Struct("=q")
_SAMPLE = struct.Struct("=dddd")
_SIZE = _COUNTER.size + _SAMPLE.size
_TRIES = 100
_READER = "elastic_env.hardware.imu_reader"
_END_S = 2.0
_WAIT_S = 8.0
"""Time to wait for the first sample, with the start of the reader on a busy computer [s]."""


class AttitudeError(HardwareError):
    """The IMU cannot be opened, is silent, or sends implausible angles."""


@dataclass(frozen=True)
class Attitude:
    """One sample: Euler angles [rad], north-east-down, and its time [s, monotonic clock]."""

    time_s: float
    roll: float
    pitch: float
    yaw: float

    def link_angle(self, axis: Axis, sign: int, offset_rad: float) -> float:
        """Link angle sign · (Euler angle − offset) [rad], from −π to π.

        The offset is the Euler angle at q = 0.
        """
        return math.remainder(sign * (getattr(self, axis) - offset_rad), 2.0 * math.pi)


class PlausibleAttitudes:
    """Checks attitudes, one after the other, for values that cannot have been measured.

    An IMU marks the result of its filter as valid, right or not. A filter that has stopped goes on
    sending its last angles. Angles of a working filter should not be equal in all bits: a gyroscope
    of some 0.005 °/s/√Hz changes an angle by about 10 µrad from packet to packet at 100 Hz. A bit
    is at most 0.24 µrad. So three unchanged angles are as old as their first packet, and
    count as missing at the same age as any attitude.

    Args:
        oldest_s: Age at which an attitude counts as missing [s].
    """

    def __init__(self, oldest_s: float) -> None:
        self._oldest_s = oldest_s
        self._first: Attitude | None = None
        """First sample that has the angles of the last one."""

    def check(self, sample: Attitude) -> str:
        """Check the newest sample.

        Returns:
            The problem and its cure; "" if there is none.
        """
        for name, end in _RANGE_RAD.items():
            angle = getattr(sample, name)
            if is_outside(angle, -end - _ROUNDING_RAD, end + _ROUNDING_RAD):
                return (
                    f"sends {name} = {angle:g} rad and calls it valid; it must lie "
                    f"between {-end:.4f} and {end:.4f} rad: switch the IMU off and on, "
                    "and look at the settings of its filter"
                )
        if self._first is None or astuple(sample)[1:] != astuple(self._first)[1:]:
            self._first = sample
        same_s = sample.time_s - self._first.time_s
        if is_outside(same_s, 0.0, self._oldest_s):
            return (
                f"has sent the same attitude in all bits for {1e3 * same_s:.0f} ms, "
                f"{1e3 * self._oldest_s:.0f} ms are allowed (imu_oldest_s): its filter "
                "stands still; switch the IMU off and on"
            )
        return ""


class SharedSample:
    """The newest sample, written by one process and read by another.

    Args:
        descriptor: File of the memory, from `SharedSample.file`.
    """

    def __init__(self, descriptor: int) -> None:
        self._memory = mmap.mmap(descriptor, _SIZE)
        self._last: Attitude | None = None

    @staticmethod
    def file() -> int:
        """Create memory for a sample and return its file descriptor."""
        descriptor = os.memfd_create("attitude")
        os.ftruncate(descriptor, _SIZE)
        return descriptor

    def write(self, sample: Attitude) -> None:
        """Replace the sample."""
        counter = self._counter()
        _COUNTER.pack_into(self._memory, 0, counter + 1)
        _SAMPLE.pack_into(self._memory, _COUNTER.size, *astuple(sample))
        _COUNTER.pack_into(self._memory, 0, counter + 2)

    def get(self) -> Attitude | None:
        """Newest sample; None before the first.

        If a write does not end, because its process died or waits, it is the sample before.
        """
        for _ in range(_TRIES):
            before = self._counter()
            values = _SAMPLE.unpack_from(self._memory, _COUNTER.size)
            # packing a counter clears it first: a zero is no valid count
            if before and before % 2 == 0 and before == self._counter():
                self._last = Attitude(*values)
                break
        return self._last

    def _counter(self) -> int:
        return _COUNTER.unpack_from(self._memory)[0]


class AttitudeStream(AbstractContextManager["AttitudeStream"]):
    """Reads an IMU that streams its filter's Euler angles (MIP set 0x82, field 0x05).

    Args:
        port: Device, such as /dev/ttyACM0.
        baudrate: Bits per second.
        oldest_s: Age at which a sample counts as missing [s].

    Raises:
        PortError: The port does not exist, cannot be opened, or another program uses it.
        AttitudeError: No attitude comes.
    """

    def __init__(self, port: str, baudrate: int = 115200, oldest_s: float = 0.05) -> None:
        self.port = port
        self._oldest_s = oldest_s
        self._plausible = PlausibleAttitudes(oldest_s)
        self._resources = ExitStack()
        self._resources.callback(os.close, lock_port(port))
        self._process: Process | None = None
        try:
            self._process = self._start(baudrate)
            self._resources.callback(end_child, self._process, _END_S)
            deadline = time.monotonic() + _WAIT_S
            while self._shared.get() is None:
                if self._process.poll() is not None or time.monotonic() > deadline:
                    raise self._silence()
                time.sleep(0.01)
        except BaseException:
            self.close()
            raise

    def latest(self) -> Attitude:
        """Newest sample.

        Raises:
            AttitudeError: It is too old, because the stream has stopped, or it is implausible.
        """
        sample = self._shared.get()
        age_s = math.inf if sample is None else time.monotonic() - sample.time_s
        if sample is None or is_outside(age_s, 0.0, self._oldest_s):
            raise self._silence(sample)
        problem = self._plausible.check(sample)
        if problem:
            raise AttitudeError(f"the IMU at {self.port} {problem}")
        return sample

    def close(self) -> None:
        """End the reader and release the port; a second call does nothing."""
        self._process = None
        self._resources.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _start(self, baudrate: int) -> Process:
        """Map the shared memory, then start the reader."""
        file = SharedSample.file()
        try:
            self._shared = SharedSample(file)
            pipes: Any = dict.fromkeys(("stdin", "stderr"), subprocess.PIPE)
            arguments = (str(file), self.port, str(baudrate))
            return start_child(_READER, *arguments, pass_fds=[file], **pipes)
        finally:
            os.close(file)

    def _silence(self, last: Attitude | None = None) -> AttitudeError:
        """Error of a stream that is silent after a last sample, or from the beginning."""
        process = self._process
        if process is None:
            return AttitudeError(f"the IMU at {self.port} is closed")
        if process.poll() is not None and process.stderr is not None:
            lines = process.stderr.read().strip().splitlines() or ["its reader ended"]
            return AttitudeError(f"the IMU at {self.port} cannot be read: {lines[-1]}")
        if last is None:
            return AttitudeError(
                f"the IMU at {self.port} sends no attitude; it must stream its filter's Euler "
                "angles (set 0x82, field 0x05) at 100 Hz or more, at this baud rate"
            )
        return AttitudeError(
            f"the IMU at {self.port} has sent no attitude for "
            f"{1e3 * (time.monotonic() - last.time_s):.0f} ms, {1e3 * self._oldest_s:.0f} ms are "
            "allowed (imu_oldest_s); look at its cable and its data rate"
        )
