"""The leaderboard of a comparison: scores of policies over groups of scenarios, in tracks by what a policy needs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from baselines.catalogue import Track
from train.evaluate.changes import Change, Groups, by_cell
from train.evaluate.environments import Column
from train.evaluate.evaluate import Evaluation
from train.evaluate.maps import failed_of
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
        rival: Of a residual: its change against the best policy without learning.
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
    found = []
    for title in dict.fromkeys(e.condition.policy.title for e in evaluations):
        cells = by_cell([e for e in evaluations if e.condition.policy.title == title])
        for reference in dict.fromkeys(e.condition.reference_name for e in evaluations):
            own = {str(key[1]): members for key, members in cells.items() if key[0] == reference}
            whole = {name: scopes for name, scopes in groups.items() if all(scope in own for scope in scopes)}
            pooled = {scope for scopes in whole.values() for scope in scopes}
            rows = [(name, True, True, [own[scope] for scope in scopes]) for name, scopes in whole.items()]
            rows += [(scope, False, scope not in pooled, [members]) for scope, members in own.items()]
            for scope, is_group, is_column, members in rows:
                found += [
                    _standing(members, column, (scope, is_group, is_column), changes, step_us.get(title, float("nan")))
                    for column in members[0][0].condition.environment.judged
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
    cells: Sequence[Sequence[Evaluation]], column: Column, scope: tuple[str, bool, bool], changes: Sequence[Change],
    step_us: float,
) -> Standing:  # fmt: skip
    first = cells[0][0].condition
    counts = [failed_of(members) for members in cells]
    own = [
        row for row in changes
        if row.is_family and row.policy == first.policy.title and row.reference == first.reference_name
        and (row.scope, row.is_group) == scope[:2] and row.column == column
    ]  # fmt: skip
    return Standing(
        track=first.track, policy=first.policy.title, reference=first.reference_name,
        scope=scope[0], is_group=scope[1], is_column=scope[2], title=column.title, metric=column.metric,
        score=pooled(cells, column), failed=sum(failed for failed, _ in counts), episodes=sum(n for _, n in counts),
        training_seeds=0 if first.member is None else len(cells[0]),
        base=_paired([row for row in own if not row.is_rival]), rival=_paired([row for row in own if row.is_rival]),
        step_us=step_us,
    )  # fmt: skip


def _paired(rows: Sequence[Change]) -> Paired | None:
    return Paired(rows[0].base, rows[0].relative, rows[0].verdict) if rows else None


def _mean(evaluation: Evaluation, column: Column) -> float:
    values = evaluation.values(column.metric)
    return float(values.mean()) if len(values) else float("nan")
