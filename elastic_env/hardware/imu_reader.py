"""Process that reads the IMU by the maker's library, pymscl, whose module is called mscl."""

import os
import select
import sys
import time
from typing import Any

from elastic_env.core.errors import missing_extra
from elastic_env.hardware.imu import Attitude, SharedSample
from elastic_env.hardware.safety.realtime import Priority, prefer_realtime

_CHANNELS = ("estRoll", "estPitch", "estYaw")
_WAIT_MS = 20
_STALE_S = 0.1
"""Time after the start in which samples may still come from the port's buffer [s]."""


def read_attitudes(shared: SharedSample, port: str, baudrate: int) -> None:
    """Write every valid attitude into shared memory until the input is closed.

    Samples that were in the port's buffer before have no known age and are dropped. The library
    itself drops damaged packets.
    """
    try:
        import mscl
    except ModuleNotFoundError:
        raise missing_extra("pymscl", "hardware", "reading the IMU") from None
    # the library reads in a thread
    prefer_realtime(Priority.IMU_READER, with_threads=True)
    connection = mscl.Connection.Serial(port, baudrate)
    node = mscl.InertialNode(connection)
    begin = time.monotonic()
    while not select.select([sys.stdin], [], [], 0.0)[0]:
        for packet in node.getDataPackets(_WAIT_MS):
            sample = _attitude(packet)
            if sample is not None and sample.time_s > begin + _STALE_S:
                shared.write(sample)
    connection.disconnect()


def _attitude(packet: Any) -> Attitude | None:
    """Attitude in a packet; None if it contains no valid one."""
    points = {point.channelName(): point for point in packet.data()}
    if not all(name in points and points[name].valid() for name in _CHANNELS):
        return None
    age_s = time.time() - packet.collectedTimestamp().nanoseconds() * 1e-9
    roll, pitch, yaw = (points[name].as_float() for name in _CHANNELS)
    return Attitude(time.monotonic() - max(age_s, 0.0), roll, pitch, yaw)


if __name__ == "__main__":
    try:
        read_attitudes(SharedSample(int(sys.argv[1])), sys.argv[2], int(sys.argv[3]))
    except Exception as error:
        print(error, file=sys.stderr)
        sys.stderr.flush()
        os._exit(1)
    os._exit(0)
