"""Real-time scheduling of processes, and the clock of a control loop."""

import contextlib
import gc
import os
import time
from enum import IntEnum

from elastic_env.hardware.clock import Clock
from elastic_env.hardware.safety.guard import exceeds

LONGEST_WAIT_S = 0.02
"""Longest time from the request of a control cycle to its reading [s]."""


class Priority(IntEnum):
    """Order of the processes: those that end a motion run before those that move, however busy."""

    LOOP = 5
    IMU_READER = 10
    SUPERVISOR = 15
    EMULATOR = 20


def prefer_realtime(priority: Priority, *, with_threads: bool = False) -> bool:
    """Request real-time scheduling of this thread; a program needs a permission, see docs.

    Objects that exist now are left out of garbage collections: a full collection takes ten control
    periods.

    Args:
        priority: Priority among the processes of a motion.
        with_threads: True to schedule threads and programs that it starts later in the same way;
            else they run as usual.

    Returns:
        True if the system grants it.
    """
    gc.collect()
    gc.freeze()
    with contextlib.suppress(OSError, AttributeError):
        policy = os.SCHED_FIFO | (0 if with_threads else os.SCHED_RESET_ON_FORK)
        os.sched_setscheduler(0, policy, os.sched_param(priority))
        return True
    return False


def schedule_like(thread_id: int) -> None:
    """Schedule this thread like another one of this program.

    Args:
        thread_id: Native id of the other thread.
    """
    with contextlib.suppress(OSError, AttributeError):
        policy = os.sched_getscheduler(thread_id)
        os.sched_setscheduler(0, policy, os.sched_getparam(thread_id))


def give_up_realtime() -> None:
    """Return to the usual scheduling, and to full garbage collections."""
    gc.unfreeze()
    # clearing the flag needs special rights
    with contextlib.suppress(OSError, AttributeError):
        policy = os.SCHED_OTHER | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(0))


def sleep_until(moment_s: float, clock: Clock = time) -> None:
    """Wait for a moment of the monotonic clock."""
    remaining = moment_s - clock.monotonic()
    if remaining > 0.0:
        clock.sleep(remaining)


class Pace:
    """Moments at which a control loop reads, one period after the other.

    The loop catches up with small delays. An overrun is a period whose command or reading is more
    than half a period late. A new period begins there, so that one hold-up counts once and the next
    period has its whole time.

    Args:
        period_s: Time between readings [s].
        clock: Clock of the loop; default the system's.
    """

    def __init__(self, period_s: float, clock: Clock = time) -> None:
        self._period_s = period_s
        self._clock = clock
        self.restart()

    def restart(self) -> None:
        """Begin a period now."""
        self._due_s = self._clock.monotonic()
        self._lost_s = 0.0

    def next(self) -> float:
        """Moment to read for a command that is ready now, not before now [s, monotonic clock]."""
        now = self._clock.monotonic()
        self._due_s += self._period_s
        self._lost_s = now - self._due_s
        if not self.is_overrun(self._lost_s):
            self._lost_s = 0.0
            return max(self._due_s, now)
        self._due_s = now + self._period_s
        return self._due_s

    def late(self, moment_s: float) -> float:
        """Delay of the last period's command and reading [s].

        Args:
            moment_s: Moment of the reading [s, monotonic clock].
        """
        late_s = moment_s - self._due_s
        if self.is_overrun(late_s):
            self._due_s = moment_s
        return self._lost_s + late_s

    def is_overrun(self, late_s: float) -> bool:
        """Return True if a period with such a delay counts as lost."""
        return bool(exceeds(late_s, 0.5 * self._period_s))
