"""Maps over two axes: the best policy of every cell, and the gain of learning against it.

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
from train.evaluate.changes import Change, changes_of
from train.evaluate.conditions import (
    HALF_WIDTH,
    SCENARIO,
    Condition,
    scenario_fields,
    vary_scenario,
)
from train.evaluate.environments import Column, Environment
from train.evaluate.episodes import Evaluation, group_by
from train.evaluate.scores import best_of, failures, score
from train.evaluate.statistics import Estimate
from train.evaluate.table import EpisodeTable

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
        """True if it varies the motion instead of the scenario."""
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

    def ticks(self, environment: Environment) -> list[str]:
        """Texts of its values, in their shown unit."""
        if self.is_motion:
            name = environment.motion
            motions = [environment.arguments(value)[name] for value in self.values]
            numbers = [n for m in motions for n in environment.abscissa(m).values()]
            return [f"{n:g}" for n in numbers] or list(map(environment.label, motions))
        factor = _UNITS.get(scenario_fields()[self.what][1], ("", 1.0))[1]
        return [f"{factor * value:.4g}" for value in self.values]

    def place(self, condition: Condition) -> int:
        """Index of the value of a condition."""
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
        """Both axes."""
        return self.x, self.y

    @property
    def motion(self) -> Axis | None:
        """The axis that varies the motion; None if both vary the scenario."""
        return next((axis for axis in self.axes if axis.is_motion), None)

    def require(self, environment: Environment) -> None:
        """Refuse axes that an environment does not have, and values beyond their bounds.

        Raises:
            ConfigurationError: An axis or a value is wrong.
        """
        for name, axis in (("x", self.x), ("y", self.y)):
            names = [environment.motion, *scenario_fields()]
            if axis.what not in names:
                choices = choices_listed(axis.what, names)
                if axis.what in PolicyOptions.model_fields:
                    choices += "; an option of the policies is varied by sweep, not by a map"
                raise ConfigurationError(f"unknown axis {axis.what!r} of map.{name}; {choices}")
            if axis.is_motion:
                continue  # values of the motion are `references`, which are checked
            for value in axis.values:
                if isinstance(value, bool) or not isinstance(value, int | float):
                    problem = f"values of map.{name} must be numbers"
                    raise ConfigurationError(f"{problem}, got {quote(value)}")
                vary_scenario(GROUNDS["nominal"], {axis.what: value})

    def coordinates(self) -> list[dict[str, float]]:
        """Varied fields of the scenario in every cell of one motion."""
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
        levels: Mean score of every policy over the episodes that did not fail, for residuals over
            training seeds [SI].
        failed: Number of failed episodes and of all episodes, for every policy.
        best: The best policy; None if no episode of any policy reached its end.
        best_analytic: The best policy without learning and with the standard sensors.
        learned: Paired change of every residual against `best_analytic`.
    """

    levels: Mapping[str, Estimate]
    failed: Mapping[str, tuple[int, int]]
    best: str | None
    best_analytic: str | None
    learned: Mapping[str, Change]


@dataclass(frozen=True, eq=False)
class HeatMap:
    """A metric over both axes, in one scenario; with one motion if no axis varies it.

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
        """Texts of the values of x and y."""
        environment = self.table.environment
        return self.axes.x.ticks(environment), self.axes.y.ticks(environment)

    @property
    def flat(self) -> list[MapCell]:
        """All cells."""
        return [cell for row in self.cells for cell in row]

    @property
    def wins(self) -> dict[str, int]:
        """Number of cells in which a policy is the best, most first; only policies with any."""
        wins = Counter(cell.best for cell in self.flat)
        ranked = sorted(self.table.policies, key=lambda title: -wins[title])
        return {title: wins[title] for title in ranked if wins[title]}

    def changes_of(self, title: str) -> list[Change]:
        """Changes of a residual in all cells that have any."""
        return [cell.learned[title] for cell in self.flat if title in cell.learned]


def heat_maps(evaluations: Sequence[Evaluation], config: MapConfig) -> list[HeatMap]:
    """The maps of a comparison, one per scenario, motion and judged metric.

    Args:
        evaluations: All cells, one per training seed.
        config: The axes.
    """

    def title_of(e: Evaluation) -> str:
        c = e.condition
        motion = c.environment.title(c.reference_name)
        return c.scenario if config.motion else f"{motion}, {c.scenario}"

    return [
        heat_map
        for title, group in group_by(evaluations, title_of).items()
        for heat_map in _heat_maps(title, EpisodeTable(group), config)
    ]


def _heat_maps(title: str, table: EpisodeTable, config: MapConfig) -> list[HeatMap]:
    """One map per judged metric."""
    cells = {
        (config.y.place(condition), config.x.place(condition)): cell
        for (_, cell), condition in table.conditions.items()
    }
    across = range(len(config.x.values))
    rows = [[cells[y, x] for x in across] for y in range(len(config.y.values))]
    maps = []
    for column in table.environment.judged:
        map_cells = [[_map_cell(table, cell, column) for cell in row] for row in rows]
        maps.append(HeatMap(title, column, config, table, map_cells))
    return maps


def _map_cell(table: EpisodeTable, cell: int, column: Column) -> MapCell:
    """Scores of one cell, and changes of residuals against the best policy without learning."""
    titles = [title for title in table.policies if (title, cell) in table.conditions]
    rows = {title: table.rows_of(title, cell) for title in titles}
    scores = {title: (score(own, column), failures(own)) for title, own in rows.items()}
    tracks = {title: table.conditions[title, cell].track for title in titles}
    standard = [title for title in titles if tracks[title] is Track.STANDARD]
    without_truth = [title for title in titles if tracks[title] is not Track.TRUTH]
    analytic = best_of({title: scores[title] for title in standard})
    learned = [title for title in titles if title in table.members] if analytic else []
    return MapCell(
        levels={title: level for title, (level, _) in scores.items()},
        failed={title: failed for title, (_, failed) in scores.items()},
        best=best_of({title: scores[title] for title in without_truth}),
        best_analytic=analytic,
        learned={
            title: changes_of(table, table.scope(title, cell), str(analytic), [column])[0]
            for title in learned
        },
    )
