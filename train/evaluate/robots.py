"""Scores over drawn robots: how a policy does on the middle half of them, on the worst tenth, and against its base."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from elastic_env.core.signals import Array
from elastic_env.runtime.scenario import make_scenario
from train.evaluate.changes import by_cell, opponents
from train.evaluate.environments import Column
from train.evaluate.episodes import Evaluation, group_by
from train.evaluate.maps import failed_of
from train.evaluate.statistics import Estimate, interquartile_mean, over_seeds, share_better, worst_share_mean

FEWEST_ROBOTS = 4
"""Episodes from which on there is a middle half."""


@dataclass(frozen=True)
class RobotScores:
    """A policy in one metric over the drawn robots of a cell; of residuals over training seeds, with intervals.

    Attributes:
        policy, reference, scenario: Titles of the cell.
        column: The metric.
        mean: Mean over the robots [SI].
        middle: Interquartile mean over the robots [SI].
        worst: Mean of the worst tenth of the robots [SI].
        failed, episodes: Episodes that failed, and all. The figures are of the others.
        better: Share of the robots for which the policy is better than another one, by its title; ties count half,
            and to fail is worse than any value.
        failure: What failing is called, in the plural.
    """

    policy: str
    reference: str
    scenario: str
    column: Column
    mean: Estimate
    middle: Estimate
    worst: Estimate
    failed: int
    episodes: int
    better: dict[str, Estimate]
    failure: str


def robot_scores(evaluations: Sequence[Evaluation]) -> list[RobotScores]:
    """A row per cell and judged metric, of the cells that draw robots and have enough of them.

    Args:
        evaluations: All cells, one per training seed.
    """
    found = []
    others = opponents(evaluations)
    policies = {title: by_cell(own) for title, own in group_by(evaluations, lambda e: e.condition.policy.title).items()}
    for title, cells in policies.items():
        for cell, members in cells.items():
            reference, scenario, *swept = cell
            if swept or not _draws_robots(members[0]):
                continue
            against = {name: policies[name][cell][0] for name in others[title] if cell in policies.get(name, {})}
            for column in members[0].condition.environment.judged:
                found.append(_scores((title, str(reference), str(scenario)), members, column, against))
    return found


def _scores(
    names: tuple[str, str, str], members: Sequence[Evaluation], column: Column, against: dict[str, Evaluation]
) -> RobotScores:
    """The scores of one cell and metric."""
    is_family = members[0].condition.member is not None

    def estimate(statistic: Callable[[Evaluation], float]) -> Estimate:
        each = [statistic(e) for e in members]
        return over_seeds(each) if is_family else Estimate(each[0])

    def of_values(statistic: Callable[[Array], float]) -> Estimate:
        return estimate(lambda e: statistic(v) if len(v := e.values(column.metric)) else float("nan"))

    failed, episodes = failed_of(members)
    return RobotScores(
        *names,
        column=column,
        mean=of_values(lambda values: float(np.mean(values))),
        middle=of_values(lambda values: float(interquartile_mean(values))),
        worst=of_values(worst_share_mean),
        failed=failed,
        episodes=episodes,
        better={
            title: estimate(lambda e, other=other: share_better(e.episodes, other.episodes, column.metric))
            for title, other in against.items()
        },
        failure=members[0].condition.environment.failures,
    )


def _draws_robots(e: Evaluation) -> bool:
    known = e.condition.environment
    return (
        not known.is_real
        and len(e.episodes) >= FEWEST_ROBOTS
        and make_scenario(e.condition.scenario, known.walks).draws_robots
    )
