"""Text of a user, such as the label of a policy, in the formats of results.

The console, CSV tables, Markdown and the page of a report all pass texts through `visible`. It
shows terminal commands, and characters that change the direction of writing, as �.
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
"""Numbers separated by spaces. They are no formula, even if they begin with a sign."""
_WHITESPACE = re.compile(r"[^\S\N{NO-BREAK SPACE}]+")
_CONTROLS = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f"  # controls, C0 and C1, except tab and newline
    "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"  # direction of writing
    "\ud800-\udfff]"  # single surrogates, which cannot be encoded
)
_LINK = re.compile(
    r"(?i)\](?=[(\[:])|(?<=http):(?=//)|(?<=https):(?=//)|(?<=ftp):(?=//)|(?<=www)\."
)
"""Signs of Markdown; when they are escaped, a text is neither link nor image."""
_BACKSLASH = re.compile(r"\\(?=[!-/:-@[-`{-~])")
"""A backslash that Markdown would remove, because a sign follows it."""
_SCRIPT_ESCAPES = {ord(sign): f"\\u{ord(sign):04x}" for sign in "<>&\u2028\u2029"}


def visible(text: str) -> str:
    """Return a text without terminal commands and changes of direction; tabs and newlines stay."""
    return _CONTROLS.sub("�", text)


def csv_cell(value: Any) -> Any:
    """Return a cell of a CSV file; text that looks like a formula gets an apostrophe in front."""
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
    """Write a CSV file of rows by column name; columns that a row lacks are empty."""
    head = list(dict.fromkeys(name for record in records for name in record))
    return write_csv(head, [[r.get(name, "") for name in head] for r in records], path)


def markdown_text(text: str) -> str:
    """Return plain text as one line of Markdown, also within a table; no-break spaces stay.

    The text becomes neither tags nor links nor images.
    """
    line = _WHITESPACE.sub(" ", visible(text)).strip()
    line = _BACKSLASH.sub(r"\\\\", line)
    return html.escape(_LINK.sub(_escape, line), quote=False).replace("|", "\\|")


def _escape(match: re.Match[str]) -> str:
    """Return a sign of Markdown as text."""
    sign = match[0]
    return f"{sign}\\" if sign == "]" else f"\\{sign}"


def script_json(value: Any) -> str:
    """Return JSON for a script element; nothing in it ends the element or begins a comment."""
    options = {"ensure_ascii": False, "separators": (",", ":"), "allow_nan": False}
    return json.dumps(_visible_data(value), **options).translate(_SCRIPT_ESCAPES)


def _visible_data(value: Any) -> Any:
    """Return plain data with visible texts."""
    if isinstance(value, str):
        return visible(value)
    if isinstance(value, dict):
        return {key: _visible_data(part) for key, part in value.items()}
    is_list = isinstance(value, list | tuple)
    return [_visible_data(part) for part in value] if is_list else value


def template_value(value: Any) -> Any:
    """Return a value for a page: plain text becomes visible; HTML has a type of its own."""
    return visible(value) if type(value) is str else value


def line_value(value: Any) -> Any:
    """Return a value for sentences, which blank lines separate: text becomes one visible line."""
    return visible(value).replace("\n", " ") if isinstance(value, str) else value


def chart_text(text: str) -> str:
    """Return plain text for a chart, whose texts are HTML."""
    return html.escape(visible(text), quote=False)
