"""Messages of failures, one sentence each, and exit codes of `elastic`.

| exit code | meaning |
|---|---|
| 0 | fine |
| 1 | `elastic bench` alone: a figure is worse than accepted |
| 2 | a wrong input: configuration, name, option, a user's policy that fails |
| 3 | the system failed: disk, memory, process, port |
| 70 | a defect of this program, with its traceback |
| 128 + n | ended by signal n |
"""

import ctypes
import errno
import re
from collections.abc import Iterator

from train.runs.import_path import ShadowedError

WRONG_INPUT = 2
SYSTEM_FAILED = 3
DEFECT = 70

_EXTRAS = {
    "train": ("torch", "stable_baselines3", "tensorboard", "cmaes"),
    "report": ("matplotlib", "plotly", "jinja2", "imageio", "imageio_ffmpeg", "PIL"),
    "onnx": ("onnx", "onnxruntime"),
    "cluster": ("dask", "distributed", "submitit"),
    "hardware": ("dynamixel_sdk", "serial", "mscl"),
    "robots": ("example_robot_data",),
    "hub": ("huggingface_hub",),
}
_CURES = {
    errno.ENOSPC: "free some space; a run goes on with --resume",
    errno.EDQUOT: "free some of your quota; a run goes on with --resume",
    errno.EFBIG: "raise the limit on the size of files (ulimit -f); a run goes on with --resume",
    errno.EROFS: "name a folder that can be written, by --output",
    errno.EACCES: "name a folder that can be written, by --output",
}

_DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class SignalError(KeyboardInterrupt):
    """A signal that ends the program; everything happens as at Ctrl-C, such as torque off."""


def explain(error: BaseException) -> tuple[str, int] | None:
    """Return message and exit code of a failure; None for a defect, which needs its traceback."""
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
        cure = "take fewer worlds or fewer --jobs"
        return f"there is not enough memory; {cure}", SYSTEM_FAILED
    for cause in _causes(error):
        if isinstance(cause, OSError) and cause.errno is not None:
            place = f"{shorten(cause.filename)}: " if cause.filename else ""
            cure = f"; {_CURES[cause.errno]}" if cause.errno in _CURES else ""
            return f"{place}{cause.strerror}{cure}", SYSTEM_FAILED
    return None


def is_interrupt(error: BaseException) -> bool:
    """Return True for Ctrl-C, which a loading module or a call of C may turn into another error."""
    return any(map(_names_interrupt, _causes(error)))


def _names_interrupt(error: BaseException) -> bool:
    """Return True for an interrupt, or an error of `ctypes` that quotes one.

    An interrupt during the conversion of an argument becomes such an error.
    """
    if isinstance(error, ctypes.ArgumentError):
        return re.search("KeyboardInterrupt|SignalError", str(error)) is not None
    return isinstance(error, KeyboardInterrupt)


def is_closed_pipe(error: BaseException) -> bool:
    """Return True if an error comes from a pipe whose reader has ended, such as `head`."""
    return any(isinstance(cause, BrokenPipeError) for cause in _causes(error))


def is_disk_full(error: BaseException) -> bool:
    """Return True if an error comes from a full disk, a quota or a limit on the size of files."""
    return any(isinstance(e, OSError) and e.errno in _DISK_FULL for e in _causes(error))


def _extra_of(error: ModuleNotFoundError) -> str:
    """Return the extra that installs a missing module; empty if none does."""
    package = str(error.name).split(".")[0]
    return next((extra for extra in _EXTRAS if package in _EXTRAS[extra]), "")


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error and the errors that it came from."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__
