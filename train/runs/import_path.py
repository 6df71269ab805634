"""Import path: installed packages, and the working folder last if the user names code in it.

Python puts the working folder, or the folder of a script, first. A user's `train.py` would then
replace our package, and a `multiprocessing.py` the standard library, also in child processes. Even
in last place the working folder would be searched for plug-ins of installed packages, and their
code would run. So it is on the path only if the user names a module.
"""

import importlib.util
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[2]
_PACKAGES = ("elastic_env", "baselines", "train")
_SAFE_PATH = "PYTHONSAFEPATH"


class ShadowedError(ImportError):
    """A file of the user would be imported instead of one of our packages."""


def remove_from_path(folder: Path) -> None:
    """Take the working folder from the import path.

    Raises:
        ShadowedError: Another entry of the path has a file with the name of one of our packages.
    """
    here = os.path.realpath(folder)
    others = [entry for entry in sys.path if os.path.realpath(entry or ".") != here]
    root = str(_ROOT)  # an editable installation is searched after the whole path
    sys.path[:] = others if root in others else [*others, root]
    _require_own_packages()


def append_to_path(folder: Path) -> None:
    """Append the working folder, in which the user names a module, unless it is on the path."""
    here = os.path.realpath(folder)
    if all(os.path.realpath(entry or ".") != here for entry in sys.path):
        sys.path.append(str(folder))


def _require_own_packages() -> None:
    for name in _PACKAGES:
        spec = importlib.util.find_spec(name)
        expected = _ROOT / name / "__init__.py"
        origin = spec and spec.origin
        file = Path(origin).resolve() if origin else None
        if file != expected:
            raise ShadowedError(
                f"{file or name} stands in the place of the package {name} of elastic-env,"
                f" {expected.parent}; rename it, or take its folder out of PYTHONPATH"
            )


@contextmanager
def isolate_children() -> Iterator[None]:
    """Keep Python processes that start within from importing from the working folder first."""
    before = os.environ.get(_SAFE_PATH)
    os.environ[_SAFE_PATH] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[_SAFE_PATH]
        else:
            os.environ[_SAFE_PATH] = before
