"""The tables and sentences of a report as Markdown."""

from collections.abc import Iterable

from train.figures.map_plots import panel_rows, panels
from train.report.change_tables import changes_table
from train.report.leaderboard import leaderboard_markdown
from train.report.render import Table, render
from train.report.report_text import Results, facts, in_short, notes
from train.report.score_tables import ROBOTS, SCORES, learning_table, robots_table, scores_table
from train.runs.escaping import markdown_text


def markdown(results: Results) -> str:
    """A whole report."""
    parts = [f"# Comparison: {markdown_text(results.name)}"]
    parts += [_bullets(f"{term}: {text}" for term, text in facts(results))]
    parts += ["## In short", _bullets(in_short(results))]
    if results.standings:
        parts += ["## Leaderboard", leaderboard_markdown(results.standings).rstrip()]
    for heat_map in results.maps:
        parts.append(f"## Map: {markdown_text(f'{heat_map.column.title}, {heat_map.title}')}")
        for panel in panels(heat_map):
            key = ", ".join(f"{letter} {title}" for letter, title, _ in panel.key)
            parts.append(markdown_text(f"{panel.title}{key and f' ({key})'}:"))
            parts.append(render(Table.plain(*panel_rows(panel)), "markdown"))
    for title, rows in results.grouped_changes.items():
        if rows:
            parts += [f"## {title}", render(changes_table(rows, results.colours), "markdown")]
    if results.robots:
        parts += ["## Drawn robots", ROBOTS, render(robots_table(results.robots), "markdown")]
    for title, columns in results.environment.splits:
        parts += [f"## {title}", SCORES, render(scores_table(results.table, columns), "markdown")]
    if results.learning:
        learning = learning_table(results.learning, results.environment.judged)
        parts += [
            "## Learning curves",
            "Share of the base's score, over training seeds.",
            render(learning, "markdown"),
        ]
    parts += ["## Notes", _bullets(notes(results))]
    return "\n\n".join(parts) + "\n"


def _bullets(lines: Iterable[str]) -> str:
    return "\n".join(f"* {markdown_text(line)}" for line in lines)
