"""Finished cells on the disk: a file each under the key of its content, written atomically.

A file holds its key and a digest of the rest, and is checked against the condition before anything
of it is used.
"""

import dataclasses
import hashlib
import io
import json
import math
import zipfile
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from baselines.identification.identify import StaticPoints
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
            content = read_bounded(file, _MOST_BYTES, within=self.folder)
            return _from_bytes(condition, file.stem, content)
        except FileNotFoundError:
            return None
        except UnfitCellError as error:
            raise UnfitCellError(f"{file.name}: {error}") from None
        except Exception as error:  # of a reader of archives that meets a foreign file
            cause = f"{type(error).__name__}: {quote(str(error))}"
            raise UnfitCellError(f"{file.name}: {cause}") from None

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
    points = {} if evaluation.points is None else vars(evaluation.points)
    arrays: Arrays = {
        f"{part}/{name}": np.asarray(values)
        for part, series in ((_TRACE, evaluation.trace), (_POINTS, points))
        for name, values in series.items()
    }
    episodes = json.dumps(evaluation.episodes, default=lambda number: number.item())
    arrays[_EPISODES] = np.frombuffer(episodes.encode(), dtype=np.uint8)
    arrays[_REST] = evaluation.rest_references
    seal = {_KEY: np.array(key), _DIGEST: _digest(arrays)}
    content = io.BytesIO()
    np.savez_compressed(content, allow_pickle=False, **arrays, **seal)
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
    if size > _MOST_BYTES:
        problem = f"unpacked it has {size} bytes, at most {_MOST_BYTES} are read"
        raise UnfitCellError(problem)
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        found = {name: arrays[name] for name in arrays.files}
    if str(found.pop(_KEY, "")) != key:
        raise UnfitCellError("it is that of another cell")
    if str(found.pop(_DIGEST, "")) != str(_digest(found)):
        raise UnfitCellError("its content is not what was written")
    text = found[_EPISODES]
    most = _EPISODE_BYTES * condition.episodes
    if (size := text.nbytes) > most:
        raise UnfitCellError(f"its episodes have {size} bytes, at most {most} are read")
    points = _part(found, _POINTS)
    evaluation = Evaluation(
        condition,
        episodes=json.loads(text.tobytes()),
        trace=_part(found, _TRACE),
        points=StaticPoints(**points) if points else None,
        rest_references=found[_REST],
    )
    problems = chain(_problems_of_episodes(evaluation), _problems_of_arrays(evaluation))
    for problem in problems:
        raise UnfitCellError(problem)
    return evaluation


def _part(found: Arrays, name: str) -> Arrays:
    prefix = f"{name}/"
    keys = [key for key in found if key.startswith(prefix)]
    return {key.removeprefix(prefix): found[key] for key in keys}


def _problems_of_episodes(evaluation: Evaluation) -> Iterator[str]:
    """Yield why records are not those of a condition: all, in order, with finite scores."""
    condition = evaluation.condition
    episodes = evaluation.episodes
    are_records = isinstance(episodes, list) and {*map(type, episodes)} <= {dict}
    if not are_records:
        yield "it has no episodes"
        return
    if len(episodes) != condition.episodes:
        yield f"it has {len(episodes)} episodes, the cell has {condition.episodes}"
    names = {name for record in episodes for name in record}
    for number, record in enumerate(episodes):
        for name, value in episode_labels(condition, number).items():
            own = record.get(name)
            if type(own) is not type(value) or own != value:
                wanted = f"in the cell it is {quote(value)}"
                yield f"{name} of episode {number} is {quote(own)}, {wanted}"
        if not isinstance(record.get("termination"), str):
            yield f"episode {number} does not say how it ended"
        for name, value in record.items():
            if not isinstance(value, str | int | float):
                yield f"{name} of episode {number} is {quote(value)}"
        for column in condition.environment.judged:
            value = record.get(column.metric)
            is_score = isinstance(value, float) and math.isfinite(value)
            if not record.get("termination") and not is_score:
                yield (
                    f"{column.metric} of episode {number} must be a finite number, it is"
                    f" {quote(value)}"
                )
        # an episode that ended early lacks what it did not come to, as a robot that fell at once
        # has no step behind it
        lacks = names - record.keys()
        if lacks and not record.get("termination"):
            yield f"episode {number} lacks {quote(min(lacks))}, which others have"


def _problems_of_arrays(evaluation: Evaluation) -> Iterator[str]:
    """Yield why time series and static points are not those of the condition."""
    trace = evaluation.trace
    rest = evaluation.rest_references
    traced = list(evaluation.condition.environment.traced)
    if list(trace) != traced:
        yield f"it has the signals {quote(list(trace))}, the cell has {quote(traced)}"
    for name, values in {**trace, _REST: rest}.items():
        if values.ndim != 1 or values.dtype.kind != "f":
            yield f"{name} is no series of numbers"
            return
        if np.isinf(values).any():
            yield f"{name} is not finite"
    lengths = {len(values) for values in trace.values()}
    if len(lengths) != 1 or lengths == {0}:
        yield f"its signals have {sorted(lengths)} samples"
    time_s = trace.get("time_s", np.zeros(1))
    if not (np.isfinite(time_s).all() and (np.diff(time_s) > 0.0).all()):
        yield "its time does not go on"
    for values in () if evaluation.points is None else vars(evaluation.points).values():
        is_finite = values.dtype.kind in "if" and np.isfinite(values).all()
        if values.shape != rest.shape or not is_finite:
            yield "its static points are not one for each visit"
