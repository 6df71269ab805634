"""How this project is installed: from a checkout or as a package, and what of it is where."""

import re
from importlib import import_module
from importlib.metadata import PackageNotFoundError, requires
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

_DISTRIBUTION = "elastic-env"
_ROOT = Path(__file__).resolve().parents[2]


def checkout() -> Path | None:
    """Folder of the checkout that this code runs from; None for an installed package."""
    files = [_ROOT / name for name in ("constraints.txt", "pyproject.toml")]
    return _ROOT if all(file.is_file() for file in files) else None


def install_command(extra: str) -> str:
    """The command that installs an extra: of the checkout, or by the names of its packages.

    Args:
        extra: Such as train.
    """
    root = checkout()
    if root is not None:
        return f"pip install -c constraints.txt '.[{extra}]' in {root}"
    return f"pip install {' '.join(_packages_of(extra))}"


def _packages_of(extra: str) -> list[str]:
    """Packages of an extra with their versions, as the installed package names them."""
    try:
        known = requires(_DISTRIBUTION) or []
    except PackageNotFoundError:
        known = []
    parts = [requirement.partition(";") for requirement in known]
    of_extra = re.compile(rf"""extra\s*==\s*['"]{re.escape(extra)}['"]""")
    return [f"'{name.strip()}'" for name, _, marker in parts if of_extra.search(marker)]


def own_package(name: str) -> ModuleType:
    """A package of this project beside `elastic_env`, whose name other files may have too.

    Args:
        name: baselines or train.

    Raises:
        ImportError: Another module of that name stands before it on the path.
    """
    own = _ROOT / name / "__init__.py"
    spec = find_spec(name)
    found = spec and spec.origin
    if found is None or Path(found).resolve() != own:
        raise ImportError(
            f"{found or name} stands in the place of the package {name} of elastic-env,"
            f" {own.parent}; rename it, or take its folder out of the path of imports"
        )
    return import_module(name)
