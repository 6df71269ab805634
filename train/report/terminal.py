"""Tables on a terminal, without the columns that have no room."""

import re
from dataclasses import replace

from rich import box
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from elastic_env.core.errors import quote
from train.report.tables import Cell, Table, column_notes, parts_of

_ANY_WIDTH = 10_000
_WORD = re.compile(r"\S+(?: [^\w\s]+)*")
"""A word, with the signs after it."""
_ROW_STYLES = {"": "", "group": "bold", "heading": "italic"}


def print_table(table: Table, console: Console, file: str) -> None:
    """Print a table without the columns that have no room; name these columns and their file.

    Args:
        table: The table.
        console: The terminal.
        file: File that has all columns.
    """
    missing: list[str] = []
    while not (fitting := _fit(table, console)):
        places = [place for place, head in enumerate(table.heads) if head.leaves]
        if len(places) < 2:
            fitting = to_terminal(table, breaks_words=True)
            break
        place = min(places, key=lambda place: (table.heads[place].leaves, -place))
        missing.insert(0, replace(table.heads[place], unit="").label)
        table = table.without(place)
    console.print(fitting)
    if missing:
        columns = ", ".join(map(quote, missing))
        message = f"no room for {columns}: widen the terminal, or see {file}"
        console.print(message, style="dim", markup=False)


def has_room(table: Table, console: Console) -> bool:
    """Return True if a terminal has room for all columns of a table."""
    return _fit(table, console) is not None


def _fit(table: Table, console: Console) -> RichTable | None:
    """Return a table that fits on a terminal; None if it has no room."""
    options = console.options.update(max_width=_ANY_WIDTH)
    for form in (table, _move_to_title(table)):
        rich_table = to_terminal(form)
        if console.measure(rich_table, options=options).minimum <= console.width:
            return rich_table
    return None


def _move_to_title(table: Table) -> Table:
    """Move columns with a single value into the title, if they allow that."""
    for place, head in reversed(list(enumerate(table.heads))):
        values = set(table.column(place))
        if head.titles and len(values) == 1:
            table = replace(table.without(place), subjects=(*table.subjects, *values))
    return table


def to_terminal(table: Table, breaks_words: bool = False) -> RichTable:
    """Return a table for a terminal, whose words may be broken if nothing else helps."""
    title = ": ".join(filter(None, [", ".join(table.subjects), table.title]))
    caption = " ".join(filter(None, [*column_notes(table.heads), table.caption]))
    rich_table = RichTable(
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
        width = max(map(cell_len, texts), default=0) + (len(indent) if place == 0 else 0)
        rich_table.add_column(
            Text(head.lines),
            justify="right" if head.is_number else "left",
            vertical="bottom",
            no_wrap=head.is_number,
            overflow="fold",
            min_width=None if breaks_words and not head.is_number else width,
        )
    for row in table.sparse_rows:
        is_heading = row.kind == "heading"
        if rich_table.row_count and (is_heading or (table.keys > 1 and row.cells[0])):
            rich_table.add_section()
        cells = [_terminal_cell(cell) for cell in row.cells]
        cells[0] = cells[0] if is_heading else Text(indent).append(cells[0])
        rich_table.add_row(*cells, style=_ROW_STYLES[row.kind])
    return rich_table


def _terminal_cell(cell: Cell) -> Text:
    text = Text()
    for part in parts_of(cell):
        if part.style != "small":
            text.append(part.before)
            text.append(part.text, "bold" if part.style == "bold" else None)
    return text
