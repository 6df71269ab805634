"""Scores of policies from rows of the episode table: means over robots and cells, pairs, ranks."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import pandas as pd

from elastic_env.core.signals import Array
from train.evaluate.environments import Column
from train.evaluate.episodes import Evaluation, group_by
from train.evaluate.statistics import (
    Counts,
    Estimate,
    Mean,
    beats,
    estimate,
    mean_of_part,
    mean_of_robots,
    middle,
)


class EpisodesByRobot:
    """Episodes by cell, training seed and robot, grouped once for all metrics.

    Args:
        rows: With `member`, `cell` and `robot`.
    """

    def __init__(self, rows: pd.DataFrame) -> None:
        groups: Any = rows.groupby(["cell", "member", "robot"])
        self._group_of = groups.ngroup().to_numpy()
        index = groups.size().index
        cells, members = (index.get_level_values(i).to_numpy() for i in range(2))
        robots = index.codes[2]
        num_robots = len(index.levels[2])
        self._seeds = {member: row for row, member in enumerate(rows["member"].unique())}
        row_of = np.array([self._seeds[member] for member in members])
        self._places: list[tuple[Any, Any, Any]] = []
        for cell in rows["cell"].unique():
            groups = np.flatnonzero(cells == cell)
            # Intervals draw robots by column. A cell with all robots has them by name, another one
            # in their order.
            column_of, names = pd.factorize(robots[groups])
            if len(names) == num_robots:
                column_of = robots[groups]
            self._places.append((groups, row_of[groups], column_of))

    def figures(
        self, values: Any, statistic: Literal["mean", "sum", "count"] = "mean"
    ) -> list[Array]:
        """A statistic over the episodes of each robot, (seeds, robots) for every cell.

        Args:
            values: Series with a value for every row.
            statistic: nan without an episode; a mean also without a value.
        """
        figures = values.groupby(self._group_of).agg(statistic).to_numpy(dtype=np.float64)
        tables = []
        for groups, rows, columns in self._places:
            table = np.full((len(self._seeds), columns.max() + 1), np.nan)
            table[rows, columns] = figures[groups]
            tables.append(table)
        return tables


def per_robot(rows: pd.DataFrame, metric: str) -> list[Array]:
    """Means over the episodes of each robot, (seeds, robots) for every cell; nan without a value.

    Args:
        rows: With `member`, `cell`, `robot` and the metric.
        metric: Its name.
    """
    return EpisodesByRobot(rows).figures(rows[metric])


def episodes_as_robots(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows in which each random episode of an undrawn robot counts as a robot of its own.

    Its seed is the name of the robot. Statistics of policies without training use these rows.
    """
    is_alone = rows["random"] & (rows["robot"] == "")
    return rows.assign(robot=rows["robot"].where(~is_alone, rows["seed"].astype(str)))


def score(rows: pd.DataFrame, column: Column, mean: Mean = mean_of_robots) -> Estimate:
    """Mean over cells of a metric of one policy [SI]; over training seeds the interquartile mean.

    Args:
        rows: Rows of one policy in one or several cells.
        column: The metric.
        mean: Mean over the robots of a cell that have a value.
    """
    return over_cells(per_robot(rows, column.metric), mean)


def over_cells(values: Sequence[Array], mean: Mean = mean_of_robots) -> Estimate:
    """Mean over cells of means over robots, with its interval.

    Args:
        values: As `per_robot` returns them.
        mean: See `score`.
    """

    def mean_of_cells(counts: Counts) -> Array:
        return means_of_cells(values, counts, mean).mean(axis=0)

    return estimate(mean_of_cells, [cell.shape[1] for cell in values])


def median_of(evaluation: Evaluation, metric: str) -> Estimate:
    """Median over the episodes that did not fail; for a residual interquartile mean over seeds.

    The interval is over seeds and episodes. There is none if all episodes are the same.
    """
    c = evaluation.condition
    count = 1 if c.environment.is_deterministic(c.scenario, c.reference) else None
    seeds = group_by(evaluation.episodes, lambda episode: episode.get("training_seed"))
    values = [
        [None if e["termination"] else e.get(metric) for e in episodes[:count]]
        for episodes in seeds.values()
    ]
    return over_cells([np.array(values, dtype=np.float64)], mean_of_part(middle))


def means_of_cells(values: Sequence[Array], counts: Counts, mean: Mean = mean_of_robots) -> Array:
    """Means over the robots of every cell, (cells, resamples, seeds)."""
    cells = zip(values, counts, strict=True)
    return np.array([mean(cell, count) for cell, count in cells])


def match_episodes(mine: pd.DataFrame, base: pd.DataFrame) -> pd.DataFrame:
    """Return the base's rows with the cells and seeds of a policy's rows, one for each of these.

    Args:
        mine: Rows of a policy, with `member`, `cell` and `seed`.
        base: Rows of the base, one per cell and seed.

    Returns:
        Metrics are nan where the base has no row.

    Raises:
        ValueError: A seed occurs twice, so that episodes cannot be paired.
    """
    for rows in (mine, base):
        if rows.duplicated(["member", "cell", "seed"]).any():
            raise ValueError(
                f"every episode needs a seed of its own to be paired, got {rows['seed'].tolist()}"
            )
    matched = mine[["cell", "seed"]].merge(base, on=["cell", "seed"], how="left")
    return matched.set_index(mine.index)


def pair(mine: pd.DataFrame, base: pd.DataFrame, metric: str) -> pd.DataFrame:
    """Return a metric of paired episodes.

    Args:
        mine: Rows of a policy.
        base: Those of `match_episodes`.
        metric: Name of the metric.

    Returns:
        A row for each of the policy's, with the metric as `mine` and `base`, and `won`: 1 where the
        policy is better (lower), one half in a tie. All three are nan where either has no value.
    """
    both = pd.DataFrame({"mine": mine[metric], "base": base[metric]})
    both["won"] = beats(both["mine"], both["base"])
    return both.where(both.notna().all(axis=1))


def failures(rows: pd.DataFrame) -> tuple[int, int]:
    """Number of episodes that failed, and of all episodes."""
    return int(rows["failed"].to_numpy().sum()), len(rows)


Scores = Mapping[str, tuple[Estimate, tuple[int, int]]]
"""Score of every policy, with the number of its failed episodes and of all its episodes."""


def ranking(scores: Scores) -> list[str]:
    """The policies that have a score, the best first: fewer failures, then the lower score.

    Failures count first. The score is a mean over episodes that did not fail, so it would favour a
    policy that fails in the hard ones.
    """

    def rank(title: str) -> tuple[float, float]:
        estimate, (failed, played) = scores[title]
        return failed / max(played, 1), estimate.value

    return sorted((title for title in scores if scores[title][0].is_known), key=rank)


def best_of(scores: Scores) -> str | None:
    """The best policy of a `ranking`; None if no policy has a score."""
    return next(iter(ranking(scores)), None)
