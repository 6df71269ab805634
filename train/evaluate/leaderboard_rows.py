"""The leaderboard of a comparison: scores over groups of scenarios, in tracks by the needs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

from baselines.catalogue import Track
from elastic_env.core.errors import ConfigurationError
from train.evaluate.changes import changes_of
from train.evaluate.environments import Column
from train.evaluate.episodes import Evaluation, group_by
from train.evaluate.scores import best_of, failures, score
from train.evaluate.statistics import Estimate
from train.evaluate.table import EpisodeTable, Groups, Scope


@dataclass(frozen=True)
class PairedChange:
    """A paired change of a residual.

    Attributes:
        opponent: Title of the policy that it is compared with.
        change: Change of its score on the same episodes [1].
        verdict: As `Change.verdict`.
    """

    opponent: str
    change: Estimate
    verdict: str


@dataclass(frozen=True)
class Standing:
    """A policy in one metric, in one scenario or over a group of them: a row of `leaderboard.csv`.

    Attributes:
        track: Needs of the policy.
        policy: Its title.
        reference: Label of the motion.
        scope: Scenario, or name of the group.
        is_group: True for a group.
        is_column: True for a column of the leaderboard; otherwise the row is in the table of single
            scenarios.
        title: Words for the metric.
        metric: Its name, with its unit in SI.
        score: Mean over scenarios of means over the robots that did not fail; for residuals the
            interquartile mean over training seeds; nan if a scenario has no such episode. Its
            interval is over training seeds and drawn robots.
        failed, episodes: Episodes that failed, and all.
        training_seeds: Training seeds of a residual; 0 for another policy.
        base: Change of a residual against its base; None for another policy.
        rival: Change of a residual against the best policy without learning and with the standard
            sensors, in the same scope and metric. The rival is chosen on the same episodes, which
            favours it.
        step_us: Median time of the policy alone for a control step of one world [µs].
        interval_over: Units of the score's interval, such as "64 robots"; empty without one.
        origin: Version and protocol of the rollouts, which rows of one leaderboard share.
        is_published: True if the row was read from a file instead of played.
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
    base: PairedChange | None
    rival: PairedChange | None
    step_us: float
    interval_over: str = ""
    origin: str = ""
    is_published: bool = False


def append_standings(published: Sequence[Standing], own: Sequence[Standing]) -> list[Standing]:
    """Return a published leaderboard followed by own rows; a policy in both stays published.

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
            "published rows and your own must have the same version and protocol, got published"
            f" {there or 'an unknown version'} and own {here}; the protocol is motions, scenarios,"
            " groups, episodes and seed"
        )
    policies = {row.policy for row in published}
    marked = [replace(row, is_published=True) for row in published]
    return [*marked, *(row for row in own if row.policy not in policies)]


def standings(
    evaluations: Sequence[Evaluation],
    groups: Groups,
    step_us: Mapping[str, float],
    origin: str = "",
) -> list[Standing]:
    """The leaderboard, a row per policy, motion, scope and judged metric.

    Each motion has a column for every group whose scenarios are all played with it. Scenarios in
    none of these groups have columns of their own.

    Args:
        evaluations: All cells, one per training seed.
        groups: Scenarios to pool over, by name.
        step_us: Time per step of every policy, by its title.
        origin: See `Standing`.
    """
    table = EpisodeTable(evaluations)
    scopes = [s for title in table.policies for s in table.scopes(title, groups)]
    motions = group_by(scopes, lambda scope: (scope.policy, scope.reference))
    for scopes_of_motion in motions.values():
        scopes_of_motion.sort(key=lambda scope: not scope.is_group)
    scopes = list(chain(*motions.values()))
    standard = [scope for scope in scopes if scope.first.track is Track.STANDARD]
    rivals = group_by(standard, lambda scope: scope.place)
    result = []
    for scope in scopes:
        scopes_of_motion = motions[scope.policy, scope.reference]
        groups_of_motion = [s.conditions for s in scopes_of_motion if s.is_group]
        pooled = {condition.scenario for condition in chain(*groups_of_motion)}
        rows = table.rows_of(scope.policy, *scope.cells)
        failed, episodes = failures(rows)
        for column in table.environment.judged:
            base = rival = None
            if scope.first.member is not None:
                base = _paired_change(table, scope, scope.first.member.base, column)
                best = _best_policy(table, rivals.get(scope.place, []), column)
                rival = _paired_change(table, scope, best, column)
            mean = score(rows, column)
            standing = Standing(
                track=scope.first.track,
                policy=scope.policy,
                reference=scope.reference,
                scope=scope.scope,
                is_group=scope.is_group,
                is_column=scope.is_group or scope.scope not in pooled,
                title=column.title,
                metric=column.metric,
                score=mean,
                failed=failed,
                episodes=episodes,
                training_seeds=len(table.members.get(scope.policy, ())),
                base=base,
                rival=rival,
                step_us=step_us.get(scope.policy, float("nan")),
                interval_over=mean.over,
                origin=origin,
            )
            result.append(standing)
    return result


def _paired_change(
    table: EpisodeTable, scope: Scope, opponent: str, column: Column
) -> PairedChange | None:
    """Change of a policy against another one; None if that one does not play the same cells."""
    if len(table.cells_of_base(scope, opponent)) < len(scope.cells):
        return None
    (row,) = changes_of(table, scope, opponent, [column])
    return PairedChange(opponent, row.relative, row.verdict)


def _best_policy(table: EpisodeTable, scopes: Sequence[Scope], column: Column) -> str:
    """The best of some policies; empty if none has a score."""
    scores = {}
    for scope in scopes:
        rows = table.rows_of(scope.policy, *scope.cells)
        scores[scope.policy] = score(rows, column), failures(rows)
    return best_of(scores) or ""
