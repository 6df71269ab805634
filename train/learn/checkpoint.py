"""A checkpoint: a folder that is written whole or not at all, and read only if it is whole.

Its files are listed with their SHA-256 digests, which are checked before anything is loaded. A
digest tells damage from a full disk or a failing one; it is no seal against somebody who writes
both.
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
"""Size of a file of a checkpoint, such as a replay buffer."""
_ARRAY = "array"


@contextmanager
def write_checkpoint(checkpoint: Path) -> Iterator[Path]:
    """A fresh folder, which takes the checkpoint's place when all of its files are on the disk.

    A kill between its steps loses nothing, once `recover_checkpoint` was called; a failure leaves
    the old one.
    """
    fresh = _beside(checkpoint, "new")
    old = _beside(checkpoint, "old")
    shutil.rmtree(fresh, ignore_errors=True)
    fresh.mkdir(parents=True)
    yield fresh
    text = json.dumps(_digests(fresh), indent=2)
    (fresh / _DIGESTS).write_text(f"{text}\n", encoding="utf-8")
    for file in fresh.iterdir():
        flush(file)
    flush(fresh)
    shutil.rmtree(old, ignore_errors=True)
    if checkpoint.exists():
        checkpoint.rename(old)
    fresh.rename(checkpoint)
    flush(checkpoint.parent)
    shutil.rmtree(old, ignore_errors=True)


def recover_checkpoint(checkpoint: Path) -> bool:
    """True if there is a checkpoint, also after a kill between the moves of `write_checkpoint`."""
    old = _beside(checkpoint, "old")
    if not checkpoint.exists() and old.exists():
        old.rename(checkpoint)
    return checkpoint.exists()


def require_whole(checkpoint: Path) -> None:
    """Check that the files are those that were written.

    Raises:
        ElasticError: One is missing, of another content, or not of this checkpoint.
    """
    try:
        digests = json.loads(read_bounded(checkpoint / _DIGESTS, LARGEST_JSON))
        found = _digests(checkpoint)
    except (OSError, ValueError, RecursionError) as error:
        raise damage_error(checkpoint, f"{_DIGESTS}: {error}") from None
    if not isinstance(digests, dict):
        raise damage_error(checkpoint, f"{_DIGESTS} is no table of files")
    for name in sorted(digests.keys() | found.keys()):
        if name not in found:
            raise damage_error(checkpoint, f"{name} is missing")
        if name not in digests:
            raise damage_error(checkpoint, f"{name} is not of it")
        if digests[name] != found[name]:
            problem = f"the content of {name} is not what was written"
            raise damage_error(checkpoint, problem)


def damage_error(checkpoint: Path, why: object) -> ElasticError:
    """The error of a checkpoint that cannot be gone on with."""
    return ElasticError(
        f"the checkpoint {shorten(checkpoint)} is damaged or not whole ({why}); remove it to"
        " begin this seed anew"
    )


def _beside(checkpoint: Path, ending: str) -> Path:
    return checkpoint.with_name(f"{checkpoint.name}.{ending}")


def _digests(checkpoint: Path) -> dict[str, str]:
    """SHA-256 of every file but their table."""
    found = {}
    for file in sorted(checkpoint.iterdir()):
        if file.name != _DIGESTS:
            if (size := file.stat().st_size) > _MOST_BYTES:
                most = f"at most {_MOST_BYTES:.0e} bytes"
                raise ValueError(f"{shorten(file.name)} must have {most}, not {size:g}")
            found[file.name] = digest_of(file)
    return found


def write_state(folder: Path, name: str, state: Any) -> None:
    """Write a state as `name.npz` and `name.json`."""
    arrays: dict[str, Array] = {}

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            arrays[key := f"a{len(arrays)}"] = value
            return {_ARRAY: key}
        if isinstance(value, dict):
            return {name: plain(part) for name, part in value.items()}
        return [plain(part) for part in value] if isinstance(value, list) else value

    text = json.dumps(plain(state))
    np.savez(folder / f"{name}.npz", **arrays)  # type: ignore[arg-type]
    (folder / f"{name}.json").write_text(text)


def read_state(folder: Path, name: str) -> Any:
    """A state that `write_state` wrote; runs no code from the files."""
    with np.load(folder / f"{name}.npz", allow_pickle=False) as arrays:

        def whole(value: Any) -> Any:
            if isinstance(value, dict):
                if set(value) == {_ARRAY}:
                    return arrays[value[_ARRAY]]
                return {name: whole(part) for name, part in value.items()}
            return [whole(part) for part in value] if isinstance(value, list) else value

        return whole(json.loads((folder / f"{name}.json").read_text()))
