"""Statistics over training seeds and robots: changes, interquartile means, bootstrap intervals.

Learning draws the training seed at random, and a scenario draws robots. An interval is over both
where there are several of both, and over the one of which there are several [Agarwal 2021, Colas
2019]. All seeds play the same robots. So a resample draws seeds, and robots of every cell, and
crosses the two [Owen 2007]. A policy is compared with its base on the same episodes. One that was
not trained has nothing else that is random where one robot plays all episodes: there the interval
is over these, which differ in noise, pushes and slopes.

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
"""Units that all resamples draw at most: many episodes make fewer resamples, which need less."""
WORST = 0.1
"""Share of the robots that count as the worst ones."""
_CUT = 0.25
_BOOTSTRAP_SEED = 0

Counts: TypeAlias = Sequence[Array]
"""How often every robot is in each resample, (resamples, robots) for every cell."""


@dataclass(frozen=True)
class Estimate:
    """A figure over training seeds and drawn robots.

    Attributes:
        value: The figure; nan where there is none.
        low, high: 95 % interval over seeds and robots; None where there are fewer than two of each.
        seeds, robots, episodes: Training seeds that the interval is over, drawn robots of all
            cells, and episodes of one robot; 0 where it is not over them.
    """

    value: float
    low: float | None = None
    high: float | None = None
    seeds: int = field(default=0, compare=False)
    robots: int = field(default=0, compare=False)
    episodes: int = field(default=0, compare=False)

    @property
    def has_interval(self) -> bool:
        """True if there are training seeds or robots enough for an interval."""
        return self.low is not None

    @property
    def over(self) -> str:
        """What the interval is over: "10 training seeds and 64 robots"; empty without one."""
        units = {
            "training seeds": self.seeds,
            "robots": self.robots,
            "episodes": self.episodes,
        }
        return " and ".join(f"{number} {unit}" for unit, number in units.items() if number)

    @property
    def is_known(self) -> bool:
        """True if there is a figure."""
        return bool(np.isfinite(self.value))

    @property
    def ends(self) -> tuple[float, float]:
        """Ends of the interval; twice the value where there is none."""
        if self.low is None or self.high is None:
            return self.value, self.value
        return self.low, self.high

    def record(self, name: str) -> dict[str, object]:
        """Columns of a CSV file: the value, and the ends of the interval, empty without one."""
        low = "" if self.low is None else self.low
        high = "" if self.high is None else self.high
        return {name: self.value, f"{name}_low": low, f"{name}_high": high}

    def times(self, factor: float) -> "Estimate":
        """In another unit; the factor is positive."""
        ends: dict[str, Any] = {}
        if self.low is not None and self.high is not None:
            ends = {"low": factor * self.low, "high": factor * self.high}
        return replace(self, value=factor * self.value, **ends)


def change(mine: Array, base: Array) -> Array:
    """Relative change of every training seed: mean over scenarios, against the base's, minus one.

    Args:
        mine: Means of a metric over episodes, (seeds, scenarios); nan where there is no pair of
            episodes.
        base: The base's means over the same episodes, (seeds, scenarios).

    Returns:
        (seeds,); nan where a scenario has no pair: without it the mean would be one over other
        scenarios.
    """
    mine = np.mean(mine, axis=-1)
    base = np.mean(base, axis=-1)
    return np.where(base > 0.0, mine / np.where(base > 0.0, base, 1.0) - 1.0, np.nan)


def interquartile_mean(values: Array, axis: int = -1) -> Any:
    """Mean of what is left without the lowest and the highest quarter, rounded down in number."""
    # here: it takes half a second to load, and most programs need none of it
    from scipy import stats

    # one nan, and SciPy goes row by row
    is_unknown = np.isnan(values).any(axis=axis, keepdims=True)
    trimmed = stats.trim_mean(np.where(is_unknown, 0.0, values), _CUT, axis=axis)
    return np.where(np.squeeze(is_unknown, axis=axis), np.nan, trimmed)[()]


def beats(mine: Any, base: Any) -> Any:
    """1 where a policy is better (lower) than its base, one half in a tie, else 0."""
    return (mine < base) + 0.5 * (mine == base)


def over_seeds(values: Sequence[float] | Array) -> Estimate:
    """Interquartile mean over training seeds with its 95 % percentile bootstrap interval.

    Args:
        values: One per training seed; those that are nan have no figure and are left out.
    """
    found = np.asarray(values, dtype=np.float64)
    return estimate(lambda _: found[None], ())


def improvement(won: Sequence[Array], played: Sequence[Array]) -> Estimate:
    """Probability that an episode is better (lower) than the same with the base; ties count half.

    Args:
        won: Pairs of episodes in which the policy is better, (seeds, robots) for every cell.
        played: Pairs of episodes, likewise.

    Returns:
        Share of all pairs of training seed and episode, with an interval. As in `change`, seeds
        count that have pairs in every cell.
    """
    whole = np.all([own.sum(axis=1) > 0 for own in played], axis=0)

    def figures(counts: Counts) -> Array:
        parts = [
            sum(count @ own.T for count, own in zip(counts, cells, strict=True))
            for cells in (won, played)
        ]
        return np.where(whole, np.array(parts), np.nan)

    return estimate(figures, [own.shape[1] for own in played], _share)


def _share(parts: Array, axis: int = -1) -> Any:
    """Won over played pairs, of (2, ..., seeds); nan without one."""
    won, played = parts.sum(axis=axis)
    return won / np.where(played > 0.0, played, np.nan)


def mean_of_robots(values: Array, counts: Array) -> Array:
    """Means over robots in resamples, (seeds, robots) to (resamples, seeds).

    Robots that are nan have no figure and are left out; a mean of none is nan.
    """
    is_known = np.isfinite(values)
    total = counts @ np.where(is_known, values, 0.0).T
    number = counts @ is_known.T.astype(np.float64)
    return total / np.where(number > 0.0, number, np.nan)


Part: TypeAlias = Callable[[Array], tuple[Array, Array]]
"""Of a sorted sample of n values, how many lie below the part that counts, and where it ends."""


def middle_half(n: Array) -> tuple[Array, Array]:
    """The part of `interquartile_mean`."""
    cut = np.floor(_CUT * n)
    return cut, n - cut


def worst_share(n: Array) -> tuple[Array, Array]:
    """The highest tenth, whose mean is the CVaR [Rockafellar2000].

    The value at the edge counts in part, so that 32 values have a worst tenth of 3.2. A tenth of
    fewer than ten is the highest.

    [Rockafellar2000] R. T. Rockafellar, S. Uryasev, "Optimization of Conditional Value-at-Risk", J.
    Risk 2(3).
    """
    return n - np.maximum(WORST * n, 1.0), n


def middle(n: Array) -> tuple[Array, Array]:
    """The part of the median: the value in the middle, or half of each of the two there."""
    return (n - 1.0) / 2.0, (n + 1.0) / 2.0


def mean_of_part(part: Part) -> Callable[[Array, Array], Array]:
    """A mean over a part of the robots, from the best to the worst; as `mean_of_robots`."""

    def mean(values: Array, counts: Array) -> Array:
        return np.stack([_mean_of_part(own, counts, part) for own in values], axis=-1)

    return mean


def _mean_of_part(values: Array, counts: Array, part: Part) -> Array:
    """Means of one seed, (robots,) to (resamples,)."""
    known = np.sort(values[np.isfinite(values)])
    order = np.argsort(values)[: len(known)]
    if not len(known):
        return np.full(len(counts), np.nan)
    own = counts[:, order]
    above = own.cumsum(axis=1)
    low, high = part(above[:, -1:])
    counted = np.minimum(above, high) - np.maximum(above - own, low)
    share = np.where(above[:, -1:] > 0.0, high - low, 0.0)
    total = np.maximum(counted, 0.0) @ known
    return total / np.where(share > 0.0, share, np.nan)[:, 0]


def estimate(
    figures: Callable[[Counts], Array],
    robots: Sequence[int],
    combine: Callable[..., Any] = interquartile_mean,
) -> Estimate:
    """A figure with its 95 % percentile bootstrap interval over training seeds and robots.

    With training seeds alone it is the one of `scipy.stats.bootstrap`, bit for bit.

    Args:
        figures: Figures of every seed in resamples of the robots, (..., resamples or 1, seeds);
            seeds that are nan with all robots are left out.
        robots: Robots of every cell; 1 where none is drawn.
        combine: A figure over seeds, the last axis.
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
    found = np.asarray(figures(counts) if drawn else once)[..., order]
    found = np.broadcast_to(found, (*found.shape[:-2], len(chosen), seeds))
    chosen = np.broadcast_to(chosen, found.shape)
    replicates = combine(np.take_along_axis(found, chosen, axis=-1), axis=-1)
    tail = (1.0 - CONFIDENCE) / 2.0
    tails = 100.0 * np.array([tail, 1.0 - tail])
    low, high = np.percentile(replicates[np.isfinite(replicates)], tails)
    is_of_seeds = seeds > 1
    return Estimate(value, float(low), float(high), seeds if is_of_seeds else 0, drawn)


def named_intervals(estimates: Iterable[Estimate]) -> str:
    """What the intervals of some figures are over, such as "95 % over 64 robots"; empty if none."""
    over = dict.fromkeys(own.over for own in estimates if own.over)
    return f"{100.0 * CONFIDENCE:g} % over {', or '.join(over)}" if over else ""


@lru_cache(maxsize=8)
def _resamples(seeds: int, robots: tuple[int, ...]) -> tuple[IntArray, list[Array]]:
    """Seeds of every resample, and how often it has each robot of every cell; always the same."""
    rng = np.random.default_rng(_BOOTSTRAP_SEED)
    resamples = min(RESAMPLES, MOST_DRAWS // max(robots, default=1))
    chosen = rng.integers(0, seeds, (resamples, seeds))
    return chosen, [_drawn_counts(rng, resamples, number) for number in robots]


def _drawn_counts(rng: np.random.Generator, resamples: int, number: int) -> Array:
    """How often each of some units is drawn in as many draws, (resamples, number)."""
    if number == 1:
        return np.ones((resamples, 1))
    drawn = rng.integers(0, number, (resamples, number))
    drawn += number * np.arange(resamples)[:, None]
    counts = np.bincount(drawn.ravel(), minlength=resamples * number)
    return counts.reshape(resamples, number).astype(np.float64)
