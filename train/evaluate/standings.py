"""The leaderboard of a comparison: scores over groups of scenarios, in tracks by needs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

from baselines.catalogue import Track
from elastic_env.core.errors import ConfigurationError
from train.evaluate.changes import change_of
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
        score: Mean over scenarios of means over the robots that did not fail; of residuals the
            interquartile mean over training seeds; nan where a scenario has no such episode. Its
            interval is over training seeds and drawn robots.
        failed, episodes: Episodes that failed, and all.
        training_seeds: Of a residual; 0 of another policy.
        base: Of a residual: its change against its base.
        rival: Of a residual: its change against the best policy without learning and with the
            standard sensors, in the same scope and metric. It is chosen on the same episodes, which
            favours it.
        step_us: Median time of the policy alone for a control step of one world [µs].
        interval_over: What the interval of the score is over; empty without one.
        origin: Version and protocol that it was played with, which rows of one leaderboard share.
        is_published: Whether it was read from a file, and not played.
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
    interval_over: str = ""
    origin: str = ""
    is_published: bool = False


def append_standings(published: Sequence[Standing], own: Sequence[Standing]) -> list[Standing]:
    """A published leaderboard with one's own rows behind; bases that both have stay published.

    Args:
        published: Rows that were read.
        own: Rows that were played.

    Raises:
        ConfigurationError: They were played with another version or protocol.
    """
    theirs = dict.fromkeys(row.origin for row in published)
    ours = dict.fromkeys(row.origin for row in own)
    if theirs.keys() != ours.keys():
        there, here = (" and ".join(origins) or "nothing" for origins in (theirs, ours))
        raise ConfigurationError(
            f"published rows must be played as one's own, there by {there or 'an unknown version'},"
            f" here by {here}; the protocol is motions, scenarios, groups, episodes and seed"
        )
    known = {row.policy for row in published}
    kept = [replace(row, is_published=True) for row in published]
    return [*kept, *(row for row in own if row.policy not in known)]


def standings(
    evaluations: Sequence[Evaluation],
    groups: Groups,
    step_us: Mapping[str, float],
    origin: str = "",
) -> list[Standing]:
    """The leaderboard, a row per policy, motion, scope and judged metric.

    Columns are, for each motion, the groups whose scenarios are all played with it, and the
    scenarios that are in none of these groups.

    Args:
        evaluations: All cells, one per training seed.
        groups: Scenarios to pool over, by name.
        step_us: Time per step of every policy, by its title.
        origin: See `Standing`.
    """
    table = EpisodeTable(evaluations)
    scopes = [s for title in table.policies for s in table.scopes(title, groups)]
    parts_of = group_by(scopes, lambda scope: (scope.policy, scope.reference))
    for own in parts_of.values():
        own.sort(key=lambda scope: not scope.is_group)
    scopes = list(chain(*parts_of.values()))
    standard = [scope for scope in scopes if scope.first.track is Track.STANDARD]
    rivals = group_by(standard, lambda scope: scope.place)
    found = []
    for scope in scopes:
        parts = parts_of[scope.policy, scope.reference]
        groups_of = [part.conditions for part in parts if part.is_group]
        pooled = {condition.scenario for condition in chain(*groups_of)}
        rows = table.of(scope.policy, *scope.cells)
        failed, episodes = failures(rows)
        for column in table.environment.judged:
            base = best = None
            if scope.first.member is not None:
                base = _paired(table, scope, scope.first.member.base, column)
                beside = rivals.get(scope.place, [])
                best = _paired(table, scope, _best(table, beside, column), column)
            level = score(rows, column)
            standing = Standing(
                track=scope.first.track,
                policy=scope.policy,
                reference=scope.reference,
                scope=scope.scope,
                is_group=scope.is_group,
                is_column=scope.is_group or scope.scope not in pooled,
                title=column.title,
                metric=column.metric,
                score=level,
                failed=failed,
                episodes=episodes,
                training_seeds=len(table.members.get(scope.policy, ())),
                base=base,
                rival=best,
                step_us=step_us.get(scope.policy, float("nan")),
                interval_over=level.over,
                origin=origin,
            )
            found.append(standing)
    return found


def _paired(table: EpisodeTable, scope: Scope, to: str, column: Column) -> Paired | None:
    """A policy against another one; None where that does not play the same cells."""
    if len(table.cells_of_base(scope, to)) < len(scope.cells):
        return None
    row = change_of(table, scope, to, column)
    return Paired(to, row.relative, row.verdict)


def _best(table: EpisodeTable, scopes: Sequence[Scope], column: Column) -> str:
    """The best of some policies; empty where none has a score."""
    scores = {}
    for scope in scopes:
        rows = table.of(scope.policy, *scope.cells)
        scores[scope.policy] = score(rows, column), failures(rows)
    return best_of(scores) or ""
