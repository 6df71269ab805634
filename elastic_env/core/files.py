"""Files that a user names, read within bounds, and files that are written whole or not at all."""

import csv
import errno
import hashlib
import os
import stat
from pathlib import Path

from elastic_env.core.errors import ConfigurationError, quote


def read_bounded(path: Path, most_bytes: int, within: Path | None = None) -> bytes:
    """Content of a plain file, whose kind and size are known before anything of it is read.

    A named pipe or a device is never opened, so that nothing waits for ever.

    Args:
        path: The file.
        most_bytes: Bytes that it may have.
        within: Folder that it must lie in, after all links; None for anywhere.

    Raises:
        OSError: It is missing or cannot be read.
        ConfigurationError: It is no plain file, is larger, or leads out of the folder.
    """
    if within is not None and leads_out(path, within):
        problem = f"{_short_path(path)} is a link out of its folder"
        raise ConfigurationError(f"{problem}; copy the file there")
    _require_plain(path, path.stat(), most_bytes)
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    with os.fdopen(descriptor, "rb") as file:
        _require_plain(path, os.fstat(descriptor), most_bytes)
        content = file.read(most_bytes + 1)
    if len(content) > most_bytes:  # it grew, or its size is not what the system says
        raise _too_large(path, most_bytes, f"more than {most_bytes}")
    return content


def read_rows(table: Path) -> list[dict[str, str]]:
    """Rows of a table of this package, by columns; lines that begin with # are comments."""
    lines = table.read_text(encoding="utf-8").splitlines()
    return list(csv.DictReader(line for line in lines if not line.startswith("#")))


def is_file(path: str | Path) -> bool:
    """True if there is a regular file, for any path: one that no file can have is none."""
    try:
        return Path(path).is_file()
    except (OSError, ValueError):
        return False


def digest_of(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal digits.

    Raises:
        OSError: It is missing or cannot be read.
    """
    with path.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


def leads_out(path: Path, folder: Path) -> bool:
    """True if a path leads out of a folder, after all links of both."""
    return not Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))


def _require_plain(path: Path, found: os.stat_result, most_bytes: int) -> None:
    if stat.S_ISDIR(found.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(found.st_mode):
        problem = "must be a plain file, it is a pipe, a socket or a device"
        raise ConfigurationError(f"{_short_path(path)} {problem}")
    if found.st_size > most_bytes:
        raise _too_large(path, most_bytes, str(found.st_size))


def _too_large(path: Path, most_bytes: int, has: str) -> ConfigurationError:
    problem = f"must have at most {most_bytes} bytes, it has {has}"
    return ConfigurationError(f"{_short_path(path)} {problem}")


def _short_path(path: Path) -> str:
    return quote(str(path))[1:-1]


def write_whole(path: Path, content: bytes | str) -> None:
    """Write a file beside its place and move it there when it is on the disk.

    A failure leaves nothing new.

    A link at its place is replaced; what it leads to stays as it is.

    Args:
        path: The file; one that is there is replaced.
        content: Its content; text becomes UTF-8.

    Raises:
        OSError: The disk is full or the folder cannot be written; it names the file.
    """
    fresh = path.with_name(f".{path.name}.{os.getpid()}.new")
    try:
        fresh.unlink(missing_ok=True)
        descriptor = os.open(
            fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666
        )  # follows no link
        with os.fdopen(descriptor, "wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
        flush(fresh)
        fresh.rename(path)
    except BaseException as error:
        fresh.unlink(missing_ok=True)
        if isinstance(error, OSError):
            error.filename = str(path)
        raise
    flush(path.parent)


def flush(path: Path) -> None:
    """Have a file or folder on the disk before anything that comes later."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
