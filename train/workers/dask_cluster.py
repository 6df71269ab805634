"""Workers of a dask cluster, whose scheduler and workers somebody else has started."""

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
from train.workers.calls import MOST_MOVES, Pool
from train.workers.versions import everything, require_same

_CONNECT_S = 10
_WORKER_S = 60


@contextmanager
def dask_pool(address: str) -> Iterator[Pool]:
    """Workers of the cluster whose scheduler has an address.

    Dask itself moves the calls of a worker that is lost: as often as `MOST_MOVES` says, or less
    where its scheduler is told so.

    Args:
        address: Of the scheduler, HOST:PORT.

    Raises:
        SystemFailedError: No scheduler answers there, or it has no worker.
        VersionsDifferError: A worker has other versions.
    """
    try:
        import distributed
    except ModuleNotFoundError:
        raise missing_extra("distributed", "cluster", "--on dask://") from None
    warn_of_public(address)
    # what is lost is said by us
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    options = {"timeout": _CONNECT_S, "set_as_default": False}
    try:
        client = distributed.Client(f"tcp://{address}", **options)
    except (OSError, ValueError) as error:
        problem = f"no dask scheduler answers at {address} ({error})"
        cure = "start one there with: dask scheduler --host ADDRESS"
        raise SystemFailedError(f"{problem}; {cure}") from None
    with client:
        _prepare(client, address)
        topic = f"elastic-{uuid.uuid4().hex}"
        executor = client.get_executor(pure=False)
        pool = Pool(executor.submit, partial(_log_event, topic))
        client.subscribe_topic(topic, lambda event: pool.events.put(tuple(event[1])))
        try:
            yield pool
        finally:
            with suppress(Exception):  # the scheduler may be gone
                client.unsubscribe_topic(topic)
                executor.shutdown(wait=False)  # cancels what runs


def warn_of_public(address: str) -> None:
    """Warn of a scheduler, which runs the code of whoever reaches it, at a public address.

    Args:
        address: HOST:PORT; a name stands for all of its addresses.
    """
    host, _, port = address.rpartition(":")
    try:
        found = socket.getaddrinfo(host.strip("[]"), port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        return  # the connection says what is wrong
    hosts = [str(place[0]).partition("%")[0] for *_, place in found]
    public = [host for host in hosts if ipaddress.ip_address(host).is_global]
    if public:
        warnings.warn(
            f"the dask scheduler at {public[0]} is at a public address, by plain TCP: whoever"
            " reaches it runs code on all of its machines; start it with --host and an address"
            " within your network, or 127.0.0.1 behind ssh",
            UserWarning,
            stacklevel=2,
        )


def _prepare(client: Any, address: str) -> None:
    """Wait for a worker, compare versions, and have calls moved no more often than we say."""
    try:
        client.wait_for_workers(1, timeout=_WORKER_S)
        found = client.run(everything)
        client.run_on_scheduler(_limit_moves, most=MOST_MOVES)
    except TimeoutError:
        problem = f"the dask scheduler at {address} had no worker within {_WORKER_S} s"
        cure = f"start one with: dask worker {address} --nthreads 1"
        raise SystemFailedError(f"{problem}; {cure}") from None
    except ModuleNotFoundError as error:
        problem = f"the dask cluster at {address} has no module {error.name!r}"
        cure = "install elastic-env on its scheduler and its workers"
        raise ConfigurationError(f"{problem}; {cure}") from None
    for worker, versions in found.items():
        require_same(everything(), versions, worker)


def _limit_moves(most: int, dask_scheduler: Any = None) -> None:
    """On the scheduler: a call that has lost its worker more often is given up."""
    dask_scheduler.allowed_failures = min(dask_scheduler.allowed_failures, most)


def _log_event(topic: str, number: int, value: Any) -> None:
    """In a worker: report by an event of dask, by its scheduler to the client."""
    from distributed import get_worker

    get_worker().log_event(topic, (number, value))
