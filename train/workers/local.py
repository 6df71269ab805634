"""Workers on this machine: processes, which end with the program that started them."""

import multiprocessing
import os
import pickle
import queue
import signal
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from typing import Any

from train.runs.import_path import isolate_children
from train.workers import pool

_SPAWN = multiprocessing.get_context("spawn")


@contextmanager
def local_pool(jobs: int) -> Iterator[pool.Pool]:
    """Open a pool of processes of this machine, which end with the context.

    Args:
        jobs: Largest number of processes.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        # this worker imports its parent's script; the parent raises UnguardedScriptError
        sys.exit(1)
    with isolate_children():
        # here, since its start would unblock SIGINT in the threads that start workers
        resource_tracker.ensure_running()
    processes = _Processes(jobs)
    try:
        yield pool.Pool(processes.submit, _report, processes.events)
    finally:
        processes.end()


class _Processes:
    """Processes, each with a pipe, and a thread for every running call.

    A process that dies fails its own call only. In a `ProcessPoolExecutor` it would fail all calls.
    """

    def __init__(self, jobs: int) -> None:
        self.events: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._threads = ThreadPoolExecutor(jobs, initializer=_block_interrupts)
        self._lock = threading.Lock()
        self._workers = set[_Worker]()
        self._idle = list[_Worker]()
        self._is_closed = False

    def submit(self, *call: Any) -> Future[Any]:
        """Run a function with its arguments in a process.

        The future raises `WorkerLostError` if the process died, and `UnguardedScriptError` if the
        process ended by itself before the call began.
        """
        return self._threads.submit(self._run, call)

    def end(self) -> None:
        """Cancel waiting calls and terminate running ones."""
        self._threads.shutdown(wait=False, cancel_futures=True)
        with self._lock:
            self._is_closed = True
            workers = list(self._workers)
        for worker in workers:
            if worker in self._idle:
                worker.pipe.close()
            else:
                worker.process.terminate()
        for worker in workers:
            worker.process.join()

    def _run(self, call: tuple[Any, ...]) -> pool.Outcome:
        """Run a call in an idle process or a new one; a thread executes this method."""
        with self._lock:  # no process starts after `end`
            if self._is_closed:
                raise pool.WorkerLostError("the workers have been ended")
            worker = self._idle.pop() if self._idle else _Worker()
            self._workers.add(worker)
        try:
            outcome = worker.run(call, self.events)
        except (EOFError, OSError):
            self._discard(worker)
            raise worker.loss() from None
        except BaseException:  # a call or an outcome that cannot be pickled
            self._discard(worker)
            worker.process.terminate()
            worker.process.join()
            raise
        self._idle.append(worker)
        return outcome

    def _discard(self, worker: "_Worker") -> None:
        with self._lock:
            self._workers.discard(worker)


class _Worker:
    """A worker process.

    Attributes:
        process: The process.
        pipe: Pipe for calls, reports and outcomes; closing it ends an idle process.
    """

    def __init__(self) -> None:
        self.pipe, end = _SPAWN.Pipe()
        self.process = _SPAWN.Process(target=_serve, args=(end,))
        with isolate_children():
            self.process.start()
        end.close()  # so that the pipe ends when the process does
        self._has_begun = False

    def run(self, call: tuple[Any, ...], events: "queue.SimpleQueue[Any]") -> pool.Outcome:
        """Run a call, put its reports into a queue, and return its outcome.

        Raises:
            EOFError: The process has ended.
            OSError: The process has ended.
            UnpicklingError: A report or the outcome cannot be read here.
        """
        self.pipe.send(call)
        while not isinstance(message := _unpickle(self.pipe.recv_bytes()), pool.Outcome):
            self._has_begun = True
            events.put(message)
        return message

    def loss(self) -> Exception:
        """Return the error of a call that was lost with the process."""
        # the pipe ends before the exit code is known, or another thread is about to set it
        while (code := self.process.exitcode) is None:
            time.sleep(0.01)
        if self._has_begun or code < 0:
            return pool.WorkerLostError("a worker process was killed")
        return pool.UnguardedScriptError()


def _unpickle(content: bytes) -> Any:
    """Read a message of a process; its errors differ from those of a broken pipe."""
    try:
        return pickle.loads(content)
    except Exception as error:
        raise pickle.UnpicklingError(f"what a worker sent cannot be read: {error}") from error


def _block_interrupts() -> None:
    """Block SIGINT in a thread, and so in the processes that it starts.

    A process needs a second for its imports before it can ignore SIGINT. An interrupt in that time
    would end it with a traceback.
    """
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])


_parent_pipe: "Connection[Any, Any]"
"""The worker's end of its pipe to the parent; set in workers only."""


def _report(number: int, value: Any) -> None:
    """Report on a call, from a worker."""
    _parent_pipe.send((number, value))


def _serve(pipe: "Connection[Any, Any]") -> None:
    """Run calls in a worker until the parent closes the pipe.

    Ctrl-C reaches the whole process group, and the parent alone handles it. A worker ends with a
    killed parent, so that it does not write into a run that is resumed meanwhile.
    """
    global _parent_pipe
    _parent_pipe = pipe
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with suppress(OSError):  # the parent has ended
        while True:
            try:
                function, *arguments = pipe.recv()
                pipe.send(function(*arguments))
            except EOFError:
                return
            except BaseException as error:  # the user's code ends the process
                pipe.send(pool.Outcome(error=pool.CallFailedError(repr(error))))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
