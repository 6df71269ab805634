"""Emulated servos between two tests, and what stops beside them."""

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import numpy as np

from elastic_env.hardware.buses.dynamixel_bus import DynamixelBus
from elastic_env.hardware.emulator.launch import RunningEmulator
from elastic_env.hardware.errors import PortError

_LONGEST_SWING_S = 10.0
_REST_RAD_S = 0.02
_LOOK_S = 0.05
_STILL_LOOKS = 3
"""Where a swing turns back it stands still for one look."""


def wait_until_rest(emulator: RunningEmulator) -> None:
    """Wait until joints that were let go have swung out: torque goes on at rest only."""
    deadline = time.monotonic() + _LONGEST_SWING_S
    before = emulator.state()
    still_looks = 0
    while still_looks < _STILL_LOOKS:
        assert time.monotonic() < deadline, "the emulated joints still swing; is torque off?"
        time.sleep(_LOOK_S)
        now = emulator.state()
        moved = np.abs(np.subtract(now["theta"], before["theta"])).max()
        is_still = moved < _REST_RAD_S * (now["time_s"] - before["time_s"])
        still_looks = still_looks + 1 if is_still else 0
        before = now


def wait_until_free(port: str) -> None:
    """Wait until the supervisor of a program that has ended has given the port back."""
    deadline = time.monotonic() + 5.0
    while time.monotonic() < deadline:
        with suppress(PortError), DynamixelBus(port):
            return
        time.sleep(0.005)


@contextmanager
def stopped(process_id: int) -> Iterator[None]:
    """Within, a process hangs; not for longer than a test may wait."""
    os.kill(process_id, signal.SIGSTOP)
    awake = threading.Timer(10.0, os.kill, (process_id, signal.SIGCONT))
    awake.start()
    try:
        yield
    finally:
        awake.cancel()
