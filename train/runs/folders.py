"""Result folders: never overwritten, each with configuration, seed, versions and commit."""

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
from contextlib import contextmanager, suppress
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
"""Folder of results, unless the user names one."""

CONFIG = "config.yaml"
"""File of a run with its resolved configuration."""
_METADATA = "metadata.json"
_LOCK = ".lock"
_DESCRIPTION_FILES = {CONFIG, _METADATA, _LOCK}
"""Files of a run that are no results."""
_RETRY_S = 0.2
_HOLDER_CHARACTERS = 200
"""Longest text that is read from a lock file [characters]; it names the process."""
_PACKAGES = "elastic-env mujoco gymnasium pin numpy scipy stable-baselines3 torch"
"""Packages whose versions a run records."""


def record_run(folder: Path, configuration: dict[str, Any], seed: int | None) -> None:
    """Write configuration (`config.yaml`), first seed, versions and commit (`metadata.json`).

    If the folder has another configuration, its recorded results are removed.
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
    """Record the files of a run, which are removed if it continues with another configuration."""
    content = json.loads((folder / _METADATA).read_text(encoding="utf-8"))
    _write_metadata(folder, content, sorted(file.name for file in files))


def _write_metadata(folder: Path, content: dict[str, Any], results: list[str]) -> None:
    content = {**content, "results": results} if results else content
    write_whole(folder / _METADATA, json.dumps(content, indent=2) + "\n")


def _recorded_results(folder: Path) -> list[str]:
    """Return the names of recorded files in a folder, which others may have made."""
    try:
        content = read_json(folder / _METADATA, LARGEST_JSON, missing=str)
    except ConfigurationError:
        return []
    results = content.get("results") if isinstance(content, dict) else None
    recorded = results if isinstance(results, list) else []
    present = {file.name for file in folder.iterdir() if file.is_file()}
    return sorted(name for name in present - _DESCRIPTION_FILES if name in recorded)


def require_run(folder: Path) -> Path:
    """Return the configuration file of a run that is to be continued.

    Raises:
        ConfigurationError: The folder is missing, has no configuration, or contains a link that
            leads out of it, or something that is neither a file nor a folder.
    """
    file = folder / CONFIG
    if not folder.exists():
        raise ConfigurationError(f"there is no folder {folder}; name a run's folder")
    if not file.is_file():
        problem = f"{folder} is no run: it has no {CONFIG}; name a run's folder"
        raise ConfigurationError(problem)
    for parent, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = Path(parent, name)
            mode = path.lstat().st_mode
            if stat.S_ISLNK(mode) and leads_out(path, folder):
                raise ConfigurationError(
                    f"{path} is a link that leads out of {folder}, where nothing is to"
                    " be changed; remove it"
                )
            if not (stat.S_ISLNK(mode) or stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                problem = f"{path} is neither a file nor a folder, as all of a run are; remove it"
                raise ConfigurationError(problem)
    return file


def create_folder(name: str, output: Path | None = None) -> Path:
    """Create a folder for results: `output`, or runs/<name> with a number if that exists.

    Programs that run at the same time get different folders.

    Raises:
        ConfigurationError: The name is not one folder's name.
        ResultsExistError: `output` is not empty.
        SystemFailedError: The folder cannot be made.
    """
    try:
        return _numbered_folder(name) if output is None else _empty_folder(output)
    except OSError as error:
        place = RUNS if output is None else output
        cause = f"{shorten(error.filename or place)}: {error.strerror or error}"
        problem = f"no folder for results can be made at {shorten(place)} ({cause})"
        raise SystemFailedError(f"{problem}; name one by --output") from None


def require_name(name: str) -> str:
    """Return a name if it is the name of one folder, without a path.

    Raises:
        ConfigurationError: It is not.
    """
    if name in ("", ".", "..") or any(sign in name for sign in "/\\\0"):
        raise ConfigurationError(
            f"name must be the name of a folder in {RUNS}, without / and not . or ..,"
            f" got {name!r}; to write elsewhere, name a folder by --output"
        )
    return name


@contextmanager
def lock_run(folder: Path, patience_s: float = 0.0) -> Iterator[None]:
    """Lock a run, so that no other program works on it; if this program is killed, the lock ends.

    Args:
        folder: Folder of the run.
        patience_s: Longest time to wait for another program [s].

    Raises:
        ConfigurationError: Another program works on the run, or the lock is not a plain file.
    """
    with _open_lock(folder / _LOCK) as file:
        deadline = time.monotonic() + patience_s
        while True:
            with suppress(BlockingIOError):
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            if time.monotonic() >= deadline:
                holder = file.read(_HOLDER_CHARACTERS).strip() or "unknown"
                problem = f"another program, process {holder}, works on {folder}"
                cure = "wait until it has ended, or end it"
                raise ConfigurationError(f"{problem}; {cure}")
            time.sleep(_RETRY_S)
        file.truncate(0)
        file.write(f"{os.getpid()} of {platform.node()}\n")
        file.flush()
        yield


def _open_lock(path: Path) -> TextIO:
    """Open the file of a lock for reading and writing.

    Raises:
        ConfigurationError: It is a link, a pipe, or a file with several names.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        descriptor = os.open(path, flags, 0o666)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.EISDIR, errno.ENXIO):
            raise _lock_error(path) from None
        raise
    status = os.fstat(descriptor)
    if not stat.S_ISREG(status.st_mode) or status.st_nlink != 1:
        os.close(descriptor)
        raise _lock_error(path)
    return os.fdopen(descriptor, "r+", encoding="utf-8", errors="replace")


def _lock_error(path: Path) -> ConfigurationError:
    return ConfigurationError(
        f"{path} must be a plain file with one name, it is a link or something else; remove it"
    )


@contextmanager
def lock_part(folder: Path, patience_s: float) -> Iterator[None]:
    """Make the folder of a part of a run and lock it; a failure without a result removes it."""
    folder.mkdir(parents=True, exist_ok=True)
    with lock_run(folder, patience_s), _remove_without_result(folder):
        yield


@contextmanager
def result_folder(name: str, output: Path | None = None) -> Iterator[Path]:
    """Create a folder as `create_folder` does, and remove it if the work fails without a result."""
    folder = create_folder(name, output)
    try:
        with _remove_without_result(folder):
            yield folder
    except KeyboardInterrupt as error:
        if not folder.exists():
            error.add_note(f"nothing was finished, and {folder} is removed")
        raise


@contextmanager
def run_folder(
    name: str, recorded: dict[str, Any], seed: int | None, output: Path | None = None
) -> Iterator[Path]:
    """Create a `result_folder` for a new run, and record its configuration as `record_run` does."""
    with result_folder(name, output) as folder:
        record_run(folder, recorded, seed)
        yield folder


@contextmanager
def _remove_without_result(folder: Path) -> Iterator[None]:
    """Remove a folder if the work within the context fails and the folder has no results."""
    try:
        yield
    except BaseException:
        files = list(folder.iterdir())
        if {file.name for file in files} <= _DESCRIPTION_FILES:
            for file in files:
                file.unlink()
            folder.rmdir()
            if folder.parent == RUNS:
                with suppress(OSError):  # it contains other runs
                    RUNS.rmdir()
        raise


def _numbered_folder(name: str) -> Path:
    """Make runs/<name>, or runs/<name>-<number>; `mkdir` succeeds for one program only."""
    require_name(name)
    RUNS.mkdir(parents=True, exist_ok=True)
    for number in itertools.count(1):
        folder = RUNS / (name if number == 1 else f"{name}-{number}")
        with suppress(FileExistsError):
            folder.mkdir()
            return folder
    raise AssertionError


def _empty_folder(folder: Path) -> Path:
    """Make a folder, or check that it is empty."""
    if folder.exists() and not folder.is_dir():
        cure = "name a folder that is new or empty"
        raise ResultsExistError(f"{shorten(folder)} is a file; {cure}")
    folder.mkdir(parents=True, exist_ok=True)
    if names := sorted(path.name for path in folder.iterdir()):
        raise ResultsExistError(
            f"{folder} already holds results ({', '.join(names[:3])}, ...), which are"
            " never overwritten; name another folder, or leave --output out"
        )
    return folder


def provenance(seed: int | None) -> dict[str, Any]:
    """Return date, seed, commit, platform and versions of packages, for the record of a result."""
    return {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "seed": seed,
        "commit": _commit(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "versions": {name: installed_version(name) for name in _PACKAGES.split()},
    }


def installed_version(package: str) -> str | None:
    """Return the version of a package; None if it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _commit() -> str | None:
    """Return the commit of the source tree, with a + for changes; None outside a repository."""
    command = ["git", "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty=+"]
    options: Any = {"cwd": Path(__file__).parent, "text": True, "timeout": 10}
    options["stderr"] = subprocess.DEVNULL
    try:
        return subprocess.check_output(command, **options).strip()
    except (OSError, subprocess.SubprocessError):
        return None
