"""The command `elastic` around its modules: what ends it while they load, and output that nobody takes."""

import contextlib
import os
import sys

from train.runs.escaping import visible
from train.runs.failures import SYSTEM_FAILED, explained, is_interrupt


def main() -> None:
    """Entry point of the command `elastic`."""
    _have_streams()
    try:
        try:
            from train.commands.cli import main as run

            run()
        finally:
            sys.stdout.flush()
    except (KeyboardInterrupt, ImportError) as error:
        if not is_interrupt(error):
            raise
        sys.stderr.write("interrupted\n")
        os._exit(130)
    except OSError as error:
        _end_without_output(error)


def _have_streams() -> None:
    """Give a program that began without its standard streams some: libraries ask them what they are."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), "w" if number else "r"))


def _end_without_output(error: OSError) -> None:
    """End where nobody reads any more, or the disk that the output goes to is full; that is said, if it can be."""
    if not isinstance(error, BrokenPipeError):
        said, _ = explained(error) or (str(error), SYSTEM_FAILED)
        with contextlib.suppress(OSError):
            sys.stderr.write(visible(f"error: {said}\n"))
            sys.stderr.flush()
    # what is left to write goes nowhere, at the interpreter's end too
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)
    sys.exit(SYSTEM_FAILED)


if __name__ == "__main__":
    main()
