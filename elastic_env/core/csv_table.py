"""Tables of numbers from a user's CSV file: a header, then rows of finite numbers, of bounded
size.
"""

import csv
import math
import stat
from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np

from elastic_env.core.errors import ConfigurationError, quote, shorten
from elastic_env.core.signals import Array

LARGEST_BYTES = 20_000_000
"""Size of a file."""
MOST_COLUMNS = 1000
"""Columns of a table."""

_LONGEST_LINE = 200_000
_CURE = "use commas, and points in numbers"
_SEPARATORS = {";": "semicolons", "\t": "tabs", "|": "bars"}


@dataclass(frozen=True)
class Table:
    """Numbers under names.

    Attributes:
        names: Header without spaces around the names, each once, (m,).
        values: Finite numbers, (N, m).
    """

    names: tuple[str, ...]
    values: Array


def read_table(file: Path, *, what: str, row: str, most_rows: int, example: str) -> Table:
    """Read a CSV file in UTF-8, with or without a byte order mark. Empty lines do not count.

    Args:
        file: The file.
        what: Its content in words, such as log.
        row: Word for a row in messages.
        most_rows: Rows of the table, at most.
        example: Columns that a header may have, for messages.

    Raises:
        ConfigurationError: The file is missing, too large or no CSV file, or holds something else
            than finite numbers.
    """
    size = _size(file, what, example)
    if size > LARGEST_BYTES:
        raise ConfigurationError(
            f"{shorten(file)} must have at most {LARGEST_BYTES} bytes, it has {size}"
        )
    try:
        with file.open(newline="", encoding="utf-8-sig") as text:
            return _parsed(file, text, row, most_rows, example)
    except UnicodeDecodeError as error:
        raise ConfigurationError(
            f"{shorten(file)} is no text in UTF-8: {error.reason}; save it as CSV in UTF-8"
        ) from None
    except csv.Error as error:
        raise ConfigurationError(
            f"{shorten(file)} is no CSV file: {error}; check quotation marks and line ends"
        ) from None
    except OSError as error:
        raise ConfigurationError(f"{shorten(file)} cannot be read: {error.strerror}") from None


def _size(file: Path, what: str, example: str) -> int:
    """Bytes of a plain file."""
    try:
        found = file.stat()
    except (OSError, ValueError):
        raise ConfigurationError(
            f"no {what} at {quote(str(file))[1:-1]}; give a CSV file with columns such as {example}"
        ) from None
    if not stat.S_ISREG(found.st_mode):
        raise ConfigurationError(
            f"{shorten(file)} must be a plain file, it is a folder, a pipe or a device; give a"
            " CSV file"
        )
    return found.st_size


def _parsed(file: Path, text: TextIO, row: str, most_rows: int, example: str) -> Table:
    lines = (
        cells for cells in csv.reader(_bounded(file, text)) if any(cell.strip() for cell in cells)
    )
    header = next(lines, None)
    if header is None:
        raise ConfigurationError(
            f"{shorten(file)} is empty; its first line must name columns such as {example}"
        )
    names = _names(file, header)
    values = array("d")
    count = 0
    for count, cells in enumerate(lines, start=1):
        if count > most_rows:
            break
        _append(values, file, f"{row} {count}", names, cells)
    if not 0 < count <= most_rows:
        more = f"more than {most_rows}" if count else "0"
        raise ConfigurationError(
            f"{shorten(file)} must have 1 to {most_rows} {row}s, a line each, it has {more}"
        )
    return Table(names, np.frombuffer(values, dtype=np.float64).reshape(count, len(names)).copy())


def _bounded(file: Path, text: TextIO) -> Iterator[str]:
    """Lines of the file, each of bounded length."""
    while line := text.readline(_LONGEST_LINE + 1):
        if len(line) > _LONGEST_LINE:
            raise ConfigurationError(
                f"{shorten(file)} must have lines of at most {_LONGEST_LINE} characters; is it a"
                " CSV file?"
            )
        yield line


def _names(file: Path, header: list[str]) -> tuple[str, ...]:
    """Names of the columns.

    Raises:
        ConfigurationError: They are not separated by commas, too many, or not each once.
    """
    names = tuple(cell.strip() for cell in header)
    if len(names) == 1:
        for separator, called in _SEPARATORS.items():
            if separator in names[0]:
                raise ConfigurationError(
                    f"the columns of {shorten(file)} are separated by {called}; {_CURE}"
                )
    if len(names) > MOST_COLUMNS:
        raise ConfigurationError(
            f"{shorten(file)} must have at most {MOST_COLUMNS} columns, it has {len(names)}"
        )
    if "" in names:
        raise ConfigurationError(
            f"column {names.index('') + 1} of {shorten(file)} has no name; give it one, or take"
            " the column out"
        )
    name, count = Counter(names).most_common(1)[0]
    if count > 1:
        raise ConfigurationError(
            f"{shorten(file)} has the column {quote(name)[1:-1]} twice; keep one of them"
        )
    return names


def _append(
    values: "array[float]", file: Path, where: str, names: tuple[str, ...], cells: list[str]
) -> None:
    """Add the finite numbers of a row."""
    if len(cells) != len(names):
        raise ConfigurationError(f"{shorten(file)}, {where}: {_ragged(names, cells)}")
    for name, cell in zip(names, cells, strict=True):
        try:
            value = math.nan if "_" in cell else float(cell)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise ConfigurationError(
                f"{shorten(file)} must hold a header and rows of numbers: {where}, column"
                f" {quote(name)[1:-1]}: a finite number is needed, got {quote(cell)};"
                f" {_cure_of(cell)}"
            )
        values.append(value)


def _ragged(names: tuple[str, ...], cells: list[str]) -> str:
    """What is wrong with a row of another length than the header."""
    for separator, called in _SEPARATORS.items():
        if any(separator in cell for cell in cells):
            return f"its values are separated by {called}; {_CURE}"
    hint = (
        "; were its numbers written with decimal commas? Write points"
        if len(cells) == 2 * len(names)
        else ""
    )
    return f"{len(names)} values are needed, one a column, got {len(cells)}{hint}"


def _cure_of(cell: str) -> str:
    """What to do about a cell that is no finite number."""
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return "give a number, or delete the line"
    return (
        "write the number with a point" if "," in cell else "measure it again, or delete the line"
    )
