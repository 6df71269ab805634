"""Paired changes of a leaderboard, for the pages."""

from collections.abc import Sequence

from train.evaluate.standings import Standing
from train.report.leaderboard import claims_table, paired_text
from train.report.table_formats import to_markdown


def claims_markdown(found: Sequence[Standing]) -> str:
    """The paired changes of residuals, as a table."""
    return f"{paired_text()}\n\n{to_markdown(claims_table(found))}\n"
