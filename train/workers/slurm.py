"""Workers as jobs of Slurm, by submitit; they need a folder that all machines see."""

import os
import queue
import shutil
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

from elastic_env.core.config import Model, Title, quantity
from elastic_env.core.errors import SystemFailedError, missing_extra
from train.workers.calls import ExecutorLostError, Pool, WorkerLostError

_POLL_S = 0.5


class SlurmConfig(Model):
    """Limits that a job asks Slurm for; a call is a job of an array."""

    cluster: Literal["slurm", "local"] = "slurm"
    """slurm, or local: processes of this machine in the place of jobs, to try it without Slurm."""
    partition: Title | None = None
    """Partition; None for Slurm's default."""
    account: Title | None = None
    """Account that is charged; None for Slurm's default."""
    time_min: int = quantity("min", 60, ge=1, le=100_000)
    """Longest time of a job [min]."""
    memory_gb: float = quantity("GB", 4.0, gt=0, le=10_000)
    """Memory of a job [GB]."""
    cores: int = quantity("1", 1, ge=1, le=1024)
    """Cores of a job."""
    at_once: int = quantity("1", 256, ge=1, le=100_000)
    """Jobs that run at the same time."""

    def parameters(self) -> dict[str, Any]:
        """As submitit calls them."""
        named = {
            "slurm_partition": self.partition,
            "slurm_account": self.account,
            "slurm_array_parallelism": self.at_once,
            "timeout_min": self.time_min,
            "mem_gb": self.memory_gb,
            "cpus_per_task": self.cores,
        }
        return {"name": "elastic", **{key: own for key, own in named.items() if own is not None}}


@contextmanager
def slurm_pool(config: SlurmConfig, folder: Path) -> Iterator[Pool]:
    """Jobs of Slurm.

    Args:
        config: What they ask for.
        folder: For their files, which all machines must see; it goes at the end.

    Raises:
        SystemFailedError: There is no Slurm here.
    """
    try:
        import submitit
    except ModuleNotFoundError:
        raise missing_extra("submitit", "cluster", "--on slurm") from None
    if config.cluster == "slurm" and shutil.which("sbatch") is None:
        raise SystemFailedError(
            "there is no Slurm here: the command sbatch was not found; start on a login node"
        )
    folder = folder.resolve()
    reports = folder / "reports"
    reports.mkdir(parents=True, exist_ok=True)
    executor = submitit.AutoExecutor(folder, cluster=config.cluster)
    executor.update_parameters(**config.parameters())
    jobs = Jobs(executor, reports)
    pool = Pool(jobs, ToFile(reports), jobs.events)
    try:
        yield pool
    finally:
        jobs.shutdown(wait=True, cancel_futures=True)
        shutil.rmtree(folder, ignore_errors=True)


class ToFile:
    """Reports as files, of which each call has one."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __call__(self, number: int, value: Any) -> None:
        """Report, whole or not at all."""
        fresh = self._folder / f"{number}.{os.getpid()}"
        fresh.write_text(str(int(value)))
        fresh.rename(self._folder / str(number))


class Jobs(Executor):
    """An executor that hands calls to submitit, and looks after them in a thread."""

    def __init__(self, executor: Any, reports: Path) -> None:
        self.events: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._executor = executor
        self._reports = reports
        self._reported = dict[str, int]()
        self._waiting = deque[tuple[Future[Any], Callable[..., Any], tuple[Any, ...]]]()
        self._jobs = dict[Future[Any], Any]()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._look_after, daemon=True)
        self._thread.start()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Keep a call for the next array of jobs; keyword arguments are not passed on."""
        if kwargs:
            raise TypeError(f"calls have no keyword arguments, got {sorted(kwargs)}")
        if self._closed.is_set():
            raise RuntimeError("it was shut down")
        future = Future[Any]()
        self._waiting.append((future, fn, args))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Submit nothing any more; with `cancel_futures` jobs that are not done are cancelled."""
        self._closed.set()
        if wait:
            self._thread.join()
        if cancel_futures:
            for job in self._jobs.values():
                with suppress(Exception):  # it may have ended
                    job.cancel()

    def _look_after(self) -> None:
        """In a thread: submit what waits as an array, and settle what is done."""
        while not self._closed.wait(_POLL_S):
            try:
                self._submit_waiting()
                self._read_reports()
                self._settle_done()
            except Exception as error:
                # Slurm refuses, or the folder is full: that is the end of all calls
                lost = ExecutorLostError(f"jobs cannot be submitted or followed: {error}")
                for future in [*self._jobs, *(future for future, *_ in self._waiting)]:
                    if not future.cancelled():
                        future.set_exception(lost)
                return

    def _submit_waiting(self) -> None:
        waiting = list(self._waiting)
        calls = [call for call in waiting if not call[0].cancelled()]
        if calls:
            with self._executor.batch():
                jobs = [self._executor.submit(fn, *args) for _, fn, args in calls]
            self._jobs.update(zip((future for future, *_ in calls), jobs, strict=True))
        for _ in waiting:
            self._waiting.popleft()

    def _read_reports(self) -> None:
        for file in self._reports.iterdir():
            if file.suffix:
                continue
            value = int(file.read_text())
            if self._reported.get(file.name) != value:
                self._reported[file.name] = value
                self.events.put((int(file.name), value))

    def _settle_done(self) -> None:
        for future, job in list(self._jobs.items()):
            if future.cancelled():
                job.cancel()
                del self._jobs[future]
            elif job.done():
                del self._jobs[future]
                _settle(future, job)


def _settle(future: "Future[Any]", job: Any) -> None:
    if not future.set_running_or_notify_cancel():
        return
    try:
        future.set_result(job.result())
    except Exception as error:  # killed, out of time or memory: the call itself never raises
        future.set_exception(WorkerLostError(f"job {job.job_id} ended without a result: {error}"))
