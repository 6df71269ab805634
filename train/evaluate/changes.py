"""Paired changes of a comparison: every residual against its base and against the best policy
without learning.

Every baseline is compared with the base of the residuals, or without residuals with the first
policy.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import pandas as pd

from elastic_env.core.signals import Array
from elastic_env.world.scenario import make_scenario
from train.evaluate.conditions import Condition
from train.evaluate.environments import Column, Environment
from train.evaluate.episodes import Evaluation, group_by
from train.evaluate.families import Origin
from train.evaluate.statistics import (
    Estimate,
    change,
    improvement,
    interquartile_mean,
    over_seeds,
    wins,
)
from train.evaluate.table import EpisodeTable, failures

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
"""Training seeds from which on an interval is taken for a verdict: of 95 % intervals over two seeds
every other one misses the truth, over five every eleventh."""
CLAIM_SEEDS = 10
"""Training seeds that a claim needs; with fewer, intervals exclude zero too often without any
effect.
"""

SIGNS = {"none": "*", "unclear": "?"}
"""Signs behind a change that is not shown, by its verdict."""
SIGNS_ARE = "A star: the interval includes zero. A question mark: too few training seeds to say."

_SMALL = 0.0995
"""Below it a share is shown with a decimal."""
_LEAST = 0.005
"""Below it a bound would look like zero without one."""

Verdict = Literal["lower", "higher", "none", "unclear"]
Groups = Mapping[str, Sequence[str]]


@dataclass(frozen=True, eq=False)
class Change:
    """A policy against its base in one metric, in one scenario or pooled over a group of them.

    Attributes:
        policy, base: Titles.
        is_family: Whether the policy is a residual, so that it has training seeds.
        reference: Label of the motion.
        scope: Scenario, or name of the group.
        is_group: Whether it is a group.
        swept: Options that a sweep varies, and their values.
        marks: What the reader has to know of the row: a ceiling, something held out.
        column: The metric.
        is_judged: Whether policies are judged by it; else it stands in tables alone.
        per_seed: Relative change of every training seed, nan where it has no pair, (seeds,); of a
            baseline one value.
        relative: Interquartile mean of it over training seeds.
        improvement: Probability that an episode is better than the base's.
        mine, theirs: Metric of the policy and of its base over the pairs [SI]; the interquartile
            mean over training seeds.
        num_pairs: Pairs of training seed and episode.
        falls, episodes: Failed episodes of the policy, of all of its episodes.
        base_falls, base_episodes: The same of the base.
        failure: What failing is called, in the plural.
        is_rival: Whether `base` is not the base of the residual but the best policy without
            learning.
    """

    policy: str
    base: str
    is_family: bool
    reference: str
    scope: str
    is_group: bool
    swept: dict[str, float]
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
    failure: str
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
        """lower, higher, none (the interval includes zero), or unclear (too few training seeds
        to say).
        """
        low = self.relative.low
        high = self.relative.high
        if low is None or high is None or self.num_compared < FEWEST_SEEDS:
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
        parts = [self._first_words()]
        missing = len(self.per_seed) - self.num_compared
        if self.is_family and 0 < missing < self.num_seeds:
            parts.append(
                f"{missing} of {self.num_seeds} training seeds have nothing to compare and are not"
                " in it"
            )
        if self.falls_more:
            parts.append(f"MORE {self.failure.upper()} than {self.base}")
        elif self.falls_less:
            parts.append(f"fewer {self.failure} than {self.base}")
        return "; ".join(parts)

    def _first_words(self) -> str:
        value = self.relative.value
        if not np.isfinite(value):
            where = (
                "in one of the scenarios there is no episode in which"
                if self.is_group
                else "in no episode did"
            )
            return (
                f"nothing to compare: {where} both {'stayed' if self.is_group else 'stay'} up to"
                " the end"
            )
        direction = (
            "no change"
            if value == 0.0
            else f"{percent(abs(value), signed=False)} {'lower' if value < 0.0 else 'higher'}"
        )
        if not self.is_family:
            return f"{direction} (difference of means, no training seeds)"
        return {
            "lower": direction,
            "higher": direction,
            "none": "the interval includes zero: no difference shown",
            "unclear": f"{direction} with {self._few_seeds}",
        }[self.verdict]

    @property
    def _few_seeds(self) -> str:
        if self.num_compared == 1:
            return "one training seed: no interval"
        return f"{self.num_compared} training seeds: too few to tell it from chance"


def signed_off(text: str, verdict: str) -> str:
    """A change with the sign of its verdict behind it, if it has one."""
    return f"{text} {SIGNS[verdict]}" if verdict in SIGNS else text


def percent(value: float, signed: bool = True) -> str:
    """A share in per cent, with a decimal where it is small; - where there is none."""
    if not np.isfinite(value):
        return "-"
    digits = 1 if 0.0 < abs(value) < _SMALL else 0
    text = f"{100.0 * value:{'+' if signed else ''}.{digits}f}".replace("-", "−")
    return f"{text} %"


def percent_interval(estimate: Estimate, signed: bool = True) -> str:
    """A share with its interval, such as −40 % [−45, −33]."""
    if estimate.low is None or estimate.high is None:
        return percent(estimate.value, signed)
    values = estimate.value, estimate.low, estimate.high
    is_fine = 0.0 < max(map(abs, values)) < _SMALL or any(
        0.0 < abs(value) < _LEAST for value in values
    )
    number = f"{'+' if signed else ''}.{1 if is_fine else 0}f"
    value, low, high = (f"{100.0 * value:{number}}".replace("-", "−") for value in values)
    return f"{value} % [{low}, {high}]"


def signed_interval(estimate: Estimate, verdict: str) -> str:
    """A share with its interval and the sign of its verdict, such as +1 % [−2, +4] *; - where
    there is none.
    """
    text = percent_interval(estimate)
    return signed_off(text, verdict) if np.isfinite(estimate.value) else text


def merge_seeds(evaluations: Sequence[Evaluation]) -> list[Evaluation]:
    """Cells with the training seeds of a family put together: all of their episodes, the trace
    of the first.
    """
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
    """Titles of those whom each policy is compared with: base and rival, or of a baseline the
    bases, or the first.
    """
    members = {title: next(reversed(own.values())) for title, own in table.members.items()}
    default = list(dict.fromkeys(member.base for member in members.values())) or table.policies[:1]
    found = {}
    for title in table.policies:
        member = members.get(title)
        if member is None:
            found[title] = [base for base in default if base != title]
        else:
            found[title] = [other for other in (member.base, member.rival) if other is not None]
    return found


def changes(evaluations: Sequence[Evaluation], groups: Groups | None = None) -> list[Change]:
    """All paired changes: residuals against bases and rivals, baselines against bases or, without
    residuals, the first.

    Args:
        evaluations: All cells, one per training seed.
        groups: Scenarios to pool over, by name.
    """
    table = EpisodeTable(evaluations)
    rows = []
    for title, others in opponents(table).items():
        for base in others:
            if base in table.policies:
                rows += _against(Pairing(table, title, base), groups or {})
    return rows


class Pairing:
    """A policy beside another one on the same episodes.

    Args:
        table: All episodes.
        policy: Title of the policy.
        base: Title of the other one.

    Raises:
        ValueError: A seed occurs twice, so that nobody can say which episode belongs to which.
    """

    def __init__(self, table: EpisodeTable, policy: str, base: str) -> None:
        self.table = table
        self.policy = policy
        self.base = base
        known = table.environment
        self.columns = (*known.judged, *known.also)
        self.cells = {
            cell: other
            for cell in table.cells_of(policy)
            if (other := self._cell_of_base(cell)) is not None
        }
        """Number of the base's cell, by that of the policy's."""
        self._pairs: dict[tuple[int, str], pd.DataFrame] = {}

    def _cell_of_base(self, cell: int) -> int | None:
        """The same cell; where the base is not swept, the one of its level."""
        condition = self.table.conditions[self.policy, cell]
        for place in (condition.cell, condition.cell[:2]):
            number = self.table.cells.get(place)
            if number is not None and (self.base, number) in self.table.conditions:
                return number
        return None

    def pairs(self, cell: int, metric: str) -> pd.DataFrame:
        """Figures of every training seed over the pairs of a cell: means `mine` and `base`,
        number `played`, `won`.
        """
        if (cell, metric) not in self._pairs:
            mine = self.table.of(self.policy, cell)
            base = self.table.of(self.base, self.cells[cell])
            both = pair(mine, base, metric)
            figures = []
            for member in mine["member"].unique():
                own = both[both["member"] == member]
                ours = np.asarray(own["mine"])
                theirs = np.asarray(own["base"])
                figures.append(
                    {
                        "mine": ours.mean() if len(own) else np.nan,
                        "base": theirs.mean() if len(own) else np.nan,
                        "played": len(own),
                        "won": wins(ours, theirs),
                    }
                )
            self._pairs[cell, metric] = pd.DataFrame(figures)
        return self._pairs[cell, metric]

    def change(
        self,
        column: Column,
        cells: Sequence[int],
        scope: str,
        is_group: bool,
        marks: tuple[str, ...] = (),
    ) -> Change:
        """The change of one metric, over one cell or pooled over several.

        Args:
            column: The metric.
            cells: Numbers of the policy's cells.
            scope: Scenario, or name of the group.
            is_group: Whether it is a group.
            marks: See `Change`.
        """
        pairs = [self.pairs(cell, column.metric) for cell in cells]
        mine, base, played, won = (
            np.column_stack([own[name] for own in pairs])
            for name in ("mine", "base", "played", "won")
        )
        relative = change(mine, base)
        condition = self.table.conditions[self.policy, cells[0]]
        falls, episodes = failures(self.table.of(self.policy, *cells))
        base_falls, base_episodes = failures(
            self.table.of(self.base, *(self.cells[cell] for cell in cells))
        )
        return Change(
            policy=self.policy,
            base=self.base,
            is_family=condition.member is not None,
            reference=condition.reference_name,
            scope=scope,
            is_group=is_group,
            swept=condition.swept,
            marks=marks,
            column=column,
            is_judged=column in self.table.environment.judged,
            per_seed=relative,
            relative=over_seeds(relative),
            improvement=improvement(won, played),
            mine=_mean(mine),
            theirs=_mean(base),
            num_pairs=int(played.sum()),
            falls=falls,
            episodes=episodes,
            base_falls=base_falls,
            base_episodes=base_episodes,
            failure=self.table.environment.failures,
            is_rival=condition.member is not None and self.base == condition.member.rival,
        )


class Pairings:
    """Policies of a table beside one another, each pair made once.

    Args:
        table: All episodes.
    """

    def __init__(self, table: EpisodeTable) -> None:
        self.table = table
        self._found: dict[tuple[str, str], Pairing] = {}

    def of(self, policy: str, base: str) -> Pairing:
        """A policy beside another one, by their titles."""
        if (policy, base) not in self._found:
            self._found[policy, base] = Pairing(self.table, policy, base)
        return self._found[policy, base]


def pair(mine: pd.DataFrame, base: pd.DataFrame, metric: str) -> pd.DataFrame:
    """Episodes of two policies in one cell with the same seed, in which neither failed: `member`,
    `mine`, `base`.

    Args:
        mine: Rows of a policy, with `member`, `seed`, `failed` and the metric.
        base: Rows of the base, with a row per seed.
        metric: Name of the metric.

    Raises:
        ValueError: A seed occurs twice, so that nobody can say which episode belongs to which.
    """
    for rows in (mine, base):
        if len(set(zip(rows["member"], rows["seed"], strict=True))) < len(rows):
            raise ValueError(
                f"every episode needs a seed of its own to be paired, got {rows['seed'].tolist()}"
            )
    own = mine.sort_values("seed", kind="stable")
    others = pd.Series(base[metric].to_numpy(), base["seed"].to_numpy()).reindex(
        own["seed"].to_numpy()
    )
    figures = {"member": own["member"], "mine": own[metric], "base": others}
    return pd.DataFrame({name: column.to_numpy() for name, column in figures.items()}).dropna()


def _against(pairing: Pairing, groups: Groups) -> list[Change]:
    """Rows of one policy and one base: every cell, and every group behind the last one of its
    scenarios.
    """
    conditions = {cell: pairing.table.conditions[pairing.policy, cell] for cell in pairing.cells}
    blocks = group_by(conditions, lambda cell: _apart_from_scenario(conditions[cell]))
    rows = []
    for cell, condition in conditions.items():
        rows += _scope_rows(pairing, condition.scenario, [cell], is_group=False)
        block = {conditions[own].scenario: own for own in blocks[_apart_from_scenario(condition)]}
        if cell != list(block.values())[-1]:
            continue
        for name, scenarios in groups.items():
            if all(scenario in block for scenario in scenarios):
                rows += _scope_rows(pairing, name, [block[s] for s in scenarios], is_group=True)
    return rows


def _apart_from_scenario(condition: Condition) -> tuple[object, ...]:
    return (condition.reference_name, *condition.swept.items())


def _scope_rows(pairing: Pairing, scope: str, cells: Sequence[int], is_group: bool) -> list[Change]:
    """A row per judged column, over one scenario or several."""
    table = pairing.table
    trained = table.families.get(pairing.policy)
    first = table.conditions[pairing.policy, cells[0]]
    scenarios = [_seen_as(table.conditions[pairing.policy, cell], trained) for cell in cells]
    reference = _motion(table.environment, first.reference)
    marks = _marks(trained, table.environment, reference, scenarios, first.swept)
    return [pairing.change(column, cells, scope, is_group, marks) for column in pairing.columns]


def _mean(values: Array) -> float:
    """Interquartile mean, over the training seeds that have all, of means over scenarios and
    episodes.
    """
    means = np.mean(values, axis=-1)
    means = means[np.isfinite(means)]
    return float(interquartile_mean(means)) if len(means) else float("nan")


def _marks(
    trained: Origin | None,
    known: Environment,
    reference: str,
    scenarios: Sequence[str],
    swept: Mapping[str, float],
) -> tuple[str, ...]:
    """Marks of a row: how far training has seen its condition."""
    if trained is None:
        return ()
    if trained.scenarios is None:
        return ("training condition unknown",)
    motion: Any = known.default_reference if trained.reference is None else trained.reference
    seen = _motion(known, motion) == reference
    unseen = [scenario for scenario in scenarios if scenario not in trained.scenarios]
    quantity = known.quantity or "reference"
    if unseen:
        if len(unseen) == len(scenarios):
            return (HELD_OUT if seen else f"{HELD_OUT} scenario and {quantity}",)
        named = f": {', '.join(unseen)}"
        return (f"{PARTLY}{named}" if seen else f"{HELD_OUT}{named} and {quantity}",)
    if not seen:
        return (f"{HELD_OUT} {quantity}",)
    if swept:
        return ()
    if any(known.is_deterministic(scenario, motion) for scenario in scenarios):
        return (CEILING,)
    same = [scenario for scenario in scenarios if known.differs_by_noise_alone(scenario, motion)]
    named = f": {', '.join(same)}" if len(same) < len(scenarios) else ""
    return (f"{SAME_ROBOT}{named}",) if same else ()


def _seen_as(condition: Condition, trained: Origin | None) -> str:
    """The scenario of a condition; one whose fields are varied by the name under which training
    has seen the same.
    """
    played = condition.scenario_played
    ranges = {} if trained is None else trained.ranges
    if isinstance(played, str) and not ranges:
        return played
    seen = trained.scenarios if trained is not None and trained.scenarios is not None else ()
    played = make_scenario(played)
    same = (
        name
        for name in seen
        if make_scenario(name).with_ranges(ranges).replace(name="") == played.replace(name="")
    )
    if condition.swept:
        return next(same, f"varied {condition.scenario}")
    return next(
        same,
        (
            f"{condition.scenario} of other ranges"
            if condition.scenario in seen
            else condition.scenario
        ),
    )


def _motion(known: Environment, reference: Any) -> str:
    """The part of a reference that training may have seen: its kind, or its step period alone."""
    return known.label(known.arguments(reference)[known.motion])


def by_line(rows: Sequence[Change]) -> list[list[Change]]:
    """Changes of the same policy, base and cell together, one per metric."""
    lines = group_by(
        rows, lambda row: (row.policy, row.base, row.reference, row.scope, *row.swept.items())
    )
    return list(lines.values())
