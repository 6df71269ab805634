"""Workers as jobs of Slurm, by submitit; they need a folder that all machines see."""

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
from train.workers.calls import ExecutorLostError, Pool, WorkerLostError

_POLL_S = 0.5


class SlurmConfig(Model):
    """Limits that a job asks Slurm for; a call is a job of an array."""

    cluster: Literal["slurm", "local"] = "slurm"
    """slurm, or local: processes of this machine in the place of jobs, to try it without Slurm."""
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
        """As submitit calls them."""
        given = self.model_dump(by_alias=True, exclude={"cluster"}, exclude_none=True)
        return {"name": "elastic", **given}


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
    """In a worker: report by a file of the call, whole or not at all."""
    fresh = folder / f"{number}.{os.getpid()}"
    fresh.write_text(str(int(value)))
    fresh.rename(folder / str(number))


class _Jobs:
    """Hands calls to submitit, and looks after them in a thread."""

    def __init__(self, executor: Any, reports: Path) -> None:
        self.events: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._executor = executor
        self._reports = reports
        self._reported = dict[str, int]()
        self._waiting = deque[tuple[Future[Any], tuple[Any, ...]]]()
        self._jobs = dict[Future[Any], Any]()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._look_after, daemon=True)
        self._thread.start()

    def submit(self, *call: Any) -> Future[Any]:
        """Keep a function with its arguments for the next array of jobs."""
        future = Future[Any]()
        self._waiting.append((future, call))
        return future

    def end(self) -> None:
        """Submit nothing any more, and cancel jobs that are not done."""
        self._closed.set()
        self._thread.join()
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
    except Exception as error:  # killed, out of time or memory: the call never raises
        problem = f"job {job.job_id} ended without a result: {error}"
        future.set_exception(WorkerLostError(problem))
