"""A checkpoint: a folder that is written completely or not at all, and read only if complete.

It lists its files with their SHA-256 digests, which are checked before anything is loaded. A digest
detects damage by a full or failing disk. It does not protect against an attacker who changes files
and digests.
"""

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from elastic_env.core.errors import ElasticError, shorten
from elastic_env.core.files import digest_of, flush, read_bounded
from elastic_env.core.json_text import LARGEST_JSON
from elastic_env.core.signals import Array

_DIGESTS = "sha256.json"
_MOST_BYTES = 2 * 10**9
"""Largest size of a file of a checkpoint, such as a replay buffer."""
_ARRAY_KEY = "array"


@contextmanager
def write_checkpoint(checkpoint: Path) -> Iterator[Path]:
    """Yield a new folder, which replaces the checkpoint when all of its files are on the disk.

    A kill between the steps loses nothing: `recover_checkpoint` completes them. An error keeps the
    old checkpoint.
    """
    new = _sibling(checkpoint, "new")
    old = _sibling(checkpoint, "old")
    shutil.rmtree(new, ignore_errors=True)
    new.mkdir(parents=True)
    yield new
    text = json.dumps(_file_digests(new), indent=2)
    (new / _DIGESTS).write_text(f"{text}\n", encoding="utf-8")
    for file in new.iterdir():
        flush(file)
    flush(new)
    shutil.rmtree(old, ignore_errors=True)
    if checkpoint.exists():
        checkpoint.rename(old)
    new.rename(checkpoint)
    flush(checkpoint.parent)
    shutil.rmtree(old, ignore_errors=True)


def recover_checkpoint(checkpoint: Path) -> bool:
    """Recover from a kill during `write_checkpoint`; return True if there is a checkpoint."""
    old = _sibling(checkpoint, "old")
    if not checkpoint.exists() and old.exists():
        old.rename(checkpoint)
    return checkpoint.exists()


def require_complete(checkpoint: Path) -> None:
    """Check that the files are those that were written.

    Raises:
        ElasticError: A file is missing, has another content, or does not belong to it.
    """
    try:
        expected = json.loads(read_bounded(checkpoint / _DIGESTS, LARGEST_JSON))
        actual = _file_digests(checkpoint)
    except (OSError, ValueError, RecursionError) as error:
        raise damage_error(checkpoint, f"{_DIGESTS}: {error}") from None
    if not isinstance(expected, dict):
        raise damage_error(checkpoint, f"{_DIGESTS} is no table of files")
    for name in sorted(expected.keys() | actual.keys()):
        if name not in actual:
            raise damage_error(checkpoint, f"{name} is missing")
        if name not in expected:
            raise damage_error(checkpoint, f"{name} does not belong to it")
        if expected[name] != actual[name]:
            problem = f"the content of {name} is not what was written"
            raise damage_error(checkpoint, problem)


def damage_error(checkpoint: Path, problem: object) -> ElasticError:
    """The error for a checkpoint that a training cannot continue from."""
    return ElasticError(
        f"the checkpoint {shorten(checkpoint)} is damaged or incomplete ({problem});"
        " remove it to start this seed again"
    )


def _sibling(checkpoint: Path, ending: str) -> Path:
    return checkpoint.with_name(f"{checkpoint.name}.{ending}")


def _file_digests(checkpoint: Path) -> dict[str, str]:
    """SHA-256 of every file, without the file of digests."""
    digests = {}
    for file in sorted(checkpoint.iterdir()):
        if file.name != _DIGESTS:
            if (size := file.stat().st_size) > _MOST_BYTES:
                most = f"at most {_MOST_BYTES:.0e} bytes"
                raise ValueError(f"{shorten(file.name)} must have {most}, not {size:g}")
            digests[file.name] = digest_of(file)
    return digests


def write_state(folder: Path, name: str, state: Any) -> None:
    """Write a state as `name.npz` and `name.json`."""
    arrays: dict[str, Array] = {}

    def to_json(value: Any) -> dict[str, str]:
        if not isinstance(value, np.ndarray):
            raise TypeError(f"Object of type {type(value).__name__} is not JSON serializable")
        arrays[key := f"a{len(arrays)}"] = value
        return {_ARRAY_KEY: key}

    text = json.dumps(state, default=to_json)
    np.savez(folder / f"{name}.npz", **arrays)  # type: ignore[arg-type]
    (folder / f"{name}.json").write_text(text)


def read_state(folder: Path, name: str) -> Any:
    """Read a state that `write_state` wrote; no code from the files is run."""
    with np.load(folder / f"{name}.npz", allow_pickle=False) as arrays:

        def from_json(value: dict[str, Any]) -> Any:
            return arrays[value[_ARRAY_KEY]] if set(value) == {_ARRAY_KEY} else value

        return json.loads((folder / f"{name}.json").read_text(), object_hook=from_json)
