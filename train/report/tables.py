"""Tables of results: columns, rows, and cells of plain text with looks."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

from train.evaluate.changes import Verdict
from train.evaluate.environments import Column
from train.evaluate.statistics import Estimate

Style = Literal["", "bold", "small", "failure", "badge", "pooled", "ceiling"] | Verdict


@dataclass(frozen=True)
class Part:
    """A piece of a cell.

    Attributes:
        text: Plain text.
        style: Look of the text: bold; small, on a line below; a failure; a badge; or the colour of
            a verdict.
        before: Plain text between this part and the previous one.
    """

    text: str
    style: Style = ""
    before: str = ""


Cell = str | tuple[Part, ...]
Texts = Iterable[str]


@dataclass(frozen=True)
class Head:
    """A column of a table.

    Attributes:
        title: Title of the column.
        unit: Unit of its figures; empty without one.
        note: Explanation of the title, for the caption; empty if it needs none.
        second: Second part of the title, on a line of its own where titles have several lines.
        is_number: True for figures, aligned to the right; false for words.
        wraps: True if the words of a cell may be on several lines of a terminal; no word is broken.
        leaves: Turn in which the column is left out if a terminal has no room: 1 before 2; 0 for
            never. The last column that may be left out stays.
        titles: True if the title of the table may name the column's value, if all are the same.
    """

    title: str
    unit: str = ""
    note: str = ""
    second: str = ""
    is_number: bool = True
    wraps: bool = False
    leaves: int = 0
    titles: bool = False

    @property
    def label(self) -> str:
        """Whole title in one line, with unit."""
        title = f"{self.title}, {self.second}" if self.second else self.title
        return f"{title} [{self.unit}]" if self.unit else title

    @property
    def lines(self) -> str:
        """Title on a terminal; for figures a line for each word, to save width."""
        if not self.is_number:
            return self.title
        title = f"{self.title}," if self.second else self.title
        return "\n".join(filter(None, [*title.split(), self.second, self.unit]))


@dataclass(frozen=True)
class Row:
    """A row of a table.

    Attributes:
        cells: One per column; the heading of a section has one cell.
        kind: Heading of the rows below, or a group of scenarios, which is emphasised.
        dot: Colour of a dot before a heading; empty for none.
    """

    cells: tuple[Cell, ...]
    kind: Literal["", "heading", "group"] = ""
    dot: str = ""


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        heads: Columns.
        rows: Rows.
        keys: Number of first columns that name a row. On a terminal and a page, repeated names are
            left out, except in the last of these columns.
        title: Title above the table on a terminal.
        subjects: Names before the title.
        caption: Text below the table on a terminal.
        kind: Class of the table on a page.
    """

    heads: tuple[Head, ...]
    rows: tuple[Row, ...]
    keys: int = 1
    title: str = ""
    subjects: tuple[str, ...] = ()
    caption: str = ""
    kind: str = ""

    @classmethod
    def plain(cls, head: Texts, rows: Iterable[Texts], words: int = 1, **more: Any) -> Self:
        """Make a table of texts, whose first columns contain words and the others figures."""
        heads = tuple(Head(text, is_number=n >= words) for n, text in enumerate(head))
        return cls(heads, tuple(Row(tuple(row)) for row in rows), keys=words, **more)

    def column(self, place: int) -> list[str]:
        """Return the texts of a column, without headings."""
        rows = [row for row in self.rows if row.kind != "heading"]
        return [plain_text(row.cells[place]) for row in rows]

    def without(self, place: int) -> "Table":
        """Return the table without a column."""
        rows = []
        for row in self.rows:
            cells = row.cells[:place] + row.cells[place + 1 :]
            rows.append(row if row.kind == "heading" else replace(row, cells=cells))
        heads = self.heads[:place] + self.heads[place + 1 :]
        keys = self.keys - (place < self.keys)
        return replace(self, heads=heads, rows=tuple(rows), keys=keys)

    @property
    def sparse_rows(self) -> list[Row]:
        """Rows in which names that repeat the row above are empty."""
        rows = []
        above: tuple[Cell, ...] = ()
        for row in self.rows:
            is_heading = row.kind == "heading"
            same = 0
            limit = 0 if is_heading else self.keys - 1
            while same < limit and row.cells[: same + 1] == above[: same + 1]:
                same += 1
            rows.append(replace(row, cells=("",) * same + row.cells[same:]))
            above = () if is_heading else row.cells
        return rows


def parts_of(cell: Cell) -> tuple[Part, ...]:
    """Return a cell as parts."""
    return (Part(cell),) if isinstance(cell, str) else cell


def plain_text(cell: Cell) -> str:
    """Return the text of a cell without looks and without small parts."""
    parts = [part for part in parts_of(cell) if part.style != "small"]
    return "".join(part.before + part.text for part in parts)


def column_notes(columns: Iterable[Head | Column]) -> list[str]:
    """Return a sentence that explains the titles of columns; no sentence if none has a note."""
    notes = [f"{column.title}: {column.note}" for column in columns if column.note]
    return [f"{'; '.join(notes)}."] if notes else []


def number_interval(estimate: Estimate, column: Column) -> str:
    """Return a figure with its interval in the displayed unit; "-" if it is not known."""
    if not estimate.is_known:
        return "-"
    shown = estimate.times(column.scale)
    value, low, high = (f"{v:.{column.decimals}f}" for v in (shown.value, *shown.ends))
    return f"{value} [{low}, {high}]" if shown.has_interval else value
