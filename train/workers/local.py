"""Workers on this machine: a process each, which follows the program that started it."""

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
from train.workers import calls

_SPAWN = multiprocessing.get_context("spawn")


@contextmanager
def local_pool(jobs: int) -> Iterator[calls.Pool]:
    """Processes of this machine, which end with the work within.

    Args:
        jobs: How many there are at most.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        # this is a worker that imports the script of its parent, which says why it ended
        sys.exit(1)
    with isolate_children():
        # its start lets SIGINT through; the threads that start workers block it
        resource_tracker.ensure_running()
    processes = _Processes(jobs)
    try:
        yield calls.Pool(processes.submit, _report, processes.events)
    finally:
        processes.end()


class _Processes:
    """Processes, each with a pipe, and a thread for every call that runs in one.

    A process that dies fails its own call alone; in a `ProcessPoolExecutor` it would fail all of
    them.
    """

    def __init__(self, jobs: int) -> None:
        self.events: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._threads = ThreadPoolExecutor(jobs, initializer=_block_ctrl_c)
        self._lock = threading.Lock()
        self._workers = set[_Worker]()
        self._idle = list[_Worker]()
        self._is_closed = False

    def submit(self, *call: Any) -> Future[Any]:
        """Run a function with its arguments in a process.

        The future raises `WorkerLostError` where the process died, and `UnguardedScriptError` where
        it ended itself before it could begin.
        """
        return self._threads.submit(self._run, call)

    def end(self) -> None:
        """Stop: a call that waits is dropped, one that runs is ended."""
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

    def _run(self, call: tuple[Any, ...]) -> calls.Outcome:
        """In a thread: the outcome of a call in a process that is idle, or a new one."""
        with self._lock:  # no process begins behind `end`
            if self._is_closed:
                raise calls.WorkerLostError("the workers have been ended")
            worker = self._idle.pop() if self._idle else _Worker()
            self._workers.add(worker)
        try:
            outcome = worker.run(call, self.events)
        except (EOFError, OSError):
            self._discard(worker)
            raise worker.why() from None
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
    """A process.

    Attributes:
        process: The process.
        pipe: For calls, their reports and their outcomes; closed, it ends an idle process.
    """

    def __init__(self) -> None:
        self.pipe, end = _SPAWN.Pipe()
        self.process = _SPAWN.Process(target=_serve, args=(end,))
        with isolate_children():
            self.process.start()
        end.close()  # with that of the process the pipe ends too
        self._has_begun = False

    def run(self, call: tuple[Any, ...], events: "queue.SimpleQueue[Any]") -> calls.Outcome:
        """The outcome of a call, whose reports are handed on.

        Raises:
            EOFError: The process has ended.
            OSError: Likewise.
            UnpicklingError: A report or the outcome cannot be read here.
        """
        self.pipe.send(call)
        while not isinstance(message := _read(self.pipe.recv_bytes()), calls.Outcome):
            self._has_begun = True
            events.put(message)
        return message

    def why(self) -> Exception:
        """Why a call in it was lost."""
        # another thread may be about to learn it
        while (code := self.process.exitcode) is None:
            time.sleep(0.01)
        if self._has_begun or code < 0:
            return calls.WorkerLostError("a worker process was killed")
        return calls.UnguardedScriptError()


def _read(content: bytes) -> Any:
    """What a process sent; an error of its reading is none of the pipe."""
    try:
        return pickle.loads(content)
    except Exception as error:
        raise pickle.UnpicklingError(f"what a worker sent cannot be read: {error}") from error


def _block_ctrl_c() -> None:
    """In a thread that starts processes: they begin with SIGINT blocked, as the thread has it.

    Else it could end one, with a traceback, in the second in which it imports and cannot yet ignore
    it.
    """
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])


_own_end: "Connection[Any, Any]"
"""In a worker: its end of the pipe."""


def _report(number: int, value: Any) -> None:
    """In a worker: report on a call."""
    _own_end.send((number, value))


def _serve(end: "Connection[Any, Any]") -> None:
    """In a worker: carry out calls; the parent decides what happens.

    Ctrl-C reaches the whole process group and is left to the parent; a parent that is killed takes
    its workers with it, so that none of them goes on writing beside a run that was resumed.
    """
    global _own_end
    _own_end = end
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with suppress(OSError):  # the parent has ended
        while True:
            try:
                function, *arguments = end.recv()
                end.send(function(*arguments))
            except EOFError:
                return
            except BaseException as error:  # code of the user ends the process
                end.send(calls.Outcome(error=calls.CallFailedError(repr(error))))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
