"""Run a policy in an environment, many episodes at once; keep its metrics, one time series, and the static points."""

from collections.abc import Callable, Hashable, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeVar

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.identification.static_points import HoldRecorder, StaticPoints
from baselines.policies import is_saved
from elastic_env.core.errors import ConfigurationError, ElasticError, SystemFailedError
from elastic_env.core.signals import Array, BoolArray
from elastic_env.runtime.robot_model import WalkerModel
from train.evaluate.conditions import Condition, PolicySpec
from train.evaluate.support_changes import SupportChanges
from train.runs.failures import is_full
from train.runs.user_code import named_object

_MAX_WORLDS = 64
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


def with_one_world(conditions: Iterable[Condition]) -> Iterator[tuple[Condition, Any]]:
    """Conditions, each with an environment of one world, which those that differ by their policy share."""
    made: dict[str, Any] = {}
    for condition in conditions:
        key = repr((condition.env, condition.arguments))
        if key not in made:
            made[key] = make_vector_env(condition, 1)
        yield condition, made[key]


def num_steps(conditions: Iterable[Condition]) -> list[int]:
    """Control steps that all episodes of each condition take, for progress bars."""
    return [
        -(-condition.episodes // _worlds_at_once(condition)) * env.unwrapped.task.num_steps
        for condition, env in with_one_world(conditions)
    ]


def _worlds_at_once(condition: Condition) -> int:
    return 1 if condition.environment.is_real else _MAX_WORLDS


def evaluate(condition: Condition, progress: Progress | None = None, num_threads: int = 0) -> Evaluation:
    """Play all episodes of a condition. Episode i has seed + i, whatever the number of worlds and threads.

    A policy with a method `rehearse(env, seed)` is given the environment before it is scored: it may play episodes of
    the robots that it is scored on, under other noise, see `baselines.adaptation.iterative`.

    Args:
        condition: What to play.
        progress: Called with the number of control steps done since the last call.
        num_threads: Threads of the physics, 0 for all cores.
    """
    result = Evaluation(condition)
    at_once = _worlds_at_once(condition)
    for first in range(0, condition.episodes, at_once):
        worlds = min(at_once, condition.episodes - first)
        with closing(make_vector_env(condition, worlds, num_threads)) as env:
            _play(env, condition, first, worlds, result, progress)
    return result


def _play(
    env: Any, condition: Condition, first: int, worlds: int, result: Evaluation, progress: Progress | None
) -> None:
    """One batch of worlds, each until the end of its first episode."""
    policy = make_policy(condition.policy, env, condition.policy_options)
    if hasattr(policy, "rehearse"):
        with blamed(condition, 0):
            policy.rehearse(env, condition.seed + first)
    task = env.unwrapped.task
    keeper = _FirstWorld(task, condition.environment.traced) if first == 0 else None
    is_scored = hasattr(policy, "link_estimate") and not condition.environment.is_real
    estimates = _Estimates(task, worlds) if is_scored else None
    imu = _ImuError(task, worlds) if isinstance(task.assumed_model, WalkerModel) else None
    parts = [part.metrics for part in (estimates, imu) if part is not None]
    if hasattr(task, "robot_record"):  # of the robots that a walker draws from ranges
        parts.append(task.robot_record)
    observation, info = env.reset(seed=condition.seed + first)
    records: list[dict[str, Any] | None] = [None] * worlds
    state, episode_start, step, reported = None, np.ones(worlds, dtype=np.bool_), 0, 0
    while any(record is None for record in records):
        if keeper is not None and records[0] is None:
            keeper.take(observation, info)
        if imu is not None:
            imu.take(observation, info)
        with blamed(condition, step):
            action, state = policy.predict(observation, state=state, episode_start=episode_start, deterministic=True)
            if estimates is not None:
                estimates.take(step, policy.link_estimate(observation, state), observation, env.unwrapped.truth())
            observation, _, terminated, truncated, info = env.step(action)
        episode_start = np.zeros(worlds, dtype=np.bool_)
        for world in np.flatnonzero(terminated | truncated):
            if records[world] is None:
                own = [metrics(int(world)) for metrics in parts]
                records[world] = _record(condition, first + int(world), info, int(world), own)
                if world == 0 and keeper is not None:
                    keeper.take(observation, info)
        step += 1
        if progress is not None and step - reported == 250:
            progress(step - reported)
            reported = step
    if progress is not None:
        progress(task.num_steps - reported)
    result.episodes.extend(record for record in records if record is not None)
    if keeper is not None:
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
        "termination": str(info["termination"][world]),
        **metrics,
        **{name: value for metrics in further for name, value in metrics.items()},
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


class _FirstWorld:
    """Time series and static points of the first world."""

    def __init__(self, task: Any, traced: tuple[str, ...]) -> None:
        self._traced = traced
        self._encoder = task.observation_table.group("encoder_angle")
        visits = getattr(getattr(task.config, "reference", None), "visits", None)
        is_seen = "link_angle_imu" in traced  # static points need the IMU of the only link
        self.references, directions = visits if visits is not None and is_seen else (np.zeros(0), None)
        self._recorder = HoldRecorder(directions) if directions is not None else None
        self._rows: list[tuple[float, ...]] = []

    def take(self, observation: Array, info: dict[str, Any]) -> None:
        self._rows.append(tuple(float(info[name][0]) for name in self._traced))
        if self._recorder is not None:
            encoder = observation[:1, self._encoder][:, 0]
            self._recorder.take(encoder, info["link_angle_imu"][:1], int(info["rest"][0]))

    def trace(self) -> dict[str, Array]:
        return dict(zip(self._traced, np.array(self._rows).T, strict=True))

    def points(self) -> StaticPoints | None:
        return self._recorder.points()[0] if self._recorder is not None and self._recorder.is_complete else None
