"""Results of a comparison, and the sentences of its report, for all formats."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import pandas as pd

from train.evaluate import change_text
from train.evaluate.change_text import BEST_ANALYTIC
from train.evaluate.changes import Change, Verdict
from train.evaluate.environments import Column, Environment
from train.evaluate.episodes import Evaluation, group_by
from train.evaluate.leaderboard_rows import Standing
from train.evaluate.learning_curves import Curves, learning_curves
from train.evaluate.maps import HeatMap
from train.evaluate.residual_seeds import Origin
from train.evaluate.robots import RobotScores
from train.evaluate.scores import Scores, best_of, failures, ranking
from train.evaluate.statistics import Estimate
from train.evaluate.table import EpisodeTable
from train.figures.colours import policy_colours
from train.report.templates import load_template


@dataclass(frozen=True)
class Results:
    """The results that a report shows.

    Attributes:
        name: Name of the comparison.
        evaluations: All cells, one per training seed.
        changes: Paired changes.
        folder: Folder of the comparison's files and metadata.
        swept: Label of the axis of a sweep; None without one.
        maps: Heat maps over two axes; empty without a map.
        standings: Rows of the leaderboard; empty without one.
        robots: Scores over the robots of cells that draw them.
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
        """Learning curves of the families whose folders are in a training run."""
        families = self.table.families.items()
        judged = self.environment.judged
        curves = {title: learning_curves(f.folders, judged) for title, f in families}
        return {title: curve for title, curve in curves.items() if curve is not None}

    @cached_property
    def metadata(self) -> Mapping[str, Any]:
        """Origin of the comparison: date, seed, commit, versions."""
        return json.loads((self.folder / "metadata.json").read_text(encoding="utf-8"))

    @property
    def grouped_changes(self) -> dict[str, list[Change]]:
        """Changes by kinds of the compared policies."""
        kinds = group_by(self.changes, lambda row: (row.is_family, row.is_rival))
        return {
            "Residuals against their base": kinds.get((True, False), []),
            f"Residuals against the {BEST_ANALYTIC}": kinds.get((True, True), []),
            "Baselines against one another": kinds.get((False, False), []),
        }

    @property
    def judged_changes(self) -> list[Change]:
        """Changes of residuals in judged metrics."""
        return [row for row in self.changes if row.is_family and row.is_judged]

    @property
    def compared_pairs(self) -> list[list[Change]]:
        """`judged_changes` by residual and kind of opponent."""
        pairs = group_by(self.judged_changes, lambda row: (row.policy, row.is_rival))
        return list(pairs.values())

    @property
    def rivalled_residuals(self) -> set[str]:
        """Residuals that are compared with the best policy without learning."""
        return {row.policy for row in self.changes if row.is_rival}

    @property
    def claims(self) -> list[tuple[Change, Change]]:
        """Changes against the best policy without learning, each with the change against the base.

        They are the changes in groups. Without groups, they are those in scenarios, if there are
        few.
        """
        rivals = [row for row in self.judged_changes if row.is_rival]
        others = [row for row in self.judged_changes if not row.is_rival]
        bases = {(row.policy, row.place, row.column): row for row in others[::-1]}
        shown = [row for row in rivals if row.is_group]
        if not shown and len({(r.policy, r.place) for r in rivals}) <= _MAX_CLAIMS:
            shown = rivals
        return [(row, bases[row.policy, row.place, row.column]) for row in shown]

    @property
    def has_conditions(self) -> bool:
        """True if the cells are separate conditions, not points of a curve or a map."""
        return self.swept is None and not self.maps


_MAX_CLAIMS = 4
"""Most pairs of residual and scenario that have a sentence each, if there are no groups."""


def sentences(kind: Literal["headline", "in_short", "notes"], results: Results) -> list[str]:
    """Return the paragraphs that a macro of `sentences.j2` writes about the results."""
    kinds = (change_text.HELD_OUT, change_text.PARTLY, change_text.CEILING, change_text.SAME_ROBOT)
    marks = {mark for row in results.changes for mark in row.marks}
    helpers = {
        "change_text": change_text,
        "failures": failures,
        "ranked": _rank_policies,
        "by_metric": lambda rows: group_by(rows, lambda row: row.column).values(),
        "marks": [kind for kind in kinds if any(m.startswith(kind) for m in marks)],
        "verdict_words": _VERDICTS,
    }
    text = getattr(load_template("sentences.j2").make_module(helpers), kind)(results)
    parts = [re.sub(r"[ \n]+", " ", part).strip() for part in text.split("\n\n")]
    return list(filter(None, parts))


def _rank_policies(table: EpisodeTable) -> list[dict[str, Any]]:
    """Return the policies from the best to the worst by the first judged metric.

    Each has its score as text, and for every cell whether it is ahead.
    """
    column = table.environment.judged[0]
    scores = _scores(table.rows, column)
    cells = [_scores(rows, column) for _, rows in table.rows.groupby("cell")]
    return [
        {
            "policy": title,
            "score": f"{column.scale * scores[title][0].value:.{column.decimals}f} {column.unit}",
            "is_ahead": [best_of(cell) == title for cell in cells],
        }
        for title in ranking(scores)
    ]


def _scores(rows: pd.DataFrame, column: Column) -> Scores:
    """Return the mean of every policy over training seeds and cells [SI], and failures."""
    scores = {}
    for title, episodes in rows.groupby("policy", sort=False):
        means: Any = episodes.groupby(["member", "cell"])[column.metric].mean()
        scores[str(title)] = Estimate(float(means.mean())), failures(episodes)
    return scores


_VERDICTS: Mapping[Verdict, str] = {
    "lower": "lower",
    "higher": "higher",
    "none": "no difference shown (the interval includes zero)",
    "unclear": "too few training seeds to tell",
}


def facts(results: Results) -> list[tuple[str, str]]:
    """Return terms and texts: policies, episodes, date, versions, trainings."""
    table = results.table
    origin = results.metadata
    seeds = table.rows["seed"].tolist()
    per_cell = sorted({len(e.episodes) for e in results.evaluations})
    versions = [f"{name} {v}" for name, v in origin["versions"].items() if v]
    each = " and training seed" if table.members else ""
    played = f"{span(per_cell)} per cell{each}, seeds {span(sorted({min(seeds), max(seeds)}))}"
    return [
        ("policies", ", ".join(table.policies)),
        (f"{table.environment.quantity or 'reference'}s", ", ".join(table.references)),
        ("scenarios", ", ".join(table.scenarios)),
        ("episodes", played),
        ("made", f"{origin['created']}, commit {origin['commit'] or 'unknown'}"),
        ("versions", f"Python {origin['python']}, {', '.join(versions)}"),
        *((title, _training_text(family)) for title, family in table.families.items()),
    ]


def _training_text(origin: Origin) -> str:
    number = len(origin.folders)
    seeds = f"{number} training seed{'s' * (number != 1)}"
    where = " to ".join(dict.fromkeys([origin.folders[0], origin.folders[-1]]))
    on = ", ".join(origin.scenarios or ["an unknown condition"])
    motion = "" if origin.reference is None else f" ({origin.reference})"
    commits = ", ".join(commit[:12] for commit in origin.commits)
    return f"{seeds}, trained on {on}{motion}; {where}; commit {commits}"


def span(numbers: Sequence[int]) -> str:
    """Return the ends of rising numbers: 4, or 4 to 8."""
    return str(numbers[0]) if len(numbers) == 1 else f"{numbers[0]} to {numbers[-1]}"


def capital(text: str) -> str:
    """Return a text with a capital at the beginning."""
    return text[:1].upper() + text[1:]
