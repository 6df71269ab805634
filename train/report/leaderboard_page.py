"""Pages of the documentation with tables of the leaderboard, which are written from a leaderboard.csv alone.

    python -m train.report.leaderboard_page docs/results/leaderboard.csv docs/leaderboard.md docs/learned.md README.md

writes the tables between the marks of the pages anew: the whole leaderboard, or what learning adds.
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from elastic_env.core.errors import ConfigurationError
from train.evaluate.leaderboard import Standing
from train.report.leaderboard import claims_markdown, leaderboard_markdown, read_leaderboard

PARTS: Mapping[str, Callable[[Sequence[Standing]], str]] = {
    "leaderboard": leaderboard_markdown,
    "what learning adds": claims_markdown,
}
"""Tables by the name of their marks."""


def marks(part: str) -> tuple[str, str]:
    """Lines of a page, between which the tables of a part are written."""
    return f"<!-- {part}: begin -->", f"<!-- {part}: end -->"


def page_with(text: str, found: Sequence[Standing]) -> str:
    """A page with the tables between its marks written anew.

    Raises:
        ConfigurationError: It has no marks of any part, or not both of a part, each once and in order.
    """
    parts = [part for part in PARTS if any(mark in text for mark in marks(part))]
    for part in parts or PARTS:
        begin, end = marks(part)
        if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
            raise ConfigurationError(f"a page for the {part} needs the lines {begin!r} and {end!r}, each once")
        before, _, rest = text.partition(begin)
        text = f"{before}{begin}\n\n{PARTS[part](found)}\n{end}{rest.partition(end)[2]}"
    return text


def main(arguments: Sequence[str]) -> None:
    """Write the tables of pages from a leaderboard.csv: CSV, PAGE, ..."""
    if len(arguments) < 2:
        raise SystemExit("usage: python -m train.report.leaderboard_page LEADERBOARD.csv PAGE.md ...")
    table, *pages = map(Path, arguments)
    for page in pages:
        page.write_text(page_with(page.read_text(encoding="utf-8"), read_leaderboard(table)), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
