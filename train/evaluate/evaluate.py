"""Run a policy in an environment, many episodes at once; keep its metrics, one time series, and the static points."""

from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeVar

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.catalogue import Track
from baselines.identification.static_points import HoldRecorder, StaticPoints
from baselines.policies import is_saved, track
from elastic_env.core.errors import ConfigurationError, ElasticError, SystemFailedError
from elastic_env.core.signals import Array, BoolArray
from elastic_env.runtime.robot_model import WalkerModel
from elastic_env.runtime.scenario import make_scenario
from train.evaluate.conditions import Condition, PolicySpec
from train.evaluate.support_changes import SupportChanges
from train.runs.failures import is_full
from train.runs.user_code import named_object

MOST_WORLDS = 64
"""Worlds that are played at once."""
_BEFORE_FALL_S = 0.6
"""What happens in this time before a fall does not set the scale of a figure [s]."""

Progress = Callable[[int], None]
ItemT = TypeVar("ItemT")
KeyT = TypeVar("KeyT", bound=Hashable)


@dataclass
class Evaluation:
    """What came out of a condition.

    Attributes:
        condition: The condition.
        episodes: Flat records, one per episode: seed, metrics, termination.
        trace: Signals of the first episode over time, those that the environment's description names.
        points: Static points of the first episode, with reference "hold".
        rest_references: References of the static points, (visits,) [rad].
    """

    condition: Condition
    episodes: list[dict[str, Any]] = field(default_factory=list)
    trace: dict[str, Array] = field(default_factory=dict)
    points: StaticPoints | None = None
    rest_references: Array = field(default_factory=lambda: np.zeros(0))

    def values(self, metric: str, failed: bool = False) -> Array:
        """A metric over the episodes that did not fail, or over those that did, (n,); empty where none has it."""
        found = [episode.get(metric) for episode in self.episodes if bool(episode["termination"]) == failed]
        return np.array([value for value in found if value is not None], dtype=np.float64)

    @property
    def num_failed(self) -> int:
        """Episodes that ended in a failure, such as a fall."""
        return sum(1 for episode in self.episodes if episode["termination"])

    @property
    def first_failed(self) -> bool:
        """Whether the episode of the trace is one of them."""
        return bool(self.episodes and self.episodes[0]["termination"])

    @property
    def is_steady(self) -> BoolArray:
        """Samples of the trace that a figure's range goes by: all but those shortly before a fall."""
        time_s = self.trace["time_s"]
        return time_s <= max(time_s[-1] - (_BEFORE_FALL_S if self.first_failed else 0.0), 0.0)


def grouped(items: Iterable[ItemT], key: Callable[[ItemT], KeyT]) -> dict[KeyT, list[ItemT]]:
    """Items such as evaluations by what they have in common, in the order in which it first occurs."""
    groups: dict[KeyT, list[ItemT]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


class PolicyFailedError(ElasticError):
    """A policy raised, or commanded what no action can be."""


def make_policy(spec: PolicySpec, env: Any, options: dict[str, Any] | None = None) -> Any:
    """The policy of a specification for an environment.

    Args:
        spec: The specification.
        env: The environment.
        options: Options instead of its own.

    Raises:
        ConfigurationError: The name is neither a baseline nor an importable function.
    """
    options = spec.options if options is None else options
    if ":" not in spec.name or is_saved(spec.name):
        return baselines.make(spec.name, env, **options)
    try:
        function = named_object(spec.name)
    except ConfigurationError as error:
        raise _not_a_policy(spec, str(error)) from error
    attribute = spec.name.rpartition(":")[2]
    if not callable(function):
        raise _not_a_policy(spec, f"{attribute} is no function but of type {type(function).__name__}")
    try:
        return function(env, **options)
    except ElasticError:
        raise
    except Exception as error:
        problem = f"{attribute}(env, ...) raised {type(error).__name__}: {error}"
        raise _not_a_policy(spec, problem) from error


def _not_a_policy(spec: PolicySpec, problem: str) -> ConfigurationError:
    return ConfigurationError(
        f"policy {spec.name!r}: {problem}; give a baseline ({', '.join(baselines.policy_names())}) or "
        '"FILE.py:function" or "module:function", a function that takes the environment and returns an object with '
        "predict()"
    )


def make_vector_env(
    condition: Condition,
    num_envs: int,
    num_threads: int = 0,
    autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
) -> Any:
    """The vector environment of a condition.

    Raises:
        ConfigurationError: Unknown environment, scenario, reference or argument.
    """
    return gymnasium.make_vec(
        condition.environment.id,
        num_envs=num_envs,
        vectorization_mode="vector_entry_point",
        num_threads=num_threads,
        autoreset_mode=autoreset_mode,
        **condition.arguments,
    )


def make_shared_env(
    conditions: Sequence[Condition], num_threads: int = 0, autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP
) -> Any:
    """A vector environment with a world of each condition, whose scenarios may differ, see `in_common`.

    Raises:
        ConfigurationError: Unknown environment, scenario, reference or argument.
    """
    first, scenarios = conditions[0], [condition.scenario_played for condition in conditions]
    if all(scenario == scenarios[0] for scenario in scenarios):
        return make_vector_env(first, len(conditions), num_threads, autoreset_mode)
    return gymnasium.make_vec(
        first.environment.id,
        num_envs=len(conditions),
        vectorization_mode="vector_entry_point",
        num_threads=num_threads,
        autoreset_mode=autoreset_mode,
        **{**first.arguments, "scenario": scenarios},
    )


def in_common(condition: Condition) -> str:
    """What conditions must have in common for a vector environment in common.

    That is everything but the scenario of a walker, of which a policy knows the friction and the rate of the IMU.
    """
    scenario = make_scenario(condition.scenario_played)
    walks = condition.environment.walks
    known = (scenario.friction_scale, scenario.pelvis_imu.rate_hz) if walks else scenario
    return repr((condition.env, {**condition.arguments, "scenario": known}))


def plays_beside_others(condition: Condition) -> bool:
    """Whether its policy does the same beside worlds of other scenarios.

    Nobody knows that of code of one's own. The truth of several scenarios is none, and trials are of one.
    """
    name = condition.policy.name
    if ":" in name and not is_saved(name):
        return False
    return track(name, condition.environment.walks) not in (Track.TRUTH, Track.WALKS)


def with_one_world(conditions: Iterable[Condition]) -> Iterator[tuple[Condition, Any]]:
    """Conditions, each with an environment of one world, which those that differ by their policy share."""
    made: dict[str, Any] = {}
    for condition in conditions:
        key = repr((condition.env, condition.arguments))
        if key not in made:
            made[key] = make_vector_env(condition, 1)
        yield condition, made[key]


def num_steps(conditions: Iterable[Condition]) -> list[int]:
    """Control steps that all episodes of each condition take together, for progress bars."""
    return [condition.episodes * env.unwrapped.task.num_steps for condition, env in with_one_world(conditions)]


def _worlds_at_once(condition: Condition) -> int:
    return 1 if condition.environment.is_real else MOST_WORLDS


def evaluate(condition: Condition, progress: Progress | None = None, num_threads: int = 0) -> Evaluation:
    """Play all episodes of a condition. Episode i has seed + i, whatever the number of worlds and threads.

    A policy with a method `rehearse(env, seed)` is given the environment before it is scored: it may play episodes of
    the robots that it is scored on, under other noise, see `baselines.adaptation.iterative`.

    Args:
        condition: What to play.
        progress: Called with the number of control steps done since the last call, of all episodes together.
        num_threads: Threads of the physics, 0 for all cores.
    """
    return evaluate_together([condition], progress, num_threads)[0]


def evaluate_together(
    conditions: Sequence[Condition], progress: Progress | None = None, num_threads: int = 0
) -> list[Evaluation]:
    """Play conditions of one policy side by side, which costs less; their results are those of `evaluate`.

    Args:
        conditions: What to play: one, or several with the same `in_common` that play beside others.
        progress: See `evaluate`.
        num_threads: See `evaluate`.
    """
    results = [Evaluation(condition) for condition in conditions]
    episodes = [(result, number) for result in results for number in range(result.condition.episodes)]
    at_once = _worlds_at_once(conditions[0])
    for first in range(0, len(episodes), at_once):
        batch = episodes[first : first + at_once]
        with closing(make_shared_env([result.condition for result, _ in batch], num_threads)) as env:
            _play(env, batch, progress)
    return results


def _play(env: Any, episodes: Sequence[tuple[Evaluation, int]], progress: Progress | None) -> None:
    """Episodes of conditions, by their numbers, a world each; in every world the first episode counts."""
    condition, worlds = episodes[0][0].condition, len(episodes)
    seeds = [result.condition.seed + number for result, number in episodes]
    policy = make_policy(condition.policy, env, condition.policy_options)
    if hasattr(policy, "rehearse"):
        with blamed(condition, 0):
            policy.rehearse(env, seeds[0])
    task = env.unwrapped.task
    keepers = {
        world: _FirstEpisode(task, condition.environment.traced, world)
        for world, (_, number) in enumerate(episodes)
        if number == 0
    }
    is_scored = hasattr(policy, "link_estimate") and not condition.environment.is_real
    estimates = _Estimates(task, worlds) if is_scored else None
    imu = _ImuError(task, worlds) if isinstance(task.assumed_model, WalkerModel) else None
    parts = [part.metrics for part in (estimates, imu) if part is not None]
    if hasattr(task, "robot_record"):  # of the robots that a walker draws from ranges
        parts.append(task.robot_record)
    observation, info = env.reset(seed=seeds)
    records: list[dict[str, Any] | None] = [None] * worlds
    state, episode_start, step, reported = None, np.ones(worlds, dtype=np.bool_), 0, 0
    while any(record is None for record in records):
        for world, keeper in keepers.items():
            if records[world] is None:
                keeper.take(observation, info)
        if imu is not None:
            imu.take(observation, info)
        with blamed(condition, step):
            action, state = policy.predict(observation, state=state, episode_start=episode_start, deterministic=True)
            if estimates is not None:
                estimates.take(step, policy.link_estimate(observation, state), observation, env.unwrapped.truth())
            observation, _, terminated, truncated, info = env.step(action)
        episode_start = np.zeros(worlds, dtype=np.bool_)
        for world in np.flatnonzero(terminated | truncated).tolist():
            if records[world] is None:
                result, number = episodes[world]
                records[world] = _record(result.condition, number, info, world, [metrics(world) for metrics in parts])
                if world in keepers:
                    keepers[world].take(observation, info)
        step += 1
        if progress is not None and step - reported == 250:
            progress(worlds * (step - reported))
            reported = step
    if progress is not None:
        progress(worlds * (task.num_steps - reported))
    for world, ((result, _), record) in enumerate(zip(episodes, records, strict=True)):
        if record is not None:
            result.episodes.append(record)
        if keeper := keepers.get(world):
            result.trace, result.points, result.rest_references = keeper.trace(), keeper.points(), keeper.references


@contextmanager
def blamed(condition: Condition, step: int | None = None) -> Iterator[None]:
    """Say of what a policy does within whose it is, and where.

    Args:
        condition: What is played.
        step: Control step; None where nobody counts.

    Raises:
        PolicyFailedError: It raises, ends the program, or its action is none.
    """
    try:
        yield
    except (SystemFailedError, MemoryError):
        raise
    except (Exception, SystemExit) as error:
        if is_full(error):
            raise
        kind = "" if isinstance(error, ElasticError) else f"{type(error).__name__}: "
        when = "" if step is None else f", at control step {step}"
        raise PolicyFailedError(
            f"the policy {condition.policy.title!r} failed in scenario {condition.scenario!r}, "
            f"{condition.reference_name}{when}: {kind}{error}"
        ) from error


def _record(
    condition: Condition, episode: int, info: dict[str, Any], world: int, further: list[dict[str, float]]
) -> dict[str, Any]:
    metrics = {name: values[world].item() for name, values in info["episode_metrics"].items()}
    return {
        **words_of(condition, episode),
        "termination": str(info["termination"][world]),
        **metrics,
        **{name: value for metrics in further for name, value in metrics.items()},
    }


def words_of(condition: Condition, episode: int) -> dict[str, Any]:
    """What the record of an episode says before it is played: cell, training seed, and seed of the episode."""
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


class _Rms:
    """RMS over the scored steps of every world."""

    def __init__(self, task: Any, worlds: int) -> None:
        self._task, self._sum, self._count = task, np.zeros(worlds), np.zeros(worlds)

    def take(self, squared: Array) -> None:
        scored = self._task.masks(self._task.sample())["scored"]
        self._sum += np.where(scored, squared, 0.0)
        self._count += scored

    def of(self, world: int) -> float:
        count = self._count[world]
        return float(np.sqrt(self._sum[world] / count)) if count else float("nan")


class _ImuError:
    """Roll and pitch by a walker's IMU, as old as they are shown, against the truth."""

    def __init__(self, task: Any, worlds: int) -> None:
        self._rms, self._attitude = _Rms(task, worlds), task.observation_table.group("imu_attitude")

    def take(self, observation: Array, info: dict[str, Any]) -> None:
        error = observation[:, self._attitude] - np.stack([info["pelvis_roll"], info["pelvis_pitch"]], axis=1)
        self._rms.take(np.square(error).sum(axis=1))

    def metrics(self, world: int) -> dict[str, float]:
        """RMS of the angle by which the shown vertical is off."""
        return {"imu_error_rms_rad": self._rms.of(world)}


class _Estimates:
    """A policy's estimate of the link angles against the truth, and on a walker what it makes of the local frame."""

    def __init__(self, task: Any, worlds: int) -> None:
        self._rms = _Rms(task, worlds)
        self._changes = SupportChanges(task.assumed_model) if isinstance(task.assumed_model, WalkerModel) else None

    def take(self, step: int, estimate: Array, observation: Array, truth: Any) -> None:
        self._rms.take(np.square(estimate - truth.q).mean(axis=1))
        if self._changes is not None:
            self._changes.take(step, estimate, observation, truth)

    def metrics(self, world: int) -> dict[str, float]:
        """RMS over the scored steps, and the figures of the support changes."""
        changes = self._changes.metrics(world) if self._changes is not None else {}
        return {"link_estimate_error_rms_rad": self._rms.of(world), **changes}


class _FirstEpisode:
    """Time series and static points of an episode, that of a world."""

    def __init__(self, task: Any, traced: tuple[str, ...], world: int) -> None:
        self._traced, self._world = traced, world
        self._encoder = task.observation_table.group("encoder_angle")
        visits = getattr(getattr(task.config, "reference", None), "visits", None)
        is_seen = "link_angle_imu" in traced  # static points need the IMU of the only link
        self.references, directions = visits if visits is not None and is_seen else (np.zeros(0), None)
        self._recorder = HoldRecorder(directions) if directions is not None else None
        self._rows: list[tuple[float, ...]] = []

    def take(self, observation: Array, info: dict[str, Any]) -> None:
        own = slice(self._world, self._world + 1)
        self._rows.append(tuple(float(info[name][self._world]) for name in self._traced))
        if self._recorder is not None:
            encoder = observation[own, self._encoder][:, 0]
            self._recorder.take(encoder, info["link_angle_imu"][own], int(info["rest"][self._world]))

    def trace(self) -> dict[str, Array]:
        return dict(zip(self._traced, np.array(self._rows).T, strict=True))

    def points(self) -> StaticPoints | None:
        return self._recorder.points()[0] if self._recorder is not None and self._recorder.is_complete else None
