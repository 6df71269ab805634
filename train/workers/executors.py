"""Executors of calls, as `--on` names them: this machine, a dask cluster, jobs of Slurm."""

import os
import re
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from elastic_env.core.config import load_yaml
from elastic_env.core.errors import ConfigurationError, quote
from train.workers.calls import Pool
from train.workers.dask_cluster import dask_pool
from train.workers.local import local_pool
from train.workers.slurm import SlurmConfig, slurm_pool

_LOCAL = "local"
_DASK = "dask://"
_SLURM = "slurm"
_MOST_JOBS = 1024


@dataclass(frozen=True)
class Executors:
    """Executors that run calls beside each other.

    Attributes:
        on: local, dask://HOST:PORT, slurm, or slurm:FILE.yaml with a `SlurmConfig`.
        jobs: Processes of this machine, 0 for one per core; elsewhere the cluster says how many.

    Raises:
        ConfigurationError: There are none of this name.
    """

    on: str = _LOCAL
    jobs: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.jobs <= _MOST_JOBS:
            bound = ">= 0" if self.jobs < 0 else f"<= {_MOST_JOBS}"
            raise ConfigurationError(
                f"jobs must be {bound}, 0 for one per core, got {quote(self.jobs)}"
            )
        if not re.fullmatch(rf"(?s){_LOCAL}|{_DASK}.+:\d+|{_SLURM}(:.*)?", self.on):
            raise ConfigurationError(
                f"on must be {_LOCAL}, {_DASK}HOST:PORT of a scheduler, {_SLURM}, or"
                f" {_SLURM}:FILE.yaml with what a job asks for, got {quote(self.on)}"
            )

    @property
    def is_local(self) -> bool:
        """True if they are processes of this machine."""
        return self.on == _LOCAL

    def threads_per_call(self, calls: int) -> int:
        """Threads for each of some calls: an equal share of this machine's cores; elsewhere one."""
        if not self.is_local:
            return 1
        return max(1, (os.cpu_count() or 1) // self._processes(calls))

    def _processes(self, calls: int) -> int:
        """Processes of this machine for some calls: no more than those."""
        return min(self.jobs or os.cpu_count() or 1, calls)

    def open_pool(self, calls: int, folder: Path) -> AbstractContextManager[Pool]:
        """Workers for the calls within.

        Args:
            calls: How many calls there will be.
            folder: A folder of the run, in which jobs of Slurm have their files.
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
