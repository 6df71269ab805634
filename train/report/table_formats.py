"""Tables of results for the terminal, as Markdown and, by `table.html.j2`, as HTML.

Texts of a table are plain. Each of these escapes them, see `train.runs.escaping`.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

from rich import box
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from elastic_env.core.errors import missing_extra
from train.evaluate.changes import Verdict
from train.evaluate.environments import Column
from train.evaluate.statistics import Estimate
from train.figures.colours import NIGHT, VERDICTS
from train.report.specs import FONT
from train.runs.escaping import line_value, markdown_text, script_json, template_value

if TYPE_CHECKING:
    from jinja2 import Template

Look = Literal["", "bold", "small", "failure", "badge", "pooled", "ceiling"]
Style = Look | Verdict

_ANY_WIDTH = 10_000
_WORD = re.compile(r"\S+(?: [^\w\s]+)*")
"""A word, with the signs behind it."""


@dataclass(frozen=True)
class Part:
    """A piece of a cell.

    Attributes:
        text: Plain text.
        style: Look of it: bold; small, on a line below; a failure; a badge; or the colour of a
            verdict.
        before: Plain text between it and the part before.
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
        title: Its title.
        unit: Unit of its figures; empty without one.
        note: Meaning that the title leaves open, for the caption; empty where it says it all.
        second: Second part of the title, on a line of its own where there is room for lines.
        is_number: Whether it holds figures, to the right, or words.
        wraps: Whether its words may stand on several lines of a terminal, but for the longest.
        leaves: Turn in which it is left out where a terminal has no room: 1 before 2; 0 for never.
            The last one of those that may leave stays.
        titles: Whether the title of the table may name its value, if it has but one.
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
        """All of the title in one line, with unit."""
        title = f"{self.title}, {self.second}" if self.second else self.title
        return f"{title} [{self.unit}]" if self.unit else title

    @property
    def lines(self) -> str:
        """The title on a terminal: of figures a line for each word, as there is little room."""
        if not self.is_number:
            return self.title
        title = f"{self.title}," if self.second else self.title
        return "\n".join(filter(None, [*title.split(), self.second, self.unit]))


@dataclass(frozen=True)
class Row:
    """A row of a table.

    Attributes:
        cells: One per column; of the heading of a section the first one alone.
        kind: A heading of what follows, or a group of scenarios, which stands out.
        dot: Colour of a dot before a heading; empty for none.
    """

    cells: tuple[Cell, ...]
    kind: Literal["", "heading", "group"] = ""
    dot: str = ""


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        heads: Its columns.
        rows: Its rows.
        keys: Columns that name a row. Where a terminal or a page repeats them, they stand once, but
            for the last one.
        title: Above it on a terminal.
        subjects: Names before the title.
        caption: Below it on a terminal.
        kind: Class of it on a page.
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
        """A table of texts whose first columns hold words and the others figures."""
        heads = tuple(Head(text, is_number=n >= words) for n, text in enumerate(head))
        return cls(heads, tuple(Row(tuple(row)) for row in rows), keys=words, **more)

    def column(self, place: int) -> list[str]:
        """Texts of a column, without headings."""
        rows = [row for row in self.rows if row.kind != "heading"]
        return [plain_text(row.cells[place]) for row in rows]

    def without(self, place: int) -> "Table":
        """The same without a column."""
        rows = []
        for row in self.rows:
            cells = row.cells[:place] + row.cells[place + 1 :]
            rows.append(row if row.kind == "heading" else replace(row, cells=cells))
        heads = self.heads[:place] + self.heads[place + 1 :]
        keys = self.keys - (place < self.keys)
        return replace(self, heads=heads, rows=tuple(rows), keys=keys)

    @property
    def sparse(self) -> list[Row]:
        """Rows in which what the row above has already said is empty."""
        found = []
        before: tuple[Cell, ...] = ()
        for row in self.rows:
            is_heading = row.kind == "heading"
            said = 0
            most = 0 if is_heading else self.keys - 1
            while said < most and row.cells[: said + 1] == before[: said + 1]:
                said += 1
            found.append(replace(row, cells=("",) * said + row.cells[said:]))
            before = () if is_heading else row.cells
        return found


def parts_of(cell: Cell) -> tuple[Part, ...]:
    """A cell as parts."""
    return (Part(cell),) if isinstance(cell, str) else cell


def plain_text(cell: Cell) -> str:
    """The text of a cell without looks; what is small is left out."""
    shown = [part for part in parts_of(cell) if part.style != "small"]
    return "".join(part.before + part.text for part in shown)


def print_table(table: Table, console: Console, file: str) -> None:
    """Print a table without the columns that have no room, and name those and their file.

    Args:
        table: The table.
        console: The terminal.
        file: File that has all columns.
    """
    shown = table
    left_out: list[str] = []
    while not (fitting := _fit(shown, console)):
        leaving = [place for place, head in enumerate(shown.heads) if head.leaves]
        if len(leaving) < 2:
            fitting = to_terminal(shown, breaks_words=True)
            break
        place = min(leaving, key=lambda place: (shown.heads[place].leaves, -place))
        head = shown.heads[place]
        left_out.insert(0, replace(head, unit="").label)
        shown = shown.without(place)
    console.print(fitting)
    if left_out:
        missing = f"no room for {'; '.join(left_out)}"
        cure = f"widen the terminal, or see {file}"
        console.print(f"{missing}: {cure}", style="dim", markup=False)


def has_room(table: Table, console: Console) -> bool:
    """True if a terminal has room for all columns of a table."""
    return _fit(table, console) is not None


def _fit(table: Table, console: Console) -> RichTable | None:
    """A table as it has room on a terminal; None where it has none."""
    options = console.options.update(max_width=_ANY_WIDTH)
    for form in (table, _with_titles(table)):
        found = to_terminal(form)
        if console.measure(found, options=options).minimum <= console.width:
            return found
    return None


def _with_titles(table: Table) -> Table:
    """A table whose title names what has but one value."""
    for place, head in reversed(list(enumerate(table.heads))):
        values = set(table.column(place))
        if head.titles and len(values) == 1:
            table = replace(table.without(place), subjects=(*table.subjects, *values))
    return table


def to_terminal(table: Table, breaks_words: bool = False) -> RichTable:
    """A table for a terminal; words are broken where there is no other way."""
    title = ": ".join(filter(None, [", ".join(table.subjects), table.title]))
    caption = " ".join(filter(None, [*column_notes(table.heads), table.caption]))
    found = RichTable(
        title=Text(title) if title else None,
        caption=Text(caption) if caption else None,
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
    indent = "  " if any(row.kind == "heading" for row in table.rows) else ""
    for place, head in enumerate(table.heads):
        texts = [*head.lines.split("\n"), *table.column(place)]
        if head.wraps:
            texts = [word for text in texts for word in _WORD.findall(text)]
        least = max(map(cell_len, texts), default=0) + (len(indent) if place == 0 else 0)
        found.add_column(
            Text(head.lines),
            justify="right" if head.is_number else "left",
            vertical="bottom",
            no_wrap=head.is_number,
            overflow="fold",
            min_width=None if breaks_words and not head.is_number else least,
        )
    for row in table.sparse:
        is_heading = row.kind == "heading"
        if found.row_count and (is_heading or (table.keys > 1 and row.cells[0])):
            found.add_section()
        cells = [_terminal_cell(cell) for cell in row.cells]
        cells[0] = cells[0] if is_heading else Text(indent).append(cells[0])
        found.add_row(*cells, style=_ROW_STYLES[row.kind])
    return found


_ROW_STYLES = {"": "", "group": "bold", "heading": "italic"}


def column_notes(columns: Iterable[Head | Column]) -> list[str]:
    """A sentence with what the titles of columns leave open, if there is something."""
    notes = [f"{column.title}: {column.note}" for column in columns if column.note]
    return [f"{'; '.join(notes)}."] if notes else []


def _terminal_cell(cell: Cell) -> Text:
    text = Text()
    for part in parts_of(cell):
        if part.style != "small":
            text.append(part.before)
            text.append(part.text, "bold" if part.style == "bold" else None)
    return text


def to_markdown(table: Table) -> str:
    """A table in Markdown, with its texts escaped."""
    rules = ["---:" if head.is_number else "---" for head in table.heads]
    lines = [[markdown_text(head.label) for head in table.heads], rules]
    for row in table.rows:
        cells = [_markdown_cell(cell) for cell in row.cells]
        if row.kind == "heading":
            cells = [f"**{cells[0]}**", *[""] * (len(table.heads) - 1)]
        lines.append(cells)
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _markdown_cell(cell: Cell) -> str:
    text = ""
    for part in parts_of(cell):
        look = _MARKDOWN.get(part.style, "{}")
        text += part.before + look.format(markdown_text(part.text))
    return text


_MARKDOWN = {
    **{"bold": "**{}**", "small": "<br><sub>{}</sub>"},
    **dict.fromkeys(("badge", "ceiling", "pooled"), "({})"),
}


def load_template(name: str = "page.html.j2") -> "Template":
    """A template, by default that of a page; one of HTML escapes all that is put into it.

    Raises:
        MissingExtraError: Jinja2 is not installed.
    """
    try:
        from jinja2 import Environment, FileSystemLoader, StrictUndefined
    except ImportError:
        raise missing_extra("jinja2", "report", "writing a report") from None
    is_html = name.endswith(".html.j2")
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=is_html,
        undefined=StrictUndefined,
        trim_blocks=True,
        finalize=template_value if is_html else line_value,
    )
    environment.filters.update(script_json=script_json)
    environment.globals.update(font=FONT, night=NIGHT, verdicts=VERDICTS)
    return environment.get_template(name)


def number_interval(estimate: Estimate, column: Column) -> str:
    """A figure in the unit in which it is shown, with its interval; - where there is none."""
    if not estimate.is_known:
        return "-"
    shown = estimate.times(column.scale)
    value, low, high = (f"{v:.{column.decimals}f}" for v in (shown.value, *shown.ends))
    return f"{value} [{low}, {high}]" if shown.has_interval else value
