"""Work in processes of its own, with what it reports on the way."""

import multiprocessing
import os
import queue
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.managers import SyncManager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from elastic_env.core.errors import ConfigurationError, SystemFailedError, shown

_MOST_JOBS = 1024
_LEAST_S = 10.0
"""Time between two lines of progress in a log [s]; shorter work says nothing."""
_ANNOUNCED_S, _LONG_S = 3.0, 30.0
"""When the time to go is said, and from how much on [s]."""


class WorkerKilledError(SystemFailedError):
    """A process that worked beside this one was killed.

    Attributes:
        results: Of the calls, in their order; None where there is none.
    """

    def __init__(self, results: list[Any]) -> None:
        super().__init__("a worker process was killed, most often for lack of memory; take fewer --jobs")
        self.results = results


def require_jobs(jobs: int) -> None:
    """Check a number of processes.

    Raises:
        ConfigurationError: It is none.
    """
    if not 0 <= jobs <= _MOST_JOBS:
        bound = ">= 0" if jobs < 0 else f"<= {_MOST_JOBS}"
        raise ConfigurationError(f"jobs must be {bound}, 0 for one per core, got {shown(jobs)}")


def side_by_side(
    function: Callable[..., Any],
    arguments: Sequence[tuple[Any, ...]],
    jobs: int,
    report: Callable[[int, Any], None],
) -> list[Any]:
    """Call a function with each of some arguments in processes of their own; the results are in their order.

    Args:
        function: At the top of a module; it gets the arguments and, behind them, a function that takes its reports.
        arguments: Of each call.
        jobs: Processes at a time, 0 for one per core.
        report: Called with the number of the call and what it reported.

    Raises:
        WorkerKilledError: A process was killed; it has the results of the calls that had ended.
        Exception: The first that a call raised, when all others have been ended.
    """
    jobs = min(jobs or os.cpu_count() or 1, len(arguments))
    context = multiprocessing.get_context("spawn")
    manager = SyncManager(ctx=context)
    with _ctrl_c_held():
        manager.start(_follow_parent)
    with manager:
        reports = manager.Queue()
        pool = ProcessPoolExecutor(jobs, mp_context=context, initializer=_follow_parent)
        futures: list[Future[Any]] = []
        try:
            with _ctrl_c_held():
                futures += [pool.submit(_call, function, given, n, reports) for n, given in enumerate(arguments)]
            while not all(future.done() for future in futures):
                for number, value in _drain(reports):
                    report(number, value)
                _raise_first(futures)
            results = [future.result() for future in futures]
        except BrokenProcessPool:
            _end(pool)
            raise WorkerKilledError([_result_of(future) for future in futures]) from None
        except BaseException:
            _end(pool)
            raise
        pool.shutdown()
    return results


def plain_progress(console: Console, least_s: float = 0.0) -> Callable[[float], None]:
    """A function that takes the share of the work that is done, and says each tenth of it in a line.

    Long work is announced early, with the time that it will take.

    For work beside a control loop and work that is timed, from which the thread of a bar would take time, and for logs.

    Args:
        console: Where it says so.
        least_s: Shortest time between two lines, and before the first one [s].
    """
    said, when = 0, time.monotonic()
    first: tuple[float, float] | None = None  # processes take their time to start
    is_announced = False

    def say(share: float) -> None:
        nonlocal said, when, first, is_announced
        first = first or (time.monotonic(), share)
        elapsed, done = time.monotonic() - first[0], share - first[1]
        if not is_announced and done > 0.0 and elapsed > _ANNOUNCED_S:
            is_announced = True
            if (to_go := elapsed * (1.0 - share) / done) > _LONG_S:
                console.print(f"  about {duration(to_go)} to go")
        if int(10 * share) > said and time.monotonic() - when >= least_s:
            said, when = int(10 * share), time.monotonic()
            console.print(f"  {10 * said} %")

    return say


def duration(seconds: float) -> str:
    """A time in words, rounded to what matters: 40 s, 3 min, 2 h."""
    for unit, size in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 1.5 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{10.0 * round(seconds / 10.0):.0f} s"


@contextmanager
def show_progress(
    console: Console, totals: Mapping[str, int], transient: bool = False
) -> Iterator[Callable[[int, int], None]]:
    """Show how far some tasks are: by a bar each on a terminal, by a line now and then where there is none.

    Args:
        console: Where it is shown.
        totals: What is to be done of every task, by its name.
        transient: Whether the bars vanish at the end.

    Yields:
        A function that takes the number of a task and how much of it has been done.
    """
    if not console.is_terminal:
        say, done = plain_progress(console, _LEAST_S), [0] * len(totals)

        def count(number: int, amount: int) -> None:
            done[number] = amount
            say(sum(done) / sum(totals.values()))

        yield count
        return
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, TimeRemainingColumn(), console=console, transient=transient) as bar:
        tasks = [bar.add_task(name, total=total, start=False) for name, total in totals.items()]

        def draw(number: int, amount: int) -> None:
            bar.start_task(tasks[number])
            bar.update(tasks[number], completed=amount)

        yield draw


@contextmanager
def _ctrl_c_held() -> Iterator[None]:
    """Keep SIGINT waiting while processes are started: they begin with it blocked, as the parent is then.

    Else it could end them, with a traceback each, in the second in which they import and cannot yet ignore it.
    """
    resource_tracker.ensure_running()  # its own start would let SIGINT through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _follow_parent() -> None:
    """In a worker: the parent decides what happens.

    Ctrl-C reaches the whole process group and is left to the parent; a parent that is killed takes its workers with
    it, so that none of them goes on writing beside a run that was resumed.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _raise_first(futures: Sequence[Future[Any]]) -> None:
    """The error of a call that failed, as soon as it has."""
    for future in futures:
        if future.done():
            future.result()


def _result_of(future: Future[Any]) -> Any:
    """What a call returned; None where it did not end, or not well."""
    return future.result() if future.done() and not future.cancelled() and future.exception() is None else None


def _end(pool: ProcessPoolExecutor) -> None:
    """Stop at once: what is queued is dropped, what runs is ended."""
    workers = list(getattr(pool, "_processes", {}).values())
    pool.shutdown(wait=False, cancel_futures=True)
    for worker in workers:
        worker.terminate()
    for worker in workers:
        worker.join()


def _call(function: Callable[..., Any], given: tuple[Any, ...], number: int, reports: "queue.Queue[Any]") -> Any:
    return function(*given, lambda value: reports.put((number, value)))


def _drain(reports: "queue.Queue[Any]") -> Iterator[Any]:
    """What has been put into the queue, waiting a little for the first."""
    try:
        yield reports.get(timeout=0.2)
        while True:
            yield reports.get_nowait()
    except queue.Empty:
        return
