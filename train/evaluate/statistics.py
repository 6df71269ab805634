"""Statistics over training seeds and robots: changes, interquartile means, bootstrap intervals.

Training seeds are random, and a scenario draws robots at random. An interval is over seeds, robots
or both, depending on which there are several of [Agarwal 2021, Colas 2019]. All seeds play the same
robots. So a resample draws seeds, and robots of every cell, and crosses the two [Owen 2007]. A
policy is compared with its base on the same episodes. If one robot plays all episodes of a policy
without training, the interval is over the episodes. They differ in noise, pushes and slopes.

[Agarwal 2021] R. Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical
Precipice", NeurIPS. [Colas 2019] C. Colas et al., "A Hitchhiker's Guide to Statistical Comparisons
of Reinforcement Learning Algorithms". [Owen 2007] A. B. Owen, "The Pigeonhole Bootstrap", Ann.
Appl. Stat. 1(2).
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np

from elastic_env.core.signals import Array, IntArray

CONFIDENCE = 0.95
RESAMPLES = 9999
MOST_DRAWS = 10**7
"""Largest number of units that all resamples draw; it bounds the resamples of many episodes."""
WORST = 0.1
"""Share of the robots that count as the worst ones."""
_TRIM_SHARE = 0.25
_BOOTSTRAP_SEED = 0

Counts: TypeAlias = Sequence[Array]
"""Number of times that each resample has each robot, (resamples, robots) for every cell."""


@dataclass(frozen=True)
class Estimate:
    """An estimate over training seeds and drawn robots.

    Attributes:
        value: The estimate; nan if there is none.
        low, high: 95 % interval over seeds and robots; None with fewer than two of both.
        seeds, robots, episodes: Training seeds, drawn robots of all cells, and episodes of one
            robot that the interval is over; 0 if it is not over them.
    """

    value: float
    low: float | None = None
    high: float | None = None
    seeds: int = field(default=0, compare=False)
    robots: int = field(default=0, compare=False)
    episodes: int = field(default=0, compare=False)

    @property
    def has_interval(self) -> bool:
        """True if there are enough training seeds or robots for an interval."""
        return self.low is not None

    @property
    def over(self) -> str:
        """Units of the interval: "10 training seeds and 64 robots"; empty without one."""
        units = {"training seeds": self.seeds, "robots": self.robots, "episodes": self.episodes}
        return " and ".join(f"{n} {unit}" for unit, n in units.items() if n)

    @property
    def is_known(self) -> bool:
        """True if there is a value."""
        return bool(np.isfinite(self.value))

    @property
    def ends(self) -> tuple[float, float]:
        """Ends of the interval; the value twice without one."""
        if self.low is None or self.high is None:
            return self.value, self.value
        return self.low, self.high

    def record(self, name: str) -> dict[str, object]:
        """Columns of a CSV file: the value, and the ends of the interval, empty without one."""
        low = "" if self.low is None else self.low
        high = "" if self.high is None else self.high
        return {name: self.value, f"{name}_low": low, f"{name}_high": high}

    def times(self, factor: float) -> "Estimate":
        """Return the estimate in another unit; the factor is positive."""
        bounds = (self.low, self.high)
        low, high = (None if end is None else factor * end for end in bounds)
        return replace(self, value=factor * self.value, low=low, high=high)


def change(mine: Array, base: Array) -> Array:
    """Relative change of every training seed: mean over scenarios, against the base's, minus one.

    Args:
        mine: Means of a metric over episodes, (seeds, scenarios); nan where there is no pair of
            episodes.
        base: The base's means over the same episodes, (seeds, scenarios).

    Returns:
        (seeds,); nan if a scenario has no pair, since the mean would be over other scenarios.
    """
    mine = np.mean(mine, axis=-1)
    base = np.mean(base, axis=-1)
    return np.where(base > 0.0, mine / np.where(base > 0.0, base, 1.0) - 1.0, np.nan)


def interquartile_mean(values: Array, axis: int = -1) -> Any:
    """Mean without the lowest and the highest quarter, each rounded down to whole values."""
    # imported here: it takes half a second to load, and most programs do not need it
    from scipy import stats

    # with any nan, SciPy would loop over the rows
    is_unknown = np.isnan(values).any(axis=axis, keepdims=True)
    trimmed = stats.trim_mean(np.where(is_unknown, 0.0, values), _TRIM_SHARE, axis=axis)
    return np.where(np.squeeze(is_unknown, axis=axis), np.nan, trimmed)[()]


def beats(mine: Any, base: Any) -> Any:
    """Return 1 where a policy is better (lower) than its base, one half in a tie, otherwise 0."""
    return (mine < base) + 0.5 * (mine == base)


def improvement(won: Sequence[Array], played: Sequence[Array]) -> Estimate:
    """Probability that an episode is better (lower) than the same with the base; ties count half.

    Args:
        won: Pairs of episodes in which the policy is better, (seeds, robots) for every cell.
        played: All pairs of episodes, likewise.

    Returns:
        Share of all pairs of training seed and episode, with an interval. As in `change`, only
        seeds with pairs in every cell count.
    """
    is_complete = np.all([cell.sum(axis=1) > 0 for cell in played], axis=0)

    def sums(counts: Counts) -> Array:
        parts = [
            sum(count @ cell.T for count, cell in zip(counts, cells, strict=True))
            for cells in (won, played)
        ]
        return np.where(is_complete, np.array(parts), np.nan)

    return estimate(sums, [cell.shape[1] for cell in played], _won_share)


def _won_share(parts: Array, axis: int = -1) -> Any:
    """Won over played pairs, from their numbers (2, ..., seeds); nan without a pair."""
    won, played = parts.sum(axis=axis)
    return won / np.where(played > 0.0, played, np.nan)


def mean_of_robots(values: Array, counts: Array) -> Array:
    """Means over robots in resamples, (seeds, robots) to (resamples, seeds).

    Robots that are nan are left out; the mean of no robot is nan.
    """
    is_known = np.isfinite(values)
    total = counts @ np.where(is_known, values, 0.0).T
    number = counts @ is_known.T.astype(np.float64)
    return total / np.where(number > 0.0, number, np.nan)


Mean: TypeAlias = Callable[[Array, Array], Array]
"""Mean over robots in resamples, from values and counts, as `mean_of_robots`."""
Part: TypeAlias = Callable[[Array], tuple[Array, Array]]
"""Number of values below the part that counts, and up to its end, in a sorted sample of n."""


def middle_half(n: Array) -> tuple[Array, Array]:
    """The part of `interquartile_mean`."""
    trimmed = np.floor(_TRIM_SHARE * n)
    return trimmed, n - trimmed


def worst_share(n: Array) -> tuple[Array, Array]:
    """The highest tenth, whose mean is the CVaR [Rockafellar2000].

    The value at the edge counts in part: the worst tenth of 32 values has 3.2 values. The worst
    tenth of fewer than ten values is the highest value.

    [Rockafellar2000] R. T. Rockafellar, S. Uryasev, "Optimization of Conditional Value-at-Risk", J.
    Risk 2(3).
    """
    return n - np.maximum(WORST * n, 1.0), n


def middle(n: Array) -> tuple[Array, Array]:
    """The part of the median: the middle value, or half of each of the two middle values."""
    return (n - 1.0) / 2.0, (n + 1.0) / 2.0


def mean_of_part(part: Part) -> Mean:
    """Return the mean over a part of the robots, which are sorted by their values."""

    def mean(values: Array, counts: Array) -> Array:
        return np.stack([_mean_of_part(seed, counts, part) for seed in values], axis=-1)

    return mean


def _mean_of_part(values: Array, counts: Array, part: Part) -> Array:
    """Means of one seed, (robots,) to (resamples,)."""
    known = np.sort(values[np.isfinite(values)])
    if not len(known):
        return np.full(len(counts), np.nan)
    sorted_counts = counts[:, np.argsort(values)[: len(known)]]
    ends = sorted_counts.cumsum(axis=1)
    low, high = part(ends[:, -1:])
    weights = np.minimum(ends, high) - np.maximum(ends - sorted_counts, low)
    size = np.where(ends[:, -1:] > 0.0, high - low, 0.0)
    total = np.maximum(weights, 0.0) @ known
    return total / np.where(size > 0.0, size, np.nan)[:, 0]


def estimate(
    figures: Callable[[Counts], Array],
    robots: Sequence[int],
    combine: Callable[..., Any] = interquartile_mean,
) -> Estimate:
    """An estimate with its 95 % percentile bootstrap interval over training seeds and robots.

    Without robots the interval is that of `scipy.stats.bootstrap`, bit for bit.

    Args:
        figures: Values of every seed in resamples of the robots, (..., resamples or 1, seeds);
            seeds that are nan with all robots are left out.
        robots: Number of robots of every cell; 1 if none is drawn.
        combine: Statistic over seeds, the last axis.
    """
    once = np.asarray(figures([np.ones((1, number)) for number in robots]))
    values = once.reshape(math.prod(once.shape[:-1]), once.shape[-1])
    known = np.flatnonzero(np.isfinite(values).all(axis=0))
    if not len(known):
        return Estimate(float("nan"))
    # sorted, so that the order of the files makes no difference
    order = known[np.lexsort(values[::-1, known])]
    value = float(np.squeeze(combine(once[..., order], axis=-1)))
    seeds = len(order)
    drawn = sum(number for number in robots if number > 1)
    if seeds < 2 and not drawn:
        return Estimate(value)
    chosen, counts = _resamples(seeds, tuple(robots))
    resampled = np.asarray(figures(counts) if drawn else once)[..., order]
    resampled = np.broadcast_to(resampled, (*resampled.shape[:-2], len(chosen), seeds))
    chosen = np.broadcast_to(chosen, resampled.shape)
    replicates = combine(np.take_along_axis(resampled, chosen, axis=-1), axis=-1)
    tail = (1.0 - CONFIDENCE) / 2.0
    tails = 100.0 * np.array([tail, 1.0 - tail])
    low, high = np.percentile(replicates[np.isfinite(replicates)], tails)
    return Estimate(value, float(low), float(high), seeds if seeds > 1 else 0, drawn)


def named_intervals(estimates: Iterable[Estimate]) -> str:
    """Confidence and units of intervals, such as "95 % over 64 robots"; empty without any."""
    over = dict.fromkeys(estimate.over for estimate in estimates if estimate.over)
    return f"{100.0 * CONFIDENCE:g} % over {', or '.join(over)}" if over else ""


@lru_cache(maxsize=8)
def _resamples(seeds: int, robots: tuple[int, ...]) -> tuple[IntArray, list[Array]]:
    """Seeds of every resample, and its counts of the robots of every cell; always the same."""
    rng = np.random.default_rng(_BOOTSTRAP_SEED)
    resamples = min(RESAMPLES, MOST_DRAWS // max(robots, default=1))
    chosen = rng.integers(0, seeds, (resamples, seeds))
    return chosen, [_draw_counts(rng, resamples, number) for number in robots]


def _draw_counts(rng: np.random.Generator, resamples: int, number: int) -> Array:
    """Draw as many units as there are, with replacement; count each unit, (resamples, number)."""
    if number == 1:
        return np.ones((resamples, 1))
    drawn = rng.integers(0, number, (resamples, number))
    drawn += number * np.arange(resamples)[:, None]
    counts = np.bincount(drawn.ravel(), minlength=resamples * number)
    return counts.reshape(resamples, number).astype(np.float64)
