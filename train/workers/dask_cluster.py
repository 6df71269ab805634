"""Workers of a dask cluster, whose scheduler and workers somebody else has started."""

import ipaddress
import logging
import queue
import socket
import uuid
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Executor, Future
from contextlib import contextmanager, suppress
from typing import Any

from elastic_env.core.errors import ConfigurationError, SystemFailedError, missing_extra
from train.workers.calls import MOST_MOVES, ExecutorLostError, Pool, WorkerKilledError
from train.workers.versions import everything, require_same

_CONNECT_S = 10
_WORKER_S = 60


@contextmanager
def dask_pool(address: str) -> Iterator[Pool]:
    """Workers of the cluster whose scheduler has an address.

    Dask itself moves the calls of a worker that is lost: as often as `MOST_MOVES` says, or less where its scheduler is
    told so.

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
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what is lost is said by us
    try:
        client = distributed.Client(f"tcp://{address}", timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise SystemFailedError(
            f"no dask scheduler answers at {address} ({error}); start one there with: dask scheduler --host ADDRESS"
        ) from None
    with client:
        _prepare(client, address)
        topic = f"elastic-{uuid.uuid4().hex}"
        pool = Pool(_Cluster(client), _LogEvent(topic))
        client.subscribe_topic(topic, _into(pool.events))
        try:
            yield pool
        finally:
            with suppress(Exception):  # the scheduler may be gone
                client.unsubscribe_topic(topic)
            pool.executor.shutdown(wait=False, cancel_futures=True)


def warn_of_public(address: str) -> None:
    """Warn where a scheduler, which runs the code of whoever reaches it, has an address of the Internet.

    Args:
        address: HOST:PORT; a name stands for all of its addresses.
    """
    host, _, port = address.rpartition(":")
    try:
        found = socket.getaddrinfo(host.strip("[]"), port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        return  # the connection says what is wrong
    public = [str(place[0]) for *_, place in found if ipaddress.ip_address(str(place[0]).partition("%")[0]).is_global]
    if public:
        warnings.warn(
            f"the dask scheduler at {public[0]} is at a public address, by plain TCP: whoever reaches it runs code on "
            "all of its machines; start it with --host and an address within your network, or 127.0.0.1 behind ssh",
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
        raise SystemFailedError(
            f"the dask scheduler at {address} had no worker within {_WORKER_S} s; start one with: "
            f"dask worker {address} --nthreads 1"
        ) from None
    except ModuleNotFoundError as error:
        raise ConfigurationError(
            f"the dask cluster at {address} has no module {error.name!r}; install elastic-env on its scheduler and its "
            "workers"
        ) from None
    for worker, versions in found.items():
        require_same(everything(), versions, worker)


def _limit_moves(most: int, dask_scheduler: Any = None) -> None:
    """On the scheduler: a call that has lost its worker more often is given up."""
    dask_scheduler.allowed_failures = min(dask_scheduler.allowed_failures, most)


class _Cluster(Executor):
    """A dask client as an executor.

    Dask's own executor keeps every result in the memory of its worker until the end. When the worker is lost, dask
    makes such results anew. Here a result is released as soon as it has arrived.
    """

    def __init__(self, client: Any) -> None:
        self._client, self._futures = client, set[Any]()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """See `Executor`."""
        future, ours = self._client.submit(fn, *args, **kwargs, pure=False), Future[Any]()
        self._futures.add(future)
        future.add_done_callback(lambda done: self._settle(done, ours))
        ours.add_done_callback(lambda _: future.cancel() if ours.cancelled() else None)
        return ours

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """See `Executor`."""
        futures = list(self._futures)
        with suppress(Exception):  # the scheduler may be gone
            if cancel_futures:
                self._client.cancel(futures)
            elif wait:
                for future in futures:
                    future.exception()

    def _settle(self, future: Any, ours: "Future[Any]") -> None:
        """In dask's thread for it: hand on what came of a call, and release it."""
        try:
            if ours.set_running_or_notify_cancel():
                ours.set_result(future.result())
        except CancelledError:
            ours.set_exception(ExecutorLostError("the dask scheduler is gone, or it has dropped the calls"))
        except Exception as error:
            lost = type(error).__name__ == "KilledWorker"
            ours.set_exception(WorkerKilledError() if lost else error)
        self._futures.discard(future)
        future.release()


class _LogEvent:
    """Reports as events of dask, from a worker by its scheduler to the client."""

    def __init__(self, topic: str) -> None:
        self._topic = topic

    def __call__(self, number: int, value: Any) -> None:
        from distributed import get_worker

        get_worker().log_event(self._topic, (number, value))


def _into(events: "queue.SimpleQueue[Any]") -> Callable[[Any], None]:
    def take(event: Any) -> None:
        number, value = event[1]
        events.put((number, value))

    return take
