"""Calls beside each other, wherever their futures come from: faults, reports and Ctrl-C.

A call that raises is an outcome, and the others go on. A call whose worker is lost begins anew
elsewhere.
"""

import os
import pickle
import platform
import queue
import signal
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from elastic_env.core.errors import ConfigurationError, ElasticError, SystemFailedError
from train.runs.import_path import remove_from_path
from train.workers.versions import VersionsDifferError, everything, require_same

MOST_MOVES = 2
"""How often a call begins anew after its worker was lost."""
_WAIT_S = 0.2

Reporter = Callable[[int, Any], None]
"""Takes the number of a call and what it reports; it travels to the workers."""


class WorkerLostError(SystemFailedError):
    """The worker of a call is gone: killed, preempted, or out of reach.

    A future raises it.
    """


class WorkerKilledError(SystemFailedError):
    """A call lost its worker each time that it was begun."""

    def __init__(self) -> None:
        super().__init__(
            "a worker process was killed each time that it was tried, most often for lack of"
            " memory; take fewer --jobs or more memory"
        )


class ExecutorLostError(SystemFailedError):
    """The executor is gone: the scheduler of a cluster."""


class UnguardedScriptError(ConfigurationError):
    """Workers import the script that runs here, and it would start workers again.

    A future raises it.
    """

    def __init__(self) -> None:
        super().__init__(
            "a process ended while it started; a script that starts processes must do so below "
            'if __name__ == "__main__": since each of them imports the script'
        )


@dataclass(frozen=True)
class Outcome:
    """Result of a call.

    Attributes:
        value: What it returned.
        error: What it raised; None where it returned.
        trace: Traceback of the error.
    """

    value: Any = None
    error: Exception | None = None
    trace: str = ""


@dataclass(frozen=True)
class Pool:
    """Workers.

    Attributes:
        submit: Runs a function with its arguments. The future that it returns raises
            `WorkerLostError` where the call may begin anew.
        reporter: How a call reports.
        events: Where the reports arrive, as pairs of number and report.
    """

    submit: Callable[..., Future[Any]]
    reporter: Reporter
    events: "queue.SimpleQueue[Any]" = field(default_factory=queue.SimpleQueue)


@dataclass
class Tally:
    """How many calls are where.

    Attributes:
        total: All of them.
        done: Those that returned.
        failed: Those that raised.
        running: Numbers of those that have begun.
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

    def in_words(self, unit: str) -> str:
        """Such as: 3 of 8 cells done, 2 running, 0 failed."""
        running = len(self.running)
        return f"{self.done} of {self.total} {unit} done, {running} running, {self.failed} failed"


@dataclass(frozen=True)
class Watch:
    """Who is told how calls go.

    Attributes:
        reported: Takes the number of a call and what it reports.
        ended: Takes the number of a call and its outcome, as soon as it has one.
        moved: Takes the number of a call that begins anew.
        tally: How many calls are where, before and after each of these.
    """

    reported: Callable[[int, Any], None] = lambda *_: None
    ended: Callable[[int, Outcome], None] = lambda *_: None
    moved: Callable[[int], None] = lambda _: None
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
        function: At the top of a module; it gets the arguments and, behind them, a function that
            takes its reports.
        arguments: Of each call.
        pool: Where they run.
        watch: Who is told how they go.
        finishes: Whether the first Ctrl-C lets running calls end and starts no others; else it ends
            at once.

    Returns:
        Outcomes in the order of the arguments; None for calls that Ctrl-C kept from starting.

    Raises:
        VersionsDifferError: A machine has other versions.
        ExecutorLostError: The executor is gone.
        UnguardedScriptError: Workers cannot import the script that runs here.
        KeyboardInterrupt: Ctrl-C for the second time, or the first where `finishes` is false.
    """
    outcomes: list[Outcome | None] = [None] * len(arguments)
    tries = [0] * len(arguments)
    futures = dict[Future[Any], int]()
    watch.tally.total = len(arguments)

    def submit(number: int) -> None:
        tries[number] += 1
        place = (Path.cwd(), everything(), pool.reporter)
        try:
            future = pool.submit(carry_out, function, arguments[number], number, *place)
        except RuntimeError as error:  # it was shut down
            raise ExecutorLostError(f"the workers are gone: {error}") from None
        futures[future] = number
        future.add_done_callback(pool.events.put)

    def cancel_waiting() -> None:
        for future, number in list(futures.items()):
            if number not in watch.tally.running and future.cancel():
                futures.pop(future, None)

    def end(number: int, outcome: Outcome) -> None:
        if isinstance(outcome.error, _FATAL):
            raise outcome.error
        if isinstance(outcome.error, WorkerLostError):
            watch.tally.running.discard(number)
            if asked.is_set():
                return
            if tries[number] <= MOST_MOVES:
                watch.moved(number)
                submit(number)
                return
            outcome = Outcome(error=WorkerKilledError())
        outcomes[number] = outcome
        watch.tally.end(number, outcome)
        watch.ended(number, outcome)

    def report(number: int, value: Any) -> None:
        if outcomes[number] is None:  # a report may come behind the end
            watch.tally.running.add(number)
        watch.reported(number, value)

    with _first_ctrl_c() if finishes else nullcontext(threading.Event()) as asked:
        for number in range(len(arguments)):
            submit(number)
        while futures:
            if asked.is_set():
                cancel_waiting()
            with suppress(queue.Empty):
                event = pool.events.get(timeout=_WAIT_S)
                if not isinstance(event, Future):
                    report(*event)
                elif event in futures:
                    end(futures.pop(event), _outcome(event))
    return outcomes


_FATAL = (VersionsDifferError, ExecutorLostError, UnguardedScriptError)
"""Errors that end all calls."""


def carry_out(
    function: Callable[..., Any],
    given: tuple[Any, ...],
    number: int,
    folder: Path,
    versions: Mapping[str, str],
    reporter: Reporter,
) -> Outcome:
    """In a worker: the outcome of a call, which never raises.

    It works in the folder of the program, from which configurations name files, if this machine has
    it. A machine with other versions than the program's is refused.
    """

    def report(value: Any) -> None:
        reporter(number, value)

    try:
        require_same(versions, everything(), platform.node())
        if folder.is_dir():
            os.chdir(folder)
            remove_from_path(folder)
        report(0)
        return Outcome(function(*given, report))
    except Exception as error:
        return Outcome(error=_portable(error), trace=traceback.format_exc())


class CallFailedError(ElasticError):
    """A call raised an error that does not travel between processes; this one has its text."""


def _portable(error: Exception) -> Exception:
    """An error without its traceback, as it can be sent."""
    error.__traceback__ = None
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return CallFailedError(f"{type(error).__name__}: {error}")
    return error


def _outcome(future: Future[Any]) -> Outcome:
    if future.cancelled():
        lost = "the workers are gone: they dropped what was to be done"
        return Outcome(error=ExecutorLostError(lost))
    error = future.exception()
    if error is None:
        return future.result()
    if type(error).__name__ == "KilledWorker":  # of dask, which moves calls itself
        return Outcome(error=WorkerKilledError())
    is_plain = isinstance(error, Exception)
    return Outcome(error=error if is_plain else CallFailedError(repr(error)))


@contextmanager
def _first_ctrl_c() -> Iterator[threading.Event]:
    """Ctrl-C sets an event; the second one does what it did before."""
    asked = threading.Event()
    before = signal.getsignal(signal.SIGINT)
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or not callable(before):
        yield asked
        return

    def note(number: int, frame: Any) -> None:
        if asked.is_set():
            before(number, frame)
        asked.set()

    signal.signal(signal.SIGINT, note)
    try:
        yield asked
    finally:
        signal.signal(signal.SIGINT, before)
