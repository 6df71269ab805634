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
from train.report.render import Head, Row, Table, number_interval, print_table, write_table

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
            for at, ratio in zip(curves.decisions, curves.ratios[column.metric].T, strict=True):
                known = ratio[np.isfinite(ratio)]
                values = (
                    (np.median(known), known.min(), known.max()) if len(known) else (np.nan,) * 3
                )
                rows.append(
                    [title, column.title, f"{at:.0f}", *(f"{value:.2f}" for value in values)]
                )
    return Table.plain(
        ["residual", "metric", "decisions", "median", "best", "worst"], rows, words=2
    )


def robots_table(found: Sequence[RobotScores]) -> Table:
    """All scores over drawn robots, a row per cell and metric."""
    heads = [Head(name, is_number=False) for name in ("reference", "scenario", "policy", "metric")]
    heads += [
        Head(name) for name in ("mean", "interquartile mean", "worst tenth", found[0].failure)
    ]
    heads += [Head("better than", is_number=False)]
    rows = []
    for row in found:
        figures = [
            number_interval(estimate, row.column) for estimate in (row.mean, row.middle, row.worst)
        ]
        better = "; ".join(
            f"{title}: {percent_interval(e, signed=False)}" for title, e in row.better.items()
        )
        names = [row.reference, row.scenario, row.policy, row.column.label]
        rows.append(Row((*names, *figures, f"{row.failed}/{row.episodes}", better or "-")))
    return Table(tuple(heads), tuple(rows), keys=4)


def print_robots(found: Sequence[RobotScores], console: Console) -> None:
    """Print a line per policy with all metrics, under the motion and the scenario, where there
    is anything to print.
    """
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
    title = (
        "over the drawn robots that did not fail: mean / interquartile mean / mean of the worst"
        " tenth"
    )
    print_table(
        Table((*heads, Head(found[0].failure)), tuple(rows), title=title), console, "robots.csv"
    )


def _three(row: RobotScores) -> str:
    """Mean, interquartile mean and worst tenth in the unit in which they are shown."""
    values = (row.column.scale * estimate.value for estimate in (row.mean, row.middle, row.worst))
    return " / ".join(
        "-" if np.isnan(value) else f"{value:.{row.column.decimals}f}" for value in values
    )


def write_robots(rows: Sequence[RobotScores], path: Path) -> Path:
    """One row per cell, metric and other policy; metrics in SI units, shares as shares of one."""
    return write_table(_HEAD, (record for row in rows for record in _records(row)), path)


def _records(row: RobotScores) -> Iterator[list[object]]:
    own = [
        row.policy,
        row.reference,
        row.scenario,
        row.column.metric,
        *row.mean.cells,
        *row.middle.cells,
    ]
    own += [*row.worst.cells, row.failed, row.episodes]
    for other, better in row.better.items() or [("", None)]:
        yield [*own, other, *(("",) * 3 if better is None else better.cells)]


_HEAD = (
    "policy",
    "reference",
    "scenario",
    "metric",
    "mean",
    "mean_low",
    "mean_high",
    "interquartile_mean",
    "interquartile_mean_low",
    "interquartile_mean_high",
    "worst_tenth",
    "worst_tenth_low",
    "worst_tenth_high",
    "failed",
    "episodes",
    "against",
    "better_share",
    "better_share_low",
    "better_share_high",
)
