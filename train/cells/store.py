"""Finished cells on the disk: a file each under the key of its content, written whole or not at
all.

A file holds its key and a digest of the rest, and is checked against the condition before anything
of it is used.
"""

import dataclasses
import hashlib
import io
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from baselines.identification.static_points import StaticPoints
from elastic_env.core.errors import ElasticError, quote
from elastic_env.core.files import read_bounded, write_whole
from train.cells.key import cell_key
from train.evaluate.conditions import Condition
from train.evaluate.episodes import Evaluation, episode_labels

CELLS = "cells"
"""Folder of a run in which its finished cells are."""
_EPISODES = "episodes"
_TRACE = "trace"
_POINTS = "points"
_REST = "rest_references"
_KEY = "key"
_DIGEST = "sha256"
_MOST_BYTES = 400_000_000
"""Bytes of a file, packed or not; a walk of two hours has less than half of it."""
_EPISODE_BYTES = 20_000
"""Bytes of the text of an episode."""

Arrays = dict[str, npt.NDArray[Any]]


class UnfitCellError(ElasticError):
    """A file of a cell is not what was kept of its condition."""


@dataclasses.dataclass(frozen=True)
class Store:
    """Finished cells.

    Attributes:
        folder: Where their files are; it is made when the first cell is kept.
    """

    folder: Path

    def get(self, condition: Condition) -> Evaluation | None:
        """The kept result of a condition; None where nothing is kept of it.

        Raises:
            UnfitCellError: The file is damaged, was changed, or is that of another condition.
        """
        file = self._file(condition)
        try:
            return _from_bytes(
                condition, file.stem, read_bounded(file, _MOST_BYTES, within=self.folder)
            )
        except FileNotFoundError:
            return None
        except UnfitCellError as error:
            raise UnfitCellError(f"{file.name}: {error}") from None
        except Exception as error:  # whatever a reader of archives makes of a foreign file
            raise UnfitCellError(
                f"{file.name}: {type(error).__name__}: {quote(str(error))}"
            ) from None

    def keep(self, evaluation: Evaluation, key: str | None = None) -> bool:
        """Keep what came out of a condition, unless what it depends on has changed since it began.

        Args:
            evaluation: What came out.
            key: Key of the condition before it was played; None where nothing can have changed.

        Returns:
            Whether it is kept.

        Raises:
            OSError: The disk is full, or the folder cannot be written; cells that were kept before
                stay.
        """
        file = self._file(evaluation.condition)
        if key is not None and file.stem != key:
            return False
        self.folder.mkdir(parents=True, exist_ok=True)
        write_whole(file, _to_bytes(evaluation, file.stem))
        return True

    def _file(self, condition: Condition) -> Path:
        return self.folder / f"{cell_key(condition)}.npz"


def _to_bytes(evaluation: Evaluation, key: str) -> bytes:
    """An evaluation as a file of NumPy's, from which no code can run."""
    arrays: Arrays = {
        f"{_TRACE}/{name}": np.asarray(values) for name, values in evaluation.trace.items()
    }
    if evaluation.points is not None:
        arrays |= {f"{_POINTS}/{name}": values for name, values in vars(evaluation.points).items()}
    episodes = json.dumps(evaluation.episodes, default=lambda number: number.item()).encode()
    arrays[_EPISODES] = np.frombuffer(episodes, dtype=np.uint8)
    arrays[_REST] = evaluation.rest_references
    content = io.BytesIO()
    np.savez_compressed(
        content, allow_pickle=False, **arrays, **{_KEY: np.array(key)}, **{_DIGEST: _digest(arrays)}
    )
    return content.getvalue()


def _digest(arrays: Arrays) -> npt.NDArray[np.str_]:
    """SHA-256 digest of arrays with their names, types and shapes."""
    found = hashlib.sha256()
    for name, values in sorted(arrays.items()):
        found.update(f"{name} {values.dtype.str} {values.shape}\n".encode())
        found.update(np.ascontiguousarray(values).tobytes())
    return np.array(found.hexdigest())


def _from_bytes(condition: Condition, key: str, content: bytes) -> Evaluation:
    """The result of a condition in a file.

    Raises:
        UnfitCellError: It is whole, and holds something else.
    """
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        size = sum(part.file_size for part in archive.infolist())
        _require(
            size <= _MOST_BYTES, f"unpacked it has {size} bytes, at most {_MOST_BYTES} are read"
        )
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        found = {name: arrays[name] for name in arrays.files}
    _require(
        _KEY in found and _DIGEST in found, "it has no key and digest, as those of an older version"
    )
    kept_for = str(found.pop(_KEY))
    digest = str(found.pop(_DIGEST))
    _require(kept_for == key, "it is that of another cell")
    _require(digest == str(_digest(found)), "its content is not what was written")
    points = _part(found, _POINTS)
    evaluation = Evaluation(
        condition,
        episodes=_episodes(condition, found[_EPISODES]),
        trace=_part(found, _TRACE),
        points=StaticPoints(**points) if points else None,
        rest_references=found[_REST],
    )
    _require_arrays(evaluation)
    return evaluation


def _part(found: Arrays, name: str) -> Arrays:
    return {
        key.removeprefix(f"{name}/"): array
        for key, array in found.items()
        if key.startswith(f"{name}/")
    }


def _episodes(condition: Condition, text: npt.NDArray[Any]) -> list[dict[str, Any]]:
    """The records of a condition's episodes: all of them, in order, with finite scores where
    they did not fail.
    """
    most = _EPISODE_BYTES * condition.episodes
    _require(text.nbytes <= most, f"its episodes have {text.nbytes} bytes, at most {most} are read")
    episodes = json.loads(text.tobytes())
    _require(
        isinstance(episodes, list) and all(isinstance(record, dict) for record in episodes),
        "it has no episodes",
    )
    count = len(episodes)
    _require(
        count == condition.episodes, f"it has {count} episodes, the cell has {condition.episodes}"
    )
    for number, record in enumerate(episodes):
        _require_record(condition, number, record)
        _require(
            record.keys() == episodes[0].keys(),
            f"episode {number} has other metrics than the first one",
        )
    return episodes


def _require_record(condition: Condition, number: int, record: dict[str, Any]) -> None:
    for name, value in episode_labels(condition, number).items():
        own = record.get(name)
        same = type(own) is type(value) and own == value
        _require(
            same, f"{name} of episode {number} is {quote(own)}, in the cell it is {quote(value)}"
        )
    _require(
        isinstance(record.get("termination"), str), f"episode {number} does not say how it ended"
    )
    for name, value in record.items():
        _require(
            isinstance(value, str | int | float), f"{name} of episode {number} is {quote(value)}"
        )
    if record["termination"]:
        return
    for column in condition.environment.judged:
        value = record.get(column.metric)
        is_score = isinstance(value, float) and math.isfinite(value)
        _require(
            is_score,
            f"{column.metric} of episode {number} must be a finite number, it is {quote(value)}",
        )


def _require_arrays(evaluation: Evaluation) -> None:
    """Refuse time series and static points that are none of the condition's."""
    trace = evaluation.trace
    traced = list(evaluation.condition.environment.traced)
    _require(
        list(trace) == traced,
        f"it has the signals {quote(list(trace))}, the cell has {quote(traced)}",
    )
    for name, values in {**trace, "rest_references": evaluation.rest_references}.items():
        _require(values.ndim == 1 and values.dtype.kind == "f", f"{name} is no series of numbers")
        _require(not np.isinf(values).any(), f"{name} is not finite")
    lengths = {len(values) for values in trace.values()}
    _require(len(lengths) == 1 and lengths != {0}, f"its signals have {sorted(lengths)} samples")
    time_s = trace.get("time_s", np.zeros(1))
    _require(
        bool(np.isfinite(time_s).all() and (np.diff(time_s) > 0.0).all()), "its time does not go on"
    )
    if evaluation.points is not None:
        series = vars(evaluation.points).values()
        same = all(values.shape == evaluation.rest_references.shape for values in series)
        finite = all(values.dtype.kind in "if" and np.isfinite(values).all() for values in series)
        _require(same and finite, "its static points are not one for each visit")


def _require(holds: bool, problem: str) -> None:
    if not holds:
        raise UnfitCellError(problem)
