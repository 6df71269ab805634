"""Scores over drawn robots: their middle half, their worst tenth, and wins against the base."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from train.evaluate.changes import opponents
from train.evaluate.environments import Column
from train.evaluate.episodes import Evaluation
from train.evaluate.scores import (
    EpisodesByRobot,
    failures,
    match_episodes,
    over_cells,
    pair,
    score,
)
from train.evaluate.statistics import Estimate, mean_of_part, middle_half, worst_share
from train.evaluate.table import EpisodeTable, Scope

FEWEST_ROBOTS = 4
"""Fewest robots that have a middle half."""


@dataclass(frozen=True, eq=False)
class RobotScores(Scope):
    """A policy in one metric over the drawn robots of a cell, with intervals.

    Attributes:
        column: The metric.
        mean: Mean over the robots [SI].
        middle: Interquartile mean over the robots [SI].
        worst: Mean of the worst tenth of the robots [SI].
        failed, episodes: Episodes that failed, and all. The means are over those that did not.
        better: Share of the robots for which the policy is better than another one, by the title
            of the other. Ties count half; a failure is worse than any value.
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
        """The three means over the robots."""
        return self.mean, self.middle, self.worst


def robot_scores(evaluations: Sequence[Evaluation]) -> list[RobotScores]:
    """Return a row per judged metric and cell, for cells that draw enough robots.

    Args:
        evaluations: All cells, one per training seed.
    """
    table = EpisodeTable(evaluations)
    result = []
    for policy, others in opponents(table).items():
        for scope in table.scopes(policy, {}):
            (cell,) = scope.cells
            rows = table.rows_of(policy, cell)
            is_small = len(set(rows["seed"])) < FEWEST_ROBOTS
            if scope.swept or is_small or not scope.first.draws_robots:
                continue
            failed, episodes = failures(rows)
            for column in table.environment.judged:
                better = {
                    title: share_better(rows, table.rows_of(title, cell), column.metric)
                    for title in others
                    if (title, cell) in table.conditions
                }
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
                result.append(scores)
    return result


def share_better(mine: pd.DataFrame, base: pd.DataFrame, metric: str) -> Estimate:
    """Share of the robots for which a policy is better (lower).

    Ties count half. A failure is worse than any value, and two failures are a tie. The share is nan
    if the policies have no robot in common. An episode that reached its end without a value is left
    out, such as a ZMP of feet that never carried anything.

    Args:
        mine: Episodes of one cell with `member`, `cell`, `robot`, `seed`, `failed` and the metric.
        base: The same of the base.
        metric: Name of the metric.
    """
    mine, base = (
        rows.assign(**{metric: rows[metric].where(~rows["failed"], np.inf)})
        for rows in (mine, base)
    )
    won = pair(mine, match_episodes(mine, base), metric)["won"]
    return over_cells(EpisodesByRobot(mine).figures(won))
