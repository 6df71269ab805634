"""Files that are written whole or not at all."""

import os
from pathlib import Path


def write_whole(path: Path, content: bytes) -> None:
    """Write a file beside its place and move it there, when it is on the disk; a failure leaves nothing new.

    Args:
        path: The file; one that is there is replaced.
        content: Its content.

    Raises:
        OSError: The disk is full or the folder cannot be written; it names the file.
    """
    fresh = path.with_name(f".{path.name}.{os.getpid()}.new")
    try:
        fresh.write_bytes(content)
        flush(fresh)
        fresh.rename(path)
    except BaseException as error:
        fresh.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename is None:
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
