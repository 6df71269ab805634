"""Reader of a user's CSV file of bounded size: a header, then rows of finite numbers."""

import csv
import io
import math
from array import array
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from elastic_env.core.errors import ConfigurationError, quote, shorten
from elastic_env.core.files import read_bounded
from elastic_env.core.signals import Array

LARGEST_BYTES = 20_000_000
"""Largest size of a file."""
MOST_COLUMNS = 1000
"""Largest number of columns."""

_LONGEST_LINE = 200_000
_CURE = "use commas, and points in numbers"
_SEPARATORS = {";": "semicolons", "\t": "tabs", "|": "bars"}


class Table(NamedTuple):
    """Columns of numbers with names.

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
        what: Word for its content in messages, such as log.
        row: Word for a row in messages.
        most_rows: Largest number of rows.
        example: Columns of a header, for messages.

    Raises:
        ConfigurationError: The file is missing, too large or no CSV file, or a value is no finite
            number.
    """
    try:
        text = read_bounded(file, LARGEST_BYTES).decode("utf-8-sig")
        if max(map(len, io.StringIO(text)), default=0) > _LONGEST_LINE:
            bound = f"lines of at most {_LONGEST_LINE} characters"
            raise ConfigurationError(f"{shorten(file)} must have {bound}; is it CSV?")
        return _parse(file, text, row, most_rows, example)
    except ConfigurationError:
        raise
    except csv.Error as error:
        problem = f"is no CSV file: {error}; check quotation marks and line ends"
    except UnicodeDecodeError as error:
        problem = f"is no text in UTF-8: {error.reason}; save it as CSV in UTF-8"
    except IsADirectoryError:
        problem = "must be a plain file, it is a folder; give a CSV file"
    except PermissionError as error:
        problem = f"cannot be read: {error.strerror}"
    except (OSError, ValueError):
        raise ConfigurationError(
            f"no {what} at {quote(str(file))[1:-1]}; give a CSV file with columns such as {example}"
        ) from None
    raise ConfigurationError(f"{shorten(file)} {problem}")


def _parse(file: Path, text: str, row: str, most_rows: int, example: str) -> Table:
    lines = csv.reader(io.StringIO(text, newline=""))
    filled = (cells for cells in lines if any(cell.strip() for cell in cells))
    header = next(filled, None)
    if header is None:
        needed = f"its first line must name columns such as {example}"
        raise ConfigurationError(f"{shorten(file)} is empty; {needed}")
    names = _names(file, header)
    values = array("d")
    count = 0
    for count, cells in enumerate(filled, start=1):
        if count > most_rows:
            break
        values.extend(_numbers(shorten(file), f"{row} {count}", names, cells))
    if not 0 < count <= most_rows:
        has = f"more than {most_rows}" if count else "0"
        needed = f"1 to {most_rows} {row}s, a line each"
        raise ConfigurationError(f"{shorten(file)} must have {needed}, it has {has}")
    return Table(names, np.array(values, dtype=np.float64).reshape(count, len(names)))


def _names(file: Path, header: list[str]) -> tuple[str, ...]:
    """Return the names of the columns.

    Raises:
        ConfigurationError: They are not separated by commas, too many, empty or not unique.
    """
    names = tuple(cell.strip() for cell in header)
    table = shorten(file)
    name, count = Counter(names).most_common(1)[0]
    problem = None
    if len(names) == 1 and (separator := _separator(header)):
        problem = f"the columns of {table} are separated by {separator}; {_CURE}"
    elif len(names) > MOST_COLUMNS:
        problem = f"{table} must have at most {MOST_COLUMNS} columns, it has {len(names)}"
    elif "" in names:
        problem = f"column {names.index('') + 1} of {table} has no name; give it one"
    elif count > 1:
        problem = f"{table} has the column {quote(name)[1:-1]} twice; keep one of them"
    if problem is not None:
        raise ConfigurationError(problem)
    return names


def _numbers(file: str, where: str, names: tuple[str, ...], cells: list[str]) -> Iterator[float]:
    """Yield the finite numbers of a row."""
    if len(cells) != len(names):
        problem = f"{len(names)} values are needed, one a column, got {len(cells)}"
        if separator := _separator(cells):
            problem = f"its values are separated by {separator}; {_CURE}"
        elif len(cells) == 2 * len(names):
            problem += "; were its numbers written with decimal commas? Write points"
        raise ConfigurationError(f"{file}, {where}: {problem}")
    for name, cell in zip(names, cells, strict=True):
        value = math.nan if "_" in cell else _number(cell)
        if not math.isfinite(value):
            raise ConfigurationError(
                f"{file} must hold a header and rows of numbers: {where}, column"
                f" {quote(name)[1:-1]}: a finite number is needed, got {quote(cell)};"
                f" {_cell_cure(cell)}"
            )
        yield value


def _separator(cells: list[str]) -> str:
    """Return the name of another separator than commas; empty where there is none."""
    text = "".join(cells)
    return next((name for mark, name in _SEPARATORS.items() if mark in text), "")


def _number(cell: str) -> float:
    """Convert a cell to a number, nan where it is none."""
    try:
        return float(cell)
    except ValueError:
        return math.nan


def _cell_cure(cell: str) -> str:
    """Return the cure for a cell that is no finite number."""
    if math.isnan(_number(cell.replace(",", "."))) and "nan" not in cell.lower():
        return "give a number, or delete the line"
    if "," in cell:
        return "write the number with a point"
    return "measure it again, or delete the line"
