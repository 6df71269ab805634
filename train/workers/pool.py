"""Pools of workers: outcomes of calls, and errors of workers and executors."""

import queue
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any

from elastic_env.core.errors import ConfigurationError, ElasticError, SystemFailedError

MAX_RETRIES = 2
"""Number of times that a call starts again after its worker was lost."""

Reporter = Callable[[int, Any], None]
"""Takes the number of a call and its report; it travels to the workers."""


class WorkerLostError(SystemFailedError):
    """The worker of a call is gone: killed, preempted, or out of reach.

    A future raises it.
    """


class WorkerKilledError(SystemFailedError):
    """A call lost its worker at every try."""

    def __init__(self) -> None:
        super().__init__(
            "a worker process was killed each time that it was tried, most often for"
            " lack of memory; take fewer --jobs or more memory"
        )


class ExecutorLostError(SystemFailedError):
    """The executor is gone: the scheduler of a cluster."""


class UnguardedScriptError(ConfigurationError):
    """Workers import the running script, and it would start workers again.

    A future raises it.
    """

    def __init__(self) -> None:
        super().__init__(
            "a process ended while it started; a script that starts processes must do so below "
            'if __name__ == "__main__": since each of them imports the script'
        )


class CallFailedError(ElasticError):
    """A call raised an error that cannot be sent between processes; this one has its text."""


@dataclass(frozen=True)
class Outcome:
    """Result of a call.

    Attributes:
        value: Returned value.
        error: Raised error; None if the call returned.
        trace: Traceback of the error.
    """

    value: Any = None
    error: Exception | None = None
    trace: str = ""


@dataclass(frozen=True)
class Pool:
    """Workers.

    Attributes:
        submit: Runs a function with its arguments. The returned future raises `WorkerLostError` if
            the call may start again.
        reporter: Sends the reports of a call.
        events: Receives the reports, as pairs of call number and report.
    """

    submit: Callable[..., Future[Any]]
    reporter: Reporter
    events: "queue.SimpleQueue[Any]" = field(default_factory=queue.SimpleQueue)
