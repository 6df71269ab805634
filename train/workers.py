"""Conditions evaluated in processes of their own, with one progress bar for all."""

import multiprocessing
import os
import queue
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing.managers import SyncManager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from train.conditions import Condition
from train.evaluate import Evaluation, evaluate, num_steps


def run_conditions(conditions: Sequence[Condition], console: Console, jobs: int = 0) -> list[Evaluation]:
    """Evaluate conditions, the long ones first, and return their results in the order given.

    The results do not depend on the number of processes.
    """
    jobs = min(jobs or os.cpu_count() or 1, len(conditions))
    steps = [num_steps(condition) for condition in conditions]
    longest_first = sorted(range(len(conditions)), key=lambda number: -steps[number])
    context = multiprocessing.get_context("spawn")
    manager = SyncManager(ctx=context)
    manager.start(_ignore_interrupts)
    with _progress(console) as bar, manager:
        task = bar.add_task("control steps", total=sum(steps))
        done = manager.Queue()
        pool = ProcessPoolExecutor(jobs, mp_context=context, initializer=_ignore_interrupts)
        try:
            submitted = {n: pool.submit(_evaluate_in_process, conditions[n], done) for n in longest_first}
            futures = [submitted[n] for n in range(len(conditions))]
            while not all(future.done() for future in futures):
                for advance in _drain(done):
                    bar.advance(task, advance)
                _raise_first(futures)
            results = [future.result() for future in futures]
        except BaseException:
            _end(pool)
            raise
        pool.shutdown()
        bar.update(task, completed=sum(steps))
    return results


def _ignore_interrupts() -> None:
    """In a worker: Ctrl-C reaches the whole process group, but the parent decides what happens."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _raise_first(futures: Sequence[Future[Evaluation]]) -> None:
    """The error of a condition that failed, as soon as it has."""
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


def _evaluate_in_process(condition: Condition, steps: "queue.Queue[int]") -> Evaluation:
    return evaluate(condition, progress=steps.put, num_threads=1)


def _drain(steps: "queue.Queue[int]") -> Iterator[int]:
    """What has been put into the queue, waiting a little for the first."""
    try:
        yield steps.get(timeout=0.2)
        while True:
            yield steps.get_nowait()
    except queue.Empty:
        return


def _progress(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn(),
        console=console, transient=True,
    )  # fmt: skip
