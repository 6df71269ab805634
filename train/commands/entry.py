"""Entry point of the program: interrupts while modules load, and output that nobody reads."""

import contextlib
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path

from train.runs import failures
from train.runs.escaping import visible
from train.runs.import_path import ShadowedError, isolate_children, remove_from_path

_PIPE_CLOSED = 128 + signal.SIGPIPE
"""Exit code if nobody reads the output."""


def main() -> None:
    """Entry point of the command `elastic`."""

    def run() -> None:
        from train.commands.cli import main as elastic

        elastic()

    start(run)


def start(run: Callable[[], None]) -> None:
    """Run a program; if nobody reads its output, it ends with exit code 141.

    Args:
        run: The program. Its imports do not come from the working folder.
    """
    _open_streams()
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
        # the console of rich raises SystemExit(1) at a closed pipe
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
    """Import nothing from the working folder, here and in child processes."""
    remove_from_path(Path.cwd())
    from elastic_env.hardware.safety.processes import child_environment

    variables = child_environment()
    if "PYTHONPATH" not in variables:
        os.environ.pop("PYTHONPATH", None)
    os.environ.update(variables)
    # otherwise Numba's configuration in the working folder could name a cache, which is unpickled
    os.environ.setdefault("NUMBA_CACHE_DIR", "")


def _open_streams() -> None:
    """Open missing standard streams, since libraries use them."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            null = os.open(os.devnull, os.O_RDWR)
            setattr(sys, name, os.fdopen(null, "w" if number else "r"))


def _end_without_output(error: OSError) -> None:
    """End the program at a closed pipe, or at a full disk, which is printed if possible."""
    is_closed = isinstance(error, BrokenPipeError)
    if not is_closed:
        message, _ = failures.explain(error) or (str(error), failures.SYSTEM_FAILED)
        with contextlib.suppress(OSError):
            sys.stderr.write(visible(f"error: {message}\n"))
            sys.stderr.flush()
    # the interpreter flushes the remaining output at its end
    null = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(null, stream)
    sys.exit(_PIPE_CLOSED if is_closed else failures.SYSTEM_FAILED)


if __name__ == "__main__":
    main()
