"""Finished cells on the disk: a file each under the key of its content, written atomically.

A key is a digest of everything that the result of a cell depends on. A file holds its key and a
digest of the rest, and is checked against the condition before anything of it is used.
"""

import ast
import dataclasses
import hashlib
import importlib.util
import io
import json
import math
import zipfile
from collections.abc import Iterator
from importlib.machinery import PathFinder
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from baselines.adaptation import offset_folder
from baselines.identification.identify import StaticPoints
from baselines.policies import is_saved
from baselines.residual.residual_policy import DESCRIPTION, WEIGHTS, find_folder
from elastic_env.core.errors import ElasticError, quote
from elastic_env.core.files import digest_of, is_file, read_bounded, write_whole
from train.evaluate.conditions import Condition
from train.evaluate.episodes import Evaluation, episode_labels
from train.evaluate.robot_file import files_of_robot
from train.workers.versions import physics

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

_NOT_OF_THE_RESULT = {"policy": {"level", "track"}, "member": {"rival"}}
"""Parts of a condition that change nothing of its episodes: what it is compared with, and where
tables list it.
"""
_LABELS = {"label": True, "policy": {"label"}, "member": {"base"}}
"""Parts of a condition that are text for people and name no files."""
_SAVED = (DESCRIPTION, WEIGHTS, offset_folder.DESCRIPTION, offset_folder.OFFSETS)
"""Files of which the folder of a policy consists."""
_LARGEST_SOURCE = 10_000_000
"""Bytes of a Python file that is looked through for imports."""


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


def cell_key(condition: Condition) -> str:
    """SHA-256 digest of a condition, of the files that it names, and of the physics' versions.

    Files are weights of residuals, tables of offsets and stiffness, robots with their models and
    joints, and Python files of the user's, with those of their folder that they import. They are
    read and never imported. What such a file reads when it runs is not seen. Labels are text and
    name no files.
    """
    content = condition.model_dump(mode="json", exclude=_NOT_OF_THE_RESULT)  # type: ignore[arg-type]
    named = condition.model_dump(mode="json", exclude=_LABELS)  # type: ignore[arg-type]
    found = [file for text in _texts(named) for file in named_files(text)]
    files = {str(file): digest_of(file) for file in found}
    whole = {"condition": content, "files": files, "versions": physics()}
    return hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()


def named_files(text: str) -> list[Path]:
    """Files that a text stands for: residual:FOLDER, FILE.py:NAME, module:NAME, or a path."""
    if is_saved(text):
        folder = find_folder(Path(text.partition(":")[2]))
        return [folder / name for name in _SAVED if is_file(folder / name)]
    place, _, name = text.rpartition(":")
    if name.isidentifier():
        source = Path(place) if place.endswith(".py") else _source(place)
        if source is not None:
            return _with_imports(source)
    if not is_file(Path(text)):
        return []
    return [file for file in (Path(text), *files_of_robot(text)) if is_file(file)]


def _source(module: str) -> Path | None:
    """The file of a module; None where there is none.

    Neither it nor the packages around it are imported.
    """
    package, *parts = module.split(".")
    if not all(part.isidentifier() for part in (package, *parts)):
        return None
    try:
        # one name alone: of a name with dots it would import the packages around it
        found = importlib.util.find_spec(package)
        found = found or PathFinder.find_spec(package, [str(Path.cwd())])
    except (ImportError, ValueError):
        return None
    if found is None:
        return None
    if not parts:
        origin = found.origin or ""
        return Path(origin) if origin.endswith(".py") else None
    for folder in found.submodule_search_locations or ():
        for file in _files_of(Path(folder).joinpath(*parts)):
            if is_file(file):
                return file
    return None


def _files_of(module: Path) -> list[Path]:
    """Files of a module, by its path without an ending: a package, or a file."""
    return [module / "__init__.py", module.with_name(f"{module.name}.py")]


def _with_imports(file: Path) -> list[Path]:
    """A Python file and those that it imports from its folder, directly or not, sorted."""
    seen = set[Path]()
    waiting = [file]
    while waiting:
        file = waiting.pop()
        if file in seen or not is_file(file):
            continue
        seen.add(file)
        for name in _imports(file):
            waiting += _files_of(file.parent.joinpath(*name.split(".")))
    return sorted(seen)


def _imports(file: Path) -> Iterator[str]:
    """Modules that a file imports, by full name; none of a file that is no Python."""
    try:
        tree = ast.parse(read_bounded(file, _LARGEST_SOURCE))
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            package = [node.module] if node.module else []
            yield from package
            yield from (".".join([*package, alias.name]) for alias in node.names)


def _texts(value: Any) -> Iterator[str]:
    """All texts within plain data."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _texts(part)
