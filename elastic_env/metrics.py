"""Scores of an episode from the samples of its steps: RMS, peak, range, mean. One row per world."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from elastic_env.signals import Array, BoolArray, Signals


@dataclass(frozen=True)
class Metric:
    """One figure of an episode: a statistic of a signal over the steps of a mask.

    The name ends with its unit, as in link_error_rms_rad. The mask is "scored", "all", or one that the task names.
    """

    name: str
    signal: str
    statistic: Literal["rms", "peak", "min", "max", "mean", "count"]
    over: str = "scored"


class RunningStatistics:
    """Sum, sum of squares, smallest, largest and count of the rows of an array, in every world.

    A row that was never sampled has the statistics nan, not zero.
    """

    def __init__(self, num_rows: int, num_worlds: int) -> None:
        shape = (num_rows, num_worlds)
        self._sum, self._sum_of_squares = np.zeros(shape), np.zeros(shape)
        self._low, self._high = np.full(shape, np.inf), np.full(shape, -np.inf)
        self._count = np.zeros(shape, dtype=np.int64)

    def restart(self, worlds: BoolArray) -> None:
        """Forget the samples of some worlds, (num_worlds,) mask."""
        self._sum[:, worlds] = self._sum_of_squares[:, worlds] = 0.0
        self._low[:, worlds], self._high[:, worlds] = np.inf, -np.inf
        self._count[:, worlds] = 0

    def update(self, values: Array, sampled: BoolArray) -> None:
        """Take the samples of some steps where `sampled` is true, (num_steps, num_rows, num_worlds) both.

        The result does not depend on how many steps are taken at once.
        """
        counted = np.where(sampled, values, 0.0)  # where, not a product: a nan outside does not count
        squares = counted * counted
        for value, square in zip(counted, squares, strict=True):
            self._sum += value
            self._sum_of_squares += square
        np.minimum(self._low, np.where(sampled, values, np.inf).min(axis=0), out=self._low)
        np.maximum(self._high, np.where(sampled, values, -np.inf).max(axis=0), out=self._high)
        self._count += sampled.sum(axis=0)

    def statistic(self, name: str, row: int) -> Array:
        """A statistic of a row, (num_worlds,)."""
        count = self._count[row]
        if name == "count":
            return count.astype(np.float64)
        low, high, some = self._low[row], self._high[row], np.maximum(count, 1)
        values = {
            "rms": np.sqrt(self._sum_of_squares[row] / some),
            "mean": self._sum[row] / some,
            "min": low,
            "max": high,
            "peak": np.maximum(np.abs(low), np.abs(high)),
        }[name]
        return np.where(count > 0, values, np.nan)


class EpisodeMetrics:
    """The metrics of a task, accumulated step by step in every world."""

    def __init__(self, metrics: Sequence[Metric], num_worlds: int) -> None:
        self._metrics = tuple(metrics)
        rows = sorted({(m.signal, m.over) for m in metrics})
        self._row_of_metric = [rows.index((m.signal, m.over)) for m in metrics]
        self._signals = [signal for signal, _ in rows]
        self._masks = list(dict.fromkeys(over for _, over in rows))
        self._mask_of_row = np.array([self._masks.index(over) for _, over in rows])
        self._statistics = RunningStatistics(len(rows), num_worlds)

    def restart(self, worlds: BoolArray) -> None:
        """Begin new episodes in some worlds, (num_worlds,) mask."""
        self._statistics.restart(worlds)

    def update(self, signals: Signals, masks: Mapping[str, BoolArray]) -> None:
        """Take steps: the task's signals and the masks by name, (num_steps, num_worlds) each, or (num_worlds,)."""
        values = np.array([np.atleast_2d(signals[name]) for name in self._signals], dtype=np.float64)
        sampled = np.array([np.atleast_2d(masks[name]) for name in self._masks])[self._mask_of_row]
        self._statistics.update(values.swapaxes(0, 1), sampled.swapaxes(0, 1))

    def values(self) -> dict[str, Array]:
        """Metrics so far, (num_worlds,) each; nan where no step was sampled."""
        return {
            metric.name: self._statistics.statistic(metric.statistic, row)
            for metric, row in zip(self._metrics, self._row_of_metric, strict=True)
        }
