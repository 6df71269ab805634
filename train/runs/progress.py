"""How far long work is: bars on a terminal, a line now and then in a log."""

import contextlib
import logging
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from rich import progress
from rich.console import Console

from train.runs.console import can_redraw

_LEAST_S = 10.0
"""Time between two lines of progress in a log [s]; shorter work says nothing."""
_ANNOUNCED_S = 3.0
_LONG_S = 30.0
"""When the time to go is said, and from how much on [s]."""


_COMPILER = logging.getLogger("elastic_env.core.compiled")


Show = Callable[..., None]
"""Takes the number of a task, how much of it has been done, and a note, such as how many calls are
running.
"""


def plain_progress(
    console: Console, least_s: float = 0.0, unit: str = "work"
) -> Callable[..., None]:
    """A function that takes share of the work, 0 to 1, and note, and prints each tenth in a line.

    Long work is announced early, with the time that it will take. A line with a note ends with the
    time to go.

    For work beside a control loop and work that is timed, from which the thread of a bar would take
    time, and for logs.

    Args:
        console: Where it says so.
        least_s: Shortest time between two lines, and before the first one [s].
        unit: What is counted, such as control steps; a line with a note names it, since the note
            counts others.
    """
    said = 0
    when = time.monotonic()
    first: tuple[float, float] | None = None  # processes take their time to start
    is_announced = False

    def say(share: float, note: str = "") -> None:
        nonlocal said, when, first, is_announced
        if share <= 0.0:
            return
        first = first or (time.monotonic(), share)
        elapsed = time.monotonic() - first[0]
        done = share - first[1]
        to_go = elapsed * (1.0 - share) / done if done > 0.0 else 0.0
        if not is_announced and done > 0.0 and elapsed > _ANNOUNCED_S:
            is_announced = True
            if to_go > _LONG_S:
                console.print(f"  about {duration(to_go)} to go")
        if int(10 * share) > said and time.monotonic() - when >= least_s:
            said = int(10 * share)
            when = time.monotonic()
            more = f" of the {unit}, about {duration(to_go)} to go; {note}"
            console.print(f"  {10 * said} %{more if note else ''}")

    return say


def duration(seconds: float) -> str:
    """A time in words, rounded to what matters: 40 s, 3 min, 2 h."""
    for unit, size in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 1.5 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{10.0 * round(seconds / 10.0):.0f} s"


@contextmanager
def show_progress(
    console: Console, totals: Mapping[str, int], transient: bool = False, unit: str = "work"
) -> Iterator[Show]:
    """Show the progress of tasks: by a bar each on a terminal, else by a line now and then.

    Args:
        console: Where it is shown.
        totals: What is to be done of every task, by its name.
        transient: Whether the bars vanish at the end.
        unit: See `plain_progress`.

    Yields:
        A function that takes the number of a task, how much of it has been done, and a note.
    """
    if not can_redraw(console):
        say = plain_progress(console, _LEAST_S, unit)
        done = [0] * len(totals)

        def count(number: int, amount: int, note: str = "") -> None:
            done[number] = amount
            say(sum(done) / sum(totals.values()), note)

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
        begun = {"start": False, "note": ""}
        tasks = [bar.add_task(name, total=totals[name], **begun) for name in totals]

        def draw(number: int, amount: int, note: str = "") -> None:
            bar.start_task(tasks[number])
            bar.update(tasks[number], completed=amount, note=note)

        yield draw


@contextmanager
def say_what_is_compiled(console: Console) -> Iterator[None]:
    """Say in one line that functions are compiled, when the first one is; nothing if none is.

    Args:
        console: Where it is said.
    """
    said: list[str] = []

    def show(record: logging.LogRecord) -> bool:
        if not said:
            said.append(record.getMessage())
            # nobody reads: no reason to end what is compiled
            with contextlib.suppress(OSError):
                console.print(said[0], soft_wrap=True)
        return True

    level = _COMPILER.level
    _COMPILER.addFilter(show)
    _COMPILER.setLevel(logging.INFO)
    try:
        yield
    finally:
        _COMPILER.removeFilter(show)
        _COMPILER.setLevel(level)
