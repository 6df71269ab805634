"""Cache on the disk for numbers that take long to compute, shared by processes.

The key is the digest of everything that the numbers depend on. So a change needs no deletion. A
file begins with a digest of its key and its numbers, which is checked at every reading. Damaged or
missing numbers are computed again. Files are replaced as a whole: any number of processes can read
and write them at once.
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
_DISABLED = "off"
_NUMBER = np.dtype("<f8")
_LOG = logging.getLogger(__name__)


def cache_folder() -> Path | None:
    """Return the folder of all caches: `ELASTIC_ENV_CACHE`, or the user's; None where it is off."""
    setting = os.environ.get(VARIABLE, "")
    if setting:
        return None if setting == _DISABLED else Path(setting)
    try:
        home = Path.home()
    except RuntimeError:  # a user without a home
        return None
    if sys.platform == "darwin":
        return home / "Library" / "Caches" / "elastic-env"
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if base else home / ".cache") / "elastic-env"


@dataclass(frozen=True)
class DiskCache:
    """Rows of numbers by their keys, in a folder of their own.

    Attributes:
        name: Name of the folder.
        most_files: Largest number of files; the least recently used ones are removed first.
    """

    name: str
    most_files: int = 4096

    def read(self, key: str, length: int) -> Array | None:
        """Return the numbers of a key, (length,); None where they are missing or damaged."""
        file = self._file(key)
        if file is None:
            return None
        most = hashlib.sha256().digest_size + length * _NUMBER.itemsize
        try:
            numbers = _unseal(key, read_bounded(file, most))
        except FileNotFoundError:
            return None
        except (OSError, ConfigurationError) as error:
            _LOG.info("%s is not used: %s", file, error)
            return None
        if numbers is None or len(numbers) != length:
            _LOG.info("%s is not used: it is not what was written", file)
            return None
        with contextlib.suppress(OSError):  # a read-only folder
            os.utime(file)
        return numbers

    def keep(self, key: str, numbers: Array) -> None:
        """Write the numbers of a key, (length,); a disk that refuses costs only time."""
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
        by_age = sorted((_last_use(folder / name), name) for name in names)
        for _, name in by_age[: len(names) - self.most_files * 3 // 4]:
            (folder / name).unlink(missing_ok=True)


def key_of(parts: Iterable[bytes | str]) -> str:
    """Return the SHA-256 digest of everything that numbers depend on, in order."""
    digest = hashlib.sha256()
    for part in parts:
        content = part.encode() if isinstance(part, str) else part
        digest.update(f"{len(content)} ".encode())
        digest.update(content)
    return digest.hexdigest()


def _unseal(key: str, sealed: bytes) -> Array | None:
    """Return the numbers of a file; None where the digest does not fit the key."""
    size = hashlib.sha256().digest_size
    content = sealed[size:]
    if hashlib.sha256(key.encode() + content).digest() != sealed[:size]:
        return None
    return np.frombuffer(content, dtype=_NUMBER).astype(np.float64)


def _last_use(file: Path) -> float:
    """Return the time of a file's last use [s]; 0 for one that another process has removed."""
    try:
        return file.stat().st_mtime
    except OSError:
        return 0.0
