"""The results of a comparison, and the sentences of a report, whatever it is written in."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from train.evaluate.changes import (
    BEST_ANALYTIC,
    CEILING,
    CLAIM_SEEDS,
    FEWEST_SEEDS,
    HELD_OUT,
    PARTLY,
    SAME_ROBOT,
    SIGNS_ARE,
    Change,
    percent,
    percent_interval,
)
from train.evaluate.environments import Column, Environment
from train.evaluate.episodes import Evaluation
from train.evaluate.families import Origin
from train.evaluate.maps import HeatMap, best_of
from train.evaluate.progress import Curves, learning_curves
from train.evaluate.robots import RobotScores
from train.evaluate.standings import Standing
from train.evaluate.statistics import Estimate
from train.evaluate.table import EpisodeTable, failures, per_seed
from train.figures.colours import policy_colours


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
        columns = self.environment.judged
        families = self.table.families.items()
        found = {title: learning_curves(origin.folders, columns) for title, origin in families}
        return {title: curves for title, curves in found.items() if curves is not None}

    @cached_property
    def metadata(self) -> Mapping[str, Any]:
        """Origin of the comparison: date, seed, commit, versions."""
        return json.loads((self.folder / "metadata.json").read_text(encoding="utf-8"))

    @property
    def grouped_changes(self) -> dict[str, list[Change]]:
        """Changes by what is compared with what."""
        return {
            "Residuals against their base": [
                row for row in self.changes if row.is_family and not row.is_rival
            ],
            f"Residuals against the {BEST_ANALYTIC}": [row for row in self.changes if row.is_rival],
            "Baselines against one another": [row for row in self.changes if not row.is_family],
        }

    @property
    def has_conditions(self) -> bool:
        """True if its cells are conditions of their own, and not points of a curve or a map."""
        return self.swept is None and not self.maps


def headline(results: Results) -> str:
    """Three sentences: what was played and what failed, who is best, and what learning adds, or
    who comes last.
    """
    table = results.table
    failed, played = failures(table.rows)
    of_these = f"of which {failed} failed" if failed else "none of which failed"
    first = (
        f"{_count(len(table.policies), 'policy', 'policies')} played {_count(played, 'episode')} in"
        f" {_count(len(table.scenarios), 'scenario')}, {of_these}."
    )
    best, worst = _best_and_worst(table)
    return " ".join([first, best, _learning_sentence(results) or worst])


def _best_and_worst(table: EpisodeTable) -> tuple[str, str]:
    """Sentences on the best and the worst policy by the first judged metric; one that fails less
    often is better.
    """
    column = table.environment.judged[0]
    scores = _scores(table.rows, column)
    best = best_of(scores)
    if best is None:
        return f"No policy has a {column.title}.", "No episode reached its end."
    others = [title for title in scores if title != best and scores[title][0].is_known]
    worst = max(
        others or [best],
        key=lambda title: (scores[title][1][0] / scores[title][1][1], scores[title][0].value),
    )
    shown = {
        t: f"{column.scale * scores[t][0].value:.{column.decimals}f} {column.unit}"
        for t in (best, worst)
    }
    found = f"The lowest {column.title} is that of {best}, a mean of {shown[best]}"
    ahead = [best_of(_scores(rows, column)) == best for _, rows in table.rows.groupby("cell")]
    where = (
        f"; it is ahead in {sum(ahead)} of {len(ahead)} cells" if len(ahead) > 1 and others else ""
    )
    last = f"{worst} comes last, with {shown[worst]}." if others else "No other policy was played."
    return f"{found}{where}.", last


def _scores(rows: pd.DataFrame, column: Column) -> dict[str, tuple[Estimate, tuple[int, int]]]:
    """Mean of every policy over training seeds and cells with an episode that reached its end
    [SI], and failures.
    """
    found = {}
    for title, own in rows.groupby("policy", sort=False):
        values = per_seed(own, column.metric)
        known = values[np.isfinite(values)]
        mean = float(known.mean()) if len(known) else float("nan")
        found[str(title)] = Estimate(mean), failures(own)
    return found


def _learning_sentence(results: Results) -> str:
    """Change by learning in the first judged metric, or that there are too few training seeds to
    judge.
    """
    rows = [row for row in results.changes if row.is_family and row.is_judged and not row.is_rival]
    if not rows:
        return ""
    row = next((row for row in rows if row.is_group), rows[0])
    found = f"{row.policy} changes the {row.column.title} of {row.base} in {row.scope} by"
    if row.num_seeds < FEWEST_SEEDS:
        few = (
            f"{_count(row.num_seeds, 'training seed')} cannot tell that from chance, {FEWEST_SEEDS}"
            " are needed"
        )
        return f"{found} {percent(row.relative.value)}; {few}."
    return f"{found} {percent_interval(row.relative)}."


def _count(number: int, one: str, several: str = "") -> str:
    return f"{number} {one if number == 1 else several or f'{one}s'}"


def facts(results: Results) -> list[tuple[str, str]]:
    """The subject of the comparison, its date and versions: terms and texts."""
    table = results.table
    origin = results.metadata
    seeds = table.rows["seed"].tolist()
    per_cell = sorted({len(e.episodes) for e in results.evaluations})
    versions = ", ".join(
        f"{name} {version}" for name, version in origin["versions"].items() if version
    )
    quantity = table.environment.quantity or "reference"
    each = " and training seed" if table.members else ""
    found = [
        ("policies", ", ".join(table.policies)),
        (f"{quantity}s", ", ".join(table.references)),
        ("scenarios", ", ".join(table.scenarios)),
        (
            "episodes",
            f"{_span(per_cell)} per cell{each}, seeds {_span(sorted({min(seeds), max(seeds)}))}",
        ),
        ("made", f"{origin['created']}, commit {origin['commit'] or 'unknown'}"),
        ("versions", f"Python {origin['python']}, {versions}"),
    ]
    return found + [(title, _training_text(origin)) for title, origin in table.families.items()]


def _training_text(origin: Origin) -> str:
    number = len(origin.folders)
    where = origin.folders[0] if number == 1 else f"{origin.folders[0]} to {origin.folders[-1]}"
    on = "an unknown condition" if origin.scenarios is None else ", ".join(origin.scenarios)
    motion = "" if origin.reference is None else f" ({origin.reference})"
    seeds = f"{number} training seed{'s' * (number != 1)}"
    return (
        f"{seeds}, trained on {on}{motion}; {where}; commit"
        f" {', '.join(commit[:12] for commit in origin.commits)}"
    )


def in_short(results: Results) -> list[str]:
    """Gains by learning in a sentence each; then per residual and metric in how many cells it is
    better, or worse.
    """
    found = [sentence for heat_map in results.maps for sentence in of_a_map(heat_map)] + claims(
        results
    )
    for title in results.table.members:
        for is_rival in (False, True):
            rows = [
                r
                for r in results.changes
                if r.policy == title and r.is_judged and r.is_rival == is_rival
            ]
            for column in dict.fromkeys(row.column for row in rows):
                found += _of_a_metric(results, [row for row in rows if row.column == column])
            worse = [row for row in rows if row.falls_more and not row.is_group]
            if worse:
                where = ", ".join(dict.fromkeys(f"{row.scope}{_at(results, row)}" for row in worse))
                found.append(f"{title}: more {worse[0].failure} than {worse[0].base} in {where}.")
    return found or [
        "No residual takes part: there are no training seeds, and differences are differences of"
        " means."
    ]


def of_a_map(heat_map: HeatMap) -> list[str]:
    """Who is best in how many cells of a map, and where learning is ahead of the best policy
    without it.
    """
    where = f"{heat_map.column.title}, {heat_map.title}"
    cells = heat_map.flat
    wins = {title: sum(cell.best == title for cell in cells) for title in heat_map.policies}
    ranking = sorted((title for title in wins if wins[title]), key=lambda title: -wins[title])
    found = [
        f"{where}: best of {len(cells)} cells: "
        + ", ".join(f"{title} in {wins[title]}" for title in ranking)
        + "."
    ]
    for title in heat_map.families:
        rows = [cell.learned[title] for cell in cells if title in cell.learned]
        values = [row.relative.value for row in rows if np.isfinite(row.relative.value)]
        if values:
            span = f"from {percent(min(values))} to {percent(max(values))}"
            found.append(
                f"{where}: {title} against the {BEST_ANALYTIC} of each cell: {_tally(rows)};"
                f" {span}."
            )
    return found


def _of_a_metric(results: Results, own: Sequence[Change]) -> list[str]:
    """Lines of a residual in one metric against one other policy: pooled figures, and in how
    many cells what holds.
    """
    found = [
        f"{row.policy} against {row.base}, {row.column.title}, pooled over"
        f" {row.scope}{_at(results, row)}:"
        f" {percent_interval(row.relative)}{marks_text(row)}{_besides(row)}."
        for row in own
        if row.is_group and not any(c.is_rival and c.policy == row.policy for c in results.changes)
    ]
    cells = [row for row in own if not row.is_group]
    if cells:
        found.append(
            f"{cells[0].policy} against {cells[0].base}, {cells[0].column.title}: {_tally(cells)}."
        )
    return found


def claims(results: Results) -> list[str]:
    """Gains by learning over the base of a residual, and to the best policy without learning: a
    sentence per scope.

    Scopes are the groups; without groups the scenarios, where there are few.
    """
    judged = [row for row in results.changes if row.is_family and row.is_judged]
    rivals = [row for row in judged if row.is_rival]
    pooled = [row for row in rivals if row.is_group]
    few = (
        len({(row.policy, row.reference, row.scope, *row.swept.items()) for row in rivals})
        <= _MOST_CLAIMS
    )
    found = []
    for rival in pooled or (rivals if few else []):
        base = next(
            row
            for row in judged
            if not row.is_rival
            and (row.policy, row.reference, row.scope, row.is_group, row.swept, row.column)
            == (
                rival.policy,
                rival.reference,
                rival.scope,
                rival.is_group,
                rival.swept,
                rival.column,
            )
        )
        where = f"{'pooled over ' if rival.is_group else ''}{rival.scope}{_at(results, rival)}"
        found.append(
            f"{rival.policy}, {rival.column.title}, {where}{marks_text(rival)}: {_comparison(base)}"
            f" than {base.base}, its base{_bounds(base)}; {_comparison(rival)} than {rival.base},"
            f" the {BEST_ANALYTIC}{_bounds(rival)}."
        )
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
    counts = {
        "lower": [row for row in cells if row.verdict == "lower"],
        "higher": [row for row in cells if row.verdict == "higher"],
        "no difference shown (the interval includes zero)": [
            row for row in cells if row.verdict == "none"
        ],
        "too few training seeds to tell": [row for row in cells if row.verdict == "unclear"],
    }
    parts = [f"{words} in {len(rows)}" for words, rows in counts.items() if rows]
    return f"of {len(cells)} cells " + ", ".join(parts)


def _at(results: Results, row: Change) -> str:
    several = len(results.table.references) > 1
    swept = [f"{name}={value:g}" for name, value in row.swept.items()]
    return "".join(f", {part}" for part in [*([row.reference] if several else []), *swept])


def marks_text(row: Change) -> str:
    """Marks of a row in brackets."""
    return f" ({'; '.join(row.marks)})" if row.marks else ""


def notes(results: Results) -> list[str]:
    """Notes that a reader of this comparison needs."""
    failure = results.environment.failures
    notes = [
        (
            "A change is the mean of a policy over the episodes, over the mean of its base over"
            " the same episodes, minus one. An episode in which either did not reach the end is"
            f" left out of both and counted under {failure}. Below zero is better."
        ),
    ]
    if results.table.members:
        notes.append(
            "Figures of residuals are interquartile means over training seeds with 95 % percentile"
            " bootstrap intervals over training seeds (never over the episodes of one); where a"
            " table shows base → policy, plain means. With five training seeds such an interval"
            " misses the truth in one of eleven cases, with ten in one of sixteen; fewer than five"
            " are not judged. A base has no training seed, so it has no interval. Pooled: means"
            " over scenarios are compared, per training seed."
        )
        notes.append(
            "Better than base: share of all pairs of training seed and episode in which the"
            " residual is ahead, ties as one half."
        )
    if results.maps:
        notes.append(
            f"The {BEST_ANALYTIC} of a cell is the one with the lowest mean on that cell's"
            " episodes, among those that read the standard sensors. It is chosen after the fact,"
            " which favours it. Failures count before scores: who fails less often is the better"
            f" one. {SIGNS_ARE}"
        )
    if any(row.is_rival for row in results.changes):
        notes.append(
            f"The {BEST_ANALYTIC} reads the same sensors as the residual (encoders, foot sensors"
            " and IMU). The change against the base says what learning adds to that compensator;"
            " the change against this policy says what it adds to good practice."
        )
    marks = {mark for row in results.changes for mark in row.marks}
    if any(mark.startswith(HELD_OUT) for mark in marks):
        notes.append(
            f"Marked {HELD_OUT!r}: nothing of this scenario, or of this motion, was seen in"
            " training."
        )
    if any(mark.startswith(PARTLY) for mark in marks):
        notes.append(
            f"Marked {PARTLY!r}: the scenarios that are named were not seen in training, the others"
            " were."
        )
    if CEILING in marks:
        notes.append(
            f"Marked {CEILING!r}: the scenario is deterministic and the residual was trained on it,"
            " so that training and evaluation see the same. It says what is possible, not what is"
            " to be expected."
        )
    if any(mark.startswith(SAME_ROBOT) for mark in marks):
        notes.append(
            f"Marked {SAME_ROBOT!r}: training and evaluation have the same robot and motion there,"
            " and differ by sensor noise alone. It says that the residual has learned this robot,"
            " not that it fits others."
        )
    for title, origin in results.table.families.items():
        if len(origin.folders) == 1:
            notes.append(
                f"{title} is a single training seed: another one may come out differently."
            )
        elif len(origin.folders) < FEWEST_SEEDS:
            notes.append(
                f"{title} has but {len(origin.folders)} training seeds: too few to judge by its"
                " intervals."
            )
        elif len(origin.folders) < CLAIM_SEEDS:
            notes.append(
                f"{title} has {len(origin.folders)} training seeds. Intervals over so few exclude"
                f" zero too often, so its verdicts are provisional; a claim needs {CLAIM_SEEDS}."
            )
        if origin.missing_seeds:
            missing = ", ".join(map(str, origin.missing_seeds))
            notes.append(f"{title} lacks training seeds of its configuration: {missing}.")
    return notes


def _span(numbers: Sequence[int]) -> str:
    return str(numbers[0]) if len(numbers) == 1 else f"{numbers[0]} to {numbers[-1]}"


def capital(text: str) -> str:
    """With a capital at the beginning."""
    return text[:1].upper() + text[1:]
