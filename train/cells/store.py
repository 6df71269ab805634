"""Finished cells on the disk: a file each under the key of its content, written whole or not at all."""

import dataclasses
import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from baselines.identification.static_points import StaticPoints
from train.cells.key import cell_key
from train.evaluate.conditions import Condition
from train.evaluate.evaluate import Evaluation
from train.runs.whole import write_whole

CELLS = "cells"
"""Folder of a run in which its finished cells are."""
_EPISODES, _TRACE, _POINTS, _REST = "episodes", "trace", "points", "rest_references"


@dataclasses.dataclass(frozen=True)
class Store:
    """Finished cells.

    Attributes:
        folder: Where their files are; it is made when the first cell is kept.
    """

    folder: Path

    def get(self, condition: Condition) -> Evaluation | None:
        """What came out of a condition; None where nothing is kept of it, or the file is damaged."""
        try:
            content = self._file(condition).read_bytes()
            return _read(condition, content)
        except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile):
            return None

    def keep(self, evaluation: Evaluation, key: str | None = None) -> bool:
        """Keep what came out of a condition, unless what it depends on has changed since it began.

        Args:
            evaluation: What came out.
            key: Key of the condition before it was played; None where nothing can have changed.

        Returns:
            Whether it is kept.

        Raises:
            OSError: The disk is full, or the folder cannot be written; cells that were kept before stay.
        """
        file = self._file(evaluation.condition)
        if key is not None and file.stem != key:
            return False
        self.folder.mkdir(parents=True, exist_ok=True)
        write_whole(file, _written(evaluation))
        return True

    def _file(self, condition: Condition) -> Path:
        return self.folder / f"{cell_key(condition)}.npz"


def _written(evaluation: Evaluation) -> bytes:
    """An evaluation as a file of NumPy's, from which no code can run."""
    arrays: dict[str, Any] = {f"{_TRACE}/{name}": values for name, values in evaluation.trace.items()}
    if evaluation.points is not None:
        arrays |= {f"{_POINTS}/{name}": values for name, values in vars(evaluation.points).items()}
    episodes = json.dumps(evaluation.episodes, default=lambda number: number.item()).encode()
    content = io.BytesIO()
    np.savez_compressed(
        content,
        **arrays,
        **{_EPISODES: np.frombuffer(episodes, dtype=np.uint8), _REST: evaluation.rest_references},
    )
    return content.getvalue()


def _read(condition: Condition, content: bytes) -> Evaluation:
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        found = {name: arrays[name] for name in arrays.files}
    points = _part(found, _POINTS)
    return Evaluation(
        condition,
        episodes=json.loads(found[_EPISODES].tobytes()),
        trace=_part(found, _TRACE),
        points=StaticPoints(**points) if points else None,
        rest_references=found[_REST],
    )


def _part(found: dict[str, Any], name: str) -> dict[str, Any]:
    return {key.removeprefix(f"{name}/"): array for key, array in found.items() if key.startswith(f"{name}/")}
