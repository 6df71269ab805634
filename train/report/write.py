"""The report of a comparison: `report.html`, which works without a network, and its tables as
Markdown.
"""

from collections.abc import Sequence
from pathlib import Path

from elastic_env.core.errors import missing_extra
from elastic_env.core.files import write_whole
from train.evaluate.changes import SIGNS_ARE
from train.evaluate.environments import Column
from train.evaluate.episodes import Evaluation, group_by
from train.evaluate.statistics import Estimate
from train.evaluate.table import EpisodeTable, score
from train.figures.chart import Cells, learning_chart, sweep_chart, time_chart
from train.figures.comparison_figures import (
    by_option,
    by_reference,
    cells_together,
    swept_scenarios,
)
from train.figures.map_plots import panels
from train.report.change_tables import changes_table
from train.report.charts import forest, ladder
from train.report.leaderboard import PAIRED, board, claims_table, legend, scenarios_board
from train.report.markdown import markdown
from train.report.page import Page
from train.report.render import Table
from train.report.report_text import Results, capital, facts, headline, in_short, notes
from train.report.score_tables import ROBOTS, SCORES, robots_table, scores_table
from train.report.specs import page_chart

_LONG = 40
"""Rows from which on a table is folded away."""
_POINTS = 600
_LEAST_POINTS = 250
_ALL_POINTS = 6000
"""Points of a curve, at most and at least, and of all cells together, so that a large comparison
stays small.
"""


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
    page = results.folder / "report.html"
    text = results.folder / "report.md"
    write_whole(page, _page(results).html(require_plotly()))
    write_whole(text, markdown(results))
    return [page, text]


def _page(results: Results) -> Page:
    known = results.environment
    page = Page(
        f"Comparison: {results.name}",
        f"{capital(known.subject)}; made {results.metadata['created'][:10]}",
    )
    page.section("What was compared", headline(results))
    page.add("definitions", facts(results))
    page.add("bullets", in_short(results))
    _add_leaderboard(page, results)
    _add_maps(page, results)
    if results.has_conditions:
        _add_ladder(page, results)
    _add_changes(page, results)
    _add_robots(page, results)
    _add_phases(page, results)
    if results.has_conditions:
        _add_curves(page, results)
    if not results.maps:
        _add_sweeps(page, results)
    if results.learning:
        page.section(
            "Learning curves",
            "Score over that of the base (dotted) on episodes that training never sees, mean over"
            " the trained scenarios: median over training seeds, band from the best to the worst.",
        )
        chart = learning_chart(results.learning, known.judged, results.colours)
        page.add("chart", page_chart(chart))
    page.section("Notes")
    page.add("bullets", notes(results))
    return page


def _add_leaderboard(page: Page, results: Results) -> None:
    """The leaderboard, what learning adds, and folded away the single scenarios."""
    found = results.standings
    if not found:
        return
    page.section("Leaderboard", legend(found))
    page.add("table", board(found))
    claims = claims_table(found)
    if claims.rows:
        page.add("heading", "What learning adds")
        page.add("text", PAIRED)
        _add_table(page, claims)
    single = scenarios_board(found)
    if single is not None:
        page.add("table", single, folded=f"Single scenarios, {found[0].reference}")


def _add_maps(page: Page, results: Results) -> None:
    """Heat maps: who is best, learning against the best policy without it, and folded away every
    policy's score.
    """
    if not results.maps:
        return
    page.section(
        "Maps",
        "Who is best where, and what learning changes against the best policy without it, in per"
        " cent: green and below zero, learning is ahead; red and above zero, it is behind."
        f" {SIGNS_ARE} A cross counts failed episodes.",
    )
    for heat_map in results.maps:
        found = panels(heat_map)
        page.add("heading", capital(f"{heat_map.column.title}, {heat_map.title}"))
        page.add("map", [panel for panel in found if panel.is_main])
        page.add(
            "map", [panel for panel in found if not panel.is_main], folded="Scores of every policy"
        )


def _add_ladder(page: Page, results: Results) -> None:
    seeds = (
        " Diamonds are residuals: interquartile mean over training seeds with its 95 % interval."
        if results.table.members
        else ""
    )
    page.section(
        "Ladder of policies",
        "Mean over the episodes that reached the end; lower is better, and the axis is"
        f" logarithmic.{seeds}",
    )
    references = results.table.references
    for number, reference in enumerate(references):
        chart = ladder(results.table, reference, results.colours)
        title = results.environment.title(reference)
        page.add(
            "chart",
            chart,
            folded=capital(title) if len(references) > 1 else None,
            is_open=number < 3,
        )


def _add_changes(page: Page, results: Results) -> None:
    """Forest charts and tables of residuals; baselines in a table of their own."""
    *of_residuals, (name_of_others, others) = results.grouped_changes.items()
    for name, rows in of_residuals:
        if not rows:
            continue
        drawn = results.has_conditions
        marks = (
            " Open circles are held out, stars are ceilings on the training condition."
            if drawn
            else ""
        )
        page.section(
            name,
            "Change on the same episodes, with 95 % intervals over training seeds. Green: the"
            " interval lies below zero; red: above; grey: it includes zero, or there are too few"
            f" training seeds.{marks}",
        )
        for title in dict.fromkeys(row.policy for row in rows if drawn):
            own = [row for row in rows if row.policy == title and row.is_judged]
            page.add("heading", f"{title} against {own[0].base}")
            page.add("chart", forest(own))
        _add_table(page, changes_table(rows, results.colours), "Table of changes")
    if others:
        page.section(
            name_of_others,
            "Paired differences of means. Baselines are not trained: there are no training seeds to"
            " draw from.",
        )
        _add_table(page, changes_table(others, results.colours), "Table of differences")


def _add_robots(page: Page, results: Results) -> None:
    """Scores over drawn robots: the middle half, the worst tenth, and how many robots are better
    off.
    """
    if not results.robots:
        return
    page.section("Drawn robots", ROBOTS)
    _add_table(page, robots_table(results.robots), "Table of drawn robots")


def _add_table(page: Page, table: Table, title: str = "Table") -> None:
    """A table, folded away under its title where it is long."""
    number = len(table.rows)
    page.add("table", table, f"{title} ({number} rows)" if number > _LONG else None)


def _add_phases(page: Page, results: Results) -> None:
    for title, columns in results.environment.splits:
        page.section(title, SCORES)
        _add_table(page, scores_table(results.table, columns))


def _add_curves(page: Page, results: Results) -> None:
    """Signals of the first episodes over time, a chart for each motion and scenario."""
    table = results.table
    seeds = " Of residuals: median over training seeds, band from the least to the most."
    band = seeds if table.members else ""
    shade = " Single support is shaded." if table.environment.splits else ""
    text = f"The first episode of every cell; a line ends where the episode does.{band}{shade}"
    page.section("Curves over time", text)
    most = min(
        _POINTS, max(_LEAST_POINTS, _ALL_POINTS // (len(table.references) * len(table.scenarios)))
    )
    traced = [e for e in results.evaluations if e.trace]
    cells = group_by(traced, lambda e: (e.condition.reference_name, e.condition.scenario))
    for number, ((reference, scenario), own) in enumerate(cells.items()):
        policies = group_by(own, lambda e: e.condition.policy.title)
        chart = time_chart(policies, table.environment.curves, results.colours, most)
        title = f"{table.environment.title(reference)}, {scenario}"
        page.add("chart", page_chart(chart), folded=capital(title), is_open=number == 0)


def _add_sweeps(page: Page, results: Results) -> None:
    """Scores over the swept option, or over what the references differ in."""
    known = results.environment
    charts: list[tuple[str, Cells, str]] = []
    if results.swept is not None:
        for own in cells_together(results.evaluations):
            title = f"{known.title(own[0].condition.reference_name)}, {own[0].condition.scenario}"
            charts.append((title, by_option(own), results.swept))
    else:
        for scenario in swept_scenarios(results.evaluations):
            own = [e for e in results.evaluations if e.condition.scenario == scenario]
            charts.append((f"scenario {scenario}", by_reference(own), f"{known.quantity} [s]"))
    if not charts:
        return
    page.section(
        "Sweeps",
        "Means over the episodes that reached the end. A cross on top: all episodes of a policy"
        " failed there; an open one: some did."
        + (" Bands are 95 % intervals over training seeds." if results.table.members else ""),
    )
    for number, (title, cells, label) in enumerate(charts):
        chart = sweep_chart(cells, known.judged, label, results.colours, _cell_score)
        page.add("chart", page_chart(chart), folded=capital(title), is_open=number == 0)


def _cell_score(cell: Sequence[Evaluation], column: Column) -> Estimate:
    return score(EpisodeTable(cell).rows, column)
