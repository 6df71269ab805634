"""The tables and sentences of a report as Markdown."""

from collections.abc import Iterable, Sequence

import numpy as np

from train.evaluate.changes import Change, by_line, percent_interval
from train.figures.map_plots import in_rows, panels
from train.report.changes_tables import falls
from train.report.leaderboard import leaderboard_markdown
from train.report.report_text import SCORES, Results, facts, in_short, marked, notes
from train.report.robots_tables import ROBOTS, WORDS, robots_table, scores_table
from train.runs.escaping import markdown_table, markdown_text


def markdown(results: Results) -> str:
    """A whole report."""
    parts = [
        f"# Comparison: {markdown_text(results.name)}",
        _bullets(f"{term}: {text}" for term, text in facts(results)),
    ]
    parts += ["## In short", _bullets(in_short(results))]
    if results.standings:
        parts += ["## Leaderboard", leaderboard_markdown(results.standings).rstrip()]
    for heat_map in results.maps:
        parts.append(f"## Map: {markdown_text(f'{heat_map.column.title}, {heat_map.title}')}")
        for panel in panels(heat_map):
            key = ", ".join(f"{letter} {title}" for letter, title, _ in panel.key)
            head, rows = in_rows(panel)
            parts += [markdown_text(f"{panel.title}{key and f' ({key})'}:"), _markdown_table(head, rows, words=1)]
    for title, rows in results.grouped_changes.items():
        if rows:
            parts += [f"## {title}", _changes_markdown(rows, results.table.swept)]
    if results.robots:
        head, rows = robots_table(results.robots)
        parts += ["## Drawn robots", ROBOTS, _markdown_table(head, rows, words=WORDS, last_is_words=True)]
    for title, columns in results.environment.splits:
        head, rows = scores_table(results.table, columns)
        parts += [f"## {title}", SCORES, _markdown_table(head, rows, words=3 + len(results.table.swept))]
    if results.learning:
        parts += ["## Learning curves", _learning_markdown(results)]
    parts += ["## Notes", _bullets(notes(results))]
    return "\n\n".join(parts) + "\n"


def _bullets(lines: Iterable[str]) -> str:
    return "\n".join(f"* {markdown_text(line)}" for line in lines)


def _changes_markdown(rows: Sequence[Change], swept: Sequence[str]) -> str:
    head = ["policy", "base", "reference", "scenario", *swept, "metric", "base → policy", "change", "better than base",
            f"{rows[0].failure} (base)", "what it shows"]  # fmt: skip
    lines = []
    for row in (row for line in by_line(rows) for row in line):
        number = f".{row.column.decimals}f"
        before, after = (f"{row.column.scale * value:{number}}" for value in (row.theirs, row.mine))
        scope = ("pooled: " if row.is_group else "") + row.scope + marked(row)
        lines.append(
            [
                row.policy, row.base, row.reference, scope,
                *(f"{row.swept[name]:g}" if name in row.swept else "-" for name in swept), row.column.title,
                f"{before} → {after} {row.column.unit}" if np.isfinite(row.mine) else "-",
                percent_interval(row.relative), percent_interval(row.improvement, signed=False), falls(row),
                row.sentence,
            ]
        )  # fmt: skip
    return _markdown_table(head, lines, words=5 + len(swept), last_is_words=True)


def _learning_markdown(results: Results) -> str:
    head = ["residual", "metric", "decisions", "median", "best", "worst"]
    rows = []
    for title, curves in results.learning.items():
        for column in results.environment.judged:
            for at, ratio in zip(curves.decisions, curves.ratios[column.metric].T, strict=True):
                known = ratio[np.isfinite(ratio)]
                values = (np.median(known), known.min(), known.max()) if len(known) else (np.nan,) * 3
                rows.append([title, column.title, f"{at:.0f}", *(f"{value:.2f}" for value in values)])
    return "Share of the base's score, over training seeds.\n\n" + _markdown_table(head, rows, words=2)


def _markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]], words: int, last_is_words: bool = False) -> str:
    last = len(head) - 1
    rules = ["---" if i < words or (last_is_words and i == last) else "---:" for i in range(len(head))]
    return markdown_table(head, rules, rows)
