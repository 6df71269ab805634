"""Versions that results depend on: our sources, and numerical libraries."""

import functools
import hashlib
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path

from elastic_env.core.errors import ConfigurationError
from train.runs.folders import installed_version

_ROOT = Path(__file__).parents[2]
_PHYSICS = ("elastic_env", "baselines", "train/evaluate")
"""Folders of the sources on which a cell depends: plant, policies, scores."""
_ALL = ("elastic_env", "baselines", "train")
_LIBRARIES = ("numpy", "scipy", "mujoco", "pin", "numba", "gymnasium")


class VersionsDifferError(ConfigurationError):
    """The versions of two machines differ."""


@functools.cache
def physics() -> dict[str, str]:
    """Return the versions on which the figures of a cell depend, by name."""
    return {"sources of the physics": _digest(_PHYSICS), **_library_versions()}


@functools.cache
def everything() -> dict[str, str]:
    """Return the versions that must be the same on all machines of a run, by name."""
    return {"sources of elastic-env": _digest(_ALL), **_library_versions()}


_Versions = Mapping[str, str]


def require_same(ours: _Versions, theirs: _Versions, where: str) -> None:
    """Refuse a machine with other versions.

    Raises:
        VersionsDifferError: The versions differ; the message lists both.
    """
    names = dict.fromkeys([*ours, *theirs])
    differing = [name for name in names if ours.get(name) != theirs.get(name)]
    differences = [f"{k} {theirs.get(k)} there, {ours.get(k)} here" for k in differing]
    if differences:
        raise VersionsDifferError(
            f"all machines must have the same versions, but on {where} they differ:"
            f" {'; '.join(differences)}; install the same commit with the same constraints.txt"
        )


def _library_versions() -> dict[str, str]:
    """Return the versions of Python and of the numerical libraries."""
    versions = {name: installed_version(name) or "none" for name in _LIBRARIES}
    return {"python": platform.python_version(), **versions}


def _digest(folders: Sequence[str]) -> str:
    """Return the first 16 characters of the SHA-256 of modules and tables in some folders."""
    digest = hashlib.sha256()
    for folder in folders:
        for file in sorted((_ROOT / folder).rglob("*")):
            if file.suffix in (".py", ".csv"):
                digest.update(f"{file.relative_to(_ROOT).as_posix()}\0".encode())
                digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()[:16]
