"""Scores of an episode from the samples of its steps, such as RMS and peak. One row per world.

Which scores there are is listed in `robots/thormang/metrics.csv` and `world/joint_metrics.csv`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from elastic_env.core.compiled import compiled, compiled_part
from elastic_env.core.signals import Array, BoolArray, IntArray, Signals
from elastic_env.world.rows import WHOLE, record_type

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


_NEUTRAL: dict[Statistic, float] = {
    "rms": 0.0,
    "mean": 0.0,
    "min": np.inf,
    "max": -np.inf,
    "peak": 0.0,
    "last": np.nan,
    "count": 0.0,
}
"""What a statistic is before its first sample. `joined` knows a statistic by its place here."""

FOLD = record_type(("statistic", WHOLE), ("signal", WHOLE), ("mask", WHOLE))
"""A metric as places in `_NEUTRAL` and in the rows of signals and masks."""


@compiled
def fold(folds: Any, signals: Array, masks: BoolArray, total: Array, count: IntArray) -> None:
    """Take samples into the statistics in the order of their steps.

    The result does not depend on how many steps are taken at once.

    Args:
        folds: Records of `FOLD`, (rows,).
        signals: (signals, num_steps, num_worlds).
        masks: Whether a sample counts, (masks, num_steps, num_worlds).
        total: To be brought up to date, (rows, num_worlds).
        count: Number of samples, likewise.
    """
    for row in range(len(folds)):
        statistic = folds[row].statistic
        values = signals[folds[row].signal]
        is_sampled = masks[folds[row].mask]
        for step in range(values.shape[0]):
            for world in range(values.shape[1]):
                if is_sampled[step, world]:
                    before = total[row, world]
                    total[row, world] = join_sample(statistic, before, values[step, world])
                    count[row, world] += 1


@compiled_part
def join_sample(statistic: int, before: float, value: float) -> float:
    """A statistic and the next sample; a sample that is nan makes all but the last value nan."""
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
        statistics = [*_NEUTRAL]
        self._metrics = metrics
        self._signals = [*dict.fromkeys(metric.signal for metric in metrics)]
        self._masks = [*dict.fromkeys(metric.over for metric in metrics)]
        self._folds = np.zeros(len(metrics), FOLD)
        for row, own in zip(self._folds, metrics, strict=True):
            row["statistic"] = statistics.index(own.statistic)
            row["signal"] = self._signals.index(own.signal)
            row["mask"] = self._masks.index(own.over)
        neutral = [[_NEUTRAL[metric.statistic]] for metric in metrics]
        self._neutral = np.tile(neutral, num_worlds)
        self._total = self._neutral.copy()
        self._count = np.zeros(self._total.shape, dtype=np.int64)

    def restart(self, worlds: BoolArray) -> None:
        """Begin new episodes in some worlds, (num_worlds,) mask."""
        self._total[:, worlds] = self._neutral[:, worlds]
        self._count[:, worlds] = 0

    def update(self, signals: Signals, masks: Mapping[str, BoolArray]) -> None:
        """Take signals and masks by name, (num_steps, num_worlds) or (num_worlds,) each."""
        values = np.array([signals[name] for name in self._signals], dtype=np.float64)
        sampled = np.array([masks[name] for name in self._masks])
        steps = (-1, self._total.shape[1])
        by_signal = values.reshape(len(values), *steps)
        by_mask = sampled.reshape(len(sampled), *steps)
        fold(self._folds, by_signal, by_mask, self._total, self._count)

    def values(self) -> dict[str, Array]:
        """Metrics so far, (num_worlds,) each; nan where no step was sampled."""
        found: dict[str, Array] = {}
        rows = zip(self._metrics, self._total, self._count, strict=True)
        for metric, total, count in rows:
            value = total.copy()
            if metric.statistic in ("rms", "mean"):
                value /= np.maximum(count, 1)
            if metric.statistic == "rms":
                value = np.sqrt(value)
            if metric.statistic != "count":
                value[count == 0] = np.nan
            found[metric.name] = value
        return found
