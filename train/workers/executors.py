"""Executors of calls, the values of `--on`: this machine, a dask cluster, jobs of Slurm."""

import os
import re
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator

from elastic_env.core.config import Model, load_yaml, quantity
from elastic_env.core.errors import unknown_name
from train.workers.dask_cluster import dask_pool
from train.workers.local import local_pool
from train.workers.pool import Pool
from train.workers.slurm import SlurmConfig, slurm_pool

_LOCAL = "local"
_DASK = "dask://"
_NAMES = re.compile(rf"(?s){_LOCAL}|{_DASK}.+:\d+|slurm(:.*)?")
_CHOICES = (_LOCAL, f"{_DASK}HOST:PORT", "slurm", "slurm:FILE.yaml")


def _require_executors(name: str) -> str:
    if not _NAMES.fullmatch(name):
        raise unknown_name("executors", name, _CHOICES)
    return name


class Executors(Model):
    """Machines that run cells of a comparison, or training seeds, at the same time."""

    jobs: int = quantity("1", 0, ge=0, le=1024)
    """Cells, or training seeds, at a time on this machine, 0 for one per core; several share the
    cores, and all of them end sooner than one by one. On hardware cells come one after the other; a
    cluster decides itself."""
    on: Annotated[str, AfterValidator(_require_executors)] = _LOCAL
    """Executors: local, dask://HOST:PORT of a scheduler, slurm, or slurm:FILE.yaml with what a job
    asks for; see docs/cluster.md."""

    @property
    def is_local(self) -> bool:
        """True if the executors are processes of this machine."""
        return self.on == _LOCAL

    def threads_per_call(self, calls: int) -> int:
        """Return the threads of a call: an equal share of this machine's cores; elsewhere one."""
        if not self.is_local:
            return 1
        return max(1, (os.cpu_count() or 1) // self._processes(calls))

    def _processes(self, calls: int) -> int:
        """Return the number of processes of this machine, at most one per call."""
        return min(self.jobs or os.cpu_count() or 1, calls)

    def open_pool(self, calls: int, folder: Path) -> AbstractContextManager[Pool]:
        """Open a pool of workers.

        Args:
            calls: Number of calls that will be made.
            folder: Folder of the run, for the files of Slurm's jobs.
        """
        if self.is_local:
            return local_pool(self._processes(calls))
        if self.on.startswith(_DASK):
            return dask_pool(self.on.removeprefix(_DASK))
        _, _, file = self.on.partition(":")
        config = load_yaml(Path(file), SlurmConfig) if file else SlurmConfig()
        return slurm_pool(config, folder / "jobs")


LOCAL_EXECUTORS = Executors()
"""The cores of this machine."""
