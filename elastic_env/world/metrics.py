"""Scores of an episode from the samples of its steps, such as RMS and peak. One row per world."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal, TypeAlias

import numpy as np

from elastic_env.core.signals import Array, BoolArray, Signals

Statistic: TypeAlias = Literal["rms", "peak", "min", "max", "mean", "last", "count"]


@dataclass(frozen=True)
class Metric:
    """One figure of an episode: a statistic of a signal over the steps of a mask.

    The name ends with its unit, as in link_error_rms_rad. The mask is "scored", "all", or one that
    the task names.
    """

    name: str
    signal: str
    statistic: Statistic
    over: str = "scored"


def metrics_of(
    signal: str, unit: str, *statistics: Statistic, over: str = "scored"
) -> tuple[Metric, ...]:
    """Statistics of a signal, each named `signal_statistic_unit`."""
    return tuple(Metric(f"{signal}_{s}_{unit}", signal, s, over) for s in statistics)


def _join(join: np.ufunc, values: Array) -> Array:
    """Values joined in the order of their steps, (num_rows, num_steps, num_worlds)."""
    return join.accumulate(values, axis=1)[:, -1].copy()


def _last_known(values: Array) -> Array:
    """The last value that is not nan, of those that `_join` takes; nan where all are."""
    back = (~np.isnan(values[:, ::-1])).argmax(axis=1)
    row = values.shape[1] - 1 - back
    return np.take_along_axis(values, row[:, None], axis=1)[:, 0]


_FOLDS: dict[str, tuple[Callable[[Array], Array], Callable[[Array], Array], float]] = {
    "rms": (np.square, partial(_join, np.add), 0.0),
    "mean": (np.positive, partial(_join, np.add), 0.0),
    "min": (np.positive, partial(_join, np.minimum), np.inf),
    "max": (np.positive, partial(_join, np.maximum), -np.inf),
    "peak": (np.abs, partial(_join, np.maximum), 0.0),
    "last": (np.positive, _last_known, np.nan),
    "count": (np.ones_like, partial(_join, np.add), 0.0),
}
"""A function of every sample, how its values are joined, and what changes nothing, by statistic."""


class RunningStatistic:
    """One statistic of the rows of an array over the sampled steps, in every world."""

    def __init__(self, name: str, num_rows: int, num_worlds: int) -> None:
        self._name = name
        self._function, self._join, self._neutral = _FOLDS[name]
        self._total = np.full((num_rows, num_worlds), self._neutral)
        self._count = np.zeros((num_rows, num_worlds), dtype=np.int64)

    def restart(self, worlds: BoolArray) -> None:
        """Forget the samples of some worlds, (num_worlds,) mask."""
        self._total[:, worlds] = self._neutral
        self._count[:, worlds] = 0

    def update(self, values: Array, sampled: BoolArray) -> None:
        """Take samples where `sampled` is true, (num_rows, num_steps, num_worlds) both.

        The result does not depend on how many steps are taken at once: they are added in order.
        """
        # where, not a product: a nan outside does not count
        samples = np.where(sampled, self._function(values), self._neutral)
        self._count += sampled.sum(axis=1)
        steps = np.concatenate([self._total[:, None], samples], axis=1)
        self._total = self._join(steps)

    def values(self) -> Array:
        """The statistic of every row, (num_rows, num_worlds); nan without a sample."""
        if self._name == "count":
            return self._total.copy()
        value = self._total
        if self._name in ("rms", "mean"):
            value = value / np.maximum(self._count, 1)
        if self._name == "rms":
            value = np.sqrt(value)
        return np.where(self._count > 0, value, np.nan)


class EpisodeMetrics:
    """The metrics of a task, accumulated step by step in every world."""

    def __init__(self, metrics: Sequence[Metric], num_worlds: int) -> None:
        self._names = [metric.name for metric in metrics]
        self._folded = [
            (RunningStatistic(name, len(own), num_worlds), own)
            for name in _FOLDS
            if (own := [metric for metric in metrics if metric.statistic == name])
        ]

    def restart(self, worlds: BoolArray) -> None:
        """Begin new episodes in some worlds, (num_worlds,) mask."""
        for statistic, _ in self._folded:
            statistic.restart(worlds)

    def update(self, signals: Signals, masks: Mapping[str, BoolArray]) -> None:
        """Take signals and masks by name, (num_steps, num_worlds) or (num_worlds,) each."""
        for statistic, metrics in self._folded:
            values = [np.atleast_2d(signals[metric.signal]) for metric in metrics]
            sampled = [np.atleast_2d(masks[metric.over]) for metric in metrics]
            statistic.update(np.array(values, dtype=np.float64), np.array(sampled))

    def values(self) -> dict[str, Array]:
        """Metrics so far, (num_worlds,) each; nan where no step was sampled."""
        rows: dict[str, Array] = {}
        for statistic, metrics in self._folded:
            names = [metric.name for metric in metrics]
            rows |= zip(names, statistic.values(), strict=True)
        return {name: rows[name] for name in self._names}
