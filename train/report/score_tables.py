"""Tables of scores: of cells, over drawn robots, and during trainings."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path

from rich.console import Console

from train.evaluate.change_text import percent_interval
from train.evaluate.changes import count_episodes_apart
from train.evaluate.environments import Column
from train.evaluate.episodes import group_by
from train.evaluate.learning_curves import Curves
from train.evaluate.robots import RobotScores
from train.evaluate.scores import episodes_as_robots, score
from train.evaluate.statistics import Estimate
from train.evaluate.table import EpisodeTable
from train.figures.chart import quantiles
from train.report.tables import Head, Row, Table, number_interval
from train.report.terminal import print_table
from train.runs.escaping import write_records


def scores_table(table: EpisodeTable, columns: Sequence[Column]) -> Table:
    """Return the mean of every policy in every cell, with intervals."""
    rows = []
    places = product(table.references, table.scenarios, table.policies)
    for reference, scenario, policy in places:
        for cell in table.cells_of(policy, reference, scenario):
            condition = table.conditions[policy, cell]
            episodes = table.rows_of(policy, cell)
            if condition.member is None:
                episodes = episodes_as_robots(episodes)
            units = ([len(set(episodes["robot"]))], [condition.draws_robots])
            scores = [score(episodes, column) for column in columns]
            scores = [count_episodes_apart(estimate, *units) for estimate in scores]
            figures = map(number_interval, scores, columns)
            over = next((estimate.over for estimate in scores if estimate.over), "-")
            values = condition.swept_values(table.swept)
            rows.append([reference, scenario, policy, *values, *figures, over])
    labels = [column.label for column in columns]
    head = ["reference", "scenario", "policy", *table.swept, *labels, "95 % over"]
    return Table.plain(head, rows, words=3 + len(table.swept))


def learning_table(learning: Mapping[str, Curves], columns: Sequence[Column]) -> Table:
    """Return the score as a share of the base's during trainings, over training seeds."""
    rows = []
    for title, curves in learning.items():
        for column in columns:
            best, median, worst = quantiles(curves.ratios[column.metric])
            for at, *values in zip(curves.decisions, median, best, worst, strict=True):
                figures = (f"{value:.2f}" for value in values)
                rows.append([title, column.title, f"{at:.0f}", *figures])
    head = ["residual", "metric", "decisions", "median", "best", "worst"]
    return Table.plain(head, rows, words=2)


def robots_table(cells: Sequence[RobotScores]) -> Table:
    """Return all scores over drawn robots: a row per cell and metric."""
    figures = ("mean", "interquartile mean", "worst tenth", cells[0].failure)
    head = ["reference", "scenario", "policy", "metric", *figures, "95 % over"]
    rows = []
    for row in cells:
        names = (row.reference, row.scope, row.policy, row.column.label)
        scores = [number_interval(estimate, row.column) for estimate in row.scores]
        shares = row.better.items()
        better = [f"{k}: {percent_interval(v, signed=False)}" for k, v in shares]
        others = "; ".join(better) or "-"
        failed = f"{row.failed}/{row.episodes}"
        rows.append(Row((*names, *scores, failed, row.mean.over or "-", others)))
    heads = Table.plain(head, [], words=4).heads
    return Table((*heads, Head("better than", is_number=False)), tuple(rows), keys=4)


def print_robots(cells: Sequence[RobotScores], console: Console) -> None:
    """Print a line per policy with all metrics, under the motion and the scenario."""
    if not cells:
        return
    columns = list(dict.fromkeys(row.column for row in cells))
    heads = [
        Head(column.title, column.unit, second=figure, leaves=turn)
        for column in columns
        for figure, turn in (("mean", 3), ("middle half", 1), ("worst tenth", 2))
    ]
    heads = [Head("policy", is_number=False), *heads, Head(cells[0].failure)]
    rows = []
    for names, group in group_by(cells, lambda row: (row.reference, row.scope)).items():
        rows.append(Row((", ".join(names),), kind="heading"))
        for policy, metrics in group_by(group, lambda row: row.policy).items():
            figures = {row.column: row.scores for row in metrics}
            failed = f"{metrics[0].failed}/{metrics[0].episodes}"
            texts = (number_interval(score, c) for c in columns for score in figures[c])
            rows.append(Row((policy, *texts, failed)))
    number = max(row.mean.robots for row in cells)
    title = f"means over up to {number} drawn robots, those that did not fail [95 % interval]"
    print_table(Table(tuple(heads), tuple(rows), title=title), console, "robots.csv")


def write_robots(rows: Sequence[RobotScores], path: Path) -> Path:
    """Write a CSV row per cell, metric and other policy: metrics in SI units."""
    return write_records([record for row in rows for record in _records(row)], path)


def _records(row: RobotScores) -> Iterator[dict[str, object]]:
    for other, better in row.better.items() or [("", Estimate(0.0))]:
        share = better.record("better_share")
        if not other:
            share = dict.fromkeys(share, "")
        yield {
            "policy": row.policy,
            "reference": row.reference,
            "scenario": row.scope,
            "metric": row.column.metric,
            **row.mean.record("mean"),
            **row.middle.record("interquartile_mean"),
            **row.worst.record("worst_tenth"),
            "interval_over": row.mean.over,
            "failed": row.failed,
            "episodes": row.episodes,
            "against": other,
            **share,
        }
