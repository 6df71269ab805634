"""Scores over drawn robots as a table for the terminal, for the report, and as CSV."""

import csv
from collections.abc import Sequence
from pathlib import Path

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from train.evaluate.changes import percent_interval
from train.evaluate.robots import RobotScores
from train.evaluate.statistics import Estimate
from train.report.parts import number_interval
from train.runs.escaping import csv_row

ROBOTS = (
    "Over the robots of each cell that did not fail: mean, interquartile mean, and mean of the worst tenth. Better "
    "than: share of the robots for which the policy is better, ties as one half; to fail is worse than any value. Of "
    "residuals interquartile means over training seeds with 95 % intervals."
)
"""What the tables of drawn robots hold."""
WORDS = 4
"""Columns of the table that hold words."""


def robots_table(found: Sequence[RobotScores]) -> tuple[list[str], list[list[str]]]:
    """Head and rows, a row per cell and metric."""
    failure = found[0].failure
    head = ["reference", "scenario", "policy", "metric", "mean", "interquartile mean", "worst tenth", failure,
            "better than"]  # fmt: skip
    rows = []
    for row in found:
        shown = (number_interval(e.scaled(row.column.scale), row.column) for e in (row.mean, row.middle, row.worst))
        better = "; ".join(f"{title}: {percent_interval(e, signed=False)}" for title, e in row.better.items())
        counts = f"{row.failed}/{row.episodes}"
        rows.append([row.reference, row.scenario, row.policy, row.column.label, *shown, counts, better or "-"])
    return head, rows


def print_robots(found: Sequence[RobotScores], console: Console) -> None:
    """Print the table, where there is anything in it."""
    if not found:
        return
    head, rows = robots_table(found)
    table = Table(title="over drawn robots that did not fail", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for number, name in enumerate(head):
        is_figure = WORDS <= number < len(head) - 1
        table.add_column(name, justify="right" if is_figure else "left", vertical="bottom", overflow="fold")
    for row in rows:
        table.add_row(*map(escape, row))
    console.print(table)


def write_robots(rows: Sequence[RobotScores], path: Path) -> Path:
    """One row per cell, metric and other policy; metrics in SI units, shares as shares of one."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(_HEAD)
        for row in rows:
            own = [row.policy, row.reference, row.scenario, row.column.metric, *_cells(row.mean), *_cells(row.middle)]
            own += [*_cells(row.worst), row.failed, row.episodes]
            for other, better in row.better.items() or [("", None)]:
                writer.writerow(csv_row([*own, other, *(("",) * 3 if better is None else _cells(better))]))
    return path


_HEAD = (
    "policy", "reference", "scenario", "metric", "mean", "mean_low", "mean_high", "interquartile_mean",
    "interquartile_mean_low", "interquartile_mean_high", "worst_tenth", "worst_tenth_low", "worst_tenth_high",
    "failed", "episodes", "against", "better_share", "better_share_low", "better_share_high",
)  # fmt: skip


def _cells(estimate: Estimate) -> tuple[object, object, object]:
    low, high = ("" if bound is None else bound for bound in (estimate.low, estimate.high))
    return estimate.value, low, high
