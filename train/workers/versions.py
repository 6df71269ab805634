"""Versions that results depend on: our sources, and the libraries that calculate."""

import functools
import hashlib
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path

from elastic_env.core.errors import ConfigurationError
from train.runs.folders import installed_version

_ROOT = Path(__file__).parents[2]
_PHYSICS = ("elastic_env", "baselines", "train/evaluate")
"""Folders of the sources that a cell depends on: plant, policies, scores."""
_ALL = ("elastic_env", "baselines", "train")
_LIBRARIES = ("numpy", "scipy", "mujoco", "pin", "numba", "gymnasium")


class VersionsDifferError(ConfigurationError):
    """Two machines have other versions."""


@functools.cache
def physics() -> dict[str, str]:
    """Versions that the figures of a cell depend on, by name."""
    return {"sources of the physics": _digest(_PHYSICS), **_library_versions()}


@functools.cache
def everything() -> dict[str, str]:
    """Versions that all machines of a run must have in common, by name."""
    return {"sources of elastic-env": _digest(_ALL), **_library_versions()}


_Versions = Mapping[str, str]


def require_same(ours: _Versions, theirs: _Versions, where: str) -> None:
    """Refuse a machine with other versions.

    Raises:
        VersionsDifferError: It has; the message names what differs, with both versions.
    """
    names = dict.fromkeys([*ours, *theirs])
    unlike = [name for name in names if ours.get(name) != theirs.get(name)]
    different = [f"{k} {theirs.get(k)} there, {ours.get(k)} here" for k in unlike]
    if different:
        raise VersionsDifferError(
            f"all machines must have the same versions, but on {where} they differ:"
            f" {'; '.join(different)}; install the same commit with the same constraints.txt"
        )


def _library_versions() -> dict[str, str]:
    """Python and the libraries that calculate."""
    versions = {name: installed_version(name) or "none" for name in _LIBRARIES}
    return {"python": platform.python_version(), **versions}


def _digest(folders: Sequence[str]) -> str:
    """The first 16 characters of the SHA-256 digest of modules and tables in some folders."""
    digest = hashlib.sha256()
    for folder in folders:
        for file in sorted((_ROOT / folder).rglob("*")):
            if file.suffix in (".py", ".csv"):
                digest.update(f"{file.relative_to(_ROOT).as_posix()}\0".encode())
                digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()[:16]
