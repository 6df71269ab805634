"""Files: bounded reading of a user's files, and writing of whole files or nothing."""

import csv
import errno
import hashlib
import os
import stat
from pathlib import Path

from elastic_env.core.errors import ConfigurationError, quote


def read_bounded(path: Path, most_bytes: int, within: Path | None = None) -> bytes:
    """Read a plain file after a check of its kind and size.

    A named pipe or a device is never opened: reading it could wait for ever.

    Args:
        path: The file.
        most_bytes: Largest size [bytes].
        within: Folder that must contain the file, after all links; None for anywhere.

    Raises:
        OSError: The file is missing or cannot be read.
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
    if len(content) > most_bytes:  # it has grown, or the system gave a wrong size
        raise _too_large(path, most_bytes, f"more than {most_bytes}")
    return content


def read_rows(table: Path) -> list[dict[str, str]]:
    """Read the rows of a table of this package; lines that begin with # are comments."""
    lines = table.read_text(encoding="utf-8").splitlines()
    return list(csv.DictReader(line for line in lines if not line.startswith("#")))


def is_file(path: str | Path) -> bool:
    """Return True if the path is a regular file, False also for a path that no file can have."""
    try:
        return Path(path).is_file()
    except (OSError, ValueError):
        return False


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal digits.

    Raises:
        OSError: It is missing or cannot be read.
    """
    with path.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


def leads_out(path: Path, folder: Path) -> bool:
    """Return True if a path leads out of a folder, after all links of both."""
    return not Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))


def _require_plain(path: Path, status: os.stat_result, most_bytes: int) -> None:
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(status.st_mode):
        problem = "must be a plain file, it is a pipe, a socket or a device"
        raise ConfigurationError(f"{_short_path(path)} {problem}")
    if status.st_size > most_bytes:
        raise _too_large(path, most_bytes, str(status.st_size))


def _too_large(path: Path, most_bytes: int, size: str) -> ConfigurationError:
    problem = f"must have at most {most_bytes} bytes, it has {size}"
    return ConfigurationError(f"{_short_path(path)} {problem}")


def _short_path(path: Path) -> str:
    return quote(str(path))[1:-1]


def write_whole(path: Path, content: bytes | str) -> None:
    """Write a temporary file beside the path, and move it there once it is on the disk.

    A failure leaves no new file. A link at the path is replaced; its target stays as it is.

    Args:
        path: The file; an existing one is replaced.
        content: Its content; text becomes UTF-8.

    Raises:
        OSError: The disk is full or the folder cannot be written; it names the file.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.new")
    try:
        temporary.unlink(missing_ok=True)
        descriptor = os.open(
            temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666
        )  # follows no link
        with os.fdopen(descriptor, "wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
        flush(temporary)
        temporary.rename(path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            error.filename = str(path)
        raise
    flush(path.parent)


def flush(path: Path) -> None:
    """Flush a file or folder to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
