"""Text of a failure, and the exit code of `elastic`: one sentence each, from one place.

| exit code | meaning |
|---|---|
| 0 | fine |
| 1 | `elastic bench` alone: a figure is worse than accepted |
| 2 | a wrong input: configuration, name, option, a policy of the user's that fails |
| 3 | the system failed: disk, memory, process, port |
| 70 | a defect of this program, with its traceback |
| 128 + n | ended by signal n |
"""

import ctypes
import errno
from collections.abc import Iterator

from train.runs.import_path import ShadowedError

WRONG_INPUT = 2
SYSTEM_FAILED = 3
DEFECT = 70

_EXTRAS = {
    "train": ("torch", "stable_baselines3", "tensorboard", "cmaes"),
    "report": ("matplotlib", "plotly", "jinja2", "imageio", "imageio_ffmpeg", "PIL"),
    "cluster": ("dask", "distributed", "submitit"),
    "hardware": ("dynamixel_sdk", "serial", "mscl"),
    "robots": ("example_robot_data",),
}
_CURES = {
    errno.ENOSPC: "free some space; a run goes on with --resume",
    errno.EDQUOT: "free some of your quota; a run goes on with --resume",
    errno.EFBIG: "raise the limit on the size of files (ulimit -f); a run goes on with --resume",
    errno.EROFS: "name a folder that can be written, by --output",
    errno.EACCES: "name a folder that can be written, by --output",
}

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class EndedError(KeyboardInterrupt):
    """A signal that asks to end; what is done at Ctrl-C is done for it too, such as torque off,
    and saying so.
    """


def explain(error: BaseException) -> tuple[str, int] | None:
    """Sentence and exit code of a failure; None for a defect, of which the traceback is worth
    having.
    """
    if isinstance(error, ShadowedError):
        return str(error), WRONG_INPUT
    from elastic_env.core.errors import ElasticError, missing_extra, shorten

    if is_interrupt(error):
        return "interrupted", 130
    if isinstance(error, ElasticError):
        return str(error), error.exit_code
    if isinstance(error, ModuleNotFoundError) and (extra := _extra_of(error)):
        return str(missing_extra(str(error.name), extra, "this")), WRONG_INPUT
    if isinstance(error, MemoryError):
        return "there is not enough memory; take fewer worlds or fewer --jobs", SYSTEM_FAILED
    for cause in _causes(error):
        if isinstance(cause, OSError) and cause.errno is not None:
            place = f"{shorten(cause.filename)}: " if cause.filename else ""
            cure = _CURES.get(cause.errno)
            return f"{place}{cause.strerror}" + (f"; {cure}" if cure else ""), SYSTEM_FAILED
    return None


def is_interrupt(error: BaseException) -> bool:
    """True if it is Ctrl-C, which a module that is being loaded or a call of C may turn into an
    error of its own.
    """
    return any(
        isinstance(cause, KeyboardInterrupt) or _quotes_interrupt(cause) for cause in _causes(error)
    )


def _quotes_interrupt(error: BaseException) -> bool:
    """True if `ctypes` met Ctrl-C while it converted an argument: its error only quotes the
    exception.
    """
    names = (KeyboardInterrupt.__name__, EndedError.__name__)
    return isinstance(error, ctypes.ArgumentError) and any(name in str(error) for name in names)


def is_unread(error: BaseException) -> bool:
    """True if it comes from a pipe whose reader has gone, such as `head`."""
    return any(isinstance(cause, BrokenPipeError) for cause in _causes(error))


def is_full(error: BaseException) -> bool:
    """True if it comes from a disk, a quota or a limit on files that leaves no room."""
    return any(isinstance(cause, OSError) and cause.errno in _NO_ROOM for cause in _causes(error))


def _extra_of(error: ModuleNotFoundError) -> str:
    package = str(error.name).split(".")[0]
    return next((extra for extra, packages in _EXTRAS.items() if package in packages), "")


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """An error and what it came from."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__
