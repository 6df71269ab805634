"""Rows of a `leaderboard.csv`, read for the pages."""

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from elastic_env.core.errors import ConfigurationError, shorten
from train.evaluate.standings import Paired, Standing
from train.evaluate.statistics import Estimate
from train.report.leaderboard import COLUMNS, board, claims_table
from train.report.table_formats import Cell, Table, parts_of, plain_text, to_markdown

_JUDGED = (
    ("mixture", "3 s"),
    ("held out", "3 s"),
    ("drawn", "3 s"),
    ("nominal", "3 s num_steps=20"),
    ("drawn", "3 s num_steps=20"),
    ("mixture", "1.6 s"),
    ("mixture", "1.1 s"),
)
"""Columns of the leaderboard that the page shows."""
_GAITS = ("mixture, 3 s", "mixture, 1.6 s", "mixture, 1.1 s")
"""Columns that show a residual at every gait."""


def board_markdown(found: Sequence[Standing]) -> str:
    """The judged columns of the leaderboard, without intervals."""
    table = board(found)
    for place in reversed(range(len(table.heads))):
        head = table.heads[place]
        if head.second and (head.title, head.second) not in _JUDGED:
            table = table.without(place)
    rows = (replace(row, cells=tuple(map(_score, row.cells))) for row in table.rows)
    return to_markdown(replace(table, rows=tuple(rows))) + "\n"


def _score(cell: Cell) -> Cell:
    """A cell without its intervals."""
    return tuple(part for part in parts_of(cell) if part.style != "small")


def claims_markdown(found: Sequence[Standing]) -> str:
    """The paired changes of residuals against the best policy without learning, at every gait."""
    table = claims_table(found)
    for place in (4, 2):  # against the base
        table = table.without(place)
    rows = tuple(
        replace(row, cells=(plain_text(row.cells[0]).removeprefix("residual of "), *row.cells[1:]))
        for row in table.rows
        if row.cells[1] in _GAITS
    )
    heads = tuple(replace(head, title=head.title.partition(",")[0]) for head in table.heads)
    return to_markdown(Table(heads, rows, keys=table.keys)) + "\n"


def read_leaderboard(path: Path) -> list[Standing]:
    """The rows of a `leaderboard.csv`.

    Raises:
        ConfigurationError: It is none.
    """
    with path.open(newline="", encoding="utf-8") as file:
        try:
            found = [_standing(row) for row in csv.DictReader(file)]
        except ValidationError as error:
            said = error.errors()[0]["msg"]
            raise ConfigurationError(f"{shorten(path)} is no leaderboard.csv: {said}") from None
        except (KeyError, TypeError, ValueError) as error:
            problem = f"{shorten(path)} is no leaderboard.csv: {error!r}"
            raise ConfigurationError(problem) from None
    if not found:
        raise ConfigurationError(f"{shorten(path)} has no rows")
    return found


def _standing(row: Mapping[str, str]) -> Standing:
    fields = {}
    for name in Standing.__dataclass_fields__:
        if name == "interval_over" and name not in row:
            continue  # of a leaderboard that was written before there was one
        cells = [row[column] for column in COLUMNS.get(name, (name,))]
        fields[name] = _FIELDS[len(cells)](*cells)
    return _STANDING.validate_python(fields)


def _estimate(value: str, low: str, high: str) -> Estimate:
    if not low:
        return Estimate(float(value))
    return Estimate(float(value), float(low), float(high))


def _paired(to: str, value: str, low: str, high: str, verdict: str) -> Paired | None:
    return Paired(to, _estimate(value, low, high), verdict) if to else None


_FIELDS: Mapping[int, Callable[..., Any]] = {1: str, 3: _estimate, 5: _paired}
"""Fields from so many columns."""
_STANDING = TypeAdapter(Standing)
