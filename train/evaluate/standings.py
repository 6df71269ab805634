"""The leaderboard of a comparison: scores over groups of scenarios, in tracks by needs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

from baselines.catalogue import Track
from train.evaluate.changes import Change, Groups, Pairings
from train.evaluate.environments import Column
from train.evaluate.episodes import Evaluation, group_by
from train.evaluate.maps import best_of
from train.evaluate.statistics import Estimate
from train.evaluate.table import EpisodeTable, failures, score


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
        """The part of a change that a leaderboard keeps."""
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
        is_column: Whether it is a column of the leaderboard; else it stands in the table of single
            scenarios.
        title: Words for the metric.
        metric: Its name, with its unit in SI.
        score: Mean over scenarios of means over the episodes that did not fail; of residuals the
            interquartile mean over training seeds with its interval; nan where a scenario has no
            such episode.
        failed, episodes: Episodes that failed, and all.
        training_seeds: Of a residual; 0 of another policy.
        base: Of a residual: its change against its base.
        rival: Of a residual: its change against the best policy without learning and with the
            standard sensors, in the same scope and metric. It is chosen on the same episodes, which
            favours it.
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
    evaluations: Sequence[Evaluation],
    changes: Sequence[Change],
    groups: Groups,
    step_us: Mapping[str, float],
) -> list[Standing]:
    """The leaderboard, a row per policy, motion, scope and judged metric.

    Columns are, for each motion, the groups whose scenarios are all played with it, and the
    scenarios that are in none of these groups.

    Args:
        evaluations: All cells, one per training seed.
        changes: Paired changes of the same.
        groups: Scenarios to pool over, by name.
        step_us: Time per step of every policy, by its title.
    """
    table = EpisodeTable(evaluations)
    pairings = Pairings(table)
    scopes = _scopes(table, groups)
    standard = [scope for scope in scopes if table.condition(scope.policy).track is Track.STANDARD]
    rivals = group_by(standard, lambda scope: scope.name)
    against_base = {
        (row.policy, row.reference, row.scope, row.is_group, row.column): Paired.of(row)
        for row in reversed(changes)
        if row.is_family and not row.is_rival
    }
    found = []
    for scope in scopes:
        members = table.members.get(scope.policy, {})
        rows = table.of(scope.policy, *scope.cells)
        failed, episodes = failures(rows)
        for column in table.environment.judged:
            rival = None
            if members:
                rival = _against_the_best(pairings, scope, column, rivals.get(scope.name, []))
            found.append(
                Standing(
                    track=table.condition(scope.policy).track,
                    policy=scope.policy,
                    reference=scope.reference,
                    scope=scope.scope,
                    is_group=scope.is_group,
                    is_column=scope.is_column,
                    title=column.title,
                    metric=column.metric,
                    score=score(rows, column),
                    failed=failed,
                    episodes=episodes,
                    training_seeds=len(members),
                    base=against_base.get((scope.policy, *scope.name, column)),
                    rival=rival,
                    step_us=step_us.get(scope.policy, float("nan")),
                )
            )
    return found


@dataclass(frozen=True)
class _Scope:
    """A policy in one scenario, or in a group of them.

    Attributes:
        policy: Its title.
        reference: Label of the motion.
        scope: Scenario or group.
        is_group: Whether it is a group.
        is_column: Whether it is a column of the leaderboard.
        cells: Numbers of its cells.
    """

    policy: str
    reference: str
    scope: str
    is_group: bool
    is_column: bool
    cells: Sequence[int]

    @property
    def name(self) -> tuple[str, str, bool]:
        """Name that scopes of several policies share."""
        return self.reference, self.scope, self.is_group


def _scopes(table: EpisodeTable, groups: Groups) -> list[_Scope]:
    """Scenarios and whole groups of every policy and motion, in their order."""
    found = []
    for policy in table.policies:
        for reference in table.references:
            cells = table.cells_of(policy, reference)
            own = {table.conditions[policy, cell].scenario: cell for cell in cells}
            grouped = set[str]()
            for name, parts in groups.items():
                if all(part in own for part in parts):
                    grouped.update(parts)
                    members = [own[part] for part in parts]
                    found.append(_Scope(policy, reference, name, True, True, members))
            for name, cell in own.items():
                found.append(_Scope(policy, reference, name, False, name not in grouped, [cell]))
    return found


def _against_the_best(
    pairings: Pairings, scope: _Scope, column: Column, rivals: Sequence[_Scope]
) -> Paired | None:
    """A residual against the best of some policies; None where none has a score."""
    played = {rival.policy: pairings.table.of(rival.policy, *rival.cells) for rival in rivals}
    best = best_of({title: (score(rows, column), failures(rows)) for title, rows in played.items()})
    if best is None:
        return None
    own = (scope.cells, scope.scope, scope.is_group)
    return Paired.of(pairings.change(scope.policy, best, column, *own))
