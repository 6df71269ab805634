"""Tables and lists in Markdown, with their texts escaped."""

from collections.abc import Iterable

from train.report.tables import Cell, Table, parts_of
from train.runs.escaping import markdown_text

_LOOKS = {
    **{"bold": "**{}**", "small": "<br><sub>{}</sub>"},
    **dict.fromkeys(("badge", "ceiling", "pooled"), "({})"),
}


def to_markdown(table: Table) -> str:
    """Return a table in Markdown."""
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
        look = _LOOKS.get(part.style, "{}")
        text += part.before + look.format(markdown_text(part.text))
    return text


def bullets(texts: Iterable[str]) -> str:
    """Return a list in Markdown."""
    return "\n".join(f"* {markdown_text(text)}" for text in texts)
