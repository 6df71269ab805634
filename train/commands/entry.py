"""The command `elastic` before its modules are loaded: what ends it meanwhile is said in a word."""

import os
import sys

from train.runs.failures import is_interrupt


def main() -> None:
    """Entry point of the command `elastic`."""
    try:
        from train.commands.cli import main as run

        run()
        sys.stdout.flush()
    except (KeyboardInterrupt, ImportError) as error:
        if not is_interrupt(error):
            raise
        sys.stderr.write("interrupted\n")
        os._exit(130)
    except BrokenPipeError:
        # nobody reads any more; neither may the interpreter write what is left
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(3)


if __name__ == "__main__":
    main()
