"""A program around its modules: what ends it while they load, and output that nobody takes."""

import contextlib
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path

from train.runs import failures
from train.runs.escaping import visible
from train.runs.import_path import ShadowedError, isolate_children, remove_from_path

_UNREAD = 128 + signal.SIGPIPE


def main() -> None:
    """Entry point of the command `elastic`."""

    def run() -> None:
        from train.commands.cli import main as elastic

        elastic()

    start(run)


def start(run: Callable[[], None]) -> None:
    """Run a program, which ends with exit code 141 where nobody reads what it says.

    Args:
        run: The program. What it imports itself does not come from the working folder.
    """
    _have_streams()
    try:
        try:
            _leave_working_folder()  # before anything else is imported
            with isolate_children():
                run()
        finally:
            sys.stdout.flush()
    except ShadowedError as error:
        sys.stderr.write(f"error: {error}\n")
        sys.exit(failures.WRONG_INPUT)
    except SystemExit as error:
        # the console of rich ends the program with 1 by itself
        if failures.is_closed_pipe(error):
            _end_without_output(BrokenPipeError())
        raise
    except (KeyboardInterrupt, ImportError) as error:
        if not failures.is_interrupt(error):
            raise
        sys.stderr.write("interrupted\n")
        os._exit(130)
    except OSError as error:
        _end_without_output(error)


def _leave_working_folder() -> None:
    """Import nothing from the working folder, here and in the processes that are started."""
    remove_from_path(Path.cwd())
    from elastic_env.hardware.safety.processes import child_environment

    kept = child_environment()
    if "PYTHONPATH" not in kept:
        os.environ.pop("PYTHONPATH", None)
    os.environ.update(kept)
    # else Numba's configuration in the working folder could name a cache, and Numba unpickles it
    os.environ.setdefault("NUMBA_CACHE_DIR", "")


def _have_streams() -> None:
    """Open standard streams where the program began without them: libraries ask what they are."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            nowhere = os.open(os.devnull, os.O_RDWR)
            setattr(sys, name, os.fdopen(nowhere, "w" if number else "r"))


def _end_without_output(error: OSError) -> None:
    """End where nobody reads, or where the disk is full, which is said if it can be."""
    is_closed = isinstance(error, BrokenPipeError)
    if not is_closed:
        said, _ = failures.explain(error) or (str(error), failures.SYSTEM_FAILED)
        with contextlib.suppress(OSError):
            sys.stderr.write(visible(f"error: {said}\n"))
            sys.stderr.flush()
    # what is left to write goes nowhere, at the interpreter's end too
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)
    sys.exit(_UNREAD if is_closed else failures.SYSTEM_FAILED)


if __name__ == "__main__":
    main()
