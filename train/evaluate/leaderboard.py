"""The leaderboard of a comparison: scores of policies over groups of scenarios, in tracks by what a policy needs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from baselines.catalogue import Track
from train.evaluate.changes import Change, Groups, by_cell, paired
from train.evaluate.conditions import Condition
from train.evaluate.environments import Column
from train.evaluate.episodes import Evaluation, group_by
from train.evaluate.maps import best_of, failed_of
from train.evaluate.statistics import Estimate, over_seeds


@dataclass(frozen=True)
class Paired:
    """A paired change of a residual.

    Attributes:
        to: Title of the policy that it is compared with.
        change: Change of its score on the same episodes [1].
        verdict: As `Change.verdict`.
    """

    to: str
    change: Estimate
    verdict: str

    @classmethod
    def of(cls, row: Change) -> Self:
        """What a leaderboard keeps of a change."""
        return cls(row.base, row.relative, row.verdict)


@dataclass(frozen=True)
class Standing:
    """A policy in one metric, in one scenario or over a group of them: a row of `leaderboard.csv`.

    Attributes:
        track: What the policy needs.
        policy: Its title.
        reference: Label of the motion.
        scope: Scenario, or name of the group.
        is_group: Whether it is a group.
        is_column: Whether it is a column of the leaderboard; else it stands in the table of single scenarios.
        title: Words for the metric.
        metric: Its name, with its unit in SI.
        score: Mean over scenarios of means over the episodes that did not fail; of residuals the interquartile mean
            over training seeds with its interval; nan where a scenario has no such episode.
        failed, episodes: Episodes that failed, and all.
        training_seeds: Of a residual; 0 of another policy.
        base: Of a residual: its change against its base.
        rival: Of a residual: its change against the best policy without learning and with the standard sensors, in the
            same scope and metric. It is chosen on the same episodes, which favours it.
        step_us: Median time of the policy alone for a control step of one world [µs].
    """

    track: Track
    policy: str
    reference: str
    scope: str
    is_group: bool
    is_column: bool
    title: str
    metric: str
    score: Estimate
    failed: int
    episodes: int
    training_seeds: int
    base: Paired | None
    rival: Paired | None
    step_us: float


def standings(
    evaluations: Sequence[Evaluation], changes: Sequence[Change], groups: Groups, step_us: Mapping[str, float]
) -> list[Standing]:
    """The leaderboard, a row per policy, motion, scope and judged metric.

    Columns are, for each motion, the groups whose scenarios are all played with it, and the scenarios that are in none
    of these groups.

    Args:
        evaluations: All cells, one per training seed.
        changes: Paired changes of the same.
        groups: Scenarios to pool over, by name.
        step_us: Time per step of every policy, by its title.
    """
    scopes = _scopes(evaluations, groups)
    rivals = group_by([s for s in scopes if s.first.track is Track.STANDARD], lambda s: s.name)
    return [
        _standing(scope, column, changes, rivals.get(scope.name, []), step_us)
        for scope in scopes
        for column in scope.first.environment.judged
    ]


@dataclass(frozen=True)
class _Scope:
    """A policy in one scenario, or in a group of them.

    Attributes:
        name: Label of the motion, scenario or group, and whether it is a group.
        is_column: Whether it is a column of the leaderboard.
        cells: Its scenarios, each with an evaluation per training seed.
    """

    name: tuple[str, str, bool]
    is_column: bool
    cells: Sequence[Sequence[Evaluation]]

    @property
    def first(self) -> Condition:
        """A condition of the policy."""
        return self.cells[0][0].condition

    @property
    def failed(self) -> tuple[int, int]:
        """Episodes that failed, and all."""
        counts = [failed_of(members) for members in self.cells]
        return sum(failed for failed, _ in counts), sum(played for _, played in counts)


def _scopes(evaluations: Sequence[Evaluation], groups: Groups) -> list[_Scope]:
    """Scenarios and whole groups of every policy and motion, in the order of policies and motions."""
    found = []
    for title in dict.fromkeys(e.condition.policy.title for e in evaluations):
        cells = by_cell([e for e in evaluations if e.condition.policy.title == title])
        for reference in dict.fromkeys(e.condition.reference_name for e in evaluations):
            own = {str(key[1]): members for key, members in cells.items() if key[0] == reference}
            whole = {name: parts for name, parts in groups.items() if all(part in own for part in parts)}
            grouped_ones = {part for parts in whole.values() for part in parts}
            found += [
                _Scope((reference, name, True), is_column=True, cells=[own[part] for part in parts])
                for name, parts in whole.items()
            ]
            found += [
                _Scope((reference, part, False), is_column=part not in grouped_ones, cells=[members])
                for part, members in own.items()
            ]
    return found


def pooled(cells: Sequence[Sequence[Evaluation]], column: Column) -> Estimate:
    """Mean over scenarios of means over episodes [SI]; of training seeds the interquartile mean.

    Args:
        cells: Scenarios, each with an evaluation per training seed.
        column: The metric.
    """
    means = np.array([[_mean(e, column) for e in members] for members in cells]).mean(axis=0)
    return Estimate(float(means[0])) if cells[0][0].condition.member is None else over_seeds(means.tolist())


def _standing(
    scope: _Scope, column: Column, changes: Sequence[Change], rivals: Sequence[_Scope], step_us: Mapping[str, float]
) -> Standing:
    first, (reference, name, is_group) = scope.first, scope.name
    against_base = [
        Paired.of(row)
        for row in changes
        if row.is_family and not row.is_rival and row.policy == first.policy.title and row.column == column
        and (row.reference, row.scope, row.is_group) == scope.name
    ]  # fmt: skip
    failed, episodes = scope.failed
    return Standing(
        track=first.track, policy=first.policy.title, reference=reference,
        scope=name, is_group=is_group, is_column=scope.is_column, title=column.title, metric=column.metric,
        score=pooled(scope.cells, column), failed=failed, episodes=episodes,
        training_seeds=0 if first.member is None else len(scope.cells[0]),
        base=against_base[0] if against_base else None,
        rival=None if first.member is None else _against_the_best(scope, column, rivals),
        step_us=step_us.get(first.policy.title, float("nan")),
    )  # fmt: skip


def _against_the_best(scope: _Scope, column: Column, rivals: Sequence[_Scope]) -> Paired | None:
    """A residual against the best of some policies in this scope and metric; None where none has a score."""
    scores = {rival.first.policy.title: (pooled(rival.cells, column), rival.failed) for rival in rivals}
    best = best_of(scores)
    if best is None:
        return None
    (cells,) = [rival.cells for rival in rivals if rival.first.policy.title == best]
    return Paired.of(paired(list(zip(scope.cells, cells, strict=True)), column))


def _mean(evaluation: Evaluation, column: Column) -> float:
    values = evaluation.values(column.metric)
    return float(values.mean()) if len(values) else float("nan")
