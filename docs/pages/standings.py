"""Scores and paired changes of a leaderboard, for the pages."""

from collections.abc import Sequence
from dataclasses import replace

from train.evaluate.standings import Standing
from train.report.leaderboard import board, claims_table
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
