"""Who gets the processor first, on an emulated bus; true also where the system grants nobody
real-time scheduling."""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from elastic_env.hardware.emulator.launch import RunningEmulator
from elastic_env.hardware.errors import FaultError
from elastic_env.hardware.safety.realtime import Pace, Priority, give_up_realtime, prefer_realtime
from elastic_env.hardware.safety.supervised_bus import SupervisedBus
from elastic_env.hardware.settings import SafetyLimits
from tests.busy import once_more

BUSY_S = 0.5
BUSY_PROGRAM = f"""
import sys, time
from elastic_env.hardware.safety.realtime import Priority, prefer_realtime
prefer_realtime(Priority.LOOP)
print("ready", flush=True)
end = float(sys.stdin.readline()) + {BUSY_S}
while time.monotonic() < end:
    pass
"""

pytestmark = once_more


@pytest.fixture
def one_core() -> Iterator[None]:
    """This program, and all that it starts, on one core."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(cores)})
    yield
    os.sched_setaffinity(0, cores)


@pytest.fixture
def in_realtime() -> Iterator[None]:
    """This program as a control loop is."""
    prefer_realtime(Priority.LOOP)
    yield
    give_up_realtime()


@pytest.mark.slow  # on every commit: the priority that the supervisor has asked for
@pytest.mark.usefixtures("one_core")
def test_a_program_that_keeps_the_processor_busy_does_not_keep_torque_on() -> None:
    """Catches a supervisor that waits in a line with the program whose hang it is to end."""
    busy = subprocess.Popen(
        [sys.executable, "-c", BUSY_PROGRAM],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert busy.stdin is not None
    assert busy.stdout is not None
    try:
        with RunningEmulator() as emulator, SupervisedBus({emulator.port: [1]}) as bus:
            busy.stdout.readline()
            start = bus.enable(SafetyLimits(patience_cycles=10))
            last = time.monotonic()
            bus.exchange(start, last)
            before = _in_line_s(bus.process_id)
            busy.stdin.write(f"{last}\n")
            busy.stdin.flush()
            time.sleep(BUSY_S)
            with pytest.raises(FaultError, match="hangs"):
                bus.exchange(start, time.monotonic())
            in_line = _in_line_s(bus.process_id) - before
    finally:
        busy.kill()
        busy.communicate()
    # not when the servo loses its torque: the kernel carries bytes between pseudo-terminals in its
    # turn with all other
    # programs, so that the 100 ms asked for are held to by `python -m tests.hardware_trials`
    assert in_line < BUSY_S / 2


def _in_line_s(process_id: int) -> float:
    """How long a process has been ready to run and did not run [s]."""
    return 1e-9 * int(Path(f"/proc/{process_id}/schedstat").read_text().split()[1])


@pytest.mark.usefixtures("in_realtime")
def test_what_a_control_loop_starts_runs_as_all_others_do() -> None:
    """Catches a plot, a video or an IMU's library that is loaded in the place of a control
    cycle."""
    child = subprocess.run(
        [sys.executable, "-c", "import os; print(os.sched_getscheduler(0))"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert int(child.stdout) == os.SCHED_OTHER


@pytest.mark.usefixtures("in_realtime")
@pytest.mark.slow
def test_goals_are_kept_as_urgently_as_the_loop_commands_them() -> None:
    """Catches a thread of the loop that a busy computer takes for a hang."""
    with RunningEmulator() as emulator, SupervisedBus({emulator.port: [1]}) as bus:
        start = bus.enable(SafetyLimits(patience_cycles=10, hang_s=0.09))
        bus.keep(start)
        (keeper,) = (thread for thread in threading.enumerate() if "_keep" in thread.name)
        time.sleep(0.05)
        assert keeper.native_id is not None
        found = (
            os.sched_getscheduler(keeper.native_id),
            os.sched_getparam(keeper.native_id).sched_priority,
        )
        bus.exchange(np.array(start), time.monotonic())
    assert found == (os.sched_getscheduler(0), os.sched_getparam(0).sched_priority)


class Clock:
    """In the place of the module `time`: stands until it is set."""

    now_s = 0.0

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float, /) -> None:
        self.now_s += seconds


@pytest.fixture
def clock() -> Clock:
    return Clock()


def paced(clock: Clock, pace: Pace, before_s: float, reading_s: float) -> tuple[float, float]:
    """A cycle of a loop that needs a while for its command and whose reading waits: when it
    read, how late that was."""
    clock.now_s += before_s
    clock.now_s = max(clock.now_s, pace.next()) + reading_s
    return clock.now_s, pace.late(clock.now_s)


def test_a_loop_that_keeps_up_reads_on_the_grid(clock: Clock) -> None:
    """Catches readings whose small delays add up: the loop would run below its rate."""
    pace = Pace(0.004, clock)
    moments, lateness = np.transpose(
        [paced(clock, pace, 0.002, 1e-4 * (number % 3)) for number in range(30)]
    )
    delays = 1e-4 * (np.arange(30) % 3)
    assert moments == pytest.approx(0.004 * np.arange(1, 31) + delays, abs=1e-12)
    assert lateness == pytest.approx(delays, abs=1e-12)


@pytest.mark.parametrize("is_command", [True, False])
def test_a_short_delay_is_caught_up_with_and_no_overrun(clock: Clock, is_command: bool) -> None:
    pace = Pace(0.004, clock)
    delay = (0.0055, 0.0) if is_command else (0.002, 0.0015)
    _, first = paced(clock, pace, *delay)
    moment, second = paced(clock, pace, 0.002, 0.0)
    assert (first, second) == pytest.approx((0.0015, 0.0), abs=1e-12)
    assert not pace.is_overrun(first)
    assert moment == pytest.approx(0.008)


@pytest.mark.parametrize("is_command", [True, False])
def test_one_hold_up_is_one_overrun_and_a_whole_period_follows(
    clock: Clock, is_command: bool
) -> None:
    """Catches a hold-up that counts twice, and a command that has no time to act before the
    reading after it."""
    pace = Pace(0.004, clock)
    delay = (0.0075, 0.0) if is_command else (0.002, 0.0035)
    (moment, late_s), *after = [
        paced(clock, pace, *delay),
        *(paced(clock, pace, 0.0035, 0.0) for _ in range(3)),
    ]
    assert late_s == pytest.approx(0.0035)
    assert pace.is_overrun(late_s)
    assert moment == pytest.approx(0.0115 if is_command else 0.0075)
    assert [at for at, _ in after] == pytest.approx(
        [moment + 0.004 * number for number in (1, 2, 3)]
    )
    assert [late for _, late in after] == pytest.approx([0.0] * 3, abs=1e-12)


def test_a_loop_that_is_always_too_slow_cannot_hide_it(clock: Clock) -> None:
    """Catches a grid that moves along with every small delay: 4.9 ms for each 4 ms, and never an
    overrun."""
    pace = Pace(0.004, clock)
    overruns = sum(pace.is_overrun(paced(clock, pace, 0.0049, 0.0)[1]) for _ in range(300))
    assert overruns == pytest.approx(100, abs=1)
