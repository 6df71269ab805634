"""Scores of an episode from the samples of its steps: RMS, peak, range, mean. One row per world."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from elastic_env.signals import Array, BoolArray, Signals


@dataclass(frozen=True)
class Metric:
    """One figure of an episode: a statistic of a signal, over its scored steps or over all.

    The name ends with its unit, as in link_error_rms_rad.
    """

    name: str
    signal: str
    statistic: Literal["rms", "peak", "min", "max", "mean"]
    scored_only: bool = True


class RunningStatistics:
    """Sum, sum of squares, smallest, largest and count of named signals, in every world.

    A signal that was never sampled has the statistics nan, not zero.
    """

    def __init__(self, names: Sequence[str], num_worlds: int) -> None:
        self._row = {name: row for row, name in enumerate(names)}
        shape = (len(names), num_worlds)
        self._sum, self._sum_of_squares = np.zeros(shape), np.zeros(shape)
        self._low, self._high = np.full(shape, np.inf), np.full(shape, -np.inf)
        self._count = np.zeros(num_worlds, dtype=np.int64)

    def restart(self, worlds: BoolArray) -> None:
        """Forget the samples of some worlds, (num_worlds,) mask."""
        self._sum[:, worlds] = self._sum_of_squares[:, worlds] = 0.0
        self._low[:, worlds], self._high[:, worlds] = np.inf, -np.inf
        self._count[worlds] = 0

    def update(self, signals: Signals, sampled: BoolArray) -> None:
        """Take one sample of every signal, (num_worlds,) each, in the worlds where `sampled` is true."""
        values = np.array([signals[name] for name in self._row], dtype=np.float64).reshape(self._sum.shape)
        counted = np.where(sampled, values, 0.0)  # where, not a product: a nan outside does not count
        self._sum += counted
        self._sum_of_squares += counted * counted
        np.minimum(self._low, values, out=self._low, where=sampled)
        np.maximum(self._high, values, out=self._high, where=sampled)
        self._count += sampled

    def statistic(self, metric: Metric) -> Array:
        """The statistic that a metric asks for, (num_worlds,)."""
        row, count = self._row[metric.signal], np.maximum(self._count, 1)
        low, high = self._low[row], self._high[row]
        values = {
            "rms": np.sqrt(self._sum_of_squares[row] / count),
            "mean": self._sum[row] / count,
            "min": low,
            "max": high,
            "peak": np.maximum(np.abs(low), np.abs(high)),
        }[metric.statistic]
        return np.where(self._count > 0, values, np.nan)


class EpisodeMetrics:
    """The metrics of a task, accumulated step by step in every world."""

    def __init__(self, metrics: Sequence[Metric], num_worlds: int) -> None:
        self._metrics = tuple(metrics)
        self._scored, self._all = (
            RunningStatistics(sorted({m.signal for m in metrics if m.scored_only is scored}), num_worlds)
            for scored in (True, False)
        )
        self._every = np.ones(num_worlds, dtype=np.bool_)

    def restart(self, worlds: BoolArray) -> None:
        """Begin new episodes in some worlds, (num_worlds,) mask."""
        self._scored.restart(worlds)
        self._all.restart(worlds)

    def update(self, signals: Signals, scored: BoolArray) -> None:
        """Take one step: the task's signals, (num_worlds,) each, and where they are scored."""
        self._scored.update(signals, scored)
        self._all.update(signals, self._every)

    def values(self) -> dict[str, Array]:
        """Metrics so far, (num_worlds,) each; nan where no step was scored."""
        return {m.name: (self._scored if m.scored_only else self._all).statistic(m) for m in self._metrics}
