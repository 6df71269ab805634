"""The report of a comparison: `report.html`, which works offline, and `report.md`."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from elastic_env.core.errors import missing_extra
from elastic_env.core.files import write_whole
from train.evaluate.change_text import SIGNS_ARE
from train.evaluate.environments import Column
from train.evaluate.episodes import Evaluation, group_by
from train.evaluate.scores import score
from train.evaluate.statistics import Estimate
from train.evaluate.table import EpisodeTable
from train.figures.comparison_figures import group_cells, sweep_charts
from train.figures.map_plots import panels
from train.figures.score_charts import learning_chart
from train.figures.time_chart import time_chart
from train.report.change_tables import changes_table
from train.report.dot_plots import forest, ladder
from train.report.leaderboard import add_leaderboard
from train.report.page import TEXTS, Page
from train.report.plotly_charts import page_chart
from train.report.report_text import Results, capital, facts, sentences
from train.report.score_tables import learning_table, robots_table, scores_table
from train.report.summary import bound_notes
from train.report.tables import Table
from train.report.templates import load_template

_MAX_OPEN_ROWS = 40
"""Largest number of rows of a table that is not folded."""
_MAX_POINTS = 600
_MIN_POINTS = 250
_TOTAL_POINTS = 6000
"""Points of a curve, at most and at least, and of all cells together; they limit the report's size.
"""


def require_libraries() -> None:
    """Check that a report can be written, before anything is played.

    Raises:
        MissingExtraError: Plotly or Jinja2 is not installed.
    """
    require_plotly()
    load_template()


def require_plotly() -> str:
    """Return the source of plotly.js, for a page.

    Raises:
        MissingExtraError: Plotly is not installed.
    """
    try:
        from plotly.offline import get_plotlyjs
    except ImportError:
        raise missing_extra("plotly", "report", "writing a report") from None
    return get_plotlyjs()


def write_report(results: Results) -> list[Path]:
    """Write `report.html` and `report.md` into the folder of a comparison."""
    return write_page(_page(results), results.folder)


def write_page(page: Page, folder: Path) -> list[Path]:
    """Write a page as `report.html` and `report.md`."""
    files = [folder / "report.html", folder / "report.md"]
    write_whole(files[0], page.html(require_plotly()))
    write_whole(files[1], page.as_markdown())
    return files


def _page(results: Results) -> Page:
    subject = capital(results.environment.subject)
    under = f"{subject}; made {results.metadata['created'][:10]}"
    page = Page(f"Comparison: {results.name}", under)
    page.section("What was compared", *sentences("headline", results))
    page.add("definitions", facts(results))
    in_short = [*sentences("in_short", results), *bound_notes(results.evaluations)]
    page.add("bullets", in_short, "In short")
    if results.standings:
        add_leaderboard(page, results.standings)
    if results.maps:
        _add_maps(page, results)
    if results.has_conditions:
        _add_ladder(page, results)
    _add_changes(page, results)
    if results.robots:
        page.section("Drawn robots", TEXTS["robots"])
        _add_table(page, robots_table(results.robots), "Table of drawn robots")
    splits = results.environment.splits_of(e.condition.arguments for e in results.evaluations)
    for title, columns in splits.items():
        page.section(title, TEXTS["scores"])
        _add_table(page, scores_table(results.table, columns))
    if results.has_conditions:
        _add_curves(page, results)
    if not results.maps:
        _add_sweeps(page, results)
    if results.learning:
        columns = results.environment.judged
        page.section("Learning curves", TEXTS["learning"])
        chart = learning_chart(results.learning, columns, results.colours)
        page.add("chart", page_chart(chart))
        table = learning_table(results.learning, columns)
        page.add("table", table, "Table of learning curves", is_folded=True)
    page.section("Notes")
    page.add("bullets", sentences("notes", results))
    return page


def _text(results: Results, name: str) -> str:
    """Return a paragraph, with a sentence about families of residuals if there are some."""
    return TEXTS[name] + (TEXTS[f"{name}_families"] if results.table.members else "")


def _add_maps(page: Page, results: Results) -> None:
    """Add heat maps: the best policies, changes by learning, and (folded) all scores."""
    page.section("Maps", TEXTS["maps"].format(signs=SIGNS_ARE))
    page.add("caption", "Green: learning is ahead. Red: it is behind.")
    for heat_map in results.maps:
        all_panels = panels(heat_map)
        title = capital(f"{heat_map.column.title}, {heat_map.title}")
        page.add("map", [panel for panel in all_panels if panel.is_main], title)
        scores = [panel for panel in all_panels if not panel.is_main]
        page.add("map", scores, "Scores of every policy", is_folded=True)


def _add_ladder(page: Page, results: Results) -> None:
    page.section("Ladder of policies", _text(results, "ladder"))
    references = results.table.references
    for number, reference in enumerate(references):
        chart = ladder(results.table, reference, results.colours)
        several = len(references) > 1
        title = capital(results.environment.title(reference)) if several else ""
        page.add("chart", chart, title, is_folded=several, is_open=number < 3)


def _add_changes(page: Page, results: Results) -> None:
    """Add charts and tables of changes of residuals, and a table of differences of baselines."""
    *of_residuals, (name_of_others, others) = results.grouped_changes.items()
    for name, rows in of_residuals:
        if not rows:
            continue
        page.section(name, TEXTS["changes"])
        page.add("caption", TEXTS["changes_colours"])
        drawn = [row for row in rows if row.is_judged] if results.has_conditions else []
        for title, changes in group_by(drawn, lambda row: row.policy).items():
            page.add("chart", forest(changes), f"{title} against {changes[0].base}")
        _add_table(page, changes_table(rows, results.colours), "Table of changes")
    if others:
        page.section(name_of_others, TEXTS["differences"])
        _add_table(page, changes_table(others, results.colours), "Table of differences")


def _add_table(page: Page, table: Table, title: str = "Table") -> None:
    """Add a table, folded under its title if it is long."""
    number = len(table.rows)
    is_long = number > _MAX_OPEN_ROWS
    title = f"{title} ({number} rows)" if is_long else ""
    page.add("table", table, title, is_folded=is_long)


def _add_curves(page: Page, results: Results) -> None:
    """Add the signals of first episodes over time: a chart for each motion and scenario."""
    table = results.table
    walk = TEXTS["curves_walk"] if table.environment.walks else ""
    page.section("Curves over time", f"{_text(results, 'curves')}{walk}")
    traced = [e for e in results.evaluations if e.trace]
    share = _TOTAL_POINTS // (len(table.references) * len(table.scenarios))
    points = min(_MAX_POINTS, max(_MIN_POINTS, share))
    for number, cells in enumerate(group_cells(traced)):
        add_time_chart(page, cells, results.colours, points, is_folded=True, is_open=number == 0)


def add_time_chart(
    page: Page,
    cells: Sequence[Evaluation],
    colours: Mapping[str, str],
    points: int,
    **folding: bool,
) -> None:
    """Add the signals of all policies in one motion and scenario, with at most so many points."""
    condition = cells[0].condition
    environment = condition.environment
    policies = group_by(cells, lambda e: e.condition.policy.title)
    chart = time_chart(policies, environment.curves, colours, points)
    title = capital(f"{environment.title(condition.reference_name)}, {condition.scenario}")
    page.add("chart", page_chart(chart), title, **folding)


def _add_sweeps(page: Page, results: Results) -> None:
    """Add scores over the swept option, or over the value in which the references differ."""
    columns = results.environment.judged
    charts = sweep_charts(results.evaluations, results.swept, columns, _cell_score)
    if charts:
        page.section("Sweeps", _text(results, "sweeps"))
    for number, chart in enumerate(charts.values()):
        page.add("chart", page_chart(chart), chart.title, is_folded=True, is_open=number == 0)


def _cell_score(cell: Sequence[Evaluation], column: Column) -> Estimate:
    return score(EpisodeTable(cell).rows, column)
