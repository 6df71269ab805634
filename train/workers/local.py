"""Workers on this machine: a process each, which follows the program that started it."""

import multiprocessing
import os
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Any, cast

from elastic_env.core.errors import ConfigurationError, quote
from train.runs.import_path import safe_children
from train.workers.calls import Pool, UnguardedScriptError, WorkerLostError

_MOST_JOBS = 1024


def require_jobs(jobs: int) -> None:
    """Check a number of processes.

    Raises:
        ConfigurationError: It is none.
    """
    if not 0 <= jobs <= _MOST_JOBS:
        bound = ">= 0" if jobs < 0 else f"<= {_MOST_JOBS}"
        raise ConfigurationError(f"jobs must be {bound}, 0 for one per core, got {quote(jobs)}")


def num_processes(jobs: int, calls: int) -> int:
    """Processes for some calls: `jobs`, or one per core where that is 0, and no more than calls."""
    return min(jobs or os.cpu_count() or 1, calls)


_LATEST_REPORT_S = 5.0
"""Time in which the last report of a call arrives, or never."""


@contextmanager
def local_pool(jobs: int, calls: int) -> Iterator[Pool]:
    """Processes of this machine, which end with what is within.

    Args:
        jobs: Processes, 0 for one per core.
        calls: How many calls there will be; there are no more processes than that.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        # this is a worker that imports the script of its parent, which says why it ended
        sys.exit(1)
    with safe_children():
        # its start lets SIGINT through; the threads that start workers block it
        resource_tracker.ensure_running()
    events: queue.SimpleQueue[Any] = queue.SimpleQueue()
    processes = Processes(num_processes(jobs, calls), events)
    try:
        yield Pool(processes, _report, events)
    except BaseException:
        processes.end()
        raise
    processes.shutdown()


class Processes(Executor):
    """An executor of processes, in which a process that dies fails its own call alone.

    In a `ProcessPoolExecutor` it fails all calls, and none knows whose process it was. So each
    process here has a pool of its own, a thread that waits for it, and a pipe for its reports.
    """

    def __init__(self, jobs: int, events: "queue.SimpleQueue[Any]") -> None:
        self._threads = ThreadPoolExecutor(jobs, initializer=_block_ctrl_c)
        self._own = threading.local()
        self._lock = threading.Lock()
        self._events = events
        self._workers = set[_Worker]()
        self._is_closed = False

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run a call in a process.

        The future raises `WorkerLostError` where the process died, and `UnguardedScriptError` where
        it ended itself before it could begin.
        """
        return self._threads.submit(self._in_process, fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes when their calls have ended."""
        self._threads.shutdown(wait, cancel_futures=cancel_futures)
        for worker in self._workers:
            worker.pool.shutdown(wait)

    def end(self) -> None:
        """Stop at once: what is queued is dropped, what runs is ended."""
        self._threads.shutdown(wait=False, cancel_futures=True)
        with self._lock:
            self._is_closed = True
            processes = [worker.process for worker in self._workers]
        for process in processes:
            process.terminate()
        for process in processes:
            process.join()

    def _in_process(self, fn: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """In a thread: a call in the thread's process."""
        try:
            with self._lock:  # no process begins behind `end`
                worker = self._worker()
                future = worker.pool.submit(_count_reports, fn, *args, **kwargs)
            value, sent = future.result()
            worker.wait_for(sent)
            return value
        except BrokenProcessPool:
            lost = self._own.worker
            self._own.worker = None
            with self._lock:
                self._workers.discard(lost)
            raise lost.why() from None

    def _worker(self) -> "_Worker":
        if self._is_closed:
            raise WorkerLostError("the workers have been ended")
        if getattr(self._own, "worker", None) is None:
            self._own.worker = _Worker(self._events)
            self._workers.add(self._own.worker)
        return self._own.worker


class _Worker:
    """A process, and a thread that takes its reports.

    Attributes:
        pool: Runs calls in it.
        process: The process.
    """

    def __init__(self, events: "queue.SimpleQueue[Any]") -> None:
        context = multiprocessing.get_context("spawn")
        reports, end = context.Pipe(duplex=False)
        self.pool = ProcessPoolExecutor(1, mp_context=context, initializer=_begin, initargs=(end,))
        with safe_children():
            self.pool.submit(_nothing)  # starts it
        (self.process,) = cast("dict[int, SpawnProcess]", self.pool._processes).values()
        end.close()  # with that of the process the pipe ends too
        self._has_begun = False
        self._handed_on = 0
        self._news = threading.Condition()
        self._reader = threading.Thread(target=self._read, args=(reports, events), daemon=True)
        self._reader.start()

    def wait_for(self, reports: int) -> None:
        """Wait until so many reports were handed on: a result has its own way and may be faster."""
        with self._news:
            self._news.wait_for(lambda: self._handed_on >= reports, timeout=_LATEST_REPORT_S)

    def why(self) -> Exception:
        """Why a call in it was lost."""
        self._reader.join()
        while (code := self.process.exitcode) is None:  # another thread is about to learn it
            time.sleep(0.01)
        if self._has_begun or code < 0:
            return WorkerLostError("a worker process was killed")
        return UnguardedScriptError()

    def _read(self, reports: "Connection[Any, Any]", events: "queue.SimpleQueue[Any]") -> None:
        """In a thread: hand on what is reported, as long as the process lives."""
        with reports, suppress(EOFError, OSError):
            self._has_begun = reports.recv()
            while True:
                events.put(reports.recv())
                with self._news:
                    self._handed_on += 1
                    self._news.notify_all()


def _nothing() -> None:
    """A first call, with which a process starts."""


def _block_ctrl_c() -> None:
    """In a thread that starts processes: they begin with SIGINT blocked, as the thread has it.

    Else it could end one, with a traceback, in the second in which it imports and cannot yet ignore
    it.
    """
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])


_own_end: "Connection[Any, Any] | None" = None
"""In a worker: its end of the pipe for reports."""


_sent = 0
"""In a worker: how many reports it has sent."""


def _report(number: int, value: Any) -> None:
    """In a worker: report on a call."""
    global _sent
    if _own_end is not None:
        _own_end.send((number, value))
        _sent += 1


def _count_reports(fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> tuple[Any, int]:
    """In a worker: the result of a call, and how many reports were sent up to its end."""
    return fn(*args, **kwargs), _sent


def _begin(end: "Connection[Any, Any]") -> None:
    """In a worker, before its first call: the parent decides what happens.

    Ctrl-C reaches the whole process group and is left to the parent; a parent that is killed takes
    its workers with it, so that none of them goes on writing beside a run that was resumed.
    """
    global _own_end
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    end.send(True)
    _own_end = end


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
