"""Metrics of an episode, such as RMS and peak, from the samples of its steps. One row per world.

The metrics are listed in `robots/thormang/metrics.csv` and `world/joint_metrics.csv`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from elastic_env.core.compiled import compiled, compiled_part
from elastic_env.core.signals import Array, BoolArray, IntArray, Signals
from elastic_env.world.records import WHOLE, record_type

Statistic: TypeAlias = Literal["rms", "peak", "min", "max", "mean", "last", "count"]


@dataclass(frozen=True)
class Metric:
    """One figure of an episode: a statistic of a signal over the steps of a mask.

    The name ends with the unit, as in link_error_rms_rad. The mask `over` is "scored", "all", or a
    mask of the task.
    """

    name: str
    signal: str
    statistic: Statistic
    over: str = "scored"


_INITIAL_VALUES: dict[Statistic, float] = {
    "rms": 0.0,
    "mean": 0.0,
    "min": np.inf,
    "max": -np.inf,
    "peak": 0.0,
    "last": np.nan,
    "count": 0.0,
}
"""Statistics before their first sample. `add_sample` uses their order in this mapping."""

FOLD = record_type(("statistic", WHOLE), ("signal", WHOLE), ("mask", WHOLE))
"""A metric as indices into `_INITIAL_VALUES`, signals and masks."""


@compiled
def fold(folds: Any, signals: Array, masks: BoolArray, total: Array, count: IntArray) -> None:
    """Add samples to the statistics in the order of their steps.

    The result does not depend on how the steps are divided into calls.

    Args:
        folds: Records of `FOLD`, (rows,).
        signals: Samples, (signals, num_steps, num_worlds).
        masks: True where a sample counts, (masks, num_steps, num_worlds).
        total: Statistics, updated in place, (rows, num_worlds).
        count: Numbers of samples, updated in place, (rows, num_worlds).
    """
    for row in range(len(folds)):
        statistic = folds[row].statistic
        values = signals[folds[row].signal]
        is_sampled = masks[folds[row].mask]
        for step in range(values.shape[0]):
            for world in range(values.shape[1]):
                if is_sampled[step, world]:
                    before = total[row, world]
                    value = values[step, world]
                    total[row, world] = add_sample(statistic, before, value)
                    count[row, world] += 1


@compiled_part
def add_sample(statistic: int, before: float, value: float) -> float:
    """Return a statistic after its next sample; nan makes every statistic nan except "last"."""
    if statistic == 0:
        return before + value * value
    if statistic == 1:
        return before + value
    if statistic == 2:
        return value if value < before or np.isnan(value) else before
    if statistic == 3:
        return value if value > before or np.isnan(value) else before
    if statistic == 4:
        return abs(value) if abs(value) > before or np.isnan(value) else before
    if statistic == 5:
        return before if np.isnan(value) else value
    return before + 1.0


class EpisodeMetrics:
    """The metrics of a task, accumulated step by step in every world."""

    def __init__(self, metrics: Sequence[Metric], num_worlds: int) -> None:
        statistics = [*_INITIAL_VALUES]
        self._metrics = metrics
        self._signals = [*dict.fromkeys(metric.signal for metric in metrics)]
        self._masks = [*dict.fromkeys(metric.over for metric in metrics)]
        self._folds = np.zeros(len(metrics), FOLD)
        for row, metric in zip(self._folds, metrics, strict=True):
            row["statistic"] = statistics.index(metric.statistic)
            row["signal"] = self._signals.index(metric.signal)
            row["mask"] = self._masks.index(metric.over)
        initial = [[_INITIAL_VALUES[metric.statistic]] for metric in metrics]
        self._initial = np.tile(initial, num_worlds)
        self._total = self._initial.copy()
        self._count = np.zeros(self._total.shape, dtype=np.int64)

    def restart(self, worlds: BoolArray) -> None:
        """Begin new episodes in some worlds, a (num_worlds,) mask."""
        self._total[:, worlds] = self._initial[:, worlds]
        self._count[:, worlds] = 0

    def update(self, signals: Signals, masks: Mapping[str, BoolArray]) -> None:
        """Add signals and masks by name, (num_steps, num_worlds) or (num_worlds,) each."""
        values = np.array([signals[name] for name in self._signals], dtype=np.float64)
        is_sampled = np.array([masks[name] for name in self._masks])
        num_worlds = self._total.shape[1]
        by_signal = values.reshape(len(values), -1, num_worlds)
        by_mask = is_sampled.reshape(len(is_sampled), -1, num_worlds)
        fold(self._folds, by_signal, by_mask, self._total, self._count)

    def values(self) -> dict[str, Array]:
        """Return the metrics so far, (num_worlds,) each; nan where no step was sampled."""
        result: dict[str, Array] = {}
        rows = zip(self._metrics, self._total, self._count, strict=True)
        for metric, total, count in rows:
            value = total.copy()
            if metric.statistic in ("rms", "mean"):
                value /= np.maximum(count, 1)
            if metric.statistic == "rms":
                value = np.sqrt(value)
            if metric.statistic != "count":
                value[count == 0] = np.nan
            result[metric.name] = value
        return result
