"""Summary of a comparison: medians over the episodes of every cell, with 95 % intervals.

Medians exclude episodes that failed; failures have a column of their own.
"""

from collections.abc import Sequence
from itertools import chain, groupby
from pathlib import Path

import numpy as np
from rich.console import Console

from elastic_env.core.files import write_whole
from train.evaluate.environments import Column
from train.evaluate.episodes import Evaluation
from train.evaluate.scores import median_of
from train.evaluate.statistics import Estimate
from train.report.markdown import bullets, to_markdown
from train.report.report_text import capital
from train.report.tables import Head, Row, Table, column_notes, number_interval
from train.report.terminal import has_room, print_table
from train.runs.escaping import write_records


def print_summary(evaluations: Sequence[Evaluation], console: Console) -> None:
    """Print the summary, with intervals and all columns if the terminal has room for them."""
    environment = evaluations[0].condition.environment
    columns = [column for column in environment.columns if column.on_console]
    table = summary_table(evaluations, columns)
    if not has_room(table, console):
        table = summary_table(evaluations, columns, intervals=False)
    print_table(table, console, "summary.md")
    for note in [*failure_notes(evaluations), *bound_notes(evaluations)]:
        console.print(note, markup=False)


def summary_table(
    evaluations: Sequence[Evaluation],
    columns: Sequence[Column],
    worst: bool = False,
    intervals: bool = True,
) -> Table:
    """Return the median over the episodes of every cell that did not fail, and failures.

    Args:
        evaluations: Cells of one environment.
        columns: Metrics to show.
        worst: Add the figure that is farthest from zero in brackets, if there are several.
        intervals: Add the 95 % interval of the median, if there are several episodes.
    """
    environment = evaluations[0].condition.environment
    swept = list(dict.fromkeys(name for e in evaluations for name in e.condition.swept))
    judged = {column.metric for column in environment.judged}
    heads = [Head(key, is_number=False) for key in ("reference", "scenario", "policy")]
    heads += [Head(name) for name in swept]
    for column in columns:
        leaves = 2 if column.metric in judged else 1
        heads.append(Head(column.title, column.unit, column.note, leaves=leaves))
    heads += [Head(environment.failure)]
    rows = []
    for e in evaluations:
        condition = e.condition
        names = [condition.reference_name, condition.scenario, condition.policy.title]
        figures = [_figure(e, column, worst, intervals) for column in columns]
        failed = f"{e.num_failed}/{len(e.episodes)}"
        rows.append(Row((*names, *condition.swept_values(swept), *figures, failed)))
    title = f"{environment.subject}, median over episodes"
    title += _interval_label(evaluations) if intervals else ""
    return Table(tuple(heads), tuple(rows), keys=3, title=title, caption=environment.note)


def _interval_label(evaluations: Sequence[Evaluation]) -> str:
    return " [95 % interval]" if any(len(e.episodes) > 1 for e in evaluations) else ""


def _figure(evaluation: Evaluation, column: Column, worst: bool, interval: bool) -> str:
    """Return the median of a metric with its interval, and the figure farthest from zero."""
    median = median_of(evaluation, column.metric)
    text = number_interval(median if interval else Estimate(median.value), column)
    values = column.scale * evaluation.values(column.metric)
    if not worst or len(values) < 2:
        return text
    return f"{text} ({values[np.argmax(np.abs(values))]:.{column.decimals}f})"


def failure_notes(evaluations: Sequence[Evaluation]) -> list[str]:
    """Return how and when (median [s]) the episodes ended, for cells in which all failed."""
    cells = {(e.condition.reference_name, e.condition.scenario) for e in evaluations}
    notes = []
    for e in evaluations:
        number = len(e.episodes)
        if e.num_failed < number or not number:
            continue
        reasons = "/".join(dict.fromkeys(row["termination"] for row in e.episodes))
        times = e.values("duration_s", failed=True)
        when = f" after {np.median(times):.1f} s" if len(times) else ""
        condition = e.condition
        swept = [f"{name}={value:g}" for name, value in condition.swept.items()]
        cell = [] if len(cells) == 1 else [condition.reference_name, condition.scenario]
        label = ", ".join([*cell, " ".join([condition.policy.title, *swept])])
        notes.append(f"{label}: {reasons}{when} ({number} of {number})")
    return notes


def bound_notes(evaluations: Sequence[Evaluation]) -> list[str]:
    """Return a sentence if actions were cut at their bounds, which scores do not show."""
    shares = [e.values("clipped_share").max(initial=0.0) for e in evaluations]
    cut = sum(share > 0.0 for share in shares)
    if not cut:
        return []
    worst = evaluations[int(np.argmax(shares))].condition
    where = f"{worst.policy.title} in {worst.scenario}, {worst.reference_name}"
    share = f"{100.0 * max(shares):.3g} % of the control steps of {where}"
    return [f"Actions were cut at their bounds in {cut} of {len(shares)} cells: in up to {share}."]


def write_episodes(evaluations: Sequence[Evaluation], path: Path) -> Path:
    """Write a CSV row per episode; column names have units."""
    return write_records(list(chain(*(e.episodes for e in evaluations))), path)


def write_summary(evaluations: Sequence[Evaluation], path: Path) -> Path:
    """Write the summary table and its splits as Markdown, by environment."""
    groups = groupby(evaluations, key=lambda evaluation: evaluation.condition.env)
    parts = [part for _, group in groups for part in _parts(list(group))]
    write_whole(path, "\n\n".join(parts) + "\n")
    return path


def _parts(evaluations: Sequence[Evaluation]) -> list[str]:
    """Return the parts of a summary of one environment."""
    environment = evaluations[0].condition.environment
    interval = _interval_label(evaluations)
    worst = f"{interval} (the worst of them)" if interval else ""
    statistic = f"Median over the episodes that did not fail{worst}"
    parts = [
        f"{capital(environment.subject)}. {statistic}; failures are counted separately.",
        " ".join(filter(None, [*column_notes(environment.columns), environment.note])),
        to_markdown(summary_table(evaluations, environment.columns, worst=True)),
    ]
    splits = environment.splits_of(e.condition.arguments for e in evaluations)
    for title, columns in splits.items():
        table = summary_table(evaluations, columns, worst=True)
        parts += [f"{title}:", to_markdown(table)]
    if notes := failure_notes(evaluations):
        parts += ["Where all episodes failed:", bullets(notes)]
    return [*parts, *bound_notes(evaluations)]
