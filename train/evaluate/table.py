"""The table of all episodes of a comparison, a row each: every statistic groups its rows."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import Any, Literal

import numpy as np
import pandas as pd

from elastic_env.core.signals import Array
from train.evaluate.conditions import Condition, Member
from train.evaluate.environments import Column
from train.evaluate.episodes import Evaluation, group_by
from train.evaluate.residual_seeds import Origin, origin
from train.evaluate.statistics import (
    Counts,
    Estimate,
    beats,
    estimate,
    mean_of_part,
    mean_of_robots,
    middle,
)

Groups = Mapping[str, Sequence[str]]
"""Scenarios to pool over, by the name of the group."""


@dataclass(frozen=True, eq=False)
class Scope:
    """A policy in one cell, or in the cells of a group of scenarios that are pooled.

    Attributes:
        policy: Its title.
        scope: Scenario, or name of the group.
        is_group: Whether it is a group.
        cells: Numbers of its cells.
        conditions: Their conditions.
    """

    policy: str
    scope: str
    is_group: bool
    cells: tuple[int, ...]
    conditions: tuple[Condition, ...]

    @property
    def first(self) -> Condition:
        """The first condition: all share motion and swept values."""
        return self.conditions[0]

    @property
    def reference(self) -> str:
        """Label of the motion."""
        return self.first.reference_name

    @property
    def swept(self) -> dict[str, float]:
        """Options that a sweep or a map varies, and their values."""
        return self.first.swept

    @property
    def is_family(self) -> bool:
        """True if the policy is a residual, so that it has training seeds."""
        return self.first.member is not None

    @property
    def failure(self) -> str:
        """Name of failures, in the plural."""
        return self.first.environment.failures

    @property
    def place(self) -> tuple[object, ...]:
        """Name that scopes of several policies share."""
        return self.reference, self.scope, self.is_group, *self.swept.items()


class EpisodeTable:
    """All episodes of a comparison.

    A cell is a motion, a scenario, and the values of what a sweep or a map varies. Cells have
    numbers.

    Args:
        evaluations: All cells, one per training seed.

    Attributes:
        rows: A row per episode, with `policy`, `member` (folder of a training seed; empty of a
            policy that was not trained), `reference`, `scenario`, `cell`, `random` (whether its
            episodes differ), `seed`, `robot` (which of the cell's), `failed`, and the metrics [SI],
            nan where the episode failed.
        cells: Number of every cell, by `Condition.cell`.
        conditions: The first condition of every policy and cell.
        members: Training seeds of every residual, by title and folder.
    """

    def __init__(self, evaluations: Sequence[Evaluation]) -> None:
        self.environment = evaluations[0].condition.environment
        self.cells: dict[tuple[object, ...], int] = {}
        self.conditions: dict[tuple[str, int], Condition] = {}
        self.members: dict[str, dict[str, Member]] = {}
        records = []
        for e in evaluations:
            condition = e.condition
            title = condition.policy.title
            member = condition.member
            cell = self.cells.setdefault(condition.cell, len(self.cells))
            self.conditions.setdefault((title, cell), condition)
            if member is not None:
                self.members.setdefault(title, {})[member.folder] = member
            labels = {
                "policy": title,
                "member": "" if member is None else member.folder,
                "reference": condition.reference_name,
                "scenario": condition.scenario,
                "cell": cell,
                "random": not self.environment.is_deterministic(
                    condition.scenario, condition.reference
                ),
            }
            draws_robots = condition.draws_robots
            for episode in e.episodes:
                robot = _robot_of(episode) if draws_robots else ""
                failed = bool(episode["termination"])
                records.append({**episode, **labels, "robot": robot, "failed": failed})
        self.rows = pd.DataFrame(records)
        known = self.environment
        columns = chain(known.columns, known.judged, known.also, *known.splits.values())
        metrics = list(dict.fromkeys(column.metric for column in columns))
        figures = self.rows.reindex(columns=metrics).apply(pd.to_numeric)
        self.rows[metrics] = figures.astype(np.float64).where(~self.rows["failed"])

    @cached_property
    def policies(self) -> list[str]:
        """Titles of the policies."""
        return list(dict.fromkeys(title for title, _ in self.conditions))

    @cached_property
    def references(self) -> list[str]:
        """Labels of the motions."""
        return list(dict.fromkeys(c.reference_name for c in self.conditions.values()))

    @cached_property
    def scenarios(self) -> list[str]:
        """Names of the scenarios."""
        return list(dict.fromkeys(c.scenario for c in self.conditions.values()))

    @cached_property
    def swept(self) -> list[str]:
        """Names of what a sweep or a map varies."""
        conditions = self.conditions.values()
        return list(dict.fromkeys(name for c in conditions for name in c.swept))

    @cached_property
    def families(self) -> dict[str, Origin]:
        """Residuals by title, with how they were trained."""
        return {title: origin([*own.values()]) for title, own in self.members.items()}

    def cells_of(
        self, policy: str, reference: str | None = None, scenario: str | None = None
    ) -> list[int]:
        """Numbers of the cells of a policy, of one motion or scenario where these are given."""
        return [
            cell
            for (title, cell), c in self.conditions.items()
            if title == policy
            and reference in (None, c.reference_name)
            and scenario in (None, c.scenario)
        ]

    def scope(self, policy: str, *cells: int, group: str = "") -> Scope:
        """A policy in a cell, or in those of a group."""
        conditions = tuple(self.conditions[policy, cell] for cell in cells)
        name = group or conditions[0].scenario
        return Scope(policy, name, bool(group), cells, conditions)

    def scopes(self, policy: str, groups: Groups) -> Iterator[Scope]:
        """Every cell of a policy, and every whole group behind the last of its cells."""

        def place(cell: int) -> tuple[object, ...]:
            condition = self.conditions[policy, cell]
            return condition.reference_name, *condition.swept.items()

        cells = self.cells_of(policy)
        blocks = group_by(cells, place)
        for cell in cells:
            yield self.scope(policy, cell)
            block = blocks[place(cell)]
            if cell == block[-1]:
                own = {self.conditions[policy, each].scenario: each for each in block}
                for name, scenarios in groups.items():
                    if own.keys() >= set(scenarios):
                        members = [own[each] for each in scenarios]
                        yield self.scope(policy, *members, group=name)

    def cells_of_base(self, scope: Scope, base: str) -> list[int]:
        """Cells in which the base played what a scope's cells play; those it lacks are left out.

        A base that is not swept has one cell for all values, its level.
        """
        found = []
        for own in scope.conditions:
            numbers = [self.cells.get(place, -1) for place in (own.cell, own.cell[:2])]
            found += [n for n in numbers if (base, n) in self.conditions][:1]
        return found

    def of(self, policy: str, *cells: int) -> pd.DataFrame:
        """Rows of a policy in some cells."""
        parts = [self._parts[policy, cell] for cell in cells]
        return parts[0] if len(parts) == 1 else pd.concat(parts)

    @cached_property
    def _parts(self) -> dict[tuple[str, int], pd.DataFrame]:
        parts: Any = self.rows.groupby(["policy", "cell"])
        return dict(iter(parts))


class ByRobot:
    """Episodes by cell, training seed and robot, grouped once for all figures.

    Args:
        rows: With `member`, `cell`, `robot` and metrics.
    """

    def __init__(self, rows: pd.DataFrame) -> None:
        self._groups: Any = rows.groupby(["cell", "member", "robot"])
        index = self._groups.size().index
        cells, members = (index.get_level_values(i).to_numpy() for i in range(2))
        robots = index.codes[2]
        num_robots = len(index.levels[2])
        self._seeds = {member: row for row, member in enumerate(rows["member"].unique())}
        row_of = np.array([self._seeds[member] for member in members])
        self._places: list[tuple[Any, Any, Any]] = []
        for cell in rows["cell"].unique():
            own = np.flatnonzero(cells == cell)
            # by name, or where the cell lacks some as they come: intervals draw robots by number
            column_of, found = pd.factorize(robots[own])
            if len(found) == num_robots:
                column_of = robots[own]
            self._places.append((own, row_of[own], column_of))

    def figures(
        self, metric: str, statistic: Literal["mean", "sum", "count"] = "mean"
    ) -> list[Array]:
        """A statistic over the episodes of each robot, (seeds, robots) for every cell.

        Args:
            metric: Its name.
            statistic: nan without an episode; a mean also without a figure.
        """
        values = self._groups[metric].agg(statistic).to_numpy(dtype=np.float64)
        found = []
        for own, rows, columns in self._places:
            table = np.full((len(self._seeds), columns.max() + 1), np.nan)
            table[rows, columns] = values[own]
            found.append(table)
        return found


def per_robot(rows: pd.DataFrame, metric: str) -> list[Array]:
    """Means over the episodes of each robot, (seeds, robots) for every cell; nan without a figure.

    Args:
        rows: With `member`, `cell`, `robot` and the metric.
        metric: Its name.
    """
    return ByRobot(rows).figures(metric)


def by_episode(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows in which each random episode of an undrawn robot counts for itself.

    Its seed stands in the place of the robot. Statistics of policies without training take these.
    """
    is_alone = rows["random"] & (rows["robot"] == "")
    return rows.assign(robot=rows["robot"].where(~is_alone, rows["seed"].astype(str)))


def score(
    rows: pd.DataFrame,
    column: Column,
    mean: Callable[[Array, Array], Array] = mean_of_robots,
) -> Estimate:
    """Mean over cells of a metric of one policy [SI]; over training seeds the interquartile mean.

    Args:
        rows: Rows of one policy in one or several cells.
        column: The metric.
        mean: Over the robots of a cell that have a figure, as `mean_of_robots`.
    """
    return over_cells(per_robot(rows, column.metric), mean)


def over_cells(
    values: Sequence[Array], mean: Callable[[Array, Array], Array] = mean_of_robots
) -> Estimate:
    """Mean over cells of means over robots, with its interval; values as of `per_robot`."""

    def figures(counts: Counts) -> Array:
        return means_of_cells(values, counts, mean).mean(axis=0)

    return estimate(figures, [own.shape[1] for own in values])


def median_of(evaluation: Evaluation, metric: str) -> Estimate:
    """Median over the episodes that did not fail; of a residual its middle over training seeds.

    The interval is over seeds and episodes; there is none where all episodes are the same.
    """
    condition = evaluation.condition
    same = condition.environment.is_deterministic(condition.scenario, condition.reference)
    seeds = group_by(evaluation.episodes, lambda own: own.get("training_seed"))
    values = [
        [None if own["termination"] else own.get(metric) for own in episodes[: 1 if same else None]]
        for episodes in seeds.values()
    ]
    return over_cells([np.array(values, dtype=np.float64)], mean_of_part(middle))


def means_of_cells(
    values: Sequence[Array],
    counts: Counts,
    mean: Callable[[Array, Array], Array] = mean_of_robots,
) -> Array:
    """Means over the robots of every cell, (cells, resamples, seeds)."""
    return np.array([mean(own, count) for own, count in zip(values, counts, strict=True)])


def _robot_of(episode: Mapping[str, Any]) -> str:
    """Which robot an episode has: by its recorded figures, else that of its seed."""
    figures = [(name, value) for name, value in episode.items() if name.startswith("robot_")]
    return str(figures or episode["seed"])


def pair(mine: pd.DataFrame, base: pd.DataFrame, metric: str) -> pd.DataFrame:
    """Episodes of a policy beside those of its base with the same cell and seed.

    Args:
        mine: Rows of a policy, with `member`, `cell`, `robot`, `seed` and the metric.
        base: Rows of the base, one per cell and seed.
        metric: Name of the metric.

    Returns:
        A row for each of the policy's, with `member`, `cell` and `robot`, the metric as `mine` and
        `base`, and `won`: 1 where the policy is better (lower), one half in a tie. These three are
        nan where either has no figure.

    Raises:
        ValueError: A seed occurs twice, so that nobody can say which episode belongs to which.
    """
    for rows in (mine, base):
        if rows.duplicated(["member", "cell", "seed"]).any():
            raise ValueError(
                f"every episode needs a seed of its own to be paired, got {rows['seed'].tolist()}"
            )
    theirs = base[["cell", "seed"]].assign(base=base[metric])
    both = mine[["member", "cell", "robot", "seed"]].assign(mine=mine[metric])
    both = both.merge(theirs, on=["cell", "seed"], how="left")
    both = both.assign(won=beats(both["mine"], both["base"]))
    figures = both[["mine", "base", "won"]]
    both[["mine", "base", "won"]] = figures.where(figures.notna().all(axis=1))
    return both


def failures(rows: pd.DataFrame) -> tuple[int, int]:
    """Episodes that failed, and all."""
    return int(rows["failed"].to_numpy().sum()), len(rows)
