"""Calls that run at the same time in a pool of workers: faults, reports and Ctrl-C.

A call that raises is an outcome, and the other calls continue. A call whose worker is lost starts
again in another worker.
"""

import queue
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from train.workers import pool as workers
from train.workers.pool import Outcome, Pool
from train.workers.remote_call import run_remote_call
from train.workers.versions import VersionsDifferError, everything

_POLL_S = 0.2
_FATAL = (VersionsDifferError, workers.ExecutorLostError, workers.UnguardedScriptError)
"""Errors that end all calls."""


@dataclass
class Tally:
    """Numbers of calls by state.

    Attributes:
        total: Number of all calls.
        done: Number of calls that returned.
        failed: Number of calls that raised.
        running: Numbers that identify the running calls.
    """

    total: int = 0
    done: int = 0
    failed: int = 0
    running: set[int] = field(default_factory=set)

    def end(self, number: int, outcome: Outcome) -> None:
        """Count the outcome of a call."""
        self.running.discard(number)
        self.done += outcome.error is None
        self.failed += outcome.error is not None

    def summary(self, unit: str) -> str:
        """Return a text such as: 3 of 8 cells done, 2 running, 0 failed."""
        running = len(self.running)
        return f"{self.done} of {self.total} {unit} done, {running} running, {self.failed} failed"


@dataclass(frozen=True)
class Watch:
    """Functions that are called while calls run.

    Attributes:
        on_report: Takes the number of a call and its report.
        on_end: Takes the number of a call and its outcome, as soon as it has one.
        on_move: Takes the number of a call that starts again in another worker.
        tally: Numbers of calls by state, up to date when these functions are called.
    """

    on_report: Callable[[int, Any], None] = lambda *_: None
    on_end: Callable[[int, Outcome], None] = lambda *_: None
    on_move: Callable[[int], None] = lambda _: None
    tally: Tally = field(default_factory=Tally)


def run_calls(
    function: Callable[..., Any],
    arguments: Sequence[tuple[Any, ...]],
    pool: Pool,
    watch: Watch,
    finishes: bool = True,
) -> list[Outcome | None]:
    """Call a function with each of some arguments.

    Args:
        function: Function at the top of a module. It gets the arguments and, after them, a function
            that takes its reports.
        arguments: Arguments of each call.
        pool: Workers that run the calls.
        watch: Functions that follow the calls.
        finishes: True if the first Ctrl-C lets running calls end and starts no others; else it ends
            all at once.

    Returns:
        Outcomes in the order of the arguments; None for calls that did not start because of Ctrl-C.

    Raises:
        VersionsDifferError: A machine has other versions.
        ExecutorLostError: The executor is gone.
        UnguardedScriptError: Workers cannot import the running script.
        KeyboardInterrupt: Ctrl-C for the second time, or the first if `finishes` is false.
    """
    outcomes: list[Outcome | None] = [None] * len(arguments)
    tries = [0] * len(arguments)
    futures = dict[Future[Any], int]()
    watch.tally.total = len(arguments)

    def submit(number: int) -> None:
        tries[number] += 1
        context = (number, Path.cwd(), everything(), pool.reporter)
        try:
            future = pool.submit(run_remote_call, function, arguments[number], *context)
        except RuntimeError as error:  # the pool was shut down
            raise workers.ExecutorLostError(f"the workers are gone: {error}") from None
        futures[future] = number
        future.add_done_callback(pool.events.put)

    def cancel_waiting() -> None:
        for future, number in list(futures.items()):
            if number not in watch.tally.running and future.cancel():
                futures.pop(future, None)

    def end(number: int, outcome: Outcome) -> None:
        if isinstance(outcome.error, _FATAL):
            raise outcome.error
        if isinstance(outcome.error, workers.WorkerLostError):
            watch.tally.running.discard(number)
            if stop.is_set():
                return
            if tries[number] <= workers.MAX_RETRIES:
                watch.on_move(number)
                submit(number)
                return
            outcome = Outcome(error=workers.WorkerKilledError())
        outcomes[number] = outcome
        watch.tally.end(number, outcome)
        watch.on_end(number, outcome)

    def report(number: int, value: Any) -> None:
        if outcomes[number] is None:  # a report may arrive after the end
            watch.tally.running.add(number)
        watch.on_report(number, value)

    with _first_interrupt() if finishes else nullcontext(threading.Event()) as stop:
        for number in range(len(arguments)):
            submit(number)
        while futures:
            if stop.is_set():
                cancel_waiting()
            with suppress(queue.Empty):
                event = pool.events.get(timeout=_POLL_S)
                if not isinstance(event, Future):
                    report(*event)
                elif event in futures:
                    end(futures.pop(event), _outcome(event))
    return outcomes


def _outcome(future: Future[Any]) -> Outcome:
    """Return the outcome of a call whose future is done."""
    if future.cancelled():
        problem = "the workers are gone: they cancelled the waiting calls"
        return Outcome(error=workers.ExecutorLostError(problem))
    error = future.exception()
    if error is None:
        return future.result()
    if type(error).__name__ == "KilledWorker":  # of dask, which moves calls itself
        return Outcome(error=workers.WorkerKilledError())
    is_exception = isinstance(error, Exception)
    return Outcome(error=error if is_exception else workers.CallFailedError(repr(error)))


@contextmanager
def _first_interrupt() -> Iterator[threading.Event]:
    """Let the first Ctrl-C set an event; the second one goes to the handler from before."""
    interrupt = threading.Event()
    before = signal.getsignal(signal.SIGINT)
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or not callable(before):
        yield interrupt
        return

    def handle(number: int, frame: Any) -> None:
        if interrupt.is_set():
            before(number, frame)
        interrupt.set()

    signal.signal(signal.SIGINT, handle)
    try:
        yield interrupt
    finally:
        signal.signal(signal.SIGINT, before)
