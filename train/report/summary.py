"""The summary of a comparison: medians over the episodes of every cell, with 95 % intervals.

Scores of an episode that failed are never averaged in; failures are counted beside.
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
from train.report.page import bullets
from train.report.report_text import capital
from train.report.table_formats import (
    Head,
    Row,
    Table,
    column_notes,
    has_room,
    number_interval,
    print_table,
    to_markdown,
)
from train.runs.escaping import write_records


def print_summary(evaluations: Sequence[Evaluation], console: Console) -> None:
    """Print the summary with as many columns as the terminal has room for."""
    known = evaluations[0].condition.environment
    columns = [column for column in known.columns if column.on_console]
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
    """Median over the episodes of every cell that did not fail, failures beside them.

    Args:
        evaluations: The cells, of one environment.
        columns: Metrics to show.
        worst: Whether the episode that is farthest from zero stands in brackets, where there are
            several.
        intervals: Whether several episodes show the 95 % interval of their median.
    """
    known = evaluations[0].condition.environment
    swept = list(dict.fromkeys(name for e in evaluations for name in e.condition.swept))
    judged = {column.metric for column in known.judged}
    names = ("reference", "scenario", "policy")
    heads = [Head(name, is_number=False) for name in names]
    heads += [Head(name) for name in swept]
    for column in columns:
        leaves = 2 if column.metric in judged else 1
        heads.append(Head(column.title, column.unit, column.note, leaves=leaves))
    heads += [Head(known.failure)]
    rows = []
    for e in evaluations:
        condition = e.condition
        names = [condition.reference_name, condition.scenario, condition.policy.title]
        values = condition.swept_values(swept)
        figures = [_figure(e, column, worst, intervals) for column in columns]
        failed = f"{e.num_failed}/{len(e.episodes)}"
        rows.append(Row((*names, *values, *figures, failed)))
    title = f"{known.subject}, median over episodes"
    title += _interval(evaluations) if intervals else ""
    return Table(tuple(heads), tuple(rows), keys=3, title=title, caption=known.note)


def _interval(evaluations: Sequence[Evaluation]) -> str:
    return " [95 % interval]" if any(len(own.episodes) > 1 for own in evaluations) else ""


def _figure(evaluation: Evaluation, column: Column, worst: bool, interval: bool) -> str:
    """Median of a metric with its interval, and the episode that is farthest from zero."""
    median = median_of(evaluation, column.metric)
    found = number_interval(median if interval else Estimate(median.value), column)
    values = column.scale * evaluation.values(column.metric)
    if not worst or len(values) < 2:
        return found
    return f"{found} ({values[np.argmax(np.abs(values))]:.{column.decimals}f})"


def failure_notes(evaluations: Sequence[Evaluation]) -> list[str]:
    """How and when the episodes of a cell ended, median [s], for cells in which all failed."""
    cells = {(e.condition.reference_name, e.condition.scenario) for e in evaluations}
    notes = []
    for e in evaluations:
        number = len(e.episodes)
        if e.num_failed < number or not number:
            continue
        reasons = "/".join(dict.fromkeys(own["termination"] for own in e.episodes))
        times = e.values("duration_s", failed=True)
        when = f" after {np.median(times):.1f} s" if len(times) else ""
        own = e.condition
        swept = [f"{name}={value:g}" for name, value in own.swept.items()]
        cell = [] if len(cells) == 1 else [own.reference_name, own.scenario]
        who = ", ".join([*cell, " ".join([own.policy.title, *swept])])
        notes.append(f"{who}: {reasons}{when} ({number} of {number})")
    return notes


def bound_notes(evaluations: Sequence[Evaluation]) -> list[str]:
    """A sentence where actions were cut at their bounds, which scores alone do not show."""
    shares = [e.values("clipped_share").max(initial=0.0) for e in evaluations]
    cut = sum(share > 0.0 for share in shares)
    if not cut:
        return []
    worst = evaluations[int(np.argmax(shares))].condition
    where = f"{worst.policy.title} in {worst.scenario}, {worst.reference_name}"
    share = f"{100.0 * max(shares):.3g} % of the control steps of {where}"
    return [f"Actions were cut at their bounds in {cut} of {len(shares)} cells: in up to {share}."]


def write_episodes(evaluations: Sequence[Evaluation], path: Path) -> Path:
    """One row per episode; columns are names with units."""
    return write_records(list(chain(*(own.episodes for own in evaluations))), path)


def write_summary(evaluations: Sequence[Evaluation], path: Path) -> Path:
    """The summary table and its splits as Markdown, by environment."""
    groups = groupby(evaluations, key=lambda evaluation: evaluation.condition.env)
    parts = [part for _, group in groups for part in _parts(list(group))]
    write_whole(path, "\n\n".join(parts) + "\n")
    return path


def _parts(evaluations: Sequence[Evaluation]) -> list[str]:
    """The parts of a summary of one environment."""
    known = evaluations[0].condition.environment
    interval = _interval(evaluations)
    worst = f"{interval} (the worst of them)" if interval else ""
    statistic = f"Median over the episodes that did not fail{worst}"
    legend = [*column_notes(known.columns), *filter(None, [known.note])]
    parts = [
        f"{capital(known.subject)}. {statistic}; failures are counted beside.",
        " ".join(legend),
        to_markdown(summary_table(evaluations, known.columns, worst=True)),
    ]
    for title, columns in known.splits.items():
        table = summary_table(evaluations, columns, worst=True)
        parts += [f"{title}:", to_markdown(table)]
    if notes := failure_notes(evaluations):
        parts += ["Where all episodes failed:", bullets(notes)]
    return [*parts, *bound_notes(evaluations)]
