"""The results of a comparison, and the sentences of a report, whatever it is written in."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from train.evaluate import changes as terms
from train.evaluate.changes import (
    BEST_ANALYTIC,
    FEWEST_SEEDS,
    Change,
    Verdict,
    percent,
    percent_interval,
)
from train.evaluate.environments import Column, Environment
from train.evaluate.episodes import Evaluation, group_by
from train.evaluate.maps import HeatMap, Scores, best_of, ranking
from train.evaluate.progress import Curves, learning_curves
from train.evaluate.residual_seeds import Origin
from train.evaluate.robots import RobotScores
from train.evaluate.standings import Standing
from train.evaluate.statistics import Estimate
from train.evaluate.table import EpisodeTable, failures, per_seed
from train.figures.colours import policy_colours
from train.report.table_formats import load_template


@dataclass(frozen=True)
class Results:
    """The results that a report shows.

    Attributes:
        name: Name of the comparison.
        evaluations: All cells, one per training seed.
        changes: Paired changes.
        folder: Where the comparison's files are, with its metadata.
        swept: What the axis of a sweep says; None without one.
        maps: Heat maps over two axes, where such are wanted.
        standings: Rows of the leaderboard, where one is wanted.
        robots: Scores over the robots of the cells that draw them.
    """

    name: str
    evaluations: list[Evaluation]
    changes: list[Change]
    folder: Path
    swept: str | None = None
    maps: Sequence[HeatMap] = ()
    standings: Sequence[Standing] = ()
    robots: Sequence[RobotScores] = ()

    @cached_property
    def table(self) -> EpisodeTable:
        """All episodes."""
        return EpisodeTable(self.evaluations)

    @property
    def environment(self) -> Environment:
        """The environment of all cells."""
        return self.table.environment

    @cached_property
    def colours(self) -> dict[str, str]:
        """Colours of the policies, the same in every chart."""
        return policy_colours(self.table.policies)

    @cached_property
    def learning(self) -> dict[str, Curves]:
        """Learning curves of the families whose folders lie in a training run."""
        families = self.table.families.items()
        judged = self.environment.judged
        found = [(title, learning_curves(own.folders, judged)) for title, own in families]
        return {title: curves for title, curves in found if curves is not None}

    @cached_property
    def metadata(self) -> Mapping[str, Any]:
        """Origin of the comparison: date, seed, commit, versions."""
        return json.loads((self.folder / "metadata.json").read_text(encoding="utf-8"))

    @property
    def grouped_changes(self) -> dict[str, list[Change]]:
        """Changes by what is compared with what."""
        kinds = group_by(self.changes, lambda row: (row.is_family, row.is_rival))
        return {
            "Residuals against their base": kinds.get((True, False), []),
            f"Residuals against the {BEST_ANALYTIC}": kinds.get((True, True), []),
            "Baselines against one another": kinds.get((False, False), []),
        }

    @property
    def judged_changes(self) -> list[Change]:
        """Changes of residuals in what policies are judged by."""
        return [row for row in self.changes if row.is_family and row.is_judged]

    @property
    def has_conditions(self) -> bool:
        """True if its cells are conditions of their own, and not points of a curve or a map."""
        return self.swept is None and not self.maps


def headline(results: Results) -> str:
    """Three sentences: what was played, who is best, and what learning adds or who is last."""
    table = results.table
    failed, played = failures(table.rows)
    of_these = f"of which {failed} failed" if failed else "none of which failed"
    policies = _count(len(table.policies), "policy", "policies")
    episodes = _count(played, "episode")
    scenarios = _count(len(table.scenarios), "scenario")
    first = f"{policies} played {episodes} in {scenarios}, {of_these}."
    best, worst = _best_and_worst(table)
    return " ".join([first, best, _learning_sentence(results) or worst])


def _best_and_worst(table: EpisodeTable) -> tuple[str, str]:
    """Sentences on the best and the worst policy by the first judged metric."""
    column = table.environment.judged[0]
    scores = _scores(table.rows, column)
    known = ranking(scores)
    if not known:
        return f"No policy has a {column.title}.", "No episode reached its end."
    best = known[0]
    shown = {
        title: f"{column.scale * scores[title][0].value:.{column.decimals}f} {column.unit}"
        for title in known
    }
    found = f"The lowest {column.title} is that of {best}, a mean of {shown[best]}"
    if len(known) == 1:
        return f"{found}.", "No other policy was played."
    cells = [_scores(rows, column) for _, rows in table.rows.groupby("cell")]
    ahead = [best_of(cell) == best for cell in cells]
    if len(ahead) > 1:
        found = f"{found}; it is ahead in {sum(ahead)} of {len(ahead)} cells"
    return f"{found}.", f"{known[-1]} comes last, with {shown[known[-1]]}."


def _scores(rows: pd.DataFrame, column: Column) -> Scores:
    """Mean of every policy over training seeds and cells [SI], and failures."""
    found = {}
    for title, own in rows.groupby("policy", sort=False):
        values = per_seed(own, column.metric)
        known = values[np.isfinite(values)]
        mean = float(known.mean()) if len(known) else float("nan")
        found[str(title)] = Estimate(mean), failures(own)
    return found


def _learning_sentence(results: Results) -> str:
    """Change by learning in the first judged metric, or that there are too few training seeds."""
    rows = [row for row in results.judged_changes if not row.is_rival]
    if not rows:
        return ""
    row = next((row for row in rows if row.is_group), rows[0])
    metric = f"the {row.column.title} of {row.base}"
    subject = f"{row.policy} changes {metric} in {row.scope}"
    if row.num_seeds >= FEWEST_SEEDS:
        return f"{subject} by {percent_interval(row.relative)}."
    few = f"{_count(row.num_seeds, 'training seed')} cannot tell that from chance"
    change = percent(row.relative.value)
    return f"{subject} by {change}; {few}, {FEWEST_SEEDS} are needed."


def _count(number: int, one: str, several: str = "") -> str:
    return f"{number} {one if number == 1 else several or f'{one}s'}"


def facts(results: Results) -> list[tuple[str, str]]:
    """The subject of the comparison, its date and versions: terms and texts."""
    table = results.table
    origin = results.metadata
    seeds = table.rows["seed"].tolist()
    per_cell = sorted({len(e.episodes) for e in results.evaluations})
    known = {name: version for name, version in origin["versions"].items() if version}
    versions = ", ".join(f"{name} {version}" for name, version in known.items())
    each = " and training seed" if table.members else ""
    played = f"{_span(per_cell)} per cell{each}, seeds {_span(sorted({min(seeds), max(seeds)}))}"
    return [
        ("policies", ", ".join(table.policies)),
        (f"{table.environment.quantity or 'reference'}s", ", ".join(table.references)),
        ("scenarios", ", ".join(table.scenarios)),
        ("episodes", played),
        ("made", f"{origin['created']}, commit {origin['commit'] or 'unknown'}"),
        ("versions", f"Python {origin['python']}, {versions}"),
        *((title, _training_text(family)) for title, family in table.families.items()),
    ]


def _training_text(origin: Origin) -> str:
    number = len(origin.folders)
    where = " to ".join(dict.fromkeys([origin.folders[0], origin.folders[-1]]))
    on = ", ".join(origin.scenarios or ["an unknown condition"])
    motion = "" if origin.reference is None else f" ({origin.reference})"
    commits = ", ".join(commit[:12] for commit in origin.commits)
    return f"{_count(number, 'training seed')}, trained on {on}{motion}; {where}; commit {commits}"


def in_short(results: Results) -> list[str]:
    """Gains by learning in a sentence each; then how many cells are better or worse."""
    found = [sentence for heat_map in results.maps for sentence in of_a_map(heat_map)]
    found += claims(results)
    pairs = group_by(results.judged_changes, lambda row: (row.policy, row.is_rival))
    for rows in pairs.values():
        for own in group_by(rows, lambda row: row.column).values():
            found += _of_a_metric(results, own)
        worse = [row for row in rows if row.falls_more and not row.is_group]
        if worse:
            places = [f"{row.scope}{_at(results, row)}" for row in worse]
            than = f"more {rows[0].failure} than {rows[0].base}"
            where = ", ".join(dict.fromkeys(places))
            found.append(f"{rows[0].policy}: {than} in {where}.")
    return found or [
        "No residual takes part: there are no training seeds, and differences are differences of"
        " means."
    ]


def of_a_map(heat_map: HeatMap) -> list[str]:
    """Who is best in how many cells of a map, and in how many learning is ahead."""
    where = f"{heat_map.column.title}, {heat_map.title}"
    cells = heat_map.flat
    wins = Counter(cell.best for cell in cells)
    ranked = sorted(heat_map.table.policies, key=lambda title: -wins[title])
    best = ", ".join(f"{title} in {wins[title]}" for title in ranked if wins[title])
    found = [f"{where}: best of {len(cells)} cells: {best}."]
    for title in heat_map.table.members:
        rows = [cell.learned[title] for cell in cells if title in cell.learned]
        values = [row.relative.value for row in rows if row.relative.is_known]
        if values:
            against = f"{title} against the {BEST_ANALYTIC} of each cell"
            span = f"from {percent(min(values))} to {percent(max(values))}"
            found.append(f"{where}: {against}: {_tally(rows)}; {span}.")
    return found


def _of_a_metric(results: Results, own: Sequence[Change]) -> list[str]:
    """Lines of a residual in one metric against one policy: pooled figures, and counts of cells."""
    policy = own[0].policy
    title = f"{policy} against {own[0].base}, {own[0].column.title}"
    has_rival = any(row.is_rival and row.policy == policy for row in results.changes)
    found = []
    for row in own:
        if row.is_group and not has_rival:
            figure = f"{percent_interval(row.relative)}{marks_text(row)}{_besides(row)}"
            where = f"{row.scope}{_at(results, row)}"
            found.append(f"{title}, pooled over {where}: {figure}.")
    cells = [row for row in own if not row.is_group]
    return [*found, f"{title}: {_tally(cells)}."] if cells else found


def claims(results: Results) -> list[str]:
    """Gains by learning over the base and to the best policy without learning, one per scope.

    Scopes are the groups; without groups the scenarios, where there are few.
    """
    rivals = [row for row in results.judged_changes if row.is_rival]
    others = [row for row in results.judged_changes if not row.is_rival]
    bases = {(row.policy, row.place, row.column): row for row in others[::-1]}
    shown = [row for row in rivals if row.is_group]
    if not shown and len({(row.policy, row.place) for row in rivals}) <= _MOST_CLAIMS:
        shown = rivals
    found = []
    for rival in shown:
        base = bases[rival.policy, rival.place, rival.column]
        pooled = "pooled over " if rival.is_group else ""
        where = f"{pooled}{rival.scope}{_at(results, rival)}{marks_text(rival)}"
        subject = f"{rival.policy}, {rival.column.title}, {where}"
        to_base = f"{_comparison(base)} than {base.base}, its base{_bounds(base)}"
        best = f"{rival.base}, the {BEST_ANALYTIC}{_bounds(rival)}"
        found.append(f"{subject}: {to_base}; {_comparison(rival)} than {best}.")
    return found


_MOST_CLAIMS = 4
"""Scopes and metrics of which each has a sentence, without groups."""


def _bounds(row: Change) -> str:
    """The interval of a change."""
    text = percent_interval(row.relative)
    return text[text.index(" [") :] if row.relative.has_interval else ""


def _comparison(row: Change) -> str:
    """How much lower or higher, before "than"."""
    value = row.relative.value
    if not np.isfinite(value):
        return "not comparable (no episode in which both stayed up), neither lower nor higher"
    size = f"{percent(abs(value), signed=False)} {'higher' if value > 0.0 else 'lower'}"
    return {
        "lower": size,
        "higher": size,
        "none": "not shown to be lower or higher",
        "unclear": f"{size} (too few training seeds to tell)",
    }[row.verdict]


def _besides(row: Change) -> str:
    """The part of a row's sentence that its figures do not say."""
    is_plain = row.verdict in ("lower", "higher") and ";" not in row.sentence
    return "" if is_plain else f": {row.sentence}"


def _tally(cells: Sequence[Change]) -> str:
    counts = Counter(row.verdict for row in cells)
    shown = {verdict: words for verdict, words in _VERDICTS.items() if counts[verdict]}
    found = [f"{words} in {counts[verdict]}" for verdict, words in shown.items()]
    return f"of {len(cells)} cells {', '.join(found)}"


_VERDICTS: Mapping[Verdict, str] = {
    "lower": "lower",
    "higher": "higher",
    "none": "no difference shown (the interval includes zero)",
    "unclear": "too few training seeds to tell",
}


def _at(results: Results, row: Change) -> str:
    parts = [row.reference] if len(results.table.references) > 1 else []
    parts += [f"{name}={value:g}" for name, value in row.swept.items()]
    return "".join(f", {part}" for part in parts)


def marks_text(row: Change) -> str:
    """Marks of a row in brackets."""
    return f" ({'; '.join(row.marks)})" if row.marks else ""


def notes(results: Results) -> list[str]:
    """Notes that a reader of this comparison needs."""
    marks = {mark for row in results.changes for mark in row.marks}
    kinds = (terms.HELD_OUT, terms.PARTLY, terms.CEILING, terms.SAME_ROBOT)
    text = load_template("notes.html.j2").render(
        failures=results.environment.failures,
        walks=results.environment.walks,
        families=results.table.families,
        maps=results.maps,
        has_rivals=any(row.is_rival for row in results.changes),
        marks={kind for kind in kinds if any(mark.startswith(kind) for mark in marks)},
        terms=terms,
    )
    return [" ".join(note.split()) for note in text.split("\n\n") if note.strip()]


def _span(numbers: Sequence[int]) -> str:
    return str(numbers[0]) if len(numbers) == 1 else f"{numbers[0]} to {numbers[-1]}"


def capital(text: str) -> str:
    """With a capital at the beginning."""
    return text[:1].upper() + text[1:]
