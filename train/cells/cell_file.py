"""Files of cells: an evaluation as an archive of NumPy, and the check of its content.

A file contains its key and a digest of the rest. It is compared with the condition before any of
its content is used.
"""

import hashlib
import io
import json
import math
import zipfile
from collections.abc import Iterator
from itertools import chain
from typing import Any

import numpy as np
import numpy.typing as npt

from baselines.identification.identify import StaticPoints
from elastic_env.core.errors import ElasticError, quote
from train.evaluate.conditions import Condition
from train.evaluate.episodes import Evaluation, episode_labels

MAX_BYTES = 400_000_000
"""Largest size of a file, packed or not; a walk of two hours needs less than half of it [B]."""
_EPISODE_BYTES = 20_000
"""Largest size of the text of an episode [B]."""
_EPISODES = "episodes"
_TRACE = "trace"
_POINTS = "points"
_REST = "rest_references"
_KEY = "key"
_DIGEST = "sha256"

Arrays = dict[str, npt.NDArray[Any]]


class UnfitCellError(ElasticError):
    """The content of a cell's file does not fit its condition."""


def pack_evaluation(evaluation: Evaluation, key: str) -> bytes:
    """Return the content of a file of NumPy; reading such a file runs no code."""
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
    """Return the SHA-256 digest of arrays with their names, types and shapes."""
    digest = hashlib.sha256()
    for name, values in sorted(arrays.items()):
        digest.update(f"{name} {values.dtype.str} {values.shape}\n".encode())
        digest.update(np.ascontiguousarray(values).tobytes())
    return np.array(digest.hexdigest())


def unpack_evaluation(condition: Condition, key: str, content: bytes) -> Evaluation:
    """Return the result of a condition from the content of a file.

    Raises:
        UnfitCellError: The file is readable, but its content does not fit the condition.
    """
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        size = sum(part.file_size for part in archive.infolist())
    if size > MAX_BYTES:
        problem = f"unpacked it has {size} bytes, at most {MAX_BYTES} are read"
        raise UnfitCellError(problem)
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        arrays = dict(archive)
    if str(arrays.pop(_KEY, "")) != key:
        raise UnfitCellError("it is that of another cell")
    if str(arrays.pop(_DIGEST, "")) != str(_digest(arrays)):
        raise UnfitCellError("its content is not what was written")
    text = arrays[_EPISODES]
    limit = _EPISODE_BYTES * condition.episodes
    if (size := text.nbytes) > limit:
        raise UnfitCellError(f"its episodes have {size} bytes, at most {limit} are read")
    points = _arrays_under(_POINTS, arrays)
    evaluation = Evaluation(
        condition,
        episodes=json.loads(text.tobytes()),
        trace=_arrays_under(_TRACE, arrays),
        points=StaticPoints(**points) if points else None,
        rest_references=arrays[_REST],
    )
    for problem in chain(_episode_problems(evaluation), _array_problems(evaluation)):
        raise UnfitCellError(problem)
    return evaluation


def _arrays_under(group: str, arrays: Arrays) -> Arrays:
    """Return the arrays whose names begin with a group, without that prefix."""
    prefix = f"{group}/"
    return {k[len(prefix) :]: a for k, a in arrays.items() if k.startswith(prefix)}


def _episode_problems(evaluation: Evaluation) -> Iterator[str]:
    """Yield why records do not fit the condition: all of them, in order, with finite scores."""
    condition = evaluation.condition
    episodes = evaluation.episodes
    if not (isinstance(episodes, list) and {*map(type, episodes)} <= {dict}):
        yield "it has no episodes"
        return
    if len(episodes) != condition.episodes:
        yield f"it has {len(episodes)} episodes, the cell has {condition.episodes}"
    names = {name for record in episodes for name in record}
    for number, record in enumerate(episodes):
        for name, value in episode_labels(condition, number).items():
            label = record.get(name)
            if type(label) is not type(value) or label != value:
                expected = f"in the cell it is {quote(value)}"
                yield f"{name} of episode {number} is {quote(label)}, {expected}"
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
                    f"{column.metric} of episode {number} must be a finite number, it"
                    f" is {quote(value)}"
                )
        # an episode that ended early lacks later metrics: a robot that fell at once took no step
        missing = names - record.keys()
        if missing and not record.get("termination"):
            yield f"episode {number} lacks {quote(min(missing))}, which others have"


def _array_problems(evaluation: Evaluation) -> Iterator[str]:
    """Yield why time series and static points do not fit the condition."""
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
