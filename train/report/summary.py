"""Tables of a comparison: one CSV of all episodes, a summary for the terminal, and the same, longer, as Markdown.

Scores of an episode that failed are never averaged in; failures are counted beside.
"""

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

import numpy as np
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from elastic_env.core.files import write_whole
from train.evaluate.environments import Column, Environment
from train.evaluate.episodes import Evaluation
from train.report.fitting import print_fitting
from train.runs.escaping import markdown_table, markdown_text, write_records


def print_summary(evaluations: Sequence[Evaluation], console: Console) -> None:
    """Print the summary with as many columns as the terminal has room for; what policies are judged by stays."""
    known = evaluations[0].condition.environment
    columns = [column for column in known.columns if column.on_console]
    judged = {column.metric for column in known.judged}
    print_fitting(
        console,
        columns,
        lambda shown: summary_table(evaluations, shown),
        lambda column: column.title,
        "summary.md",
        stays=lambda column: column.metric in judged,
    )
    for note in failure_notes(evaluations):
        console.print(note, markup=False)


def summary_table(evaluations: Sequence[Evaluation], columns: Sequence[Column] | None = None) -> Table:
    """Median over the episodes of every cell that did not fail, failures beside them.

    Args:
        evaluations: The cells, of one environment.
        columns: What to show; None for what the environment shows where there is little room.
    """
    known = evaluations[0].condition.environment
    columns = [column for column in known.columns if column.on_console] if columns is None else columns
    title = f"{known.subject}, median over episodes"
    table = Table(title=title, caption=escape(_legend(known, columns)), box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    swept = _swept(evaluations)
    for name in ("reference", "scenario", "policy"):
        table.add_column(name, no_wrap=True, vertical="bottom")
    for name in swept:
        table.add_column(name.replace("_", "\n"), justify="right", no_wrap=True, vertical="bottom")
    for column in columns:
        lines = [*column.title.split(), column.unit]
        table.add_column("\n".join(lines), justify="right", no_wrap=True, vertical="bottom")
    table.add_column(known.failure, justify="right", no_wrap=True, vertical="bottom")
    previous = None
    for evaluation in evaluations:
        cell = evaluation.condition.reference_name, evaluation.condition.scenario
        if previous is not None and cell != previous:
            table.add_section()
        shown = ("", "") if cell == previous else cell
        previous = cell
        medians = [median(evaluation, column) for column in columns]
        table.add_row(*map(escape, (*shown, evaluation.condition.policy.title)), *_swept_values(evaluation, swept),
                      *medians, failures(evaluation))  # fmt: skip
    return table


def median(evaluation: Evaluation, column: Column) -> str:
    """Median of a metric over the episodes that did not fail, - where there are none."""
    values = column.scale * evaluation.values(column.metric)
    return _number(float(np.median(values)), column) if len(values) else "-"


def median_and_worst(evaluation: Evaluation, column: Column) -> str:
    """The median, and where there are several episodes the one farthest from zero in brackets."""
    values = column.scale * evaluation.values(column.metric)
    if len(values) < 2:
        return median(evaluation, column)
    return f"{median(evaluation, column)} ({_number(float(values[np.argmax(np.abs(values))]), column)})"


def failures(evaluation: Evaluation) -> str:
    """Episodes that failed, of all."""
    return f"{evaluation.num_failed}/{len(evaluation.episodes)}"


def failure_notes(evaluations: Sequence[Evaluation]) -> list[str]:
    """How and, on the walker, when the episodes of a cell ended, median [s], for the cells in which all failed."""
    cells = {(e.condition.reference_name, e.condition.scenario) for e in evaluations}
    notes = []
    for e in evaluations:
        number = len(e.episodes)
        if e.num_failed == number > 0:
            reasons = "/".join(dict.fromkeys(episode["termination"] for episode in e.episodes))
            times = e.values("duration_s", failed=True)
            when = f" after {np.median(times):.1f} s" if len(times) else ""
            swept = [f"{name}={value:g}" for name, value in e.condition.swept.items()]
            cell = [] if len(cells) == 1 else [e.condition.reference_name, e.condition.scenario]
            who = ", ".join([*cell, " ".join([e.condition.policy.title, *swept])])
            notes.append(f"{who}: {reasons}{when} ({number} of {number})")
    return notes


def write_episodes(evaluations: Sequence[Evaluation], path: Path) -> Path:
    """One row per episode; columns are names with units."""
    return write_records([episode for evaluation in evaluations for episode in evaluation.episodes], path)


def write_summary(evaluations: Sequence[Evaluation], path: Path) -> Path:
    """The summary table and its splits as Markdown: medians, and the worst episode in brackets; by environment."""
    groups = [list(group) for _, group in groupby(evaluations, key=lambda evaluation: evaluation.condition.env)]
    write_whole(path, "\n\n".join(part for group in groups for part in _summarised(group)) + "\n")
    return path


def _summarised(evaluations: Sequence[Evaluation]) -> list[str]:
    """The parts of a summary of one environment."""
    known = evaluations[0].condition.environment
    several = any(len(evaluation.episodes) > 1 for evaluation in evaluations)
    statistic = "Median over the episodes that did not fail" + (" (the worst of them in brackets)" if several else "")
    head = f"{known.subject[0].upper()}{known.subject[1:]}. {statistic}; failures are counted beside."
    parts = [head, _legend(known, known.columns), _markdown(evaluations, known.columns)]
    for title, columns in known.splits:
        parts += [f"{title}:", _markdown(evaluations, columns)]
    notes = failure_notes(evaluations)
    if notes:
        parts += ["Where all episodes failed:", "\n".join(f"* {markdown_text(note)}" for note in notes)]
    return parts


def _markdown(evaluations: Sequence[Evaluation], columns: Sequence[Column]) -> str:
    swept, failure = _swept(evaluations), evaluations[0].condition.environment.failure
    header = ["reference", "scenario", "policy", *swept, *(column.label for column in columns), failure]
    rows = [
        [
            e.condition.reference_name, e.condition.scenario, e.condition.policy.title, *_swept_values(e, swept),
            *(median_and_worst(e, column) for column in columns), failures(e),
        ]
        for e in evaluations
    ]  # fmt: skip
    return markdown_table(header, ["---"] * len(header), rows)


def _legend(known: Environment, columns: Sequence[Column]) -> str:
    """What the titles of the columns that are shown leave open."""
    notes = "; ".join(f"{column.title}: {column.note}" for column in columns if column.note)
    return " ".join(sentence for sentence in (notes and f"{notes}.", known.note) if sentence)


def _swept(evaluations: Sequence[Evaluation]) -> list[str]:
    """Names of what a sweep varies."""
    return list(dict.fromkeys(name for evaluation in evaluations for name in evaluation.condition.swept))


def _swept_values(evaluation: Evaluation, names: Sequence[str]) -> list[str]:
    values = evaluation.condition.swept
    return [f"{values[name]:g}" if name in values else "-" for name in names]


def _number(value: float, column: Column) -> str:
    return f"{value:.{column.decimals}f}"
