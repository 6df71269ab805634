"""Scores as tables: of cells, over drawn robots, and on the way of a training."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from train.evaluate.changes import percent_interval
from train.evaluate.environments import Column
from train.evaluate.episodes import group_by
from train.evaluate.progress import Curves
from train.evaluate.robots import RobotScores
from train.evaluate.table import EpisodeTable, score
from train.figures.chart import spread
from train.report.table_formats import Head, Row, Table, number_interval, print_table
from train.runs.escaping import write_records

SCORES = (
    "Mean over the episodes that reached the end; of residuals the interquartile mean over training"
    " seeds, with its 95 % interval."
)
"""Meaning of the tables of scores."""
ROBOTS = (
    "Over the robots of each cell that did not fail: mean, interquartile mean, and mean of the"
    " worst tenth. Better than: share of the robots for which the policy is better, ties as one"
    " half; to fail is worse than any value. Of residuals interquartile means over training seeds"
    " with 95 % intervals."
)
"""Meaning of the tables of drawn robots."""


def scores_table(table: EpisodeTable, columns: Sequence[Column]) -> Table:
    """Mean of every policy in every cell, with intervals."""
    rows = []
    for reference in table.references:
        for scenario in table.scenarios:
            for policy in table.policies:
                for cell in table.cells_of(policy, reference, scenario):
                    own = table.of(policy, cell)
                    swept = table.conditions[policy, cell].swept
                    values = [f"{swept[name]:g}" if name in swept else "-" for name in table.swept]
                    figures = [number_interval(score(own, column), column) for column in columns]
                    rows.append([reference, scenario, policy, *values, *figures])
    head = ["reference", "scenario", "policy", *table.swept, *(column.label for column in columns)]
    return Table.plain(head, rows, words=3 + len(table.swept))


def learning_table(learning: Mapping[str, Curves], columns: Sequence[Column]) -> Table:
    """Share of the base's score on the way of a training, over training seeds."""
    rows = []
    for title, curves in learning.items():
        for column in columns:
            best, median, worst = spread(curves.ratios[column.metric])
            for at, *values in zip(curves.decisions, median, best, worst, strict=True):
                figures = (f"{value:.2f}" for value in values)
                rows.append([title, column.title, f"{at:.0f}", *figures])
    head = ["residual", "metric", "decisions", "median", "best", "worst"]
    return Table.plain(head, rows, words=2)


def robots_table(found: Sequence[RobotScores]) -> Table:
    """All scores over drawn robots, a row per cell and metric."""
    figures = ("mean", "interquartile mean", "worst tenth", found[0].failure)
    head = ["reference", "scenario", "policy", "metric", *figures]
    rows = []
    for row in found:
        names = (row.reference, row.scenario, row.policy, row.column.label)
        scores = [number_interval(own, row.column) for own in (row.mean, row.middle, row.worst)]
        shares = {title: percent_interval(own, signed=False) for title, own in row.better.items()}
        better = "; ".join(f"{title}: {share}" for title, share in shares.items())
        rows.append(Row((*names, *scores, f"{row.failed}/{row.episodes}", better or "-")))
    heads = Table.plain(head, [], words=4).heads
    return Table((*heads, Head("better than", is_number=False)), tuple(rows), keys=4)


def print_robots(found: Sequence[RobotScores], console: Console) -> None:
    """Print a line per policy with all metrics, under the motion and the scenario."""
    if not found:
        return
    columns = list(dict.fromkeys(row.column for row in found))
    heads = [Head("policy", is_number=False), *(Head(c.title, c.unit, leaves=1) for c in columns)]
    rows = []
    for names, cell in group_by(found, lambda row: (row.reference, row.scenario)).items():
        rows.append(Row((", ".join(names),), kind="heading"))
        for policy, own in group_by(cell, lambda row: row.policy).items():
            figures = {row.column: _three(row) for row in own}
            failed = f"{own[0].failed}/{own[0].episodes}"
            rows.append(Row((policy, *(figures[column] for column in columns), failed)))
    figures = "mean / interquartile mean / mean of the worst tenth"
    title = f"over the drawn robots that did not fail: {figures}"
    heads.append(Head(found[0].failure))
    print_table(Table(tuple(heads), tuple(rows), title=title), console, "robots.csv")


def _three(row: RobotScores) -> str:
    """Mean, interquartile mean and worst tenth in the unit in which they are shown."""
    values = (row.column.scale * estimate.value for estimate in (row.mean, row.middle, row.worst))
    return " / ".join(
        "-" if np.isnan(value) else f"{value:.{row.column.decimals}f}" for value in values
    )


def write_robots(rows: Sequence[RobotScores], path: Path) -> Path:
    """One row per cell, metric and other policy; metrics in SI units, shares as shares of one."""
    return write_records([record for row in rows for record in _records(row)], path)


_SHARE = ("better_share", "better_share_low", "better_share_high")


def _records(row: RobotScores) -> Iterator[dict[str, object]]:
    for other, better in row.better.items() or [("", None)]:
        share: dict[str, object] = dict.fromkeys(_SHARE, "")
        if better is not None:
            share = better.record("better_share")
        yield {
            "policy": row.policy,
            "reference": row.reference,
            "scenario": row.scenario,
            "metric": row.column.metric,
            **row.mean.record("mean"),
            **row.middle.record("interquartile_mean"),
            **row.worst.record("worst_tenth"),
            "failed": row.failed,
            "episodes": row.episodes,
            "against": other,
            **share,
        }
