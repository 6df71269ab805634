"""Scores over drawn robots as a table for the terminal, for the report, and as CSV."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from train.evaluate.changes import percent_interval
from train.evaluate.environments import Column
from train.evaluate.robots import RobotScores
from train.evaluate.table import EpisodeTable, score
from train.report.parts import number_interval
from train.runs.escaping import write_csv

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
    """Print a line per policy with all metrics, under the motion and the scenario, where there is anything to print."""
    if not found:
        return
    columns = list(dict.fromkeys(row.column for row in found))
    title = "over the drawn robots that did not fail: mean / interquartile mean / mean of the worst tenth"
    table = Table(title=title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("policy", vertical="bottom", overflow="fold")
    for column in columns:
        table.add_column(f"{column.title}\n{column.unit}", justify="right", no_wrap=True, vertical="bottom")
    table.add_column(found[0].failure, justify="right", no_wrap=True, vertical="bottom")
    cells: dict[tuple[str, str], dict[str, dict[Column, RobotScores]]] = {}
    for row in found:
        policies = cells.setdefault((row.reference, row.scenario), {})
        policies.setdefault(row.policy, {})[row.column] = row
    for names, policies in cells.items():
        table.add_row(escape(", ".join(names)), *[""] * (len(columns) + 1), style="bold")
        for policy, rows in policies.items():
            of_any = next(iter(rows.values()))
            figures = (_three(rows[column]) for column in columns)
            table.add_row(escape(policy), *figures, f"{of_any.failed}/{of_any.episodes}")
        table.add_section()
    console.print(table)


def _three(row: RobotScores) -> str:
    """Mean, interquartile mean and worst tenth in the unit in which they are shown."""
    values = (row.column.scale * estimate.value for estimate in (row.mean, row.middle, row.worst))
    return " / ".join("-" if np.isnan(value) else f"{value:.{row.column.decimals}f}" for value in values)


def write_robots(rows: Sequence[RobotScores], path: Path) -> Path:
    """One row per cell, metric and other policy; metrics in SI units, shares as shares of one."""
    return write_csv(_HEAD, (record for row in rows for record in _records(row)), path)


def _records(row: RobotScores) -> Iterator[list[object]]:
    own = [row.policy, row.reference, row.scenario, row.column.metric, *row.mean.cells, *row.middle.cells]
    own += [*row.worst.cells, row.failed, row.episodes]
    for other, better in row.better.items() or [("", None)]:
        yield [*own, other, *(("",) * 3 if better is None else better.cells)]


_HEAD = (
    "policy", "reference", "scenario", "metric", "mean", "mean_low", "mean_high", "interquartile_mean",
    "interquartile_mean_low", "interquartile_mean_high", "worst_tenth", "worst_tenth_low", "worst_tenth_high",
    "failed", "episodes", "against", "better_share", "better_share_low", "better_share_high",
)  # fmt: skip


def scores_table(table: EpisodeTable, columns: Sequence[Column]) -> tuple[list[str], list[list[str]]]:
    """Head and rows of a table of scores."""
    head = ["reference", "scenario", "policy", *table.swept, *(column.label for column in columns)]
    rows = []
    for reference in table.references:
        for scenario in table.scenarios:
            for policy in table.policies:
                for cell in table.cells_of(policy, reference, scenario):
                    own = table.of(policy, cell)
                    swept = table.conditions[policy, cell].swept
                    values = [f"{swept[name]:g}" if name in swept else "-" for name in table.swept]
                    figures = [number_interval(score(own, c).scaled(c.scale), c) for c in columns]
                    rows.append([reference, scenario, policy, *values, *figures])
    return head, rows
