"""The table of all episodes of a comparison, one row each. Every statistic groups its rows."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from train.evaluate.conditions import Condition, Member
from train.evaluate.episodes import Evaluation, group_by
from train.evaluate.residual_seeds import Origin, origin

Groups = Mapping[str, Sequence[str]]
"""Scenarios to pool over, by the name of the group."""


@dataclass(frozen=True, eq=False)
class Scope:
    """A policy in one cell, or in the cells of a group of scenarios that are pooled.

    Attributes:
        policy: Its title.
        scope: Scenario, or name of the group.
        is_group: True for a group.
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
        """True if the policy is a residual, which has training seeds."""
        return self.first.member is not None

    @property
    def failure(self) -> str:
        """Name of failures, in the plural: falls or failures."""
        return self.first.environment.failures

    @property
    def place(self) -> tuple[object, ...]:
        """Key that is the same for all policies that play these cells."""
        return self.reference, self.scope, self.is_group, *self.swept.items()


class EpisodeTable:
    """All episodes of a comparison.

    A cell is a motion, a scenario, and values of the options that a sweep or a map varies. Cells
    have numbers.

    Args:
        evaluations: All cells, one per training seed.

    Attributes:
        rows: A row per episode, with `policy`, `member` (folder of a training seed; empty for a
            policy without training), `reference`, `scenario`, `cell`, `random` (True if its
            episodes differ), `seed`, `robot` (name of one of the cell's robots), `failed`, and the
            metrics [SI], nan where the episode failed.
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
                robot = _robot_name(episode) if draws_robots else ""
                failed = bool(episode["termination"])
                records.append({**episode, **labels, "robot": robot, "failed": failed})
        self.rows = pd.DataFrame(records)
        metrics = self.environment.metrics
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
        """Names of the options that a sweep or a map varies."""
        conditions = self.conditions.values()
        return list(dict.fromkeys(name for c in conditions for name in c.swept))

    @cached_property
    def families(self) -> dict[str, Origin]:
        """Training of every residual, by title."""
        return {title: origin([*own.values()]) for title, own in self.members.items()}

    def cells_of(
        self, policy: str, reference: str | None = None, scenario: str | None = None
    ) -> list[int]:
        """Numbers of the cells of a policy; of one motion or scenario if these are given."""
        return [
            cell
            for (title, cell), c in self.conditions.items()
            if title == policy
            and reference in (None, c.reference_name)
            and scenario in (None, c.scenario)
        ]

    def scope(self, policy: str, *cells: int, group: str = "") -> Scope:
        """The scope of a policy in a cell, or in the cells of a group."""
        conditions = tuple(self.conditions[policy, cell] for cell in cells)
        name = group or conditions[0].scenario
        return Scope(policy, name, bool(group), cells, conditions)

    def scopes(self, policy: str, groups: Groups) -> Iterator[Scope]:
        """Yield every cell of a policy, and every complete group after the last of its cells."""

        def motion(cell: int) -> tuple[object, ...]:
            condition = self.conditions[policy, cell]
            return condition.reference_name, *condition.swept.items()

        cells = self.cells_of(policy)
        blocks = group_by(cells, motion)
        for cell in cells:
            yield self.scope(policy, cell)
            block = blocks[motion(cell)]
            if cell == block[-1]:
                by_scenario = {self.conditions[policy, n].scenario: n for n in block}
                for name, scenarios in groups.items():
                    if by_scenario.keys() >= set(scenarios):
                        members = [by_scenario[scenario] for scenario in scenarios]
                        yield self.scope(policy, *members, group=name)

    def cells_of_base(self, scope: Scope, base: str) -> list[int]:
        """Cells of the base that match a scope's cells, without those that it does not play.

        A base that is not swept has one cell for all values, its level.
        """
        result = []
        for condition in scope.conditions:
            places = (condition.cell, condition.cell[:2])
            numbers = [self.cells.get(place, -1) for place in places]
            result += [n for n in numbers if (base, n) in self.conditions][:1]
        return result

    def rows_of(self, policy: str, *cells: int) -> pd.DataFrame:
        """Rows of a policy in some cells."""
        parts = [self._rows_by_cell[policy, cell] for cell in cells]
        return parts[0] if len(parts) == 1 else pd.concat(parts)

    @cached_property
    def _rows_by_cell(self) -> dict[tuple[str, int], pd.DataFrame]:
        parts: Any = self.rows.groupby(["policy", "cell"])
        return dict(iter(parts))


def _robot_name(episode: Mapping[str, Any]) -> str:
    """Name of the robot of an episode: its recorded parameters, or else its seed."""
    figures = [item for item in episode.items() if item[0].startswith("robot_")]
    return str(figures or episode["seed"])
