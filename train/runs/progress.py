"""Progress of long work: bars on a terminal, a line from time to time in a log."""

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress

from rich import progress
from rich.console import Console

from train.runs.console import can_redraw

_LINE_INTERVAL_S = 10.0
"""Shortest time between two lines in a log [s]; shorter work prints no line."""
_ESTIMATE_AFTER_S = 3.0
"""Time after which the remaining time of long work is estimated [s]."""
_LONG_WORK_S = 30.0
"""Remaining time above which work is long, and the estimate is printed [s]."""

_COMPILER = logging.getLogger("elastic_env.core.compiled")

Show = Callable[..., None]
"""Takes the number of a task, its amount of finished work, and a note, such as the number of
running calls.
"""


def plain_progress(
    console: Console, interval_s: float = 0.0, unit: str = "work"
) -> Callable[..., None]:
    """Return a function that takes a share of the work, 0 to 1, and a note, and prints each tenth.

    The remaining time of long work is printed early. A line with a note also has the remaining
    time.

    It serves logs, control loops and timed work; the thread of a bar would delay the last two.

    Args:
        console: Console for the lines.
        interval_s: Shortest time between two lines, and before the first one [s].
        unit: Unit of the work, such as control steps. Lines with a note name it, since the note
            counts something else.
    """
    printed_tenths = 0
    printed_s = time.monotonic()
    first: tuple[float, float] | None = None  # processes need time to start
    is_estimated = False

    def show(share: float, note: str = "") -> None:
        nonlocal printed_tenths, printed_s, first, is_estimated
        if share <= 0.0:
            return
        first = first or (time.monotonic(), share)
        elapsed_s = time.monotonic() - first[0]
        done = share - first[1]
        remaining_s = elapsed_s * (1.0 - share) / done if done > 0.0 else 0.0
        if not is_estimated and done > 0.0 and elapsed_s > _ESTIMATE_AFTER_S:
            is_estimated = True
            if remaining_s > _LONG_WORK_S:
                console.print(f"  about {duration(remaining_s)} to go")
        tenths = int(10 * share)
        if tenths > printed_tenths and time.monotonic() - printed_s >= interval_s:
            printed_tenths = tenths
            printed_s = time.monotonic()
            details = f" of the {unit}, about {duration(remaining_s)} to go; {note}"
            console.print(f"  {10 * tenths} %{details if note else ''}")

    return show


def duration(seconds: float) -> str:
    """Return a rounded time in words: 40 s, 3 min, 2 h."""
    for unit, size in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 1.5 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{10.0 * round(seconds / 10.0):.0f} s"


@contextmanager
def show_progress(
    console: Console, totals: Mapping[str, int], transient: bool = False, unit: str = "work"
) -> Iterator[Show]:
    """Show the progress of tasks: a bar for each on a terminal, else a line from time to time.

    Args:
        console: Console for bars or lines.
        totals: Amount of work of every task, by its name.
        transient: Remove the bars at the end.
        unit: Unit of the work, see `plain_progress`.

    Yields:
        A function that takes the number of a task, its amount of finished work, and a note.
    """
    if not can_redraw(console):
        show = plain_progress(console, _LINE_INTERVAL_S, unit)
        done = [0] * len(totals)

        def count(number: int, amount: int, note: str = "") -> None:
            done[number] = amount
            show(sum(done) / sum(totals.values()), note)

        yield count
        return
    columns = (
        progress.TextColumn("{task.description}", markup=False),
        progress.BarColumn(),
        progress.MofNCompleteColumn(),
        progress.TimeElapsedColumn(),
        progress.TimeRemainingColumn(),
        progress.TextColumn("{task.fields[note]}", markup=False),
    )
    with progress.Progress(*columns, console=console, transient=transient) as bar:
        tasks = [bar.add_task(n, start=False, total=totals[n], note="") for n in totals]

        def draw(number: int, amount: int, note: str = "") -> None:
            bar.start_task(tasks[number])
            bar.update(tasks[number], completed=amount, note=note)

        yield draw


@contextmanager
def announce_compilation(console: Console) -> Iterator[None]:
    """Print one line when the first function is compiled within the context."""
    is_announced = False

    def show(record: logging.LogRecord) -> bool:
        nonlocal is_announced
        if not is_announced:
            is_announced = True
            # a closed console must not stop the compilation
            with suppress(OSError):
                console.print(record.getMessage(), soft_wrap=True)
        return True

    level = _COMPILER.level
    _COMPILER.addFilter(show)
    _COMPILER.setLevel(logging.INFO)
    try:
        yield
    finally:
        _COMPILER.removeFilter(show)
        _COMPILER.setLevel(level)
