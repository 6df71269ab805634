"""The page of the documentation with the leaderboard, which is written from a leaderboard.csv alone.

    python -m train.report.leaderboard_page docs/results/leaderboard.csv docs/leaderboard.md

writes the tables between the two marks of the page anew.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

from elastic_env.core.errors import ConfigurationError
from train.evaluate.leaderboard import Standing
from train.report.leaderboard import leaderboard_markdown, read_leaderboard

BEGIN, END = "<!-- leaderboard: begin -->", "<!-- leaderboard: end -->"
"""Marks of a page, between which the tables are written."""


def page_with(text: str, found: Sequence[Standing]) -> str:
    """A page with the tables between its marks written anew.

    Raises:
        ConfigurationError: It does not have both marks, each once and in order.
    """
    if text.count(BEGIN) != 1 or text.count(END) != 1 or text.index(BEGIN) > text.index(END):
        raise ConfigurationError(f"a page for the leaderboard needs the lines {BEGIN!r} and {END!r}, each once")
    before, _, rest = text.partition(BEGIN)
    return f"{before}{BEGIN}\n\n{leaderboard_markdown(found)}\n{END}{rest.partition(END)[2]}"


def main(arguments: Sequence[str]) -> None:
    """Write the tables of a page from a leaderboard.csv: CSV, PAGE."""
    if len(arguments) != 2:
        raise SystemExit("usage: python -m train.report.leaderboard_page LEADERBOARD.csv PAGE.md")
    table, page = map(Path, arguments)
    page.write_text(page_with(page.read_text(encoding="utf-8"), read_leaderboard(table)), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
