"""Workers on this machine: a process each, which follows the program that started it."""

import multiprocessing
import os
import queue
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.managers import SyncManager
from typing import Any

from elastic_env.core.errors import ConfigurationError, shown
from train.workers.calls import Pool, WorkerLostError

_MOST_JOBS = 1024


def require_jobs(jobs: int) -> None:
    """Check a number of processes.

    Raises:
        ConfigurationError: It is none.
    """
    if not 0 <= jobs <= _MOST_JOBS:
        bound = ">= 0" if jobs < 0 else f"<= {_MOST_JOBS}"
        raise ConfigurationError(f"jobs must be {bound}, 0 for one per core, got {shown(jobs)}")


@contextmanager
def local_pool(jobs: int, calls: int) -> Iterator[Pool]:
    """Processes of this machine, which end with what is within.

    Args:
        jobs: Processes, 0 for one per core.
        calls: How many calls there will be; there are no more processes than that.
    """
    context = multiprocessing.get_context("spawn")
    manager = SyncManager(ctx=context)
    with _ctrl_c_held():
        _start(manager)
    with manager:
        reports = manager.Queue()
        processes = Processes(min(jobs or os.cpu_count() or 1, calls), context)
        pool = Pool(processes, _Put(reports))
        pump = threading.Thread(target=_forward, args=(reports, pool.events), daemon=True)
        pump.start()
        try:
            yield pool
        except BaseException:
            processes.end()
            raise
        processes.shutdown()
        reports.put(None)
        pump.join()


def _start(manager: SyncManager) -> None:
    """Start the first process.

    Raises:
        ConfigurationError: It ended at once: it imports the script that runs here, which starts processes itself.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        sys.exit(1)  # this is that process; the one that started it says why
    try:
        manager.start(_follow_parent)
    except EOFError:
        raise ConfigurationError(
            "a process ended while it started; a script that starts processes must do so below "
            'if __name__ == "__main__": since each of them imports the script'
        ) from None


class Processes(Executor):
    """An executor of processes, in which a process that dies fails its own call alone.

    In a `ProcessPoolExecutor` it fails all calls, and none knows whose process it was. So each process here has a pool
    of its own, and a thread that waits for it.
    """

    def __init__(self, jobs: int, context: Any) -> None:
        self._threads = ThreadPoolExecutor(jobs, initializer=_block_ctrl_c)
        self._context, self._own, self._lock = context, threading.local(), threading.Lock()
        self._pools, self._is_closed = set[ProcessPoolExecutor](), False

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """See `Executor`; the future raises `WorkerLostError` where the process died."""
        return self._threads.submit(self._in_process, fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """See `Executor`."""
        self._threads.shutdown(wait, cancel_futures=cancel_futures)
        for pool in self._pools:
            pool.shutdown(wait)

    def end(self) -> None:
        """Stop at once: what is queued is dropped, what runs is ended."""
        self._threads.shutdown(wait=False, cancel_futures=True)
        with self._lock:
            self._is_closed = True
            workers = [worker for pool in self._pools for worker in (getattr(pool, "_processes", None) or {}).values()]
        for worker in workers:
            worker.terminate()
        for worker in workers:
            worker.join()

    def _in_process(self, fn: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """In a thread: a call in the thread's process."""
        try:
            with self._lock:  # no process begins behind `end`
                future = self._pool().submit(fn, *args, **kwargs)
            return future.result()
        except BrokenProcessPool:
            with self._lock:
                self._pools.discard(self._own.pool)
            self._own.pool = None
            raise WorkerLostError("a worker process was killed") from None

    def _pool(self) -> ProcessPoolExecutor:
        if self._is_closed:
            raise WorkerLostError("the workers have been ended")
        if getattr(self._own, "pool", None) is None:
            self._own.pool = ProcessPoolExecutor(1, mp_context=self._context, initializer=_follow_parent)
            self._pools.add(self._own.pool)
        return self._own.pool


class _Put:
    """Reports into a queue of a manager: a worker that is killed within leaves no lock behind."""

    def __init__(self, reports: "queue.Queue[Any]") -> None:
        self._reports = reports

    def __call__(self, number: int, value: Any) -> None:
        self._reports.put((number, value))


def _forward(reports: "queue.Queue[Any]", events: "queue.SimpleQueue[Any]") -> None:
    """In a thread: hand on what is reported, until None is."""
    try:
        while (report := reports.get()) is not None:
            events.put(report)
    except (EOFError, OSError):  # the manager is gone, with the workers
        return


@contextmanager
def _ctrl_c_held() -> Iterator[None]:
    """Keep SIGINT waiting while a process is started: it begins with it blocked, as the parent is then.

    Else it could end it, with a traceback, in the second in which it imports and cannot yet ignore it.
    """
    resource_tracker.ensure_running()  # its own start would let SIGINT through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _block_ctrl_c() -> None:
    """In a thread that starts processes: they begin with SIGINT blocked."""
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])


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
