"""The leaderboard of a comparison: scores over groups of scenarios, in tracks by needs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

from baselines.catalogue import Track
from train.evaluate.changes import Change, change_of
from train.evaluate.environments import Column
from train.evaluate.episodes import Evaluation, group_by
from train.evaluate.maps import best_of
from train.evaluate.statistics import Estimate
from train.evaluate.table import EpisodeTable, Groups, Scope, failures, score


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
    scopes = [scope for policy in table.policies for scope in _in_columns(table, policy, groups)]
    standard = [scope for scope in scopes if scope.first.track is Track.STANDARD]
    rivals = group_by(standard, _place)
    grouped = group_by((s for s in scopes if s.is_group), lambda s: (s.policy, _reference(s)))
    against_base = {
        (row.policy, row.reference, row.scope, row.is_group, row.column): Paired.of(row)
        for row in reversed(changes)
        if row.is_family and not row.is_rival
    }
    found = []
    for scope in scopes:
        policy = scope.policy
        reference = _reference(scope)
        pooled = {c.scenario for s in grouped.get((policy, reference), ()) for c in s.conditions}
        members = table.members.get(policy, {})
        rows = table.of(policy, *scope.cells)
        failed, episodes = failures(rows)
        for column in table.environment.judged:
            best = _best(table, rivals.get(_place(scope), []), column) if members else None
            standing = Standing(
                track=table.condition(policy).track,
                policy=policy,
                reference=reference,
                scope=scope.name,
                is_group=scope.is_group,
                is_column=scope.is_group or scope.name not in pooled,
                title=column.title,
                metric=column.metric,
                score=score(rows, column),
                failed=failed,
                episodes=episodes,
                training_seeds=len(members),
                base=against_base.get((policy, *_place(scope), column)),
                rival=Paired.of(change_of(table, scope, best, column)) if best else None,
                step_us=step_us.get(policy, float("nan")),
            )
            found.append(standing)
    return found


def _in_columns(table: EpisodeTable, policy: str, groups: Groups) -> list[Scope]:
    """Scopes of a policy, by motion the groups before the scenarios."""
    order = table.references.index
    scopes = table.scopes(policy, groups)
    return sorted(scopes, key=lambda scope: (order(_reference(scope)), not scope.is_group))


def _reference(scope: Scope) -> str:
    return scope.first.reference_name


def _place(scope: Scope) -> tuple[str, str, bool]:
    """Name that scopes of several policies share."""
    return _reference(scope), scope.name, scope.is_group


def _best(table: EpisodeTable, scopes: Sequence[Scope], column: Column) -> str | None:
    """The best of some policies; None where none has a score."""
    played = {scope.policy: table.of(scope.policy, *scope.cells) for scope in scopes}
    return best_of({title: (score(rows, column), failures(rows)) for title, rows in played.items()})
