"""Margins of a policy: the value of a quantity at which a robot falls.

Every robot has an edge of its own, which bisection finds. All robots and quantities are played side
by side, so that each halving of the intervals is one rollout. Survival need not be monotone in the
quantity: a harder push may come at a better moment of the step. Bisection finds one edge between a
value that the robot survived and one that it did not. There may be other edges.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import compress
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode

from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array, BoolArray
from train.evaluate.conditions import SCENARIO, Condition
from train.evaluate.rollout import can_share_worlds, control_steps, make_policy, make_shared_env

Causes = npt.NDArray[np.str_]
"""Causes of failure of episodes; empty for an episode that did not fail."""

CHECKED_SHARE = 0.9
"""Share of the way to the worst edge at which all robots are played once more."""
NO_REST = "no rest"
"""Cause if a robot does not stand under zero offset, so that no episode begins."""


@dataclass(frozen=True)
class Quantity:
    """A field of the scenario and the interval that contains its edge [SI].

    Attributes:
        field: Name in `Scenario`.
        title: Title in tables, with the unit there.
        harmless: Value to begin with.
        fatal: Value that no robot is expected to survive; it is not played.
        scale: Factor from SI to the unit in tables.
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
    """Both sides of the edge of each element.

    Attributes:
        survived: Survived value next to the edge; the first value if no other was survived.
        failed: Failed value next to the edge; nan if all values that were played were survived.
        causes: Causes of the failures.
    """

    survived: Array
    failed: Array
    causes: Causes


def bisect(play: Callable[[Array], Causes], first: Array, last: Array, halvings: int) -> Edges:
    """Bisect intervals, all at once.

    The distance between `survived` and `failed` is that of first and last over 2^halvings.

    Args:
        play: Plays a value for each element and returns the causes of failure.
        first: Values that count as survived without a trial.
        last: Values that count as failed without a trial.
        halvings: Number of halvings of the intervals.
    """
    survived = first
    failed = last
    causes = np.full(np.shape(first), "", dtype=np.dtype("U64"))
    for _ in range(halvings):
        middle = (survived + failed) / 2.0
        new_causes = play(middle)
        is_survived = new_causes == ""
        survived = np.where(is_survived, middle, survived)
        failed = np.where(is_survived, failed, middle)
        causes = np.where(is_survived, causes, new_causes)
    return Edges(survived, np.where(causes == "", np.nan, failed), causes)


def failure_causes(
    conditions: Sequence[Condition],
    num_threads: int = 0,
    progress: Callable[[int], None] = lambda _: None,
) -> Causes:
    """Causes of failure in the first episode of each condition; empty if it reaches its end.

    Args:
        conditions: Conditions of one policy and motion, whose scenarios may differ.
        num_threads: Threads of the physics, 0 for all cores.
        progress: Called with the number of every control step, which all worlds make together.
    """
    if len(conditions) > 1 and not can_share_worlds(conditions[0]):
        causes = [failure_causes([c], num_threads, progress) for c in conditions]
        return np.concatenate(causes)
    seeds = [condition.seed for condition in conditions]
    with closing(make_shared_env(conditions, num_threads, AutoresetMode.DISABLED)) as env:
        stands = _standing_worlds(env, seeds)
        if stands.all():
            return _walk(env, conditions[0], seeds, progress)
    causes = np.full(len(conditions), NO_REST, dtype=np.dtype("U64"))
    if stands.any():
        standing = list(compress(conditions, stands))
        causes[stands] = failure_causes(standing, num_threads, progress)
    return causes


def _standing_worlds(env: Any, seeds: Sequence[int]) -> BoolArray:
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
    """Find the edges of a policy; return a record per quantity, in SI units.

    `worst` is the edge of the robot that fails first, `median` the median of all `edges`.
    `no_rest` counts robots that cannot stand beyond their edge, before any policy acts. All robots
    are played once more at `CHECKED_SHARE` of the way to the worst edge: `failed_before` counts
    those that fail there.

    Args:
        condition: Policy, motion, scenario and seed of the first robot.
        quantities: Quantities that are varied, one at a time.
        robots: Number of robots; their seeds follow that of the condition.
        halvings: See `bisect`.
        play: Returns the causes of failure of conditions, see `failure_causes`.
    """
    fields = [f"{SCENARIO}{quantity.field}" for quantity in quantities]

    def play_values(values: Array) -> Causes:
        conditions = [
            condition.replace(swept={field: float(value)}, seed=condition.seed + robot)
            for field, row in zip(fields, values, strict=True)
            for robot, value in enumerate(row)
        ]
        return play(conditions).reshape(values.shape)

    first = np.repeat([[quantity.harmless] for quantity in quantities], robots, axis=1)
    last = np.repeat([[quantity.fatal] for quantity in quantities], robots, axis=1)
    edges = bisect(play_values, first, last, halvings)
    distance = np.abs(edges.survived - first)
    worst = distance.argmin(axis=1)
    least = distance.min(axis=1, keepdims=True)
    failed = play_values(first + CHECKED_SHARE * np.sign(last - first) * least) != ""
    records = []
    for row, quantity in enumerate(quantities):
        fails_at = edges.failed[row, worst[row]]
        record = {
            "policy": condition.policy.title,
            "reference": condition.reference_name,
            "scenario": condition.scenario,
            "quantity": quantity.field,
            "worst": edges.survived[row, worst[row]].item(),
            "median": float(np.median(edges.survived[row])),
            "fails_at": "" if np.isnan(fails_at) else fails_at.item(),
            "cause": edges.causes[row, worst[row]].item(),
            "no_rest": int((edges.causes[row] == NO_REST).sum()),
            "failed_before": int(failed[row].sum()),
            "robots": robots,
            "edges": edges.survived[row].tolist(),
        }
        records.append(record)
    return records


def margin_table(records: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[list[str]]]:
    """Head and rows of a table of records: worst and median edge of every policy and quantity."""
    cells = {(record["policy"], record["quantity"]): record for record in records}
    fields = {field for _, field in cells}
    shown = [quantity for quantity in QUANTITIES if quantity.field in fields]
    policies = dict.fromkeys(policy for policy, _ in cells)
    rows = [[p, *(_edge_text(cells[p, q.field], q) for q in shown)] for p in policies]
    return ["policy", *(quantity.title for quantity in shown)], rows


def _edge_text(record: Mapping[str, Any], quantity: Quantity) -> str:
    worst, median = (f"{quantity.scale * float(record[name]):.3g}" for name in ("worst", "median"))
    failed, robots, no_rest = (int(record[name]) for name in ("failed_before", "robots", "no_rest"))
    worst += "" if record["cause"] else " or beyond"
    worst += " *" if record["cause"] == NO_REST else ""
    median += " *" if 2 * no_rest > robots else ""
    before = f" ({failed} of {robots} fail before)" if failed else ""
    return f"{worst} / {median}{before}"
