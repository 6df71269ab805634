"""Result folders: never overwritten, each with configuration, seed, versions and commit."""

import contextlib
import errno
import fcntl
import itertools
import json
import os
import platform
import stat
import subprocess
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any, TextIO

from elastic_env.core.config import read_json
from elastic_env.core.errors import (
    ConfigurationError,
    ResultsExistError,
    SystemFailedError,
    shorten,
)
from elastic_env.core.files import leads_out, write_whole
from elastic_env.core.json_text import LARGEST_JSON
from elastic_env.core.yaml_text import yaml_of

RUNS = Path("runs")
"""Folder of results unless one is named."""

CONFIG = "config.yaml"
"""File of a run with its resolved configuration."""
_METADATA = "metadata.json"
_LOCK = ".lock"
_RETRY_S = 0.2
_LONGEST_HOLDER = 200
"""Characters of a lock that say who holds it."""
_RECORDED = "elastic-env mujoco gymnasium pin numpy scipy stable-baselines3 torch"
"""Packages whose versions a run records."""


def describe(folder: Path, configuration: dict[str, Any], seed: int | None) -> None:
    """Write configuration (`config.yaml`), first seed, versions and commit (`metadata.json`).

    Results of another configuration, which the folder has recorded, are removed.
    """
    text = yaml_of(configuration)
    results = _recorded_results(folder)
    if results and (folder / CONFIG).read_text(encoding="utf-8") != text:
        for name in results:
            (folder / name).unlink(missing_ok=True)
        results = []
    write_whole(folder / CONFIG, text)
    _write_metadata(folder, provenance(seed), results)


def record_results(folder: Path, files: Iterable[Path]) -> None:
    """Record what a run has written, so that it goes where the run goes on with another one."""
    content = json.loads((folder / _METADATA).read_text(encoding="utf-8"))
    _write_metadata(folder, content, sorted(file.name for file in files))


def _write_metadata(folder: Path, content: dict[str, Any], results: list[str]) -> None:
    content = {**content, "results": results} if results else content
    write_whole(folder / _METADATA, json.dumps(content, indent=2) + "\n")


def _recorded_results(folder: Path) -> list[str]:
    """Names of files in a folder, which may come from anybody."""
    try:
        found = read_json(folder / _METADATA, LARGEST_JSON, missing=str)
    except ConfigurationError:
        return []
    results = found.get("results") if isinstance(found, dict) else None
    named = results if isinstance(results, list) else []
    present = {file.name for file in folder.iterdir() if file.is_file()}
    return sorted(name for name in present - {CONFIG, _METADATA, _LOCK} if name in named)


def require_run(folder: Path) -> Path:
    """The file with the configuration of a run that is gone on with.

    Raises:
        ConfigurationError: The folder has no configuration, or something in it is a link that leads
            out of it, or neither a file nor a folder.
    """
    file = folder / CONFIG
    if not file.is_file():
        problem = f"{folder} is no run: it has no {CONFIG}; name a run's folder"
        raise ConfigurationError(problem)
    for place, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = Path(place, name)
            kind = path.lstat().st_mode
            if stat.S_ISLNK(kind) and leads_out(path, folder):
                raise ConfigurationError(
                    f"{path} is a link that leads out of {folder}, where nothing is to be changed;"
                    " remove it"
                )
            if not (stat.S_ISLNK(kind) or stat.S_ISREG(kind) or stat.S_ISDIR(kind)):
                problem = f"{path} is neither a file nor a folder, as all of a run are; remove it"
                raise ConfigurationError(problem)
    return file


def free_folder(name: str, output: Path | None = None) -> Path:
    """A new folder for results: the one that is named, or runs/<name>, numbered if taken.

    It is made in one step, so that of several programs each gets another one.

    Raises:
        ConfigurationError: The name is no name of a folder.
        ResultsExistError: The named folder is not empty.
        SystemFailedError: The folder cannot be made.
    """
    place = RUNS if output is None else output
    try:
        return _next_free(require_name(name)) if output is None else _empty(output)
    except OSError as error:
        cause = f"{shorten(error.filename or place)}: {error.strerror or error}"
        problem = f"no folder for results can be made at {shorten(place)} ({cause})"
        raise SystemFailedError(f"{problem}; name one by --output") from None


def require_name(name: str) -> str:
    """A name that is one folder's name and leads nowhere else.

    Raises:
        ConfigurationError: It is not.
    """
    if name in ("", ".", "..") or any(sign in name for sign in "/\\\0"):
        raise ConfigurationError(
            f"name must be the name of a folder in {RUNS}, without / and not . or .., got {name!r};"
            " to write elsewhere, name a folder by --output"
        )
    return name


@contextmanager
def lock_run(folder: Path, patience_s: float = 0.0) -> Iterator[None]:
    """Keep other programs from a run for as long as this one works on it; a kill frees it.

    Args:
        folder: Of the run.
        patience_s: How long another program is waited for [s].

    Raises:
        ConfigurationError: Another program works on it, or the lock is no file of its own.
    """
    with _open_lock(folder / _LOCK) as file:
        last = time.monotonic() + patience_s
        while True:
            with contextlib.suppress(BlockingIOError):
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            if time.monotonic() >= last:
                holder = file.read(_LONGEST_HOLDER).strip() or "unknown"
                problem = f"another program, process {holder}, works on {folder}"
                cure = "wait until it has ended, or end it"
                raise ConfigurationError(f"{problem}; {cure}")
            time.sleep(_RETRY_S)
        file.truncate(0)
        file.write(f"{os.getpid()} of {platform.node()}\n")
        file.flush()
        yield


def _open_lock(path: Path) -> TextIO:
    """The file of a lock, for reading and writing; a link, a pipe or a file of two names is none.

    Raises:
        ConfigurationError: It is one of these.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        descriptor = os.open(path, flags, 0o666)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.EISDIR, errno.ENXIO):
            raise _no_lock(path) from None
        raise
    found = os.fstat(descriptor)
    if not stat.S_ISREG(found.st_mode) or found.st_nlink != 1:
        os.close(descriptor)
        raise _no_lock(path)
    return os.fdopen(descriptor, "r+", encoding="utf-8", errors="replace")


def _no_lock(path: Path) -> ConfigurationError:
    return ConfigurationError(
        f"{path} must be a plain file with one name, it is a link or something else; remove it"
    )


@contextmanager
def lock_part(folder: Path, patience_s: float) -> Iterator[None]:
    """`lock_run` for a part of a run, whose folder is made, and removed without a result."""
    folder.mkdir(parents=True, exist_ok=True)
    with lock_run(folder, patience_s), _removed_without_result(folder):
        yield


@contextmanager
def own_folder(name: str, output: Path | None = None) -> Iterator[Path]:
    """`free_folder` for the work within, removed if that fails without a result."""
    folder = free_folder(name, output)
    with _removed_without_result(folder):
        yield folder


@contextmanager
def run_folder(
    name: str, recorded: dict[str, Any], seed: int | None, output: Path | None = None
) -> Iterator[Path]:
    """`own_folder` for a new run, described; arguments as there and in `describe`."""
    with own_folder(name, output) as folder:
        describe(folder, recorded, seed)
        yield folder


@contextmanager
def _removed_without_result(folder: Path) -> Iterator[None]:
    """Remove a folder that holds nothing but what describes it, if the work within fails."""
    try:
        yield
    except BaseException:
        files = list(folder.iterdir())
        if {file.name for file in files} <= {CONFIG, _METADATA, _LOCK}:
            for file in files:
                file.unlink()
            folder.rmdir()
            if folder.parent == RUNS:
                with contextlib.suppress(OSError):  # it holds other runs
                    RUNS.rmdir()
        raise


def _next_free(name: str) -> Path:
    """runs/<name>, or the first of its numbers that is free; `mkdir` makes it for one program."""
    RUNS.mkdir(parents=True, exist_ok=True)
    for number in itertools.count(1):
        folder = RUNS / (name if number == 1 else f"{name}-{number}")
        with contextlib.suppress(FileExistsError):
            folder.mkdir()
            return folder
    raise AssertionError


def _empty(folder: Path) -> Path:
    if folder.exists() and not folder.is_dir():
        cure = "name a folder that is new or empty"
        raise ResultsExistError(f"{shorten(folder)} is a file; {cure}")
    folder.mkdir(parents=True, exist_ok=True)
    if names := sorted(path.name for path in folder.iterdir()):
        raise ResultsExistError(
            f"{folder} already holds results ({', '.join(names[:3])}, ...), which are never"
            " overwritten; name another folder, or leave --output out"
        )
    return folder


def provenance(seed: int | None) -> dict[str, Any]:
    """When, from which commit and with which versions something is made."""
    return {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "seed": seed,
        "commit": _commit(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "versions": {name: installed_version(name) for name in _RECORDED.split()},
    }


def installed_version(package: str) -> str | None:
    """Version of a package; None where it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _commit() -> str | None:
    """Commit of the source tree, with a + for uncommitted changes; None outside a repository."""
    command = ["git", "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty=+"]
    options: Any = {"cwd": Path(__file__).parent, "text": True, "timeout": 10}
    options["stderr"] = subprocess.DEVNULL
    try:
        return subprocess.check_output(command, **options).strip()
    except (OSError, subprocess.SubprocessError):
        return None
