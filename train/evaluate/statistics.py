"""Statistics over training seeds: changes, interquartile means, bootstrap intervals.

What is drawn at random in learning is the training seed, so intervals are over training seeds and
never over the episodes of one of them [Agarwal 2021, Colas 2019]. A policy is compared with its
base on the same episodes.

[Agarwal 2021] R. Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical
Precipice", NeurIPS. [Colas 2019] C. Colas et al., "A Hitchhiker's Guide to Statistical Comparisons
of Reinforcement Learning Algorithms".
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from elastic_env.core.signals import Array

CONFIDENCE = 0.95
RESAMPLES = 9999
_BOOTSTRAP: dict[str, Any] = {
    **{"n_resamples": RESAMPLES, "confidence_level": CONFIDENCE},
    **{"method": "percentile", "paired": True, "vectorized": True},
}
WORST = 0.1
"""Share of the robots that count as the worst ones."""
_CUT = 0.25
_BOOTSTRAP_SEED = 0


@dataclass(frozen=True)
class Estimate:
    """A figure over training seeds.

    Attributes:
        value: The figure; nan where there is none.
        low, high: 95 % interval over training seeds; None where fewer than two of them have the
            figure.
    """

    value: float
    low: float | None = None
    high: float | None = None

    @property
    def has_interval(self) -> bool:
        """True if there are training seeds enough for an interval."""
        return self.low is not None

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
        if self.low is None or self.high is None:
            return Estimate(factor * self.value)
        return Estimate(factor * self.value, factor * self.low, factor * self.high)


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

    return stats.trim_mean(values, _CUT, axis=axis)


def worst_share_mean(values: Array, share: float = WORST) -> float:
    """Mean of the highest share of some values, their CVaR [Rockafellar2000]; nan of none.

    The value at the edge counts in part, so that 32 values have a worst tenth of 3.2. A tenth of
    fewer than ten is the highest.

    [Rockafellar2000] R. T. Rockafellar, S. Uryasev, "Optimization of Conditional Value-at-Risk", J.
    Risk 2(3).
    """
    if len(values) == 0:
        return float("nan")
    counted = max(share * len(values), 1.0)
    weights = np.clip(counted - np.arange(len(values)), 0.0, 1.0)
    return float(weights @ np.sort(values)[::-1] / counted)


def beats(mine: Any, base: Any) -> Any:
    """1 where a policy is better (lower) than its base, one half in a tie, else 0."""
    return (mine < base) + 0.5 * (mine == base)


def over_seeds(values: Sequence[float] | Array) -> Estimate:
    """Interquartile mean over training seeds with its 95 % percentile bootstrap interval.

    Args:
        values: One per training seed; those that are nan have no figure and are left out.
    """
    found = np.asarray(values, dtype=np.float64)
    found = np.sort(found[np.isfinite(found)])
    if len(found) == 0:
        return Estimate(float("nan"))
    value = float(interquartile_mean(found))
    if len(found) < 2:
        return Estimate(value)
    return Estimate(value, *_interval((found,), interquartile_mean))


def improvement(won: Array, played: Array) -> Estimate:
    """Probability that an episode is better (lower) than the same with the base; ties count half.

    Args:
        won: Pairs of episodes in which the policy is better, (seeds, scenarios).
        played: Pairs of episodes, (seeds, scenarios).

    Returns:
        Share of all pairs of training seed and episode, with an interval over training seeds. As in
        `change`, seeds count that have pairs in every scenario.
    """
    whole = (played > 0).all(axis=1)
    both = np.column_stack([won[whole].sum(axis=1), played[whole].sum(axis=1)])
    if not len(both):
        return Estimate(float("nan"))
    samples = np.array(sorted(both.tolist())).T
    share = float(_share(*samples))
    if len(both) < 2:
        return Estimate(share)
    return Estimate(share, *_interval(tuple(samples), _share))


def _interval(samples: tuple[Array, ...], statistic: Any) -> tuple[float, float]:
    """Percentile bootstrap over training seeds; the same sorted samples give the same interval."""
    # here: it takes half a second to load, and most programs need none of it
    from scipy import stats

    rng = np.random.default_rng(_BOOTSTRAP_SEED)
    found = stats.bootstrap(samples, statistic, rng=rng, **_BOOTSTRAP)
    low, high = found.confidence_interval
    return float(low), float(high)


def _share(won: Array, played: Array, axis: int = -1) -> Any:
    return won.sum(axis=axis) / played.sum(axis=axis)
