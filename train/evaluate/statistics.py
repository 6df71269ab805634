"""Statistics over training seeds: paired changes, interquartile means, bootstrap intervals, probability of improvement.

What is drawn at random in learning is the training seed, so intervals are over training seeds and never over the
episodes of one of them [Agarwal 2021, Colas 2019]. A policy is compared with its base on the same episodes.

[Agarwal 2021] R. Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice", NeurIPS.
[Colas 2019] C. Colas et al., "A Hitchhiker's Guide to Statistical Comparisons of Reinforcement Learning Algorithms".
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from elastic_env.core.signals import Array

CONFIDENCE, RESAMPLES = 0.95, 9999
WORST = 0.1
"""Share of the robots that count as the worst ones."""
_CUT = 0.25
_BOOTSTRAP_SEED = 0


@dataclass(frozen=True)
class Estimate:
    """A figure over training seeds.

    Attributes:
        value: The figure; nan where there is none.
        low, high: 95 % interval over training seeds; None where fewer than two of them have the figure.
    """

    value: float
    low: float | None = None
    high: float | None = None

    @property
    def has_interval(self) -> bool:
        """Whether there are training seeds enough for an interval."""
        return self.low is not None

    @property
    def cells(self) -> tuple[object, object, object]:
        """Value and ends of the interval for a CSV file; empty where there is none."""
        return self.value, "" if self.low is None else self.low, "" if self.high is None else self.high

    def scaled(self, factor: float) -> "Estimate":
        """In another unit; the factor is positive."""
        if self.low is None or self.high is None:
            return Estimate(factor * self.value)
        return Estimate(factor * self.value, factor * self.low, factor * self.high)


@dataclass(frozen=True, eq=False)
class Pairs:
    """A metric of a policy and of its base on the same episodes, those in which neither failed.

    Attributes:
        mine, base: The metric, (n,) each.
        left_out: Episodes without a pair, because one of both failed or has no figure.
    """

    mine: Array
    base: Array
    left_out: int = 0

    def __len__(self) -> int:
        return len(self.mine)


def pair(mine: Sequence[Mapping[str, Any]], base: Sequence[Mapping[str, Any]], metric: str) -> Pairs:
    """Pair episodes by their seed, whatever their order.

    Args:
        mine: Records of episodes in one cell, with `seed`, `termination` and the metric.
        base: The same of the base.
        metric: Name of the metric.

    Raises:
        ValueError: A seed occurs twice, so that nobody can say which episode belongs to which.
    """
    ours, theirs = _by_seed(mine), _by_seed(base)
    seeds = sorted(ours.keys() & theirs.keys())
    found = [(_value(ours[seed], metric), _value(theirs[seed], metric)) for seed in seeds]
    kept = [both for both in found if np.isfinite(both).all()]
    values = np.array(kept, dtype=np.float64).reshape(-1, 2)
    return Pairs(values[:, 0], values[:, 1], len(ours.keys() | theirs.keys()) - len(kept))


def change(scenarios: Sequence[Pairs]) -> float:
    """Relative change of one training seed: mean over scenarios of means over episodes, against the base's, minus one.

    nan where a scenario has no pair: without it the mean would be one over other scenarios.
    """
    if not scenarios or any(len(pairs) == 0 for pairs in scenarios):
        return float("nan")
    base = float(np.mean([pairs.base.mean() for pairs in scenarios]))
    return float(np.mean([pairs.mine.mean() for pairs in scenarios])) / base - 1.0 if base > 0.0 else float("nan")


def interquartile_mean(values: Array, axis: int = -1) -> Any:
    """Mean of what is left without the lowest and the highest quarter, rounded down in number."""
    from scipy import stats  # here: it takes half a second to load, and most programs need none of it

    return stats.trim_mean(values, _CUT, axis=axis)


def worst_share_mean(values: Array, share: float = WORST) -> float:
    """Mean of the highest share of some values, their CVaR [Rockafellar2000]; nan of none.

    The value at the edge counts in part, so that 32 values have a worst tenth of 3.2. A tenth of fewer than ten is the
    highest.

    [Rockafellar2000] R. T. Rockafellar, S. Uryasev, "Optimization of Conditional Value-at-Risk", J. Risk 2(3).
    """
    if len(values) == 0:
        return float("nan")
    counted = max(share * len(values), 1.0)
    weights = np.clip(counted - np.arange(len(values)), 0.0, 1.0)
    return float(weights @ np.sort(values)[::-1] / counted)


def share_better(mine: Sequence[Mapping[str, Any]], base: Sequence[Mapping[str, Any]], metric: str) -> float:
    """Share of the episodes of both in which the policy is better (lower) than the base; ties count half.

    To fail is worse than any value, and where both fail it is a tie. nan where they have no episode in common. An
    episode that reached its end without a figure, such as a ZMP of feet that never carried anything, is left out.

    Args:
        mine: Records of episodes in one cell, with `seed`, `termination` and the metric.
        base: The same of the base.
        metric: Name of the metric.
    """
    ours, theirs = _by_seed(mine), _by_seed(base)
    found = [(_ranked(ours[seed], metric), _ranked(theirs[seed], metric)) for seed in sorted(ours.keys() & theirs)]
    known = [both for both in found if not np.isnan(both).any()]
    values = np.array(known, dtype=np.float64).reshape(-1, 2)
    return _wins(Pairs(values[:, 0], values[:, 1])) / len(known) if known else float("nan")


def over_seeds(values: Sequence[float]) -> Estimate:
    """Interquartile mean over training seeds with its 95 % percentile bootstrap interval.

    Args:
        values: One per training seed; those that are nan have no figure and are left out.
    """
    found = np.sort(np.array([value for value in values if np.isfinite(value)], dtype=np.float64))
    if len(found) == 0:
        return Estimate(float("nan"))
    value = float(interquartile_mean(found))
    if len(found) < 2:
        return Estimate(value)
    return Estimate(value, *_interval((found,), interquartile_mean))


def improvement(seeds: Sequence[Sequence[Pairs]]) -> Estimate:
    """Probability that an episode with the policy is better (lower) than the same with the base; ties count half.

    Args:
        seeds: Pairs of every training seed, in one or several scenarios.

    Returns:
        Share of all pairs of training seed and episode, with an interval over training seeds.
    """
    # as in `change`: without one of the scenarios it would be a share over other ones
    seeds = [scenarios for scenarios in seeds if all(map(len, scenarios))]
    counts = [sum(map(len, scenarios)) for scenarios in seeds]
    wins = [sum(_wins(pairs) for pairs in scenarios) for scenarios in seeds]
    both = sorted((w, n) for w, n in zip(wins, counts, strict=True) if n > 0)
    won, played = np.array(both, dtype=np.float64).reshape(-1, 2).T
    if len(played) == 0:
        return Estimate(float("nan"))
    share = _share(won, played)
    if len(played) < 2:
        return Estimate(float(share))
    return Estimate(float(share), *_interval((won, played), _share))


def _interval(samples: tuple[Array, ...], statistic: Any) -> tuple[float, float]:
    """Percentile bootstrap over training seeds; the same samples, sorted, give the same interval."""
    from scipy import stats  # here: it takes half a second to load, and most programs need none of it

    found = stats.bootstrap(
        samples, statistic, n_resamples=RESAMPLES, confidence_level=CONFIDENCE, method="percentile", paired=True,
        vectorized=True, rng=np.random.default_rng(_BOOTSTRAP_SEED),
    )  # fmt: skip
    return float(found.confidence_interval.low), float(found.confidence_interval.high)


def _share(won: Array, played: Array, axis: int = -1) -> Any:
    return won.sum(axis=axis) / played.sum(axis=axis)


def _wins(pairs: Pairs) -> float:
    return float(np.sum(pairs.mine < pairs.base) + 0.5 * np.sum(pairs.mine == pairs.base))


def _by_seed(records: Sequence[Mapping[str, Any]]) -> dict[int, Mapping[str, Any]]:
    found = {record["seed"]: record for record in records}
    if len(found) < len(records):
        raise ValueError(f"every episode needs a seed of its own to be paired, got {[r['seed'] for r in records]}")
    return found


def _value(record: Mapping[str, Any], metric: str) -> float:
    """The metric; nan where the episode failed or has none."""
    value = record.get(metric)
    return float("nan") if record["termination"] or value is None else float(value)


def _ranked(record: Mapping[str, Any], metric: str) -> float:
    """The metric, infinite where the episode failed."""
    return float("inf") if record["termination"] else _value(record, metric)
