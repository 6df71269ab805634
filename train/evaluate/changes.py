"""Paired changes of a comparison: residuals against bases and rivals, baselines against bases.

A residual is compared with its base and with the best policy without learning. A baseline is
compared with the base of the residuals, or without residuals with the first policy.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import Any, Literal

import numpy as np
import pandas as pd

from elastic_env.core.signals import Array
from train.evaluate.change_text import FEWEST_SEEDS, percent
from train.evaluate.environments import Column
from train.evaluate.episodes import Evaluation, group_by
from train.evaluate.scores import (
    EpisodesByRobot,
    episodes_as_robots,
    failures,
    match_episodes,
    means_of_cells,
    pair,
)
from train.evaluate.statistics import (
    Counts,
    Estimate,
    change,
    estimate,
    improvement,
    interquartile_mean,
)
from train.evaluate.table import EpisodeTable, Groups, Scope
from train.evaluate.training_marks import training_marks

Verdict = Literal["lower", "higher", "none", "unclear"]


@dataclass(frozen=True, eq=False)
class Change(Scope):
    """A policy against its base in one metric, in one scenario or pooled over a group of them.

    Attributes:
        base: Title of the base.
        marks: Limits of what the row shows: a ceiling, or a condition that training never saw.
        column: The metric.
        is_judged: True if policies are judged by the metric; otherwise it is only in tables.
        per_seed: Relative change of every training seed, (seeds,); nan where it has no pair of
            episodes. One value for a baseline.
        relative: Interquartile mean of `per_seed`. Its interval is over training seeds, and over
            the robots of the cells that draw them.
        improvement: Probability that an episode is better than the base's.
        mine, theirs: Metric of the policy and of its base over the pairs [SI], interquartile mean
            over training seeds.
        num_pairs: Pairs of training seed and episode.
        falls, episodes: Failed episodes of the policy, and all of its episodes.
        base_falls, base_episodes: The same of the base.
        is_rival: True if `base` is not the base of the residual but the best policy without
            learning.
    """

    base: str
    marks: tuple[str, ...]
    column: Column
    is_judged: bool
    per_seed: Array
    relative: Estimate
    improvement: Estimate
    mine: float
    theirs: float
    num_pairs: int
    falls: int
    episodes: int
    base_falls: int
    base_episodes: int
    is_rival: bool = False

    @property
    def num_seeds(self) -> int:
        """Training seeds; 0 of a baseline."""
        return len(self.per_seed) if self.is_family else 0

    @property
    def num_compared(self) -> int:
        """Training seeds that have a pair of episodes in every cell."""
        return int(np.isfinite(self.per_seed).sum())

    @property
    def verdict(self) -> Verdict:
        """lower, higher, none (the interval includes zero), or unclear.

        It is unclear with too few training seeds. For a policy without training it is unclear with
        too few robots and episodes.
        """
        low = self.relative.low
        high = self.relative.high
        units = self.relative.robots + self.relative.episodes
        if self.is_family:
            units = self.num_compared
        if low is None or high is None or units < FEWEST_SEEDS:
            return "unclear"
        return "lower" if high < 0.0 else "higher" if low > 0.0 else "none"

    @property
    def falls_more(self) -> bool:
        """True if the policy fails in a greater share of its episodes than its base."""
        return self.falls * self.base_episodes > self.base_falls * self.episodes

    @property
    def falls_less(self) -> bool:
        """True if the policy fails in a smaller share of its episodes than its base."""
        return self.falls * self.base_episodes < self.base_falls * self.episodes

    @property
    def sentence(self) -> str:
        """The row in a sentence: the change, and the limits of what it shows."""
        parts = [self._change_text]
        missing = len(self.per_seed) - self.num_compared
        if self.is_family and 0 < missing < self.num_seeds:
            seeds = f"{missing} of {self.num_seeds} training seeds"
            parts.append(f"{seeds} have nothing to compare and are not in it")
        if self.falls_more:
            parts.append(f"MORE {self.failure.upper()} than {self.base}")
        elif self.falls_less:
            parts.append(f"fewer {self.failure} than {self.base}")
        return "; ".join(parts)

    @property
    def _change_text(self) -> str:
        value = self.relative.value
        if not np.isfinite(value):
            scope = "in one of the scenarios " if self.is_group else ""
            problem = "there is no episode in which both stayed up to the end"
            return f"nothing to compare: {scope}{problem}"
        size = f"{percent(abs(value), signed=False)} {'lower' if value < 0.0 else 'higher'}"
        if value == 0.0:
            size = "no change"
        over = self.relative.over
        if not self.is_family and not over:
            return f"{size} (difference of means, no training seeds)"
        if self.verdict == "none":
            return "the interval includes zero: no difference shown"
        if self.verdict != "unclear":
            return size
        if not over:
            return f"{size} with one training seed: no interval"
        if self.is_family and self.num_compared == 1:
            return f"{size} with one training seed: the interval is over {over} alone"
        return f"{size} with {over}: too few to tell it from chance"


def opponents(table: EpisodeTable) -> dict[str, list[str]]:
    """Titles of the policies that each policy is compared with.

    A residual has a base and a rival. A baseline has the bases of the residuals, or the first
    policy.
    """
    families = table.members.values()
    bases = dict.fromkeys(m.base for family in families for m in family.values())
    result = {}
    for title in table.policies:
        others: Sequence[str | None] = list(bases) or table.policies[:1]
        if title in table.members:
            member = next(reversed(table.members[title].values()))
            others = (member.base, member.rival)
        result[title] = [other for other in others if other not in (title, None)]
    return result


def changes(evaluations: Sequence[Evaluation], groups: Groups | None = None) -> list[Change]:
    """All paired changes of a comparison.

    Args:
        evaluations: All cells, one per training seed.
        groups: Scenarios to pool over, by name.
    """
    table = EpisodeTable(evaluations)
    environment = table.environment
    columns = (*environment.judged, *environment.also)
    return [
        row
        for title, others in opponents(table).items()
        for base in others
        if base in table.policies
        for scope in table.scopes(title, groups or {})
        if len(table.cells_of_base(scope, base)) == len(scope.cells)
        for row in changes_of(table, scope, base, columns)
    ]


def changes_of(
    table: EpisodeTable, scope: Scope, base: str, columns: Iterable[Column]
) -> list[Change]:
    """The changes of a policy against another one, one per metric.

    Args:
        table: All episodes.
        scope: Policy and cells; over several cells the means are pooled.
        base: Title of the other policy, which plays in all of these cells.
        columns: The metrics.

    Raises:
        ValueError: A seed occurs twice, so that episodes cannot be paired.
    """
    rows = table.rows_of(scope.policy, *scope.cells)
    is_drawn = [rows.loc[rows["cell"] == cell, "robot"].iloc[0] != "" for cell in scope.cells]
    member = scope.first.member
    if member is None:
        rows = episodes_as_robots(rows)
    cell_pairs = zip(table.cells_of_base(scope, base), scope.cells, strict=True)
    base_rows = pd.concat(
        [table.rows_of(base, other).assign(cell=cell) for other, cell in cell_pairs]
    )
    matched = match_episodes(rows, base_rows)
    robots = EpisodesByRobot(rows)
    falls, episodes = failures(rows)
    base_falls, base_episodes = failures(base_rows)
    marks = training_marks(table.families.get(scope.policy), scope.conditions)
    return [
        Change(
            **vars(scope),
            **_paired_figures(robots, pair(rows, matched, column.metric), is_drawn),
            base=base,
            marks=marks,
            column=column,
            is_judged=column in table.environment.judged,
            falls=falls,
            episodes=episodes,
            base_falls=base_falls,
            base_episodes=base_episodes,
            is_rival=member is not None and base == member.rival,
        )
        for column in columns
    ]


def _paired_figures(
    by_robot: EpisodesByRobot, pairs: pd.DataFrame, is_drawn: Sequence[bool]
) -> dict[str, Any]:
    """Figures of a `Change` from the pairs of one metric.

    Args:
        by_robot: Groups the pairs.
        pairs: As `pair` returns them.
        is_drawn: True for every cell that draws robots.
    """
    own_values = by_robot.figures(pairs["mine"])
    base_values = by_robot.figures(pairs["base"])
    robots = [values.shape[1] for values in own_values]
    once = [np.ones((1, number)) for number in robots]
    own_means = means_of_cells(own_values, once)[:, 0].T
    base_means = means_of_cells(base_values, once)[:, 0].T

    def relative(counts: Counts) -> Array:
        sides = (means_of_cells(v, counts).T for v in (own_values, base_values))
        return change(*sides).T

    won, played = (
        [np.nan_to_num(values) for values in by_robot.figures(pairs["won"], statistic)]
        for statistic in ("sum", "count")
    )
    return {
        "per_seed": change(own_means, base_means),
        "relative": count_episodes_apart(estimate(relative, robots), robots, is_drawn),
        "improvement": count_episodes_apart(improvement(won, played), robots, is_drawn),
        "mine": _mean_over_seeds(own_means),
        "theirs": _mean_over_seeds(base_means),
        "num_pairs": int(sum(values.sum() for values in played)),
    }


def count_episodes_apart(
    total: Estimate, units: Sequence[int], is_drawn: Sequence[bool]
) -> Estimate:
    """Return an estimate that counts drawn robots and episodes of one robot apart.

    Args:
        total: Estimate that counts all of these units as robots.
        units: Robots or episodes of every cell.
        is_drawn: True for every cell whose units are robots.
    """
    if not total.robots:
        return total
    robots = sum(n for n in compress(units, is_drawn) if n > 1)
    return replace(total, robots=robots, episodes=total.robots - robots)


def _mean_over_seeds(values: Array) -> float:
    """Interquartile mean over training seeds of means over scenarios, (seeds, scenarios)."""
    means = np.mean(values, axis=-1)
    means = means[np.isfinite(means)]
    return float(interquartile_mean(means)) if len(means) else float("nan")


def group_lines(rows: Sequence[Change]) -> list[list[Change]]:
    """Return the lines of a table: changes of one policy, base and cell, one per metric."""
    return list(group_by(rows, lambda row: (row.policy, row.base, row.place)).values())
