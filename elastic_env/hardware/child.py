"""Processes of our own: they import this package and what is installed, whatever lies in the working directory.

`python -m` puts the working directory first among the folders that modules come from, and PYTHONPATH may do the same. A
`serial.py` or `numpy.py` that lies there would run in the process that keeps the limits.
"""

import site
import sys
from pathlib import Path

_PACKAGE = Path(__file__).parents[2]


def command(module: str, *arguments: str) -> list[str]:
    """Command line that runs a module with arguments in isolated mode (`python -I`).

    The user's own site-packages and the folder of this package come behind everything that is installed.
    """
    behind = [str(_PACKAGE)]
    if site.ENABLE_USER_SITE:
        behind.insert(0, site.getusersitepackages())
    code = (
        f"import runpy, sys; sys.path += {behind!r}; runpy.run_module({module!r}, run_name='__main__', alter_sys=True)"
    )
    return [sys.executable, "-I", "-c", code, *arguments]
