"""Finished cells on the disk: one file each, named by its key and written atomically."""

from dataclasses import dataclass
from pathlib import Path

from elastic_env.core.errors import quote
from elastic_env.core.files import read_bounded, write_whole
from train.cells import cell_file
from train.cells.cell_file import UnfitCellError
from train.cells.cell_key import cell_key
from train.evaluate.conditions import Condition
from train.evaluate.episodes import Evaluation

CELLS = "cells"
"""Folder of a run for its finished cells."""


@dataclass(frozen=True)
class Store:
    """Finished cells.

    Attributes:
        folder: Folder of their files; the first stored cell creates it.
    """

    folder: Path

    def get(self, condition: Condition) -> Evaluation | None:
        """Return the stored result of a condition; None if there is none.

        Raises:
            UnfitCellError: The file is damaged, was changed, or belongs to another condition.
        """
        file = self._file(condition)
        try:
            content = read_bounded(file, cell_file.MAX_BYTES, within=self.folder)
            return cell_file.unpack_evaluation(condition, file.stem, content)
        except FileNotFoundError:
            return None
        except UnfitCellError as error:
            raise UnfitCellError(f"{file.name}: {error}") from None
        except Exception as error:  # the reader of archives meets a foreign file
            cause = f"{type(error).__name__}: {quote(str(error))}"
            raise UnfitCellError(f"{file.name}: {cause}") from None

    def keep(self, evaluation: Evaluation, key: str | None = None) -> bool:
        """Store the result of a condition, unless its key has changed since the cell began.

        Args:
            evaluation: The result.
            key: Key of the condition before it was played; None if it cannot have changed.

        Returns:
            True if the result is stored.

        Raises:
            OSError: The disk is full, or the folder cannot be written; older cells stay.
        """
        file = self._file(evaluation.condition)
        if key is not None and file.stem != key:
            return False
        self.folder.mkdir(parents=True, exist_ok=True)
        write_whole(file, cell_file.pack_evaluation(evaluation, file.stem))
        return True

    def _file(self, condition: Condition) -> Path:
        return self.folder / f"{cell_key(condition)}.npz"
