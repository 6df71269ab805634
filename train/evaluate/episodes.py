"""Episodes of a policy under a condition: metrics, one time series, and static points."""

from collections.abc import Callable, Hashable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from baselines.identification.static_points import StaticPoints
from elastic_env.core.signals import Array, BoolArray
from train.evaluate.conditions import Condition
from train.evaluate.observers import Observers
from train.evaluate.rollout import control_steps, make_policy, make_shared_env, policy_errors

MOST_WORLDS = 64
"""Worlds that are played at once."""
_BEFORE_FALL_S = 0.6
"""Time before a fall that does not set the scale of a figure [s]."""

_STEPS_PER_REPORT = 250
"""Control steps between reports of progress."""

Progress = Callable[[int], None]
Item = TypeVar("Item")
Key = TypeVar("Key", bound=Hashable)


@dataclass
class Evaluation:
    """The result of a condition.

    Attributes:
        condition: The condition.
        episodes: Flat records, one per episode: seed, metrics, termination.
        trace: Signals of the first episode over time; the environment's description names them.
        points: Static points of the first episode, with reference "hold".
        rest_references: References of the static points, (visits,) [rad].
    """

    condition: Condition
    episodes: list[dict[str, Any]] = field(default_factory=list)
    trace: dict[str, Array] = field(default_factory=dict)
    points: StaticPoints | None = None
    rest_references: Array = field(default_factory=lambda: np.zeros(0))

    def values(self, metric: str, failed: bool = False) -> Array:
        """A metric over the episodes that did not fail, or over the failed ones, (n,)."""
        chosen = [e for e in self.episodes if bool(e["termination"]) == failed]
        values = [e[metric] for e in chosen if e.get(metric) is not None]
        return np.array(values, dtype=np.float64)

    @property
    def num_failed(self) -> int:
        """Episodes that ended in a failure, such as a fall."""
        return sum(1 for episode in self.episodes if episode["termination"])

    @property
    def first_failed(self) -> bool:
        """True if the first episode failed, which the trace shows."""
        return bool(self.episodes and self.episodes[0]["termination"])

    @property
    def is_steady(self) -> BoolArray:
        """Samples of the trace that set the range of a figure: all except shortly before a fall."""
        time_s = self.trace["time_s"]
        end = time_s[-1] - (_BEFORE_FALL_S if self.first_failed else 0.0)
        return time_s <= max(end, 0.0)


Episodes = Sequence[tuple[Evaluation, int]]
"""Pairs of an evaluation and the number of one of its episodes."""


def group_by(items: Iterable[Item], key: Callable[[Item], Key]) -> dict[Key, list[Item]]:
    """Group items by a key, in the order in which each key first occurs."""
    groups: dict[Key, list[Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


def evaluate(
    condition: Condition, progress: Progress | None = None, num_threads: int = 0
) -> Evaluation:
    """Play all episodes of a condition.

    Episode i has seed + i, with any number of worlds and threads.

    A policy with a method `rehearse(env, seed)` gets the environment before it is scored. It may
    play episodes of the robots that it is scored on, under other noise, see
    `baselines.adaptation.iterative`.

    Args:
        condition: What to play.
        progress: Called with the control steps since the last call, of all episodes together.
        num_threads: Threads of the physics, 0 for all cores.
    """
    return evaluate_together([condition], progress, num_threads)[0]


def evaluate_together(
    conditions: Sequence[Condition], progress: Progress | None = None, num_threads: int = 0
) -> list[Evaluation]:
    """Play conditions of one policy side by side, which is faster; same results as `evaluate`.

    Args:
        conditions: One, or several with the same `shared_settings` that can share worlds.
        progress: See `evaluate`.
        num_threads: See `evaluate`.
    """
    results = [Evaluation(condition) for condition in conditions]
    episodes = [(r, n) for r in results for n in range(r.condition.episodes)]
    num_worlds = 1 if conditions[0].environment.is_real else MOST_WORLDS
    for first in range(0, len(episodes), num_worlds):
        batch = episodes[first : first + num_worlds]
        conditions = [result.condition for result, _ in batch]
        with closing(make_shared_env(conditions, num_threads)) as env:
            _play(env, batch, progress or (lambda _: None))
    return results


def _play(env: Any, episodes: Episodes, progress: Progress) -> None:
    """Play episodes of one policy, each in a world of its own; a world's first episode counts."""
    condition = episodes[0][0].condition
    seeds = [result.condition.seed + number for result, number in episodes]
    policy = make_policy(condition.policy, env, condition.policy_options)
    if hasattr(policy, "rehearse"):
        with policy_errors(condition, 0):
            policy.rehearse(env, seeds[0])
    first_episodes = {w: result for w, (result, n) in enumerate(episodes) if n == 0}
    observers = Observers(env, policy, condition.environment, first_episodes)
    records: dict[int, dict[str, Any]] = {}
    reported = 0
    for step in control_steps(env, policy, seeds, condition, observers.watch):
        for world in np.flatnonzero(step.is_over).tolist():
            if world not in records:
                result, number = episodes[world]
                metrics = step.info["episode_metrics"]
                records[world] = {
                    **episode_labels(result.condition, number),
                    "termination": str(step.info["termination"][world]),
                    **{name: values[world].item() for name, values in metrics.items()},
                    **observers.metrics(world),
                }
                observers.end(world, step.observation, step.info)
        if len(records) == len(episodes):
            break
        if (step.number + 1) % _STEPS_PER_REPORT == 0:
            reported += _STEPS_PER_REPORT
            progress(len(episodes) * _STEPS_PER_REPORT)
    progress(len(episodes) * (env.unwrapped.task.num_steps - reported))
    for world, (result, _) in enumerate(episodes):
        result.episodes.append(records[world])
    for world, result in first_episodes.items():
        trace = observers.traces[world]
        result.trace = trace.signals()
        result.points = trace.points()
        result.rest_references = trace.references


def episode_labels(condition: Condition, episode: int) -> dict[str, Any]:
    """Columns of a record that are known before the episode: cell, training seed, seed."""
    member = condition.member
    seed = None if member is None else member.training_seed
    return {
        "policy": condition.policy.title,
        "training_seed": "" if seed is None else seed,
        "base": "" if member is None else member.base,
        "scenario": condition.scenario,
        "reference": condition.reference_name,
        **condition.environment.abscissa(condition.reference),
        **condition.swept,
        "seed": condition.seed + episode,
    }


def merge_seeds(evaluations: Sequence[Evaluation]) -> list[Evaluation]:
    """Join the training seeds of a family in every cell: all episodes, the trace of the first."""
    cells: dict[tuple[object, ...], Evaluation] = {}
    for number, e in enumerate(evaluations):
        c = e.condition
        key = (number,) if c.member is None else (c.policy.title, *c.cell)
        cells.setdefault(key, replace(e, episodes=[])).episodes.extend(e.episodes)
    return list(cells.values())
