"""Scores over drawn robots: the middle half of them, the worst tenth, and against the base."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from train.evaluate.changes import opponents
from train.evaluate.environments import Column
from train.evaluate.episodes import Evaluation
from train.evaluate.statistics import Estimate, mean_of_part, middle_half, worst_share
from train.evaluate.table import (
    EpisodeTable,
    Scope,
    failures,
    over_cells,
    pair,
    per_robot,
    score,
)

FEWEST_ROBOTS = 4
"""Episodes from which on there is a middle half."""


@dataclass(frozen=True, eq=False)
class RobotScores(Scope):
    """A policy in one metric over the drawn robots of a cell, with intervals.

    Attributes:
        column: The metric.
        mean: Mean over the robots [SI].
        middle: Interquartile mean over the robots [SI].
        worst: Mean of the worst tenth of the robots [SI].
        failed, episodes: Episodes that failed, and all. The figures are of the others.
        better: Share of the robots for which the policy is better than another one, by its title;
            ties count half, and to fail is worse than any value.
    """

    column: Column
    mean: Estimate
    middle: Estimate
    worst: Estimate
    failed: int
    episodes: int
    better: dict[str, Estimate]

    @property
    def scores(self) -> tuple[Estimate, Estimate, Estimate]:
        """The three figures over the robots."""
        return self.mean, self.middle, self.worst


def robot_scores(evaluations: Sequence[Evaluation]) -> list[RobotScores]:
    """A row per cell and judged metric, of the cells that draw robots and have enough of them.

    Args:
        evaluations: All cells, one per training seed.
    """
    table = EpisodeTable(evaluations)
    found = []
    for policy, others in opponents(table).items():
        for scope in table.scopes(policy, {}):
            (cell,) = scope.cells
            rows = table.of(policy, cell)
            is_small = len(set(rows["seed"])) < FEWEST_ROBOTS
            if scope.swept or is_small or not scope.first.draws_robots:
                continue
            against = [other for other in others if (other, cell) in table.conditions]
            failed, episodes = failures(rows)
            beside = {title: table.of(title, cell) for title in against}
            for column in table.environment.judged:
                better = {}
                for title, theirs in beside.items():
                    better[title] = share_better(rows, theirs, column.metric)
                scores = RobotScores(
                    **vars(scope),
                    column=column,
                    mean=score(rows, column),
                    middle=score(rows, column, mean_of_part(middle_half)),
                    worst=score(rows, column, mean_of_part(worst_share)),
                    failed=failed,
                    episodes=episodes,
                    better=better,
                )
                found.append(scores)
    return found


def share_better(mine: pd.DataFrame, base: pd.DataFrame, metric: str) -> Estimate:
    """Share of the robots for which a policy is better (lower).

    Ties count half. To fail is worse than any value, and where both fail it is a tie. nan where
    they have no robot in common. An episode that reached its end without a figure, such as a ZMP
    of feet that never carried anything, is left out.

    Args:
        mine: Episodes of one cell with `member`, `cell`, `robot`, `seed`, `failed` and the metric.
        base: The same of the base.
        metric: Name of the metric.
    """
    mine, base = (
        rows.assign(**{metric: rows[metric].where(~rows["failed"], np.inf)})
        for rows in (mine, base)
    )
    return over_cells(per_robot(pair(mine, base, metric), "won"))
