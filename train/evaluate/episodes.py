"""Episodes of a policy under a condition: metrics, one time series, and static points."""

from collections.abc import Callable, Hashable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from baselines.identification.static_points import HoldRecorder, StaticPoints
from elastic_env.core.signals import Array, BoolArray
from elastic_env.world.robot_model import WalkerModel
from train.evaluate.conditions import Condition
from train.evaluate.rollout import control_steps, make_policy, make_shared_env, policy_errors
from train.evaluate.support_changes import SupportChanges

MOST_WORLDS = 64
"""Worlds that are played at once."""
_BEFORE_FALL_S = 0.6
"""Time before a fall that does not set the scale of a figure [s]."""

_REPORTED = 250
"""Control steps after which progress is reported."""

Progress = Callable[[int], None]
Item = TypeVar("Item")
Key = TypeVar("Key", bound=Hashable)


@dataclass
class Evaluation:
    """The result of a condition.

    Attributes:
        condition: The condition.
        episodes: Flat records, one per episode: seed, metrics, termination.
        trace: Signals of the first episode over time, those that the environment's description
            names.
        points: Static points of the first episode, with reference "hold".
        rest_references: References of the static points, (visits,) [rad].
    """

    condition: Condition
    episodes: list[dict[str, Any]] = field(default_factory=list)
    trace: dict[str, Array] = field(default_factory=dict)
    points: StaticPoints | None = None
    rest_references: Array = field(default_factory=lambda: np.zeros(0))

    def values(self, metric: str, failed: bool = False) -> Array:
        """A metric over the episodes that did not fail, or over those that did, (n,)."""
        shown = [own for own in self.episodes if bool(own["termination"]) == failed]
        found = [own[metric] for own in shown if own.get(metric) is not None]
        return np.array(found, dtype=np.float64)

    @property
    def num_failed(self) -> int:
        """Episodes that ended in a failure, such as a fall."""
        return sum(1 for episode in self.episodes if episode["termination"])

    @property
    def first_failed(self) -> bool:
        """True if the episode of the trace is one of them."""
        return bool(self.episodes and self.episodes[0]["termination"])

    @property
    def is_steady(self) -> BoolArray:
        """Samples of the trace that set a figure's range: all but those shortly before a fall."""
        time_s = self.trace["time_s"]
        end = time_s[-1] - (_BEFORE_FALL_S if self.first_failed else 0.0)
        return time_s <= max(end, 0.0)


Episodes = Sequence[tuple[Evaluation, int]]
"""Numbered episodes, each with the evaluation that it belongs to."""


def group_by(items: Iterable[Item], key: Callable[[Item], Key]) -> dict[Key, list[Item]]:
    """Items by a key, in the order in which it first occurs."""
    groups: dict[Key, list[Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


def evaluate(
    condition: Condition, progress: Progress | None = None, num_threads: int = 0
) -> Evaluation:
    """Play all episodes of a condition.

    Episode i has seed + i, whatever the number of worlds and threads.

    A policy with a method `rehearse(env, seed)` is given the environment before it is scored: it
    may play episodes of the robots that it is scored on, under other noise, see
    `baselines.adaptation.iterative`.

    Args:
        condition: What to play.
        progress: Called with the number of control steps done since the last call, of all episodes
            together.
        num_threads: Threads of the physics, 0 for all cores.
    """
    return evaluate_together([condition], progress, num_threads)[0]


def evaluate_together(
    conditions: Sequence[Condition], progress: Progress | None = None, num_threads: int = 0
) -> list[Evaluation]:
    """Play conditions of one policy side by side, which is faster; results are those of `evaluate`.

    Args:
        conditions: What to play: one, or several with the same `shared_settings` that can share
            worlds.
        progress: See `evaluate`.
        num_threads: See `evaluate`.
    """
    results = [Evaluation(condition) for condition in conditions]
    episodes = [(own, n) for own in results for n in range(own.condition.episodes)]
    at_once = 1 if conditions[0].environment.is_real else MOST_WORLDS
    for first in range(0, len(episodes), at_once):
        batch = episodes[first : first + at_once]
        conditions = [result.condition for result, _ in batch]
        with closing(make_shared_env(conditions, num_threads)) as env:
            _play(env, batch, progress or (lambda _: None))
    return results


def _play(env: Any, episodes: Episodes, progress: Progress) -> None:
    """Play numbered episodes of conditions, a world each; the first episode of a world counts."""
    condition = episodes[0][0].condition
    seeds = [result.condition.seed + number for result, number in episodes]
    policy = make_policy(condition.policy, env, condition.policy_options)
    if hasattr(policy, "rehearse"):
        with policy_errors(condition, 0):
            policy.rehearse(env, seeds[0])
    observers = _Observers(env, policy, episodes)
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
        if (step.number + 1) % _REPORTED == 0:
            reported += _REPORTED
            progress(len(episodes) * _REPORTED)
    progress(len(episodes) * (env.unwrapped.task.num_steps - reported))
    for world, (result, _) in enumerate(episodes):
        result.episodes.append(records[world])
        observers.keep_trace(world, result)


def episode_labels(condition: Condition, episode: int) -> dict[str, Any]:
    """The part of a record that is known before the episode: cell, training seed, seed."""
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


class _Observers:
    """Figures that no environment keeps: of the IMU, of a policy's estimate, and traces."""

    def __init__(self, env: Any, policy: Any, episodes: Episodes) -> None:
        task = env.unwrapped.task
        environment = episodes[0][0].condition.environment
        model = task.assumed_model
        has_estimate = hasattr(policy, "link_estimate") and not environment.is_real
        walks = isinstance(model, WalkerModel)
        self._env = env
        self._policy = policy
        self._task = task
        self._estimate = _Rms(len(episodes)) if has_estimate else None
        self._changes = SupportChanges(model) if has_estimate and walks else None
        self._imu = _Rms(len(episodes)) if walks else None
        self._traces = {
            world: _Trace(task, environment.traced, world)
            for world, (_, number) in enumerate(episodes)
            if number == 0
        }
        self._ended = set[int]()
        self._scored = np.zeros(len(episodes), dtype=np.bool_)

    def watch(self, step: int, observation: Array, info: Any, memory: Any) -> None:
        """Take a control step, between the command and its effect."""
        scored = self._task.masks(self._task.sample())["scored"]
        self._scored = scored
        for world, trace in self._traces.items():
            if world not in self._ended:
                trace.take(observation, {**info, "scored": scored})
        if self._imu is not None:
            shown = self._task.observation_table.group("imu_attitude")
            attitude = observation[:, shown]
            truth = np.stack([info["pelvis_roll"], info["pelvis_pitch"]], axis=1)
            self._imu.take(np.square(attitude - truth).sum(axis=1), scored)
        if self._estimate is not None:
            estimate = self._policy.link_estimate(observation, memory)
            truth = self._env.unwrapped.truth()
            self._estimate.take(np.square(estimate - truth.q).mean(axis=1), scored)
            if self._changes is not None:
                self._changes.take(step, estimate, observation, truth)

    def metrics(self, world: int) -> dict[str, float]:
        """Figures of a world over its episode so far."""
        found: dict[str, float] = {}
        if self._estimate is not None:
            found["link_estimate_error_rms_rad"] = self._estimate.of(world)
        if self._changes is not None:
            found |= self._changes.metrics(world)
        if self._imu is not None:
            found["imu_error_rms_rad"] = self._imu.of(world)
        # of the robots that a walker draws from ranges
        if hasattr(self._task, "robot_record"):
            found |= self._task.robot_record(world)
        return found

    def end(self, world: int, observation: Array, info: dict[str, Any]) -> None:
        """Take the last sample of a world."""
        self._ended.add(world)
        if world in self._traces:
            # the step before it says whether it is scored: the world may have begun anew
            self._traces[world].take(observation, {**info, "scored": self._scored})

    def keep_trace(self, world: int, result: Evaluation) -> None:
        """Put the trace of a first episode into its evaluation."""
        if world in self._traces:
            trace = self._traces[world]
            result.trace = trace.signals()
            result.points = trace.points()
            result.rest_references = trace.references


class _Rms:
    """RMS over the scored steps of every world."""

    def __init__(self, worlds: int) -> None:
        self._sum = np.zeros(worlds)
        self._count = np.zeros(worlds)

    def take(self, squared: Array, scored: BoolArray) -> None:
        self._sum += np.where(scored, squared, 0.0)
        self._count += scored

    def of(self, world: int) -> float:
        count = self._count[world]
        return float(np.sqrt(self._sum[world] / count)) if count else float("nan")


class _Trace:
    """Time series and static points of the first episode of a condition, that of a world."""

    def __init__(self, task: Any, traced: tuple[str, ...], world: int) -> None:
        self._traced = traced
        self._world = world
        self._encoder = task.observation_table.group("encoder_angle")
        self.references = np.zeros(0)
        self._recorder: HoldRecorder | None = None
        visits = getattr(getattr(task.config, "reference", None), "visits", None)
        # static points need the IMU of the only link
        if visits is not None and "link_angle_imu" in traced:
            self.references, directions = visits
            self._recorder = HoldRecorder(directions)
        self._rows: list[list[float]] = []

    def take(self, observation: Array, info: dict[str, Any]) -> None:
        """Take a sample."""
        own = slice(self._world, self._world + 1)
        signals = [info[name] for name in self._traced]
        self._rows.append([float(signal[self._world]) for signal in signals])
        if self._recorder is not None:
            encoder = observation[own, self._encoder][:, 0]
            rest = int(info["rest"][self._world])
            self._recorder.take(encoder, info["link_angle_imu"][own], rest)

    def signals(self) -> dict[str, Array]:
        """Time series by name."""
        return dict(zip(self._traced, np.array(self._rows).T, strict=True))

    def points(self) -> StaticPoints | None:
        """Static points; None where the motion did not visit all of them."""
        if self._recorder is None or not self._recorder.is_complete:
            return None
        return self._recorder.points()[0]
