"""Executors of calls, as `--on` names them: this machine, a dask cluster, jobs of Slurm."""

import os
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from elastic_env.core.config import load_yaml
from elastic_env.core.errors import ConfigurationError, quote
from train.workers.calls import Pool
from train.workers.dask_cluster import dask_pool
from train.workers.local import local_pool, num_processes, require_jobs
from train.workers.slurm import SlurmConfig, slurm_pool

_LOCAL = "local"
_DASK = "dask://"
_SLURM = "slurm"


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
        require_jobs(self.jobs)
        host, _, port = self.on.removeprefix(_DASK).rpartition(":")
        is_dask = self.on.startswith(_DASK) and host and port.isdecimal()
        if not (self.is_local or is_dask or self.on == _SLURM or self.on.startswith(f"{_SLURM}:")):
            raise ConfigurationError(
                f"on must be {_LOCAL}, {_DASK}HOST:PORT of a scheduler, {_SLURM}, or"
                f" {_SLURM}:FILE.yaml with what a job asks for, got {quote(self.on)}"
            )

    @property
    def is_local(self) -> bool:
        """True if they are processes of this machine."""
        return self.on == _LOCAL

    def threads_per_call(self, calls: int) -> int:
        """Threads for each of some calls: an equal share of the cores of this machine; elsewhere
        one.
        """
        return (
            max(1, (os.cpu_count() or 1) // num_processes(self.jobs, calls)) if self.is_local else 1
        )

    def open(self, calls: int, folder: Path) -> AbstractContextManager[Pool]:
        """Workers for the calls within.

        Args:
            calls: How many calls there will be.
            folder: A folder of the run, in which jobs of Slurm have their files.
        """
        if self.is_local:
            return local_pool(self.jobs, calls)
        if self.on.startswith(_DASK):
            return dask_pool(self.on.removeprefix(_DASK))
        _, _, file = self.on.partition(":")
        config = load_yaml(Path(file), SlurmConfig) if file else SlurmConfig()
        return slurm_pool(config, folder / "jobs")


LOCAL_EXECUTORS = Executors()
"""The cores of this machine."""
