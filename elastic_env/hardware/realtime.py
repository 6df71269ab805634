"""Processes that must not wait for others, and the time they keep."""

import contextlib
import gc
import os
import time

_PRIORITY = 20


def prefer_realtime() -> bool:
    """Ask for real-time scheduling of this process; whether the system grants it (it needs the right to, see docs).

    What is in memory now is left out of garbage collections: one that looks at all of it takes ten control periods.
    """
    gc.collect()
    gc.freeze()
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
        return True
    return False


def give_up_realtime() -> None:
    """Back to the scheduling of all others, and to collections of everything."""
    gc.unfreeze()
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def sleep_until(moment_s: float) -> None:
    """Wait for a moment of the monotonic clock."""
    remaining = moment_s - time.monotonic()
    if remaining > 0.0:
        time.sleep(remaining)
