"""Paired changes of a comparison: residuals against bases and rivals, baselines against bases.

A residual is compared with its base and with the best policy without learning. A baseline is
compared with the base of the residuals, or without residuals with the first policy.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import pandas as pd

from elastic_env.core.signals import Array
from elastic_env.world.scenario import make_scenario
from train.evaluate.conditions import Condition
from train.evaluate.environments import Column, Environment
from train.evaluate.episodes import Evaluation, group_by
from train.evaluate.residual_seeds import Origin
from train.evaluate.statistics import (
    Counts,
    Estimate,
    change,
    estimate,
    improvement,
    interquartile_mean,
)
from train.evaluate.table import (
    ByRobot,
    EpisodeTable,
    Groups,
    Scope,
    by_episode,
    failures,
    means_of_cells,
    pair,
)

CEILING = "ceiling on the training condition"
SAME_ROBOT = "trained robot"
"""Scenario in which nothing is random: training and evaluation see the same; one whose only robot
is that of the training, so that evaluation differs by noise alone."""
HELD_OUT = "held out"
PARTLY = "partly held out"
"""Scenario that training never saw; group of scenarios of which it saw some."""
BEST_ANALYTIC = "best policy without learning"
"""Title of the policy that a residual is compared with beside its base."""
FEWEST_SEEDS = 5
"""Training seeds, or robots and episodes of a policy without them, from which on an interval is
taken for a verdict: of 95 % intervals over two seeds every other one misses the truth, over five
every eleventh."""
CLAIM_SEEDS = 10
"""Training seeds that a claim needs; with fewer, intervals exclude zero too often without any
effect.
"""
CLAIM_ROBOTS = 64
"""Drawn robots that a claim about `drawn` needs: with 8 of them means differ by 15 %."""

SIGNS = {"none": "*", "unclear": "?"}
"""Signs behind a change that is not shown, by its verdict."""
SIGNS_ARE = (
    "A star: the interval includes zero. A question mark: too few training seeds, robots or"
    " episodes to say."
)

_SMALL = 0.0995
"""Below it a share is shown with a decimal."""
_LEAST = 0.005
"""Below it a bound would look like zero without one."""

Verdict = Literal["lower", "higher", "none", "unclear"]


@dataclass(frozen=True, eq=False)
class Change(Scope):
    """A policy against its base in one metric, in one scenario or pooled over a group of them.

    Attributes:
        base: Title of the base.
        marks: What the reader has to know of the row: a ceiling, something held out.
        column: The metric.
        is_judged: Whether policies are judged by it; else it stands in tables alone.
        per_seed: Relative change of every training seed, nan where it has no pair, (seeds,); of a
            baseline one value.
        relative: Interquartile mean of it over training seeds; its interval is over them and over
            the robots of the cells that draw them.
        improvement: Probability that an episode is better than the base's.
        mine, theirs: Metric of the policy and of its base over the pairs [SI]; the interquartile
            mean over training seeds.
        num_pairs: Pairs of training seed and episode.
        falls, episodes: Failed episodes of the policy, of all of its episodes.
        base_falls, base_episodes: The same of the base.
        is_rival: Whether `base` is not the base of the residual but the best policy without
            learning.
    """

    base: str
    marks: tuple[str, ...]
    column: Column
    is_judged: bool
    per_seed: Array
    relative: Estimate
    improvement: Estimate
    mine: float
    theirs: float
    num_pairs: int
    falls: int
    episodes: int
    base_falls: int
    base_episodes: int
    is_rival: bool = False

    @property
    def num_seeds(self) -> int:
        """Training seeds; 0 of a baseline."""
        return len(self.per_seed) if self.is_family else 0

    @property
    def num_compared(self) -> int:
        """Training seeds that have something to compare."""
        return int(np.isfinite(self.per_seed).sum())

    @property
    def verdict(self) -> Verdict:
        """lower, higher, none (the interval includes zero), or unclear.

        That is with too few training seeds, or too few robots and episodes of a policy that was
        not trained.
        """
        low = self.relative.low
        high = self.relative.high
        units = self.relative.robots + self.relative.episodes
        if self.is_family:
            units = self.num_compared
        if low is None or high is None or units < FEWEST_SEEDS:
            return "unclear"
        return "lower" if high < 0.0 else "higher" if low > 0.0 else "none"

    @property
    def falls_more(self) -> bool:
        """True if the policy fails in a greater share of its episodes than its base."""
        return self.falls * self.base_episodes > self.base_falls * self.episodes

    @property
    def falls_less(self) -> bool:
        """True if it fails in a smaller share."""
        return self.falls * self.base_episodes < self.base_falls * self.episodes

    @property
    def sentence(self) -> str:
        """The row in a sentence: what it shows, and what it does not."""
        parts = [self._size]
        missing = len(self.per_seed) - self.num_compared
        if self.is_family and 0 < missing < self.num_seeds:
            seeds = f"{missing} of {self.num_seeds} training seeds"
            parts.append(f"{seeds} have nothing to compare and are not in it")
        if self.falls_more:
            parts.append(f"MORE {self.failure.upper()} than {self.base}")
        elif self.falls_less:
            parts.append(f"fewer {self.failure} than {self.base}")
        return "; ".join(parts)

    @property
    def _size(self) -> str:
        value = self.relative.value
        if not np.isfinite(value):
            where = "in one of the scenarios " if self.is_group else ""
            no = "there is no episode in which both stayed up to the end"
            return f"nothing to compare: {where}{no}"
        size = f"{percent(abs(value), signed=False)} {'lower' if value < 0.0 else 'higher'}"
        if value == 0.0:
            size = "no change"
        over = self.relative.over
        if not self.is_family and not over:
            return f"{size} (difference of means, no training seeds)"
        if self.verdict == "none":
            return "the interval includes zero: no difference shown"
        if self.verdict != "unclear":
            return size
        if not over:
            return f"{size} with one training seed: no interval"
        if self.is_family and self.num_compared == 1:
            return f"{size} with one training seed: the interval is over {over} alone"
        return f"{size} with {over}: too few to tell it from chance"


def signed_off(text: str, verdict: str) -> str:
    """A change with the sign of its verdict behind it, if it has one."""
    return f"{text} {SIGNS[verdict]}" if verdict in SIGNS else text


def percent(value: float, signed: bool = True) -> str:
    """A share in per cent, with a decimal where it is small; - where there is none."""
    if not np.isfinite(value):
        return "-"
    return f"{_hundredths(value, signed, 0.0 < abs(value) < _SMALL)} %"


def percent_interval(estimate: Estimate, signed: bool = True) -> str:
    """A share with its interval, such as −40 % [−45, −33]."""
    if not estimate.has_interval:
        return percent(estimate.value, signed)
    shares = (estimate.value, *estimate.ends)
    sizes = [abs(share) for share in shares]
    is_fine = 0.0 < max(sizes) < _SMALL or any(0.0 < size < _LEAST for size in sizes)
    value, low, high = (_hundredths(share, signed, is_fine) for share in shares)
    return f"{value} % [{low}, {high}]"


def _hundredths(share: float, signed: bool, is_fine: bool) -> str:
    return f"{100.0 * share:{'+' if signed else ''}.{int(is_fine)}f}".replace("-", "−")


def signed_interval(estimate: Estimate, verdict: str) -> str:
    """A share with its interval and the sign of its verdict, such as +1 % [−2, +4] *."""
    text = percent_interval(estimate)
    return signed_off(text, verdict) if np.isfinite(estimate.value) else text


def merge_seeds(evaluations: Sequence[Evaluation]) -> list[Evaluation]:
    """Cells with all training seeds of a family in one: all episodes, the trace of the first."""
    together: dict[tuple[object, ...], Evaluation] = {}
    for number, e in enumerate(evaluations):
        c = e.condition
        key = (number,) if c.member is None else (c.policy.title, *c.cell)
        if key in together:
            together[key].episodes.extend(e.episodes)
        else:
            together[key] = replace(e, episodes=list(e.episodes))
    return list(together.values())


def opponents(table: EpisodeTable) -> dict[str, list[str]]:
    """Titles of the policies that each policy is compared with.

    A residual has a base and a rival. A baseline has the bases of the residuals, or the first
    policy.
    """
    found = {}
    families = table.members.values()
    bases = dict.fromkeys(member.base for own in families for member in own.values())
    for title in table.policies:
        others: Iterable[str | None] = bases or table.policies[:1]
        if title in table.members:
            member = next(reversed(table.members[title].values()))
            others = (member.base, member.rival)
        found[title] = [other for other in others if other not in (title, None)]
    return found


def changes(evaluations: Sequence[Evaluation], groups: Groups | None = None) -> list[Change]:
    """All paired changes of a comparison.

    Args:
        evaluations: All cells, one per training seed.
        groups: Scenarios to pool over, by name.
    """
    table = EpisodeTable(evaluations)
    known = table.environment
    return [
        change_of(table, scope, base, column)
        for title, others in opponents(table).items()
        for base in others
        if base in table.policies
        for scope in table.scopes(title, groups or {})
        if len(table.cells_of_base(scope, base)) == len(scope.cells)
        for column in (*known.judged, *known.also)
    ]


def change_of(table: EpisodeTable, scope: Scope, base: str, column: Column) -> Change:
    """The change of a policy against another one in one metric.

    Args:
        table: All episodes.
        scope: Policy and cells; over several the means are pooled.
        base: Title of the other policy, which plays in all of these cells.
        column: The metric.

    Raises:
        ValueError: A seed occurs twice, so that nobody can say which episode belongs to which.
    """
    own = table.of(scope.policy, *scope.cells)
    drawn = [own.loc[own["cell"] == cell, "robot"].iloc[0] != "" for cell in scope.cells]
    if scope.first.member is None:
        own = by_episode(own)
    cells = table.cells_of_base(scope, base)
    beside = zip(cells, scope.cells, strict=True)
    parts = [table.of(base, there).assign(cell=cell) for there, cell in beside]
    theirs = pd.concat(parts)
    both = pair(own, theirs, column.metric)
    robot_by_robot = ByRobot(both)
    mine = robot_by_robot.figures("mine")
    base_values = robot_by_robot.figures("base")
    robots = [values.shape[1] for values in mine]
    once = [np.ones((1, number)) for number in robots]
    means = means_of_cells(mine, once)[:, 0].T
    base_means = means_of_cells(base_values, once)[:, 0].T

    def relative(counts: Counts) -> Array:
        sides = (means_of_cells(values, counts).T for values in (mine, base_values))
        return change(*sides).T

    won, played = (
        [np.nan_to_num(values) for values in robot_by_robot.figures("won", statistic)]
        for statistic in ("sum", "count")
    )
    falls, episodes = failures(own)
    base_falls, base_episodes = failures(theirs)
    member = scope.first.member
    return Change(
        **vars(scope),
        base=base,
        marks=_marks(table.families.get(scope.policy), scope.conditions),
        column=column,
        is_judged=column in table.environment.judged,
        per_seed=change(means, base_means),
        relative=of_units(estimate(relative, robots), robots, drawn),
        improvement=of_units(improvement(won, played), robots, drawn),
        mine=_mean(means),
        theirs=_mean(base_means),
        num_pairs=int(sum(values.sum() for values in played)),
        falls=falls,
        episodes=episodes,
        base_falls=base_falls,
        base_episodes=base_episodes,
        is_rival=member is not None and base == member.rival,
    )


def of_units(found: Estimate, units: Sequence[int], drawn: Sequence[bool]) -> Estimate:
    """An estimate that tells drawn robots from episodes of one robot, of units in all cells."""
    if not found.robots:
        return found
    robots = sum(n for n, is_drawn in zip(units, drawn, strict=True) if is_drawn and n > 1)
    return replace(found, robots=robots, episodes=found.robots - robots)


def _mean(values: Array) -> float:
    """Interquartile mean over training seeds of means over scenarios and episodes."""
    means = np.mean(values, axis=-1)
    means = means[np.isfinite(means)]
    return float(interquartile_mean(means)) if len(means) else float("nan")


def _marks(trained: Origin | None, conditions: Sequence[Condition]) -> tuple[str, ...]:
    """Marks of a row: how far training has seen its conditions."""
    if trained is None:
        return ()
    if trained.scenarios is None:
        return ("training condition unknown",)
    known = conditions[0].environment
    motion: Any = trained.reference
    if motion is None:
        motion = known.default_reference
    seen = _motion(known, motion) == _motion(known, conditions[0].reference)
    quantity = known.quantity or "reference"
    scenarios = [_seen_as(condition, trained) for condition in conditions]
    unseen = [scenario for scenario in scenarios if scenario not in trained.scenarios]
    if unseen:
        if len(unseen) == len(scenarios):
            return (HELD_OUT if seen else f"{HELD_OUT} scenario and {quantity}",)
        named = f": {', '.join(unseen)}"
        return (f"{PARTLY}{named}" if seen else f"{HELD_OUT}{named} and {quantity}",)
    if not seen:
        return (f"{HELD_OUT} {quantity}",)
    if conditions[0].swept:
        return ()
    if any(known.is_deterministic(scenario, motion) for scenario in scenarios):
        return (CEILING,)
    same = [s for s in scenarios if known.differs_by_noise_alone(s, motion)]
    named = f": {', '.join(same)}" if len(same) < len(scenarios) else ""
    return (f"{SAME_ROBOT}{named}",) if same else ()


def _seen_as(condition: Condition, trained: Origin) -> str:
    """The scenario of a condition, by the name under which training has seen the same."""
    played = condition.scenario_played
    seen = trained.scenarios or ()
    if isinstance(played, str) and not trained.ranges:
        return played
    walks = condition.environment.walks
    played = make_scenario(played, walks).replace(name="")
    for name in seen:
        if make_scenario(name, walks, trained.ranges).replace(name="") == played:
            return name
    if condition.swept:
        return f"varied {condition.scenario}"
    is_other = condition.scenario in seen
    return f"{condition.scenario} of other ranges" if is_other else condition.scenario


def _motion(known: Environment, reference: Any) -> str:
    """The part of a reference that training may have seen: its kind, or its step period alone."""
    return known.label(known.arguments(reference)[known.motion])


def by_line(rows: Sequence[Change]) -> list[list[Change]]:
    """Changes of the same policy, base and cell together, one per metric."""
    lines = group_by(rows, lambda row: (row.policy, row.base, row.place))
    return list(lines.values())
