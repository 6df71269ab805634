"""A call in a worker process; it returns an outcome and never raises."""

import os
import pickle
import platform
import traceback
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from train.runs.import_path import remove_from_path
from train.workers.pool import CallFailedError, Outcome, Reporter
from train.workers.versions import everything, require_same


def run_remote_call(
    function: Callable[..., Any],
    arguments: tuple[Any, ...],
    number: int,
    folder: Path,
    versions: Mapping[str, str],
    reporter: Reporter,
) -> Outcome:
    """Run a call in a worker, and return its outcome.

    The worker changes to the program's folder if this machine has it, since configurations name
    files from there. A machine whose versions differ from the program's is refused.
    """
    report = partial(reporter, number)
    try:
        require_same(versions, everything(), platform.node())
        if folder.is_dir():
            os.chdir(folder)
            remove_from_path(folder)
        report(0)
        return Outcome(function(*arguments, report))
    except Exception as error:
        return Outcome(error=_portable_error(error), trace=traceback.format_exc())


def _portable_error(error: Exception) -> Exception:
    """Return an error without its traceback, in a form that can be sent."""
    error.__traceback__ = None
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return CallFailedError(f"{type(error).__name__}: {error}")
    return error
