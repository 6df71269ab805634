"""Text of a user, such as the label of a policy, in the formats of results.

All outlets go through `visible`: the console, tables of CSV, Markdown and the page of a report.
What a terminal would obey, and what turns the order of letters around, is shown as �.
"""

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
_COMMANDS = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f"  # controls, C0 and C1, but for tab and newline
    "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"  # direction of writing
    "\ud800-\udfff]"  # halves of characters, which no stream takes
)
_LINK = re.compile(
    r"(?i)\](?=[(\[:])|(?<=http):(?=//)|(?<=https):(?=//)|(?<=ftp):(?=//)|(?<=www)\."
)
"""Signs of Markdown without which a text is no link and no image."""
_BACKSLASH = re.compile(r"\\(?=[!-/:-@[-`{-~])")
"""A backslash that Markdown would take away, with what is behind it."""
_IN_SCRIPT = {ord(sign): f"\\u{ord(sign):04x}" for sign in "<>&\u2028\u2029"}


def visible(text: str) -> str:
    """Text without what a terminal obeys or what turns letters around; tabs and newlines stay."""
    return _COMMANDS.sub("�", text)


def csv_cell(value: Any) -> Any:
    """A cell of a CSV file; text that looks like a formula gets an apostrophe in front."""
    if not isinstance(value, str):
        return value
    text = visible(value)
    is_formula = text.startswith(_FORMULA) and not _NUMBERS.fullmatch(text)
    return f"'{text}" if is_formula else text


def write_csv(head: Sequence[str], rows: Iterable[Iterable[Any]], path: Path) -> Path:
    """Write a CSV file."""
    text = io.StringIO(newline="")
    csv.writer(text).writerows(map(csv_cell, row) for row in [head, *rows])
    write_whole(path, text.getvalue())
    return path


def write_records(records: Sequence[Mapping[str, Any]], path: Path) -> Path:
    """Write a CSV file of rows by column; what a row does not have is empty."""
    head = list(dict.fromkeys(name for record in records for name in record))
    rows = [[record.get(name, "") for name in head] for record in records]
    return write_csv(head, rows, path)


def markdown_text(text: str) -> str:
    """Plain text in Markdown, in one line, also within a table; no-break spaces stay.

    Neither tags nor links nor images are made of it.
    """
    line = _SPACE.sub(" ", visible(text)).strip()
    line = _BACKSLASH.sub(r"\\\\", line)
    return html.escape(_LINK.sub(_escape, line), quote=False).replace("|", "\\|")


def _escape(found: re.Match[str]) -> str:
    """A sign of Markdown as text."""
    sign = found[0]
    return f"{sign}\\" if sign == "]" else f"\\{sign}"


def script_json(value: Any) -> str:
    """JSON within a script element: nothing in it ends the element or begins a comment."""
    plain = {"ensure_ascii": False, "separators": (",", ":"), "allow_nan": False}
    return json.dumps(_visible_data(value), **plain).translate(_IN_SCRIPT)


def _visible_data(value: Any) -> Any:
    """Plain data whose texts are visible."""
    if isinstance(value, str):
        return visible(value)
    if isinstance(value, dict):
        return {key: _visible_data(part) for key, part in value.items()}
    is_list = isinstance(value, list | tuple)
    return [_visible_data(part) for part in value] if is_list else value


def template_value(value: Any) -> Any:
    """A value for a page: plain text is made visible; HTML of a template is a type of its own."""
    return visible(value) if type(value) is str else value


def line_value(value: Any) -> Any:
    """A value for sentences, of which a blank line ends one: text is visible and in one line."""
    return visible(value).replace("\n", " ") if isinstance(value, str) else value


def chart_text(text: str) -> str:
    """Plain text in a chart, whose texts are HTML."""
    return html.escape(visible(text), quote=False)
