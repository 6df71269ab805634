"""Numbers that take long to compute, kept on the disk for other processes.

They stand under a key, the digest of everything that they depend on, so that nothing has to be
thrown away after a change. A file holds a digest of its key and its numbers, and is checked before
they are used. What is damaged or missing is computed anew. Files are replaced as a whole: any
number of processes can read and write them at once.
"""

import contextlib
import hashlib
import logging
import os
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.files import read_bounded, write_whole
from elastic_env.core.signals import Array

VARIABLE = "ELASTIC_ENV_CACHE"
"""Environment variable with the folder of all caches, or "off" for none."""
_OFF = "off"
_NUMBER = np.dtype("<f8")
_LOG = logging.getLogger(__name__)


def cache_folder() -> Path | None:
    """The folder of all caches: of `ELASTIC_ENV_CACHE`, or the user's own; None where it is off."""
    told = os.environ.get(VARIABLE, "")
    if told:
        return None if told == _OFF else Path(told)
    try:
        home = Path.home()
    except RuntimeError:  # a user without a home
        return None
    if sys.platform == "darwin":
        return home / "Library" / "Caches" / "elastic-env"
    own = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(own) if own else home / ".cache") / "elastic-env"


@dataclass(frozen=True)
class DiskCache:
    """Rows of numbers by their keys, in a folder of their own.

    Attributes:
        name: Of the folder.
        most_files: Files that stay; the least recently used ones go first.
    """

    name: str
    most_files: int = 4096

    def read(self, key: str, length: int) -> Array | None:
        """The numbers of a key, (length,); None where they are not there, or are damaged."""
        file = self._file(key)
        if file is None:
            return None
        most = hashlib.sha256().digest_size + length * _NUMBER.itemsize
        try:
            content = read_bounded(file, most)
            numbers = _unsealed(key, content)
        except FileNotFoundError:
            return None
        except (OSError, ConfigurationError) as error:
            _LOG.info("%s is not used: %s", file, error)
            return None
        if numbers is None or len(numbers) != length:
            _LOG.info("%s is not used: it is not what was written", file)
            return None
        with contextlib.suppress(OSError):  # a folder for reading alone
            os.utime(file)
        return numbers

    def keep(self, key: str, numbers: Array) -> None:
        """Keep the numbers of a key, (length,); a disk that cannot be written costs time alone."""
        file = self._file(key)
        if file is None:
            return
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            content = np.ascontiguousarray(numbers, dtype=_NUMBER).tobytes()
            write_whole(file, hashlib.sha256(key.encode() + content).digest() + content)
            self._prune(file.parent)
        except OSError as error:
            _LOG.info("%s is not kept: %s", file, error)

    def _file(self, key: str) -> Path | None:
        folder = cache_folder()
        return None if folder is None else folder / self.name / f"{key}.bin"

    def _prune(self, folder: Path) -> None:
        """Remove the least recently used quarter where there are too many files."""
        with os.scandir(folder) as entries:
            names = [entry.name for entry in entries]
        if len(names) <= self.most_files:
            return
        by_age = sorted((_used_at(folder / name), name) for name in names)
        for _, name in by_age[: len(names) - self.most_files * 3 // 4]:
            (folder / name).unlink(missing_ok=True)


def key_of(parts: Iterable[bytes | str]) -> str:
    """SHA-256 digest of everything that numbers depend on, in order."""
    found = hashlib.sha256()
    for part in parts:
        content = part.encode() if isinstance(part, str) else part
        found.update(f"{len(content)} ".encode())
        found.update(content)
    return found.hexdigest()


def _unsealed(key: str, sealed: bytes) -> Array | None:
    """The numbers of a key; None where the content is another one."""
    size = hashlib.sha256().digest_size
    content = sealed[size:]
    if hashlib.sha256(key.encode() + content).digest() != sealed[:size]:
        return None
    return np.frombuffer(content, dtype=_NUMBER).astype(np.float64)


def _used_at(file: Path) -> float:
    """When a file was last used; 0 for one that another process has removed [s]."""
    try:
        return file.stat().st_mtime
    except OSError:
        return 0.0
