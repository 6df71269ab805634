"""Workers as jobs of Slurm, through submitit; they need a folder that all machines can read."""

import os
import queue
import shutil
import threading
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from elastic_env.core.config import Model, Title, quantity
from elastic_env.core.errors import SystemFailedError, missing_extra
from train.workers.pool import ExecutorLostError, Pool, WorkerLostError

_POLL_S = 0.5


class SlurmConfig(Model):
    """Limits that a job requests from Slurm; each call is a job of an array."""

    cluster: Literal["slurm", "local"] = "slurm"
    """slurm, or local: processes of this machine instead of jobs, to try it without Slurm."""
    partition: Title | None = Field(default=None, serialization_alias="slurm_partition")
    """Partition; None for Slurm's default."""
    account: Title | None = Field(default=None, serialization_alias="slurm_account")
    """Account that is charged; None for Slurm's default."""
    time_min: int = quantity("min", 60, ge=1, le=100_000, serialization_alias="timeout_min")
    """Longest time of a job [min]."""
    memory_gb: float = quantity("GB", 4.0, gt=0, le=10_000, serialization_alias="mem_gb")
    """Memory of a job [GB]."""
    cores: int = quantity("1", 1, ge=1, le=1024, serialization_alias="cpus_per_task")
    """Cores of a job."""
    at_once: int = quantity(
        "1", 256, ge=1, le=100_000, serialization_alias="slurm_array_parallelism"
    )
    """Jobs that run at the same time."""

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters under the names of submitit."""
        limits = self.model_dump(by_alias=True, exclude={"cluster"}, exclude_none=True)
        return {"name": "elastic", **limits}


@contextmanager
def slurm_pool(config: SlurmConfig, folder: Path) -> Iterator[Pool]:
    """Open a pool of Slurm's jobs.

    Args:
        config: Limits of the jobs.
        folder: Folder for their files, which all machines can read; it is removed at the end.

    Raises:
        SystemFailedError: This machine has no Slurm.
    """
    try:
        import submitit
    except ModuleNotFoundError:
        raise missing_extra("submitit", "cluster", "--on slurm") from None
    if config.cluster == "slurm" and shutil.which("sbatch") is None:
        problem = "there is no Slurm here: the command sbatch was not found; start on a login node"
        raise SystemFailedError(problem)
    folder = folder.resolve()
    reports = folder / "reports"
    reports.mkdir(parents=True, exist_ok=True)
    executor = submitit.AutoExecutor(folder, cluster=config.cluster)
    executor.update_parameters(**config.parameters)
    jobs = _Jobs(executor, reports)
    try:
        yield Pool(jobs.submit, partial(_report, reports), jobs.events)
    finally:
        jobs.end()
        shutil.rmtree(folder, ignore_errors=True)


def _report(folder: Path, number: int, value: Any) -> None:
    """Report from a worker: write a file for the call, which replaces the old one at once."""
    new = folder / f"{number}.{os.getpid()}"
    new.write_text(str(int(value)))
    new.rename(folder / str(number))


class _Jobs:
    """Jobs for calls; a thread submits and follows them."""

    def __init__(self, executor: Any, reports: Path) -> None:
        self.events: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._executor = executor
        self._reports = reports
        self._reported = dict[str, int]()
        self._waiting = deque[tuple[Future[Any], tuple[Any, ...]]]()
        self._jobs = dict[Future[Any], Any]()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._follow_jobs, daemon=True)
        self._thread.start()

    def submit(self, *call: Any) -> Future[Any]:
        """Queue a function with its arguments for the next array of jobs."""
        future = Future[Any]()
        self._waiting.append((future, call))
        return future

    def end(self) -> None:
        """Stop submitting, and cancel jobs that are not done."""
        self._closed.set()
        self._thread.join()
        for job in self._jobs.values():
            with suppress(Exception):  # it may have ended
                job.cancel()

    def _follow_jobs(self) -> None:
        """Submit waiting calls as an array, and set the results of finished ones, in a thread."""
        while not self._closed.wait(_POLL_S):
            try:
                self._submit_waiting()
                self._read_reports()
                self._set_results()
            except Exception as error:
                # Slurm refuses, or the folder is full: all calls end
                problem = f"jobs cannot be submitted or followed: {error}"
                lost = ExecutorLostError(problem)
                for future in [*self._jobs, *(future for future, _ in self._waiting)]:
                    if not future.cancelled():
                        future.set_exception(lost)
                return

    def _submit_waiting(self) -> None:
        waiting = [self._waiting.popleft() for _ in range(len(self._waiting))]
        calls = {future: call for future, call in waiting if not future.cancelled()}
        if calls:
            self._jobs |= dict.fromkeys(calls)
            with self._executor.batch():
                jobs = [self._executor.submit(*call) for call in calls.values()]
            self._jobs |= zip(calls, jobs, strict=True)

    def _read_reports(self) -> None:
        for file in self._reports.iterdir():
            if file.suffix:
                continue
            value = int(file.read_text())
            if self._reported.get(file.name) != value:
                self._reported[file.name] = value
                self.events.put((int(file.name), value))

    def _set_results(self) -> None:
        for future, job in list(self._jobs.items()):
            if future.cancelled():
                job.cancel()
                del self._jobs[future]
            elif job.done():
                del self._jobs[future]
                _set_result(future, job)


def _set_result(future: "Future[Any]", job: Any) -> None:
    if not future.set_running_or_notify_cancel():
        return
    try:
        future.set_result(job.result())
    except Exception as error:  # the job was killed, or out of time or memory
        problem = f"job {job.job_id} ended without a result: {error}"
        future.set_exception(WorkerLostError(problem))
