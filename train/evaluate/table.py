"""The table of all episodes of a comparison, a row each: every statistic groups its rows."""

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from elastic_env.core.signals import Array
from train.evaluate.conditions import Condition, Member
from train.evaluate.environments import Column
from train.evaluate.episodes import Evaluation
from train.evaluate.residual_seeds import Origin, origin
from train.evaluate.statistics import Estimate, over_seeds


class EpisodeTable:
    """All episodes of a comparison.

    A cell is a motion, a scenario, and the values of what a sweep or a map varies. Cells have
    numbers.

    Args:
        evaluations: All cells, one per training seed.

    Attributes:
        rows: A row per episode, with `policy`, `member` (folder of a training seed; empty of a
            policy that was not trained), `reference`, `scenario`, `cell`, `seed`, `failed`, and the
            metrics [SI], nan where the episode failed.
        cells: Number of every cell, by `Condition.cell`.
        conditions: The first condition of every policy and cell.
        members: Training seeds of every residual, by title and folder.
    """

    def __init__(self, evaluations: Sequence[Evaluation]) -> None:
        self.evaluations = list(evaluations)
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
            }
            records += [
                {**episode, **labels, "failed": bool(episode["termination"])}
                for episode in e.episodes
            ]
        self.rows = pd.DataFrame(records)
        known = self.environment
        columns = [*known.columns, *known.judged, *known.also]
        columns += [column for split in known.splits.values() for column in split]
        for metric in {column.metric for column in columns}:
            values = pd.to_numeric(self.rows[metric]) if metric in self.rows else np.nan
            self.rows[metric] = pd.Series(values, self.rows.index, np.float64).where(
                ~self.rows["failed"]
            )

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
        return list(dict.fromkeys(name for c in self.conditions.values() for name in c.swept))

    @cached_property
    def families(self) -> dict[str, Origin]:
        """Residuals by title, with how they were trained."""
        return {title: origin(list(members.values())) for title, members in self.members.items()}

    def condition(self, policy: str) -> Condition:
        """The first condition of a policy."""
        return next(c for (title, _), c in self.conditions.items() if title == policy)

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

    def of(self, policy: str, *cells: int) -> pd.DataFrame:
        """Rows of a policy in some cells."""
        parts = [self._parts[policy, cell] for cell in cells]
        return parts[0] if len(parts) == 1 else pd.concat(parts)

    @cached_property
    def _parts(self) -> dict[tuple[str, int], pd.DataFrame]:
        parts: Any = self.rows.groupby(["policy", "cell"])
        return dict(iter(parts))


def per_seed(
    rows: pd.DataFrame, metric: str, statistic: Callable[[Array], float] = np.mean
) -> Array:
    """A statistic for each training seed and cell, (seeds, cells); nan without a figure."""
    parts: Any = rows.groupby(["member", "cell"])[metric]
    known = {key: own.dropna().to_numpy() for key, own in parts}
    found = {key: float(statistic(values)) for key, values in known.items() if len(values)}
    members = rows["member"].unique()
    cells = rows["cell"].unique()
    return np.array([[found.get((member, cell), np.nan) for cell in cells] for member in members])


def score(
    rows: pd.DataFrame, column: Column, statistic: Callable[[Array], float] = np.mean
) -> Estimate:
    """Mean over cells of a metric of one policy [SI]; over training seeds the interquartile mean.

    Args:
        rows: Rows of one policy in one or several cells.
        column: The metric.
        statistic: Over the episodes of a cell that have a figure.
    """
    return estimate(rows, per_seed(rows, column.metric, statistic).mean(axis=-1))


def estimate(rows: pd.DataFrame, values: Array) -> Estimate:
    """An estimate from one value per training seed; without training the value itself."""
    return over_seeds(values) if rows["member"].iat[0] else Estimate(float(values[0]))


def failures(rows: pd.DataFrame) -> tuple[int, int]:
    """Episodes that failed, and all."""
    return int(rows["failed"].to_numpy().sum()), len(rows)
