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
        """Take one sample of every row where `sampled` is true, (num_rows, num_worlds) both."""
        counted = np.where(sampled, values, 0.0)  # where, not a product: a nan outside does not count
        self._sum += counted
        self._sum_of_squares += counted * counted
        np.minimum(self._low, values, out=self._low, where=sampled)
        np.maximum(self._high, values, out=self._high, where=sampled)
        self._count += sampled

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
        self._row = {row: number for number, row in enumerate(rows)}
        self._signals = [signal for signal, _ in rows]
        self._masks = list(dict.fromkeys(over for _, over in rows))
        self._mask_of_row = np.array([self._masks.index(over) for _, over in rows])
        self._statistics = RunningStatistics(len(rows), num_worlds)

    def restart(self, worlds: BoolArray) -> None:
        """Begin new episodes in some worlds, (num_worlds,) mask."""
        self._statistics.restart(worlds)

    def update(self, signals: Signals, masks: Mapping[str, BoolArray]) -> None:
        """Take one step: the task's signals, (num_worlds,) each, and the masks by name."""
        values = np.array([signals[name] for name in self._signals], dtype=np.float64)
        self._statistics.update(values, np.array([masks[name] for name in self._masks])[self._mask_of_row])

    def values(self) -> dict[str, Array]:
        """Metrics so far, (num_worlds,) each; nan where no step was sampled."""
        return {m.name: self._statistics.statistic(m.statistic, self._row[m.signal, m.over]) for m in self._metrics}
