"""Installation of this project, from a checkout or as a package, and the paths of its parts."""

import re
from importlib import import_module
from importlib.metadata import PackageNotFoundError, requires
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

_DISTRIBUTION = "elastic-env"
_ROOT = Path(__file__).resolve().parents[2]


def checkout() -> Path | None:
    """Return the checkout that this code runs from; None for an installed package."""
    files = [_ROOT / name for name in ("constraints.txt", "pyproject.toml")]
    return _ROOT if all(file.is_file() for file in files) else None


def install_command(extra: str) -> str:
    """Return the command that installs an extra, in the checkout or by its packages.

    Args:
        extra: Name of the extra, such as train.
    """
    root = checkout()
    if root is not None:
        return f"pip install -c constraints.txt '.[{extra}]' in {root}"
    return f"pip install {' '.join(_packages_of(extra))}"


def _packages_of(extra: str) -> list[str]:
    """Return the packages of an extra with their versions, by the installed metadata."""
    try:
        requirements = requires(_DISTRIBUTION) or []
    except PackageNotFoundError:
        requirements = []
    parts = [requirement.partition(";") for requirement in requirements]
    of_extra = re.compile(rf"""extra\s*==\s*['"]{re.escape(extra)}['"]""")
    return [f"'{name.strip()}'" for name, _, marker in parts if of_extra.search(marker)]


def import_package(name: str) -> ModuleType:
    """Import another package of this project, after a check that no other file has its name.

    Args:
        name: baselines or train.

    Raises:
        ImportError: Another module of that name comes before it on the path.
    """
    own = _ROOT / name / "__init__.py"
    spec = find_spec(name)
    origin = spec and spec.origin
    if origin is None or Path(origin).resolve() != own:
        raise ImportError(
            f"{origin or name} stands in the place of the package {name} of elastic-env,"
            f" {own.parent}; rename it, or take its folder out of the path of imports"
        )
    return import_module(name)
