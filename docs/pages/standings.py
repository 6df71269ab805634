"""Scores and paired changes of a leaderboard, for the pages."""

from collections.abc import Sequence
from dataclasses import replace

from train.evaluate.leaderboard_rows import Standing
from train.report.leaderboard import leaderboard_table
from train.report.markdown import to_markdown
from train.report.tables import Cell, parts_of

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


def board_markdown(found: Sequence[Standing]) -> str:
    """The judged columns of the leaderboard, without intervals."""
    table = leaderboard_table(found)
    for place in reversed(range(len(table.heads))):
        head = table.heads[place]
        if head.second and (head.title, head.second) not in _JUDGED:
            table = table.without(place)
    rows = (replace(row, cells=tuple(map(_score, row.cells))) for row in table.rows)
    return to_markdown(replace(table, rows=tuple(rows))) + "\n"


def _score(cell: Cell) -> Cell:
    """A cell without its intervals."""
    return tuple(part for part in parts_of(cell) if part.style != "small")
