"""Scores of an episode from the samples of its steps: RMS, peak, range, mean. One row per world."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from elastic_env.core.compiled import compile_now, compiled
from elastic_env.core.signals import Array, BoolArray, Signals


@dataclass(frozen=True)
class Metric:
    """One figure of an episode: a statistic of a signal over the steps of a mask.

    The name ends with its unit, as in link_error_rms_rad. The mask is "scored", "all", or one that
    the task names.
    """

    name: str
    signal: str
    statistic: Literal["rms", "peak", "min", "max", "mean", "count"]
    over: str = "scored"


@dataclass(frozen=True)
class _Fold:
    """How a statistic comes about: what is taken of a sample, how that of two is joined, and
    what changes nothing.
    """

    taken: Callable[[Array], Array]
    joined: np.ufunc
    neutral: float


_FOLDS = {
    "rms": _Fold(np.square, np.add, 0.0),
    "mean": _Fold(np.positive, np.add, 0.0),
    "min": _Fold(np.positive, np.minimum, np.inf),
    "max": _Fold(np.positive, np.maximum, -np.inf),
    "peak": _Fold(np.abs, np.maximum, 0.0),
    "count": _Fold(np.ones_like, np.add, 0.0),
}


class RunningStatistic:
    """One statistic of the rows of an array, over the steps at which they were sampled, in every
    world.
    """

    def __init__(self, name: str, num_rows: int, num_worlds: int) -> None:
        self._name = name
        self._total = np.full((num_rows, num_worlds), _FOLDS[name].neutral)
        self._count = np.zeros((num_rows, num_worlds), dtype=np.int64)

    def restart(self, worlds: BoolArray) -> None:
        """Forget the samples of some worlds, (num_worlds,) mask."""
        self._total[:, worlds] = _FOLDS[self._name].neutral
        self._count[:, worlds] = 0

    def update(self, values: Array, sampled: BoolArray) -> None:
        """Take the samples of some steps where `sampled` is true, (num_rows, num_steps, num_worlds)
        both.

        The result does not depend on how many steps are taken at once.
        """
        fold = _FOLDS[self._name]
        # where, not a product: a nan outside does not count
        taken = np.where(sampled, fold.taken(values), fold.neutral)
        self._count += sampled.sum(axis=1)
        if fold.joined is np.add:
            _add_in_order(taken, self._total)
        else:
            fold.joined(
                self._total,
                fold.joined.reduce(taken, axis=1, initial=fold.neutral),
                out=self._total,
            )

    def values(self) -> Array:
        """The statistic of every row, (num_rows, num_worlds); nan where there was no sample, but
        for their number.
        """
        if self._name == "count":
            return self._total.copy()
        value = (
            self._total / np.maximum(self._count, 1)
            if self._name in ("rms", "mean")
            else self._total
        )
        return np.where(self._count > 0, np.sqrt(value) if self._name == "rms" else value, np.nan)


@compiled
def _add_in_order(values: Array, total: Array) -> None:
    """Add values, (num_rows, num_steps, num_worlds), to a total, (num_rows, num_worlds), step
    after step.
    """
    for row in range(values.shape[0]):
        for step in range(values.shape[1]):
            for world in range(values.shape[2]):
                total[row, world] += values[row, step, world]


class EpisodeMetrics:
    """The metrics of a task, accumulated step by step in every world.

    What it compiles it compiles now: a motion of hardware cannot wait for the compiler.
    """

    def __init__(self, metrics: Sequence[Metric], num_worlds: int) -> None:
        self._names = [metric.name for metric in metrics]
        by_statistic = {name: [m for m in metrics if m.statistic == name] for name in _FOLDS}
        self._metrics = {name: own for name, own in by_statistic.items() if own}
        self._statistics = {
            name: RunningStatistic(name, len(m), num_worlds) for name, m in self._metrics.items()
        }
        none = np.zeros((1, num_worlds))
        compile_now(
            self.update,
            {m.signal: none for m in metrics},
            {m.over: none.astype(np.bool_) for m in metrics},
        )

    def restart(self, worlds: BoolArray) -> None:
        """Begin new episodes in some worlds, (num_worlds,) mask."""
        for statistic in self._statistics.values():
            statistic.restart(worlds)

    def update(self, signals: Signals, masks: Mapping[str, BoolArray]) -> None:
        """Take steps: the task's signals and the masks by name, (num_steps, num_worlds) each, or
        (num_worlds,).
        """
        for name, metrics in self._metrics.items():
            values = np.array(
                [np.atleast_2d(signals[metric.signal]) for metric in metrics], dtype=np.float64
            )
            sampled = np.array([np.atleast_2d(masks[metric.over]) for metric in metrics])
            self._statistics[name].update(values, sampled)

    def values(self) -> dict[str, Array]:
        """Metrics so far, (num_worlds,) each; nan where no step was sampled."""
        rows = {
            metric.name: row
            for name, metrics in self._metrics.items()
            for metric, row in zip(metrics, self._statistics[name].values(), strict=True)
        }
        return {name: rows[name] for name in self._names}
