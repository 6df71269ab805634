"""The path of imports: what is installed, and the working folder last where a name asks for it.

Python puts the working folder, or a script's own, first: a user's `train.py` would then stand
before our package, and a `multiprocessing.py` before the standard library, also in each process
that is started. Behind everything else, it would still be searched for plug-ins of installed
packages, whose code would run.
"""

import importlib.util
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[2]
_OURS = ("elastic_env", "baselines", "train")
_SAFE = "PYTHONSAFEPATH"


class ShadowedError(ImportError):
    """A file of the user stands before one of our packages."""


def leave(folder: Path) -> None:
    """Look for no modules in a folder.

    Args:
        folder: The working folder.

    Raises:
        ShadowedError: Another entry of the path has a file that stands before a package of ours.
    """
    here = os.path.realpath(folder)
    others = [entry for entry in sys.path if os.path.realpath(entry or ".") != here]
    root = str(_ROOT)  # an editable installation is found behind the whole path
    sys.path[:] = others if root in others else [*others, root]
    _require_ours()


def look_last_in(folder: Path) -> None:
    """Look for modules in a folder too, behind everything else, unless it is on the path.

    Args:
        folder: The working folder, from which the user names a module.
    """
    here = os.path.realpath(folder)
    if all(os.path.realpath(entry or ".") != here for entry in sys.path):
        sys.path.append(str(folder))


def _require_ours() -> None:
    for name in _OURS:
        spec = importlib.util.find_spec(name)
        own = _ROOT / name / "__init__.py"
        origin = spec and spec.origin
        found = Path(origin).resolve() if origin else None
        if found != own:
            raise ShadowedError(
                f"{found or name} stands in the place of the package {name} of elastic-env,"
                f" {own.parent}; rename it, or take its folder out of PYTHONPATH"
            )


@contextmanager
def safe_children() -> Iterator[None]:
    """Processes of Python that start within do not look for modules in the working folder first."""
    before = os.environ.get(_SAFE)
    os.environ[_SAFE] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[_SAFE]
        else:
            os.environ[_SAFE] = before
