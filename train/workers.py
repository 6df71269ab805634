"""Work in processes of its own, with what it reports on the way: conditions to evaluate, seeds to train."""

import multiprocessing
import os
import queue
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.managers import SyncManager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from train.conditions import Condition
from train.evaluate import Evaluation, evaluate, num_steps


def run_conditions(conditions: Sequence[Condition], console: Console, jobs: int = 0) -> list[Evaluation]:
    """Evaluate conditions, the long ones first, and return their results in the order given.

    The results do not depend on the number of processes. On hardware the conditions come one after the other, in this
    process, at whose terminal somebody can agree to them.
    """
    if any(condition.environment.is_real for condition in conditions):
        return [
            _on_hardware(condition, f"{n} of {len(conditions)}", console) for n, condition in enumerate(conditions, 1)
        ]
    steps = [num_steps(condition) for condition in conditions]
    longest_first = sorted(range(len(conditions)), key=lambda number: -steps[number])
    with progress_bar(console, transient=True) as bar:
        task = bar.add_task("control steps", total=sum(steps))
        results = side_by_side(
            _evaluate,
            [(conditions[number],) for number in longest_first],
            jobs,
            lambda _, advance: bar.advance(task, advance),
        )
        bar.update(task, completed=sum(steps))
    return [results[longest_first.index(number)] for number in range(len(conditions))]


def _on_hardware(condition: Condition, which: str, console: Console) -> Evaluation:
    total, done, say = num_steps(condition), 0, plain_progress(console)
    console.print(f"{which}: {condition.policy.title} plays {condition.reference_name}", soft_wrap=True)

    def progress(steps: int) -> None:
        nonlocal done
        done += steps
        say(done / total)

    return evaluate(condition, progress)


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
        try:
            with _ctrl_c_held():
                futures = [pool.submit(_call, function, given, n, reports) for n, given in enumerate(arguments)]
            while not all(future.done() for future in futures):
                for number, value in _drain(reports):
                    report(number, value)
                _raise_first(futures)
            results = [future.result() for future in futures]
        except BaseException:
            _end(pool)
            raise
        pool.shutdown()
    return results


def plain_progress(console: Console) -> Callable[[float], None]:
    """A function that takes the share of the work that is done, and says each tenth of it in a line.

    For work beside a control loop: the thread of a `progress_bar` would take time from it.
    """
    said = 0

    def progress(share: float) -> None:
        nonlocal said
        if int(10 * share) > said:
            said = int(10 * share)
            console.print(f"  {10 * said} %")

    return progress


def progress_bar(console: Console, transient: bool = False) -> Progress:
    """Progress of something that is counted, with times."""
    return Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn(),
        console=console, transient=transient,
    )  # fmt: skip


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


def _evaluate(condition: Condition, report: Callable[[int], None]) -> Evaluation:
    return evaluate(condition, progress=report, num_threads=1)


def _drain(reports: "queue.Queue[Any]") -> Iterator[Any]:
    """What has been put into the queue, waiting a little for the first."""
    try:
        yield reports.get(timeout=0.2)
        while True:
            yield reports.get_nowait()
    except queue.Empty:
        return
