"""The link's attitude from a MicroStrain IMU, read by a process of its own; a stream that stalls is an error.

The maker's library keeps Python's lock while it waits, which would hold the control loop up, hence the process. The
newest sample lies in shared memory with its time; a counter around each write, odd while it lasts, keeps halves of two
samples apart.
"""

import math
import mmap
import os
import struct
import subprocess
import time
from contextlib import AbstractContextManager

from elastic_env.hardware.errors import HardwareError
from elastic_env.hardware.imu.attitude_sample import Attitude, Axis, PlausibleAttitudes
from elastic_env.hardware.safety.bounds import is_outside
from elastic_env.hardware.safety.child_process import child_command, child_environment
from elastic_env.hardware.servo_bus.port_lock import lock_port

_COUNTER = struct.Struct("=q")
_SAMPLE = struct.Struct("=dddd")
_SIZE = _COUNTER.size + _SAMPLE.size
_TRIES = 100


class AttitudeError(HardwareError):
    """The IMU cannot be opened, sends nothing or what it cannot have measured, or has stopped sending."""


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
        """New memory for a sample."""
        descriptor = os.memfd_create("attitude")
        os.ftruncate(descriptor, _SIZE)
        return descriptor

    def put(self, sample: Attitude) -> None:
        """Replace the sample."""
        (counter,) = _COUNTER.unpack_from(self._memory)
        _COUNTER.pack_into(self._memory, 0, counter + 1)
        _SAMPLE.pack_into(self._memory, _COUNTER.size, sample.time_s, sample.roll, sample.pitch, sample.yaw)
        _COUNTER.pack_into(self._memory, 0, counter + 2)

    def get(self) -> Attitude | None:
        """The newest sample; None before the first.

        Where a write does not come to its end, because its process died or waits, it is the one before.
        """
        for _ in range(_TRIES):
            (before,) = _COUNTER.unpack_from(self._memory)
            values = _SAMPLE.unpack_from(self._memory, _COUNTER.size)
            (after,) = _COUNTER.unpack_from(self._memory)
            if before == after and before % 2 == 0:
                self._last = Attitude(*values) if before else None
                break
        return self._last


class AttitudeStream(AbstractContextManager["AttitudeStream"]):
    """Reads an IMU that streams its filter's Euler angles (MIP set 0x82, field 0x05).

    Args:
        port: Device, such as /dev/ttyACM0.
        baudrate: Bits per second.
        oldest_s: Age at which a sample counts as missing [s].
        wait_s: How long to wait for the first one, with the start of the reader on a busy computer [s].

    Raises:
        PortError: There is no such port, it may not be opened, or another program has it.
        AttitudeError: Nothing comes that is an attitude.
    """

    def __init__(self, port: str, baudrate: int = 115_200, oldest_s: float = 0.05, wait_s: float = 8.0) -> None:
        self.port, self._oldest_s = port, oldest_s
        self._plausible = PlausibleAttitudes(oldest_s)
        self._lock: int | None = lock_port(port)
        self._process: subprocess.Popen[str] | None = None
        try:
            self._shared = self._begin(port, baudrate)
            deadline = time.monotonic() + wait_s
            while self._shared.get() is None:
                if self._has_ended or time.monotonic() > deadline:
                    raise self._silent()
                time.sleep(0.01)
        except BaseException:
            self.close()
            raise

    def _begin(self, port: str, baudrate: int) -> SharedSample:
        """Start the reader."""
        file = SharedSample.file()
        try:
            self._process = subprocess.Popen(
                child_command("elastic_env.hardware.imu.attitude_reader", str(file), port, str(baudrate)),
                env=child_environment(), pass_fds=[file], stdin=subprocess.PIPE, stderr=subprocess.PIPE,
                text=True, start_new_session=True,
            )  # fmt: skip
            return SharedSample(file)
        finally:
            os.close(file)

    @property
    def _has_ended(self) -> bool:
        return self._process is None or self._process.poll() is not None

    def latest(self) -> Attitude:
        """The newest sample.

        Raises:
            AttitudeError: It is too old: the stream has stopped. Or no IMU that works can have measured it.
        """
        sample = self._shared.get()
        if sample is None or is_outside(time.monotonic() - sample.time_s, 0.0, self._oldest_s):
            raise self._silent(sample)
        if problem := self._plausible.problem(sample):
            raise AttitudeError(f"the IMU at {self.port} {problem}")
        return sample

    def close(self) -> None:
        """End the reader, and give the port back; a second time does nothing."""
        process, self._process = self._process, None
        lock, self._lock = self._lock, None
        try:
            if process is not None:
                _end(process)
        finally:
            if lock is not None:
                os.close(lock)

    def __exit__(self, *_: object) -> None:
        self.close()

    def _silent(self, last: Attitude | None = None) -> AttitudeError:
        process = self._process
        if process is None:
            return AttitudeError(f"the IMU at {self.port} is closed")
        if process.poll() is not None and process.stderr is not None:
            said = process.stderr.read().strip().splitlines()
            return AttitudeError(f"the IMU at {self.port} cannot be read: {said[-1] if said else 'its reader ended'}")
        if last is None:
            return AttitudeError(
                f"the IMU at {self.port} sends no attitude; it must stream its filter's Euler angles (set 0x82, field "
                "0x05) at 100 Hz or more, at this baud rate"
            )
        return AttitudeError(
            f"the IMU at {self.port} has sent no attitude for {1e3 * (time.monotonic() - last.time_s):.0f} ms, "
            f"{1e3 * self._oldest_s:.0f} ms are allowed (imu_oldest_s); look at its cable and its data rate"
        )


def _end(process: "subprocess.Popen[str]") -> None:
    """End a reader: it stops when its input is closed."""
    for pipe in (process.stdin, process.stderr):
        if pipe is not None:
            pipe.close()
    try:
        process.wait(timeout=2.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def link_angle(sample: Attitude, axis: Axis, sign: int, offset_rad: float) -> float:
    """Link angle [rad], from −π to π: sign · (Euler angle − offset), the offset being what the IMU shows at q = 0."""
    angle = sign * (getattr(sample, axis) - offset_rad)
    return math.remainder(angle, 2.0 * math.pi)
