"""Margins of a policy: how far a quantity can go until a robot falls.

Every robot has an edge of its own, which bisection finds. All robots and quantities are played side
by side, so that each halving of the intervals is one rollout. Whether a robot survives need not be
monotone: a push that is harder may come at a better moment of the step. Bisection finds one edge
between a value that was survived and one that was not, and there may be others.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode

from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array, BoolArray
from train.evaluate.conditions import SCENARIO, Condition
from train.evaluate.rollout import (
    can_share_worlds,
    control_steps,
    make_policy,
    make_shared_env,
)

Causes = npt.NDArray[np.str_]
"""Why episodes failed: empty for those that did not."""

CHECKED_SHARE = 0.9
"""Share of the way to the worst edge where all robots are played once more."""
NO_REST = "no rest"
"""Cause where a robot does not stand under zero offset, so that no episode begins."""


@dataclass(frozen=True)
class Quantity:
    """A field of the scenario and the interval in which its edge is looked for [SI].

    Attributes:
        field: Name in `Scenario`.
        title: In tables, with the unit there.
        harmless: Value to begin with.
        fatal: Value that nobody is expected to survive; it is not played.
        scale: Of the unit in tables.
    """

    field: str
    title: str
    harmless: float
    fatal: float
    scale: float = 1.0


QUANTITIES = (
    Quantity("push_n", "largest push [N]", 0.0, 512.0),
    Quantity("stiffness", "softest K [1]", 1.0, 0.0),
    Quantity("slope_rad", "largest slope [mrad]", 0.0, 0.128, 1e3),
    Quantity("load_kg", "largest load [kg]", 0.0, 64.0),
    Quantity("floor_friction", "least friction [1]", 1.0, 0.0),
)
"""Quantities that a walker survives up to an edge."""


@dataclass(frozen=True, eq=False)
class Edges:
    """What bisection found of each element.

    Attributes:
        survived: Value next to the edge that was survived; the first one where no other was.
        failed: Value next to the edge that was not; nan where all that were played were survived.
        causes: Why it was not.
    """

    survived: Array
    failed: Array
    causes: Causes


def bisect(play: Callable[[Array], Causes], first: Array, last: Array, halvings: int) -> Edges:
    """Bisect intervals, all at once.

    The distance between `survived` and `failed` is that of first and last over 2^halvings.

    Args:
        play: Causes of failure at a value for each element.
        first: Values that are taken to be survived, without a trial.
        last: Values beyond the edges, likewise.
        halvings: How often the intervals are halved.
    """
    survived = first
    failed = last
    causes = np.full(np.shape(first), "", dtype=np.dtype("U64"))
    for _ in range(halvings):
        middle = (survived + failed) / 2.0
        found = play(middle)
        is_survived = found == ""
        survived = np.where(is_survived, middle, survived)
        failed = np.where(is_survived, failed, middle)
        causes = np.where(is_survived, causes, found)
    return Edges(survived, np.where(causes == "", np.nan, failed), causes)


def failure_causes(
    conditions: Sequence[Condition],
    num_threads: int = 0,
    progress: Callable[[int], None] = lambda _: None,
) -> Causes:
    """Why the first episode of each condition fails; empty where the robot walks to the end.

    Args:
        conditions: Of one policy and motion, whose scenarios may differ.
        num_threads: Threads of the physics, 0 for all cores.
        progress: Called with the number of every control step, of which all worlds make one.
    """
    if len(conditions) > 1 and not can_share_worlds(conditions[0]):
        each = [failure_causes([own], num_threads, progress) for own in conditions]
        return np.concatenate(each)
    seeds = [condition.seed for condition in conditions]
    with closing(make_shared_env(conditions, num_threads, AutoresetMode.DISABLED)) as env:
        stands = _stand(env, seeds)
        if stands.all():
            return _walk(env, conditions[0], seeds, progress)
    causes = np.full(len(conditions), NO_REST, dtype=np.dtype("U64"))
    if stands.any():
        able = [own for own, is_able in zip(conditions, stands, strict=True) if is_able]
        causes[stands] = failure_causes(able, num_threads, progress)
    return causes


def _stand(env: Any, seeds: Sequence[int]) -> BoolArray:
    """Worlds whose robot comes to rest under zero offset."""
    stands = np.zeros(len(seeds), dtype=np.bool_)
    for world in range(len(seeds)):
        only = np.arange(len(seeds)) == world
        try:
            env.reset(seed=list(seeds), options={"reset_mask": only})
            stands[world] = True
        except ElasticError:
            pass
    return stands


def _walk(
    env: Any, condition: Condition, seeds: Sequence[int], progress: Callable[[int], None]
) -> Causes:
    policy = make_policy(condition.policy, env, condition.policy_options)
    causes = np.full(len(seeds), "", dtype=np.dtype("U64"))
    for step in control_steps(env, policy, list(seeds), condition):
        failed = np.asarray(step.terminated) & (causes == "")
        causes[failed] = step.info["termination"][failed]
        progress(step.number + 1)
    return causes


def find_margins(
    condition: Condition,
    quantities: Sequence[Quantity],
    robots: int,
    halvings: int,
    play: Callable[[Sequence[Condition]], Causes],
) -> list[dict[str, Any]]:
    """The edges of a policy, a record per quantity, in SI units.

    `worst` is the edge of the robot that fails first, `median` the median of all `edges`. Of
    `no_rest` robots the edge is that of standing, before any policy acts. `failed_before` robots
    fail at `CHECKED_SHARE` of the way to the worst edge, where all are played once more.

    Args:
        condition: Policy, motion, scenario and seed of the first robot.
        quantities: What is varied, one at a time.
        robots: Their seeds follow that of the condition.
        halvings: See `bisect`.
        play: Why each condition failed, see `failure_causes`.
    """

    def play_values(values: Array) -> Causes:
        conditions = [
            condition.replace(
                swept={f"{SCENARIO}{own.field}": float(value)}, seed=condition.seed + robot
            )
            for own, row in zip(quantities, values, strict=True)
            for robot, value in enumerate(row)
        ]
        return play(conditions).reshape(values.shape)

    first = np.repeat([[own.harmless] for own in quantities], robots, axis=1)
    last = np.repeat([[own.fatal] for own in quantities], robots, axis=1)
    edges = bisect(play_values, first, last, halvings)
    way = np.abs(edges.survived - first)
    worst = way.argmin(axis=1)
    checked = first + CHECKED_SHARE * np.sign(last - first) * way.min(axis=1, keepdims=True)
    failed = play_values(checked) != ""
    records = []
    for own, quantity in enumerate(quantities):
        fails_at = edges.failed[own, worst[own]]
        record = {
            "policy": condition.policy.title,
            "reference": condition.reference_name,
            "scenario": condition.scenario,
            "quantity": quantity.field,
            "worst": edges.survived[own, worst[own]].item(),
            "median": float(np.median(edges.survived[own])),
            "fails_at": "" if np.isnan(fails_at) else fails_at.item(),
            "cause": edges.causes[own, worst[own]].item(),
            "no_rest": int((edges.causes[own] == NO_REST).sum()),
            "failed_before": int(failed[own].sum()),
            "robots": robots,
            "edges": edges.survived[own].tolist(),
        }
        records.append(record)
    return records


def margin_table(records: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[list[str]]]:
    """Head and rows of a table of records: worst and median edge of every policy and quantity."""
    cells = {(own["policy"], own["quantity"]): own for own in records}
    shown = [own for own in QUANTITIES if any(own.field == field for _, field in cells)]
    policies = dict.fromkeys(policy for policy, _ in cells)
    rows = [
        [policy, *(_cell(cells[policy, own.field], own) for own in shown)] for policy in policies
    ]
    return ["policy", *(own.title for own in shown)], rows


def _cell(record: Mapping[str, Any], quantity: Quantity) -> str:
    worst, median = (f"{quantity.scale * float(record[name]):.3g}" for name in ("worst", "median"))
    failed, robots, no_rest = (int(record[name]) for name in ("failed_before", "robots", "no_rest"))
    worst += "" if record["cause"] else " or beyond"
    worst += " *" if record["cause"] == NO_REST else ""
    median += " *" if 2 * no_rest > robots else ""
    before = f" ({failed} of {robots} fail before)" if failed else ""
    return f"{worst} / {median}{before}"
