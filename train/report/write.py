"""The report of a comparison: `report.html`, which works offline, and `report.md`."""

from collections.abc import Sequence
from pathlib import Path

from elastic_env.core.errors import missing_extra
from elastic_env.core.files import write_whole
from train.evaluate.environments import Column
from train.evaluate.episodes import Evaluation, group_by
from train.evaluate.scores import score
from train.evaluate.statistics import Estimate
from train.evaluate.table import EpisodeTable
from train.evaluate.terms import SIGNS_ARE
from train.figures.comparison_figures import group_cells, sweep_charts
from train.figures.map_plots import panels
from train.figures.score_charts import learning_chart
from train.figures.time_chart import time_chart
from train.report.change_tables import changes_table
from train.report.charts import forest, ladder
from train.report.leaderboard import add_leaderboard
from train.report.page import TEXTS, Page
from train.report.report_text import Results, capital, facts, sentences
from train.report.score_tables import learning_table, robots_table, scores_table
from train.report.specs import page_chart
from train.report.summary import bound_notes
from train.report.table_formats import Table, load_template

_LONG = 40
"""Rows from which on a table is folded away."""
_POINTS = 600
_LEAST_POINTS = 250
_ALL_POINTS = 6000
"""Points of a curve, at most and at least, and of all cells together, so that a large comparison
stays small.
"""


def require_libraries() -> None:
    """Check that a report can be written, before anything is played.

    Raises:
        MissingExtraError: Plotly or Jinja2 is not installed.
    """
    require_plotly()
    load_template()


def require_plotly() -> str:
    """The source of plotly.js, to be put into a page.

    Raises:
        MissingExtraError: Plotly is not installed.
    """
    try:
        from plotly.offline import get_plotlyjs
    except ImportError:
        raise missing_extra("plotly", "report", "writing a report") from None
    return get_plotlyjs()


def write_report(results: Results) -> list[Path]:
    """Write `report.html` and `report.md` beside the other files of a comparison."""
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
    for title, columns in results.environment.splits.items():
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
    """A paragraph, with its sentence about families where there are some."""
    return TEXTS[name] + (TEXTS[f"{name}_families"] if results.table.members else "")


def _add_maps(page: Page, results: Results) -> None:
    """Heat maps: who is best, what learning adds, and folded away every policy's score."""
    page.section("Maps", TEXTS["maps"].format(signs=SIGNS_ARE))
    page.add("caption", "Green: learning is ahead. Red: it is behind.")
    for heat_map in results.maps:
        found = panels(heat_map)
        title = capital(f"{heat_map.column.title}, {heat_map.title}")
        page.add("map", [panel for panel in found if panel.is_main], title)
        rest = [panel for panel in found if not panel.is_main]
        page.add("map", rest, "Scores of every policy", is_folded=True)


def _add_ladder(page: Page, results: Results) -> None:
    page.section("Ladder of policies", _text(results, "ladder"))
    references = results.table.references
    for number, reference in enumerate(references):
        chart = ladder(results.table, reference, results.colours)
        several = len(references) > 1
        title = capital(results.environment.title(reference)) if several else ""
        page.add("chart", chart, title, is_folded=several, is_open=number < 3)


def _add_changes(page: Page, results: Results) -> None:
    """Forest charts and tables of residuals; baselines in a table of their own."""
    *of_residuals, (name_of_others, others) = results.grouped_changes.items()
    for name, rows in of_residuals:
        if not rows:
            continue
        page.section(name, TEXTS["changes"])
        page.add("caption", TEXTS["changes_colours"])
        drawn = [row for row in rows if row.is_judged] if results.has_conditions else []
        for title, own in group_by(drawn, lambda row: row.policy).items():
            page.add("chart", forest(own), f"{title} against {own[0].base}")
        _add_table(page, changes_table(rows, results.colours), "Table of changes")
    if others:
        page.section(name_of_others, TEXTS["differences"])
        table = changes_table(others, results.colours)
        _add_table(page, table, "Table of differences")


def _add_table(page: Page, table: Table, title: str = "Table") -> None:
    """A table, folded away under its title where it is long."""
    number = len(table.rows)
    is_long = number > _LONG
    title = f"{title} ({number} rows)" if is_long else ""
    page.add("table", table, title, is_folded=is_long)


def _add_curves(page: Page, results: Results) -> None:
    """Signals of the first episodes over time, a chart for each motion and scenario."""
    table = results.table
    known = table.environment
    walk = TEXTS["curves_walk"] if known.walks else ""
    page.section("Curves over time", f"{_text(results, 'curves')}{walk}")
    traced = [e for e in results.evaluations if e.trace]
    shared = _ALL_POINTS // (len(table.references) * len(table.scenarios))
    most = min(_POINTS, max(_LEAST_POINTS, shared))
    for number, own in enumerate(group_cells(traced)):
        first = own[0].condition
        policies = group_by(own, lambda e: e.condition.policy.title)
        chart = time_chart(policies, known.curves, results.colours, most)
        title = capital(f"{known.title(first.reference_name)}, {first.scenario}")
        page.add("chart", page_chart(chart), title, is_folded=True, is_open=number == 0)


def _add_sweeps(page: Page, results: Results) -> None:
    """Scores over the swept option, or over what the references differ in."""
    columns = results.environment.judged
    charts = sweep_charts(results.evaluations, results.swept, columns, _cell_score)
    if charts:
        page.section("Sweeps", _text(results, "sweeps"))
    for number, chart in enumerate(charts.values()):
        folding = {"is_folded": True, "is_open": number == 0}
        page.add("chart", page_chart(chart), chart.title, **folding)


def _cell_score(cell: Sequence[Evaluation], column: Column) -> Estimate:
    return score(EpisodeTable(cell).rows, column)
