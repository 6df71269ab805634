"""Workers of a dask cluster, whose scheduler and workers the user has started."""

import ipaddress
import logging
import socket
import uuid
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

from elastic_env.core.errors import ConfigurationError, SystemFailedError, missing_extra
from train.workers.pool import MAX_RETRIES, Pool
from train.workers.versions import everything, require_same

_CONNECT_S = 10
_WORKER_S = 60


@contextmanager
def dask_pool(address: str) -> Iterator[Pool]:
    """Open a pool of the workers of a dask scheduler.

    Dask itself moves the calls of a lost worker: `MAX_RETRIES` times, or less often if its
    scheduler is configured so.

    Args:
        address: Address of the scheduler, HOST:PORT.

    Raises:
        SystemFailedError: No scheduler answers there, or it has no worker.
        VersionsDifferError: A worker has other versions.
    """
    try:
        import distributed
    except ModuleNotFoundError:
        raise missing_extra("distributed", "cluster", "--on dask://") from None
    warn_of_public(address)
    # lost workers are reported by this program
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    try:
        client = distributed.Client(f"tcp://{address}", timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        problem = f"no dask scheduler answers at {address} ({error})"
        cure = "start one there with: dask scheduler --host ADDRESS"
        raise SystemFailedError(f"{problem}; {cure}") from None
    with client:
        _prepare_cluster(client, address)
        topic = f"elastic-{uuid.uuid4().hex}"
        executor = client.get_executor(pure=False)
        pool = Pool(executor.submit, partial(_log_event, topic))
        client.subscribe_topic(topic, lambda event: pool.events.put(tuple(event[1])))
        try:
            yield pool
        finally:
            with suppress(Exception):  # the scheduler may be gone
                client.unsubscribe_topic(topic)
                executor.shutdown(wait=False)  # cancels running calls


def warn_of_public(address: str) -> None:
    """Warn of a scheduler at a public address, since anyone who reaches it can run code there.

    Args:
        address: HOST:PORT; all addresses of a host name are checked.
    """
    host, _, port = address.rpartition(":")
    try:
        records = socket.getaddrinfo(host.strip("[]"), port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        return  # connecting raises the error
    hosts = [str(address[0]).partition("%")[0] for *_, address in records]
    public = [host for host in hosts if ipaddress.ip_address(host).is_global]
    if public:
        warnings.warn(
            f"the dask scheduler at {public[0]} is at a public address, by plain TCP:"
            " whoever reaches it runs code on all of its machines; start it with --host"
            " and an address within your network, or 127.0.0.1 behind ssh",
            UserWarning,
            stacklevel=2,
        )


def _prepare_cluster(client: Any, address: str) -> None:
    """Wait for a worker, compare versions, and limit how often calls are moved."""
    try:
        client.wait_for_workers(1, timeout=_WORKER_S)
        versions_by_worker = client.run(everything)
        client.run_on_scheduler(_limit_retries, limit=MAX_RETRIES)
    except TimeoutError:
        problem = f"the dask scheduler at {address} had no worker within {_WORKER_S} s"
        cure = f"start one with: dask worker {address} --nthreads 1"
        raise SystemFailedError(f"{problem}; {cure}") from None
    except ModuleNotFoundError as error:
        problem = f"the dask cluster at {address} has no module {error.name!r}"
        cure = "install elastic-env on its scheduler and its workers"
        raise ConfigurationError(f"{problem}; {cure}") from None
    for worker, versions in versions_by_worker.items():
        require_same(everything(), versions, worker)


def _limit_retries(limit: int, dask_scheduler: Any = None) -> None:
    """Let the scheduler give up a call that has lost its worker more often than the limit."""
    dask_scheduler.allowed_failures = min(dask_scheduler.allowed_failures, limit)


def _log_event(topic: str, number: int, value: Any) -> None:
    """Report from a worker: an event of dask, which its scheduler sends to the client."""
    from distributed import get_worker

    get_worker().log_event(topic, (number, value))
