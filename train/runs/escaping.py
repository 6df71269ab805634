"""Text of a user, such as the label of a policy, in the formats of results: each has signs that mean something."""

import csv
import html
import io
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from elastic_env.core.files import write_whole

_FORMULA = ("=", "+", "-", "@", "\t", "\r")
_NUMBERS = re.compile(r"[-+]?[\d.]+(e[-+]?\d+)?( [-+]?(nan|[\d.]+(e[-+]?\d+)?))*")
"""Numbers side by side, which are no formula whatever their sign."""
_SPACE = re.compile(r"[^\S\N{NO-BREAK SPACE}]+")
_IN_SCRIPT = {ord(sign): f"\\u{ord(sign):04x}" for sign in "<>&\u2028\u2029"}


def csv_cell(value: Any) -> Any:
    """A cell of a CSV file; text that a spreadsheet would take for a formula gets an apostrophe in front."""
    is_formula = isinstance(value, str) and value.startswith(_FORMULA) and not _NUMBERS.fullmatch(value)
    return f"'{value}" if is_formula else value


def csv_row(values: Iterable[Any]) -> list[Any]:
    """A row of a CSV file."""
    return [csv_cell(value) for value in values]


def write_csv(head: Sequence[str], rows: Iterable[Iterable[Any]], path: Path) -> Path:
    """Write a CSV file."""
    text = io.StringIO(newline="")
    csv.writer(text).writerows(map(csv_row, [head, *rows]))
    write_whole(path, text.getvalue())
    return path


def write_records(records: Sequence[Mapping[str, Any]], path: Path) -> Path:
    """Write a CSV file of rows by column; what a row does not have is empty."""
    head = list(dict.fromkeys(name for record in records for name in record))
    return write_csv(head, ([record.get(name, "") for name in head] for record in records), path)


def markdown_text(text: str) -> str:
    """Plain text in Markdown, in one line, also within a table; no-break spaces stay."""
    return html.escape(_SPACE.sub(" ", text).strip(), quote=False).replace("|", "\\|")


def markdown_table(head: Sequence[str], rules: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of plain texts; `rules` say how columns are aligned, such as "---:"."""
    lines = [map(markdown_text, head), rules, *(map(markdown_text, row) for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def script_json(value: Any) -> str:
    """JSON that can stand in a script element: nothing in it ends the element or begins a comment."""
    return json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=False).translate(_IN_SCRIPT)


def chart_text(text: str) -> str:
    """Plain text in a chart, whose texts are HTML."""
    return html.escape(text, quote=False)
