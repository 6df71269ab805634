"""Result folders: never overwritten, each with the configuration, seed, versions and commit that made it."""

import json
import platform
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any

import yaml

from elastic_env.errors import ResultsExistError

RUNS = Path("runs")
"""Where results go unless a folder is named."""

_PACKAGES = ("elastic-env", "mujoco", "gymnasium", "pin", "numpy", "scipy", "stable-baselines3", "torch")


def new_run(name: str, configuration: dict[str, Any], seed: int | None, output: Path | None = None) -> Path:
    """Create a result folder and write down what its results depend on.

    Args:
        name: Name of the run; a taken name gets the next free number.
        configuration: Resolved configuration, written as `config.yaml`.
        seed: First seed, written with versions and commit as `metadata.json`.
        output: Folder to use instead; it must not hold anything yet.

    Returns:
        The folder.

    Raises:
        ResultsExistError: The named output folder is not empty.
    """
    folder = free_folder(name, output)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(configuration, sort_keys=False, allow_unicode=True))
    (folder / "metadata.json").write_text(json.dumps(provenance(seed), indent=2) + "\n")
    return folder


def free_folder(name: str, output: Path | None = None) -> Path:
    """A folder to write results to: the one that is named, or runs/<name>, numbered if taken.

    Raises:
        ResultsExistError: The named folder is not empty.
    """
    return _next_free(RUNS / name) if output is None else _empty(output)


@contextmanager
def run_folder(
    name: str, configuration: dict[str, Any], seed: int | None, output: Path | None = None
) -> Iterator[Path]:
    """A new run for the work within; it goes again if the work is interrupted or fails without a result.

    Arguments and errors as `new_run`.
    """
    folder = new_run(name, configuration, seed, output)
    described = set(folder.iterdir())
    try:
        yield folder
    except BaseException:
        if set(folder.iterdir()) == described:
            for file in described:
                file.unlink()
            folder.rmdir()
        raise


def _next_free(folder: Path) -> Path:
    if not _holds_results(folder):
        return folder
    number = 2
    while _holds_results(candidate := folder.with_name(f"{folder.name}-{number}")):
        number += 1
    return candidate


def _empty(folder: Path) -> Path:
    if folder.exists() and not folder.is_dir():
        raise ResultsExistError(f"{folder} is a file; name a folder that is new or empty")
    if _holds_results(folder):
        raise ResultsExistError(
            f"{folder} already holds results ({', '.join(sorted(p.name for p in folder.iterdir())[:3])}, ...), "
            "which are never overwritten; name another folder, or leave --output out"
        )
    return folder


def _holds_results(folder: Path) -> bool:
    return folder.exists() and (not folder.is_dir() or any(folder.iterdir()))


def provenance(seed: int | None) -> dict[str, Any]:
    """When, from which commit and with which versions something is made."""
    return {
        "created": datetime.now(timezone.utc).isoformat(timespec="seconds"),  # noqa: UP017  Python 3.11 has both
        "seed": seed,
        "commit": _commit(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "versions": {name: _version(name) for name in _PACKAGES},
    }


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _commit() -> str | None:
    """Commit of the source tree, with a + where it has uncommitted changes; None outside a repository."""
    here = Path(__file__).parent

    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", *arguments], cwd=here, capture_output=True, text=True, check=True, timeout=10
        ).stdout.strip()

    try:
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return None
