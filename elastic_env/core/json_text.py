"""Reader of JSON from any source: of bounded size, with finite numbers and plain text."""

import json
import math
from typing import Any

from elastic_env.core.yaml_text import DEEPEST_NESTING, LONGEST_NUMBER, NO_TEXT

LARGEST_JSON = 1_000_000
"""Characters of a text in JSON."""


def parse_json(text: str, most: int = LARGEST_JSON) -> Any:
    """Parse a text in JSON.

    Args:
        text: The text.
        most: Largest number of characters.

    Raises:
        ValueError: It is not JSON, is longer or deeper than allowed, or holds a key twice, a
            number that is not finite or too long, or text with zero bytes.
    """
    if len(text) > most:
        raise ValueError(f"it must have at most {most} characters, got {len(text)}")
    numbers = {"parse_int": _to_int, "parse_float": _to_float, "parse_constant": _to_float}
    try:
        content = json.loads(text, object_pairs_hook=_to_mapping, **numbers)
    except RecursionError:
        raise _TOO_DEEP from None
    _require_plain(content, 0)
    return content


_TOO_DEEP = ValueError(f"mappings and lists must be nested at most {DEEPEST_NESTING} deep")


def _to_int(text: str) -> int:
    if len(text) > LONGEST_NUMBER:
        needed = f"at most {LONGEST_NUMBER} characters"
        raise ValueError(f"a number must have {needed}, got {len(text)}")
    return int(text)


def _to_float(text: str) -> float:
    if not math.isfinite(value := float(text)):
        raise ValueError(f"numbers must be finite, got {text[:LONGEST_NUMBER]}")
    return value


def _to_mapping(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    keys = [key for key, _ in pairs]
    if len(set(keys)) < len(keys):
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"the key {twice[:100]!r} stands twice in one mapping")
    return dict(pairs)


def _require_plain(value: Any, depth: int) -> None:
    """Refuse values that are nested too deeply, and text that no file can hold."""
    if depth > DEEPEST_NESTING:
        raise _TOO_DEEP
    if isinstance(value, str) and NO_TEXT.search(value):
        raise ValueError("text must hold neither zero bytes nor halves of characters")
    if isinstance(value, dict | list):
        for part in [*value, *value.values()] if isinstance(value, dict) else value:
            _require_plain(part, depth + 1)
