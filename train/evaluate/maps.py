"""Maps over two axes: which policy is best where, and what learning adds to the best.

An axis is a field of the scenario, such as the stiffness, or the motion, such as the step period.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from baselines.catalogue import Track
from baselines.policy_options import PolicyOptions
from elastic_env.core.config import MOST_ENTRIES, Model, Once, Title
from elastic_env.core.errors import ConfigurationError, choices_listed, quote
from elastic_env.world.scenario import GROUNDS
from train.evaluate.changes import Change, change_of
from train.evaluate.conditions import (
    HALF_WIDTH,
    SCENARIO,
    Condition,
    scenario_fields,
    vary_scenario,
)
from train.evaluate.environments import Column, Environment
from train.evaluate.episodes import Evaluation, group_by
from train.evaluate.statistics import Estimate
from train.evaluate.table import EpisodeTable, failures, score

_UNITS = {"rad": ("mrad", 1e3), "m": ("mm", 1e3)}
"""Units in which an axis is shown, with the factor from SI."""


class Axis(Model):
    """An axis of a map."""

    what: Title
    """A field of the scenario, such as scenario.stiffness or
    scenario.mounting_rad.half_width, or the motion: step_period on the walker, reference on the
    testbed."""
    values: Annotated[list[Any], Once] = Field(min_length=2, max_length=MOST_ENTRIES)
    """Values in SI units; of the motion references as `references` has them."""
    label: Title | None = None
    """Title of the axis, with its unit; None for the description of the field."""

    @property
    def is_motion(self) -> bool:
        """True if it varies the motion, and not the scenario."""
        return not self.what.startswith(SCENARIO)

    @property
    def title(self) -> str:
        """Title of the axis, with its unit."""
        if self.label is not None:
            return self.label
        if self.is_motion:
            unit = " [s]" if self.what == "step_period" else ""
            return f"{self.what.replace('_', ' ')}{unit}"
        description, unit = scenario_fields()[self.what]
        kind = "half-width, " if self.what.endswith(f".{HALF_WIDTH}") else ""
        return f"{kind}{description.split(': ')[-1]} [{_UNITS.get(unit, (unit, 1.0))[0]}]"

    def ticks(self, known: Environment) -> list[str]:
        """Its values as they are shown."""
        if self.is_motion:
            motions = [known.arguments(value)[known.motion] for value in self.values]
            numbers = [n for motion in motions for n in known.abscissa(motion).values()]
            return [f"{n:g}" for n in numbers] or list(map(known.label, motions))
        factor = _UNITS.get(scenario_fields()[self.what][1], ("", 1.0))[1]
        return [f"{factor * value:.4g}" for value in self.values]

    def place(self, condition: Condition) -> int:
        """Which of its values a condition has."""
        if not self.is_motion:
            return self.values.index(condition.swept[self.what])
        arguments = condition.environment.arguments
        values = [arguments(value) for value in self.values]
        return values.index(arguments(condition.reference))


class MapConfig(Model):
    """Two axes of a map."""

    x: Axis
    """Axis to the right."""
    y: Axis
    """Axis upwards."""

    @model_validator(mode="after")
    def _axes_differ(self) -> Self:
        x, y = (axis.what.removesuffix(f".{HALF_WIDTH}") for axis in self.axes)
        if x == y:
            raise ValueError(f"x and y of a map must vary two things, both vary {x!r}")
        return self

    @property
    def axes(self) -> tuple[Axis, Axis]:
        """Both."""
        return self.x, self.y

    @property
    def motion(self) -> Axis | None:
        """The axis that varies the motion; None where both vary the scenario."""
        return next((axis for axis in self.axes if axis.is_motion), None)

    def require(self, known: Environment) -> None:
        """Refuse axes that an environment does not have, and values that they cannot take.

        Raises:
            ConfigurationError: An axis or a value is wrong.
        """
        for name, axis in (("x", self.x), ("y", self.y)):
            if axis.what != known.motion and axis.what not in scenario_fields():
                choices = choices_listed(axis.what, [known.motion, *scenario_fields()])
                if axis.what in PolicyOptions.model_fields:
                    choices += "; an option of the policies is varied by sweep, not by a map"
                raise ConfigurationError(f"unknown axis {axis.what!r} of map.{name}; {choices}")
            for value in axis.values:
                if axis.is_motion:
                    continue  # `references` holds and checks them
                if isinstance(value, bool) or not isinstance(value, int | float):
                    problem = f"values of map.{name} must be numbers"
                    raise ConfigurationError(f"{problem}, got {quote(value)}")
                vary_scenario(GROUNDS["nominal"], {axis.what: value})

    def coordinates(self) -> list[dict[str, float]]:
        """Fields of the scenario in every cell, for one motion."""
        fields = [axis for axis in self.axes if not axis.is_motion]
        names = [axis.what for axis in fields]
        return [
            dict(zip(names, map(float, values), strict=True))
            for values in product(*(axis.values for axis in fields))
        ]


@dataclass(frozen=True, eq=False)
class MapCell:
    """One cell of a map.

    Attributes:
        levels: Mean score of every policy over the episodes that did not fail; of residuals over
            training seeds [SI].
        failed: Episodes of every policy that failed, and all.
        best: The best policy; None where no episode of any reached its end.
        best_analytic: The best one without learning and with the standard sensors.
        learned: Paired change of every residual against that one.
    """

    levels: Mapping[str, Estimate]
    failed: Mapping[str, tuple[int, int]]
    best: str | None
    best_analytic: str | None
    learned: Mapping[str, Change]


@dataclass(frozen=True, eq=False)
class HeatMap:
    """A metric over both axes, in one scenario and, where no axis is the motion, with one motion.

    Attributes:
        title: Scenario and motion.
        column: The metric.
        axes: The axes.
        table: All episodes.
        cells: (len(y.values), len(x.values)).
    """

    title: str
    column: Column
    axes: MapConfig
    table: EpisodeTable
    cells: list[list[MapCell]]

    @property
    def ticks(self) -> tuple[list[str], list[str]]:
        """Values of x and y as they are shown."""
        known = self.table.environment
        return self.axes.x.ticks(known), self.axes.y.ticks(known)

    @property
    def flat(self) -> list[MapCell]:
        """All cells."""
        return [cell for row in self.cells for cell in row]

    @property
    def wins(self) -> dict[str, int]:
        """Cells in which a policy is the best, of those that are somewhere, most first."""
        wins = Counter(cell.best for cell in self.flat)
        ranked = sorted(self.table.policies, key=lambda title: -wins[title])
        return {title: wins[title] for title in ranked if wins[title]}

    def changes_of(self, title: str) -> list[Change]:
        """Changes of a residual in all cells that have one."""
        return [cell.learned[title] for cell in self.flat if title in cell.learned]


def heat_maps(evaluations: Sequence[Evaluation], config: MapConfig) -> list[HeatMap]:
    """The maps of a comparison, one per scenario, motion and judged metric.

    Args:
        evaluations: All cells, one per training seed.
        config: The axes.
    """

    def title_of(e: Evaluation) -> str:
        own = e.condition
        motion = own.environment.title(own.reference_name)
        return own.scenario if config.motion else f"{motion}, {own.scenario}"

    return [
        heat_map
        for title, own in group_by(evaluations, title_of).items()
        for heat_map in _heat_maps(title, EpisodeTable(own), config)
    ]


Scores = Mapping[str, tuple[Estimate, tuple[int, int]]]
"""Score of every policy, and how many of its episodes failed, of how many."""


def ranking(scores: Scores) -> list[str]:
    """The policies that have a score, the best first: fewer failures go before a lower score.

    A mean over the episodes that did not fail flatters whoever fails in the hard ones, so failures
    count first.
    """

    def rank(title: str) -> tuple[float, float]:
        estimate, (failed, played) = scores[title]
        return failed / max(played, 1), estimate.value

    return sorted((title for title in scores if scores[title][0].is_known), key=rank)


def best_of(scores: Scores) -> str | None:
    """The best policy of a `ranking`; None where nobody has a score."""
    return next(iter(ranking(scores)), None)


def _heat_maps(title: str, table: EpisodeTable, config: MapConfig) -> list[HeatMap]:
    """A map per judged metric."""
    cells = {
        (config.y.place(condition), config.x.place(condition)): cell
        for (_, cell), condition in table.conditions.items()
    }
    across = range(len(config.x.values))
    rows = [[cells[y, x] for x in across] for y in range(len(config.y.values))]
    maps = []
    for column in table.environment.judged:
        found = [[_cell(table, number, column) for number in row] for row in rows]
        maps.append(HeatMap(title, column, config, table, found))
    return maps


def _cell(table: EpisodeTable, cell: int, column: Column) -> MapCell:
    """Scores of one cell, and residuals against the best policy without learning there."""
    played = [title for title in table.policies if (title, cell) in table.conditions]
    rows = {title: table.of(title, cell) for title in played}
    scores = {title: (score(own, column), failures(own)) for title, own in rows.items()}
    tracks = {title: table.conditions[title, cell].track for title in played}
    standard = [title for title in played if tracks[title] is Track.STANDARD]
    without_truth = [title for title in played if tracks[title] is not Track.TRUTH]
    analytic = best_of({title: scores[title] for title in standard})
    learned = [title for title in played if title in table.members] if analytic else []
    return MapCell(
        levels={title: level for title, (level, _) in scores.items()},
        failed={title: failed for title, (_, failed) in scores.items()},
        best=best_of({title: scores[title] for title in without_truth}),
        best_analytic=analytic,
        learned={
            title: change_of(table, table.scope(title, cell), str(analytic), column)
            for title in learned
        },
    )
