"""Paired changes of a comparison: every residual against its base and against the best policy without learning.

Every baseline is compared with the base of the residuals, or without residuals with the first policy.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from elastic_env.core.signals import Array
from elastic_env.runtime.scenario import make_scenario
from train.evaluate.conditions import Condition, Member
from train.evaluate.environments import Column, Environment
from train.evaluate.episodes import Evaluation, group_by
from train.evaluate.families import Origin, origin
from train.evaluate.statistics import Estimate, change, improvement, interquartile_mean, over_seeds, pair

CEILING, SAME_ROBOT = "ceiling on the training condition", "trained robot"
"""Scenario in which nothing is random: training and evaluation see the same; one whose only robot is that of the
training, so that evaluation differs by noise alone."""
HELD_OUT, PARTLY = "held out", "partly held out"
"""Scenario that training never saw; group of scenarios of which it saw some."""
BEST_ANALYTIC = "best policy without learning"
"""What a residual is compared with beside its base."""
FEWEST_SEEDS = 5
"""Training seeds from which on an interval is taken for a verdict: of 95 % intervals over two seeds every other one
misses the truth, over five every eleventh."""
CLAIM_SEEDS = 10
"""Training seeds that a claim needs; with fewer, intervals exclude zero too often without any effect."""

SIGNS = {"none": "*", "unclear": "?"}
"""Signs behind a change that is not shown, by its verdict."""
SIGNS_ARE = "A star: the interval includes zero. A question mark: too few training seeds to say."

_SMALL = 0.0995
"""Below it a share is shown with a decimal."""
_LEAST = 0.005
"""Below it a bound would look like zero without one."""

Groups = Mapping[str, Sequence[str]]
Cells = Sequence[tuple[Sequence[Evaluation], Sequence[Evaluation]]]
"""Evaluations of a policy, one per training seed, and those of whom it is compared with; of one cell or of several."""


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
        per_seed: Relative change of every training seed, nan where it has no pair, (seeds,); of a baseline one value.
        relative: Interquartile mean of it over training seeds.
        improvement: Probability that an episode is better than the base's.
        mine, theirs: Metric of the policy and of its base over the pairs [SI]; the interquartile mean over training
            seeds.
        num_pairs: Pairs of training seed and episode.
        falls, episodes: Failed episodes of the policy, of all of its episodes.
        base_falls, base_episodes: The same of the base.
        failure: What failing is called, in the plural.
        is_rival: Whether `base` is not the base of the residual but the best policy without learning.
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
    def verdict(self) -> str:
        """lower, higher, none (the interval includes zero), or unclear (too few training seeds to say)."""
        low, high = self.relative.low, self.relative.high
        if low is None or high is None or self.num_compared < FEWEST_SEEDS:
            return "unclear"
        return "lower" if high < 0.0 else "higher" if low > 0.0 else "none"

    @property
    def falls_more(self) -> bool:
        """Whether the policy fails in a greater share of its episodes than its base."""
        return self.falls * self.base_episodes > self.base_falls * self.episodes

    @property
    def falls_less(self) -> bool:
        """Whether it fails in a smaller share."""
        return self.falls * self.base_episodes < self.base_falls * self.episodes

    @property
    def sentence(self) -> str:
        """What the row shows, and what it does not."""
        parts = [self._first_words()]
        missing = len(self.per_seed) - self.num_compared
        if self.is_family and 0 < missing < self.num_seeds:
            parts.append(f"{missing} of {self.num_seeds} training seeds have nothing to compare and are not in it")
        if self.falls_more:
            parts.append(f"MORE {self.failure.upper()} than {self.base}")
        elif self.falls_less:
            parts.append(f"fewer {self.failure} than {self.base}")
        return "; ".join(parts)

    def _first_words(self) -> str:
        value = self.relative.value
        if not np.isfinite(value):
            where = "in one of the scenarios there is no episode in which" if self.is_group else "in no episode did"
            return f"nothing to compare: {where} both {'stayed' if self.is_group else 'stay'} up to the end"
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
    is_fine = 0.0 < max(map(abs, values)) < _SMALL or any(0.0 < abs(value) < _LEAST for value in values)
    number = f"{'+' if signed else ''}.{1 if is_fine else 0}f"
    value, low, high = (f"{100.0 * value:{number}}".replace("-", "−") for value in values)
    return f"{value} % [{low}, {high}]"


def signed_interval(estimate: Estimate, verdict: str) -> str:
    """A share with its interval and the sign of its verdict, such as +1 % [−2, +4] *; - where there is none."""
    text = percent_interval(estimate)
    return signed_off(text, verdict) if np.isfinite(estimate.value) else text


def families(evaluations: Sequence[Evaluation]) -> dict[str, Origin]:
    """Families of residuals by title, with how they were trained."""
    members: dict[str, dict[str, Member]] = {}
    for title, member in ((e.condition.policy.title, e.condition.member) for e in evaluations):
        if member is not None:
            members.setdefault(title, {})[member.folder] = member
    return {title: origin(list(found.values())) for title, found in members.items()}


def merged(evaluations: Sequence[Evaluation]) -> list[Evaluation]:
    """Cells with the training seeds of a family put together: all of their episodes, the trace of the first."""
    together: dict[tuple[object, ...], Evaluation] = {}
    for number, e in enumerate(evaluations):
        c = e.condition
        key = (number,) if c.member is None else (c.policy.title, *c.cell)
        if key in together:
            together[key].episodes.extend(e.episodes)
        else:
            together[key] = Evaluation(c, list(e.episodes), e.trace, e.points, e.rest_references)
    return list(together.values())


def changes(evaluations: Sequence[Evaluation], groups: Groups | None = None) -> list[Change]:
    """All paired changes: residuals against bases and rivals, baselines against bases or, without residuals, the first.

    Args:
        evaluations: All cells, one per training seed.
        groups: Scenarios to pool over, by name.
    """
    trained = families(evaluations)
    members = {e.condition.policy.title: e.condition.member for e in evaluations if e.condition.member}
    rows = []
    for title, others in opponents(evaluations).items():
        own = [e for e in evaluations if e.condition.policy.title == title]
        member = members.get(title)
        for base in others:
            theirs = [e for e in evaluations if e.condition.policy.title == base]
            found = _against(own, theirs, trained.get(title), groups or {})
            is_rival = member is not None and base == member.rival
            rows += [replace(row, is_rival=True) for row in found] if is_rival else found
    return rows


def opponents(evaluations: Sequence[Evaluation]) -> dict[str, list[str]]:
    """Titles of those whom each policy is compared with: base and rival, or of a baseline the bases, or the first."""
    titles = list(dict.fromkeys(e.condition.policy.title for e in evaluations))
    members = {e.condition.policy.title: e.condition.member for e in evaluations if e.condition.member}
    default = list(dict.fromkeys(member.base for member in members.values())) or titles[:1]
    found = {}
    for title in titles:
        member = members.get(title)
        found[title] = [base for base in default if base != title] if member is None else [member.base]
        if member is not None and member.rival is not None:
            found[title].append(member.rival)
    return found


def level(members: Sequence[Evaluation], column: Column) -> Estimate:
    """Mean of a metric over the episodes that did not fail; of several training seeds the interquartile mean [SI].

    Args:
        members: One cell, an evaluation per training seed.
        column: The metric.
    """
    values = [e.values(column.metric) for e in members]
    means = [float(np.mean(some)) if len(some) else float("nan") for some in values]
    return over_seeds(means) if members[0].condition.member is not None else Estimate(means[0])


def by_cell(evaluations: Sequence[Evaluation]) -> dict[tuple[object, ...], list[Evaluation]]:
    """Evaluations of a policy by reference, scenario and swept values: one per training seed."""
    return group_by(evaluations, lambda e: e.condition.cell)


def _against(own: Sequence[Evaluation], base: Sequence[Evaluation], trained: Origin | None, groups: Groups
             ) -> list[Change]:  # fmt: skip
    """Rows of one policy and one base: every cell, and every group."""
    mine, theirs = by_cell(own), by_cell(base)
    cells = {key: (found, theirs.get(key, theirs.get(key[:2], []))) for key, found in mine.items()}
    cells = {key: both for key, both in cells.items() if both[1]}
    rows = []
    for (reference, scenario, *swept), (ours, others) in cells.items():
        rows += _rows(str(scenario), [(ours, others)], trained, is_group=False)
        last = [key for key in cells if key[0] == reference and list(key[2:]) == swept][-1]
        if scenario != last[1]:
            continue
        for name, scenarios in groups.items():
            found = [cells.get((reference, s, *swept)) for s in scenarios]
            if all(found):
                rows += _rows(name, [both for both in found if both is not None], trained, is_group=True)
    return rows


def _rows(scope: str, cells: Cells, trained: Origin | None, is_group: bool) -> list[Change]:
    """A row per judged column, over one scenario or several."""
    first = cells[0][0][0].condition
    known = first.environment
    scenarios = [_seen_as(ours[0].condition, trained) for ours, _ in cells]
    marks = _marks(trained, known, _motion(known, first.reference), scenarios, first.swept)
    return [_row(scope, cells, column, marks, is_group) for column in (*known.judged, *known.also)]


def paired(cells: Cells, column: Column) -> Change:
    """A policy against another one in one metric, in one cell or pooled over several; without marks."""
    return _row(cells[0][0][0].condition.scenario, cells, column, (), is_group=len(cells) > 1)


def _row(scope: str, cells: Cells, column: Column, marks: tuple[str, ...], is_group: bool) -> Change:
    """The change of one metric, over one scenario or several."""
    first, base = cells[0][0][0].condition, cells[0][1][0].condition
    mine = [e for ours, _ in cells for e in ours]
    theirs = [e for _, others in cells for e in others]
    known = first.environment
    seeds = [
        [pair(ours[number].episodes, others[0].episodes, column.metric) for ours, others in cells]
        for number in range(len(cells[0][0]))
    ]
    per_seed = np.array([change(pairs) for pairs in seeds])
    return Change(
        policy=first.policy.title, base=base.policy.title, is_family=first.member is not None,
        reference=first.reference_name, scope=scope, is_group=is_group, swept=first.swept,
        marks=marks, column=column, is_judged=column in known.judged,
        per_seed=per_seed, relative=over_seeds(per_seed.tolist()), improvement=improvement(seeds),
        mine=_mean([[p.mine for p in pairs] for pairs in seeds]),
        theirs=_mean([[p.base for p in pairs] for pairs in seeds]),
        num_pairs=sum(len(p) for pairs in seeds for p in pairs),
        falls=sum(e.num_failed for e in mine), episodes=sum(len(e.episodes) for e in mine),
        base_falls=sum(e.num_failed for e in theirs), base_episodes=sum(len(e.episodes) for e in theirs),
        failure=known.failures,
    )  # fmt: skip


def _mean(seeds: Sequence[Sequence[Array]]) -> float:
    """Interquartile mean, over the training seeds that have all, of means over scenarios and episodes."""
    means = [np.mean([values.mean() for values in some]) for some in seeds if all(len(values) for values in some)]
    return float(interquartile_mean(np.array(means))) if means else float("nan")


def _marks(
    trained: Origin | None, known: Environment, reference: str, scenarios: Sequence[str], swept: Mapping[str, float]
) -> tuple[str, ...]:
    """What training has seen of a row's condition."""
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
    """The scenario of a condition; one whose fields are varied by the name under which training has seen the same."""
    played, ranges = condition.scenario_played, {} if trained is None else trained.ranges
    if isinstance(played, str) and not ranges:
        return played
    seen = trained.scenarios if trained is not None and trained.scenarios is not None else ()
    played = make_scenario(played)
    same = (
        name for name in seen if make_scenario(name).with_ranges(ranges).replace(name="") == played.replace(name="")
    )
    if condition.swept:
        return next(same, f"varied {condition.scenario}")
    return next(same, f"{condition.scenario} of other ranges" if condition.scenario in seen else condition.scenario)


def _motion(known: Environment, reference: Any) -> str:
    """What of a reference training may have seen: its kind, or its step period whatever the number of steps."""
    return known.label(known.arguments(reference)[known.motion])


def by_line(rows: Sequence[Change]) -> list[list[Change]]:
    """Changes of the same policy, base and cell together, one per metric."""
    lines = group_by(rows, lambda row: (row.policy, row.base, row.reference, row.scope, *row.swept.items()))
    return list(lines.values())
