"""The report of a comparison: `report.html`, which works without a network, and the same without charts as Markdown."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from elastic_env.errors import missing_extra
from train.changes import CEILING, HELD_OUT, Change, by_cell, by_line, falls, families, level, percent_interval
from train.environments import Column
from train.evaluate import Evaluation
from train.families import Origin
from train.progress import Curves, learning_curves
from train.report_charts import Lines, forest, ladder, learning, number_interval, over_time, sweep
from train.report_page import Page, changes_html, definitions, fold, table

MIN_SWEPT_REFERENCES = 3
"""From so many references with a number of their own on, the scores are drawn against it."""
_LONG = 40
"""Rows from which on a table is folded away."""


@dataclass(frozen=True)
class Results:
    """What a report is about.

    Attributes:
        name: Name of the comparison.
        evaluations: All cells, one per training seed.
        changes: Paired changes.
        folder: Where the comparison's files are, with its metadata.
        swept: What the axis of a sweep says; None without one.
    """

    name: str
    evaluations: list[Evaluation]
    changes: list[Change]
    folder: Path
    swept: str | None = None

    @cached_property
    def families(self) -> dict[str, Origin]:
        """Families of residuals and how they were trained."""
        return families(self.evaluations)

    @cached_property
    def lines(self) -> Lines:
        """Policies with their colours."""
        return Lines(self.evaluations)

    @cached_property
    def learning(self) -> dict[str, Curves]:
        """Learning curves of the families whose folders lie in a training run."""
        columns = self.lines.environment.judged
        found = {title: learning_curves(origin.folders, columns) for title, origin in self.families.items()}
        return {title: curves for title, curves in found.items() if curves is not None}

    @cached_property
    def metadata(self) -> Mapping[str, Any]:
        """Origin of the comparison: date, seed, commit, versions."""
        return json.loads((self.folder / "metadata.json").read_text(encoding="utf-8"))

    @property
    def swept_options(self) -> list[str]:
        """Names of the options that a sweep varies."""
        return list(dict.fromkeys(name for row in self.changes for name in row.swept))


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
    page, text = results.folder / "report.html", results.folder / "report.md"
    page.write_text(_page(results).html(require_plotly()), encoding="utf-8")
    text.write_text(_markdown(results), encoding="utf-8")
    return [page, text]


# What both say.


def _what(results: Results) -> list[tuple[str, str]]:
    lines, origin = results.lines, results.metadata
    seeds = [episode["seed"] for e in results.evaluations for episode in e.episodes]
    per_cell = sorted({len(e.episodes) for e in results.evaluations})
    versions = ", ".join(f"{name} {version}" for name, version in origin["versions"].items() if version)
    quantity = lines.environment.quantity or "reference"
    each = " and training seed" if results.families else ""
    found = [
        ("policies", ", ".join(lines.titles)),
        (f"{quantity}s", ", ".join(lines.references)),
        ("scenarios", ", ".join(lines.scenarios)),
        ("episodes", f"{_span(per_cell)} per cell{each}, seeds {min(seeds)} to {max(seeds)}"),
        ("made", f"{origin['created']}, commit {origin['commit'] or 'unknown'}"),
        ("versions", f"Python {origin['python']}, {versions}"),
    ]
    return found + [(title, _trained(origin)) for title, origin in results.families.items()]


def _trained(origin: Origin) -> str:
    number = len(origin.folders)
    where = origin.folders[0] if number == 1 else f"{origin.folders[0]} to {origin.folders[-1]}"
    on = "an unknown condition" if origin.scenarios is None else ", ".join(origin.scenarios)
    motion = "" if origin.reference is None else f" ({origin.reference})"
    seeds = f"{number} training seed{'s' * (number != 1)}"
    return f"{seeds}, trained on {on}{motion}; {where}; commit {', '.join(commit[:12] for commit in origin.commits)}"


def _in_short(results: Results) -> list[str]:
    """A line per residual and metric: in how many cells it is better, worse, or neither."""
    found = []
    for title in results.families:
        rows = [row for row in results.changes if row.policy == title]
        for column in dict.fromkeys(row.column for row in rows):
            own = [row for row in rows if row.column == column]
            found += [
                f"{title} against {row.base}, {column.title}, pooled over {row.scope}{_at(results, row)}: "
                f"{percent_interval(row.relative)}{_marked(row)}: {row.sentence}."
                for row in own
                if row.is_group
            ]
            cells = [row for row in own if not row.is_group]
            if cells:
                found.append(f"{title} against {cells[0].base}, {column.title}: {_tally(cells)}.")
        worse = [row for row in rows if row.falls_more and not row.is_group]
        if worse:
            where = ", ".join(dict.fromkeys(f"{row.scope}{_at(results, row)}" for row in worse))
            found.append(f"{title}: more {worse[0].failure} than {worse[0].base} in {where}.")
    return found or ["No residual takes part: there are no training seeds, and differences are differences of means."]


def _tally(cells: Sequence[Change]) -> str:
    counts = {
        "lower": [row for row in cells if row.verdict == "lower"],
        "higher": [row for row in cells if row.verdict == "higher"],
        "no difference shown (the interval includes zero)": [row for row in cells if row.verdict == "none"],
        "no interval": [row for row in cells if row.verdict == "unclear"],
    }
    parts = [f"{words} in {len(rows)}" for words, rows in counts.items() if rows]
    return f"of {len(cells)} cells " + ", ".join(parts)


def _at(results: Results, row: Change) -> str:
    several = len(results.lines.references) > 1
    swept = [f"{name}={value:g}" for name, value in row.swept.items()]
    return "".join(f", {part}" for part in [*([row.reference] if several else []), *swept])


def _marked(row: Change) -> str:
    return f" ({'; '.join(row.marks)})" if row.marks else ""


def _notes(results: Results) -> list[str]:
    """What a reader needs to know, and only what concerns this comparison."""
    failure = "falls" if results.lines.environment.failure == "falls" else "failures"
    notes = [
        "A change is, per training seed, the mean over episodes with the residual over the mean over the same episodes "
        "of its base, minus one. An episode in which either did not reach the end is left out of both and counted under "
        f"{failure}. Below zero is better.",
    ]
    if results.families:
        notes.append(
            "Figures of residuals are interquartile means over training seeds with 95 % percentile bootstrap intervals "
            "over training seeds (never over the episodes of one). A base has no training seed, so it has no interval. "
            "Pooled: means over scenarios are compared, per training seed."
        )
        notes.append(
            "Better than base: share of all pairs of training seed and episode in which the residual is ahead, ties as "
            "one half."
        )
    marks = {mark for row in results.changes for mark in row.marks}
    if any(mark.startswith(HELD_OUT) for mark in marks):
        notes.append(f"Marked {HELD_OUT!r}: nothing of this scenario, or of this motion, was seen in training.")
    if CEILING in marks:
        notes.append(
            f"Marked {CEILING!r}: the scenario is deterministic and the residual was trained on it, so that training and "
            "evaluation see the same. It says what is possible, not what is to be expected."
        )
    for title, origin in results.families.items():
        if len(origin.folders) == 1:
            notes.append(f"{title} is a single training seed: another one may come out differently.")
        if origin.missing_seeds:
            missing = ", ".join(map(str, origin.missing_seeds))
            notes.append(f"{title} lacks training seeds of its configuration: {missing}.")
    return notes


def _span(numbers: Sequence[int]) -> str:
    return str(numbers[0]) if len(numbers) == 1 else f"{numbers[0]} to {numbers[-1]}"


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


# The page.


def _page(results: Results) -> Page:
    known = results.lines.environment
    page = Page(f"Comparison: {results.name}", f"{_capital(known.subject)}; made {results.metadata['created'][:10]}")
    page.section("What was compared")
    page.add(definitions(_what(results)))
    page.bullets(_in_short(results))
    if results.swept is None:
        _add_ladder(page, results)
    _add_changes(page, results)
    _add_phases(page, results)
    if results.swept is None:
        _add_curves(page, results)
    _add_sweeps(page, results)
    if results.learning:
        page.section("Learning curves")
        chart = learning(results.learning, known.judged, results.lines.colour)
        page.text(
            "Score over that of the base (dotted) on episodes that training never sees, mean over the trained scenarios: "
            "median over training seeds, band from the best to the worst."
        )
        page.chart(chart)
    page.section("Notes")
    page.bullets(_notes(results))
    return page


def _add_ladder(page: Page, results: Results) -> None:
    page.section("Ladder of policies")
    seeds = (
        " Diamonds are residuals: interquartile mean over training seeds with its 95 % interval."
        if results.families else ""
    )  # fmt: skip
    page.text(f"Mean over the episodes that reached the end; lower is better, and the axis is logarithmic.{seeds}")
    references = results.lines.references
    for number, reference in enumerate(references):
        chart = ladder(results.lines, reference)
        title = results.lines.environment.title(reference)
        page.chart(chart, folded=_capital(title) if len(references) > 1 else None, is_open=number < 3)


def _add_changes(page: Page, results: Results) -> None:
    """Forest charts and tables of residuals; baselines in a table of their own."""
    trained = [row for row in results.changes if row.is_family]
    others = [row for row in results.changes if not row.is_family]
    colour, swept = results.lines.colour, results.swept_options
    if trained:
        page.section("Residuals against their base")
        drawn = results.swept is None
        marks = " Open circles are held out, stars are ceilings on the training condition." if drawn else ""
        page.text(
            "Change on the same episodes, with 95 % intervals over training seeds. Green: the interval lies below zero; "
            f"red: above; grey: it includes zero, or there is none.{marks}"
        )
        for title in dict.fromkeys(row.policy for row in trained if drawn):
            own = [row for row in trained if row.policy == title]
            page.heading(f"{title} against {own[0].base}")
            page.chart(forest(own))
        _add_table(page, "Table of changes", changes_html(trained, colour, swept), len(trained))
    if others:
        page.section("Baselines against one another")
        page.text("Paired differences of means. Baselines are not trained: there are no training seeds to draw from.")
        _add_table(page, "Table of differences", changes_html(others, colour, swept, False), len(others))


def _add_table(page: Page, title: str, html: str, rows: int) -> None:
    page.add(html if rows <= _LONG else fold(f"{title} ({rows} rows)", html))


def _add_phases(page: Page, results: Results) -> None:
    for title, columns in results.lines.environment.splits:
        page.section(title)
        page.text(_PHASES)
        head, rows = _scores(results, columns)
        _add_table(
            page, f"Table ({len(rows)} rows)", table(head, rows, words=3 + len(results.swept_options)), len(rows)
        )


_PHASES = (
    "Mean over the episodes that reached the end; of residuals the interquartile mean over training seeds, with its 95 % "
    "interval."
)


def _scores(results: Results, columns: Sequence[Column]) -> tuple[list[str], list[list[str]]]:
    """Head and rows of a table of scores."""
    swept, lines = results.swept_options, results.lines
    head = ["reference", "scenario", "policy", *swept, *(column.label for column in columns)]
    rows = []
    for reference in lines.references:
        for scenario in lines.scenarios:
            for title in lines.titles:
                found = by_cell(lines.cell(title, reference_name=reference, scenario=scenario))
                for cell in found.values():
                    values = cell[0].condition.swept
                    rows.append(
                        [
                            reference, scenario, title, *(f"{values[n]:g}" if n in values else "-" for n in swept),
                            *(number_interval(level(cell, c).scaled(c.scale), c) for c in columns),
                        ]
                    )  # fmt: skip
    return head, rows


def _add_curves(page: Page, results: Results) -> None:
    page.section("Curves over time")
    band = " Of residuals: median over training seeds, band from the least to the most." if results.families else ""
    shade = " Single support is shaded." if results.lines.environment.splits else ""
    page.text(f"The first episode of every cell; a line ends where the episode does.{band}{shade}")
    first = True
    for reference in results.lines.references:
        for scenario in results.lines.scenarios:
            chart = over_time(results.lines, reference, scenario)
            if chart is not None:
                title = f"{results.lines.environment.title(reference)}, {scenario}"
                page.chart(chart, folded=_capital(title), is_open=first)
                first = False


def _add_sweeps(page: Page, results: Results) -> None:
    """Scores over the swept option, or over what the references differ in."""
    lines = results.lines
    charts = []
    if results.swept is not None:
        for reference in lines.references:
            for scenario in lines.scenarios:
                points = {
                    t: _by_option(lines.cell(t, reference_name=reference, scenario=scenario)) for t in lines.titles
                }
                charts.append((f"{lines.environment.title(reference)}, {scenario}", points, results.swept))
    elif len({_number(e) for e in results.evaluations} - {None}) >= MIN_SWEPT_REFERENCES:
        for scenario in lines.scenarios:
            points = {t: _by_number(lines.cell(t, scenario=scenario)) for t in lines.titles}
            charts.append((f"scenario {scenario}", points, f"{lines.environment.quantity} [s]"))
    if not charts:
        return
    page.section("Sweeps")
    page.text(
        "Means over the episodes that reached the end. A cross on top: all episodes of a policy failed there; an open "
        "one: some did." + (" Bands are 95 % intervals over training seeds." if results.families else "")
    )
    for number, (title, points, label) in enumerate(charts):
        chart = sweep(lines, {t: own for t, own in points.items() if own}, label)
        page.chart(chart, folded=_capital(title), is_open=number == 0)


def _by_option(evaluations: Sequence[Evaluation]) -> dict[float | None, list[Evaluation]]:
    found: dict[float | None, list[Evaluation]] = {}
    for e in evaluations:
        found.setdefault(next(iter(e.condition.swept.values()), None), []).append(e)
    return found


def _by_number(evaluations: Sequence[Evaluation]) -> dict[float | None, list[Evaluation]]:
    found: dict[float | None, list[Evaluation]] = {}
    for e in evaluations:
        number = _number(e)
        if number is not None:
            found.setdefault(number, []).append(e)
    return found


def _number(evaluation: Evaluation) -> float | None:
    """What of a reference scores can be drawn against."""
    condition = evaluation.condition
    return next(iter(condition.environment.abscissa(condition.reference).values()), None)


# Markdown.


def _markdown(results: Results) -> str:
    parts = [f"# Comparison: {results.name}", "\n".join(f"* {term}: {text}" for term, text in _what(results))]
    parts += ["## In short", "\n".join(f"* {line}" for line in _in_short(results))]
    for title, rows in (
        ("Residuals against their base", [row for row in results.changes if row.is_family]),
        ("Baselines against one another", [row for row in results.changes if not row.is_family]),
    ):
        if rows:
            parts += [f"## {title}", _changes_markdown(rows, results.swept_options)]
    for title, columns in results.lines.environment.splits:
        head, scores = _scores(results, columns)
        parts += [f"## {title}", _PHASES, _markdown_table(head, scores, words=3 + len(results.swept_options))]
    if results.learning:
        parts += ["## Learning curves", _learning_markdown(results)]
    parts += ["## Notes", "\n".join(f"* {note}" for note in _notes(results))]
    return "\n\n".join(parts) + "\n"


def _changes_markdown(rows: Sequence[Change], swept: Sequence[str]) -> str:
    head = ["policy", "base", "reference", "scenario", *swept, "metric", "base →", "change", "better than base",
            "falls (base)", "what it shows"]  # fmt: skip
    lines = []
    for row in (row for line in by_line(rows) for row in line):
        number = f".{row.column.decimals}f"
        before, after = (f"{row.column.scale * value:{number}}" for value in (row.theirs, row.mine))
        scope = ("pooled: " if row.is_group else "") + row.scope + _marked(row)
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
        for column in results.lines.environment.judged:
            for at, ratio in zip(curves.decisions, curves.ratios[column.metric].T, strict=True):
                known = ratio[np.isfinite(ratio)]
                values = (np.median(known), known.min(), known.max()) if len(known) else (np.nan,) * 3
                rows.append([title, column.title, f"{at:.0f}", *(f"{value:.2f}" for value in values)])
    return "Share of the base's score, over training seeds.\n\n" + _markdown_table(head, rows, words=2)


def _markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]], words: int, last_is_words: bool = False) -> str:
    last = len(head) - 1
    rules = ["---" if i < words or (last_is_words and i == last) else "---:" for i in range(len(head))]
    lines = [head, rules, *([text.replace("|", "\\|") for text in row] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
