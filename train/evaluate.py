"""Run a policy in an environment, many episodes at once; keep its metrics, one time series, and the static points."""

import importlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from pydantic import field_validator

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.static_points import HoldRecorder, StaticPoints
from elastic_env.config import Model, quantity
from elastic_env.errors import ConfigurationError, unknown_name
from elastic_env.signals import Array

ENVIRONMENTS = {"testbed": "elastic_env/Testbed-v0"}
"""Environments by the short names of the command line."""

TRACED = (
    "time_s",
    "reference_angle",
    "link_angle",
    "link_angle_imu",
    "deflection",
    "link_error",
    "link_error_imu",
    "joint_torque",
)
"""Signals of the first episode that are kept."""

_MAX_WORLDS = 64

Progress = Callable[[int], None]


class PolicySpec(Model):
    """A policy of a comparison: a baseline's name, or "module:function" for one's own, with options."""

    name: str
    label: str | None = None
    """How tables and figures call it; None for its name."""
    options: dict[str, Any] = {}
    """Keyword arguments of `baselines.make`, or of one's own function."""

    @property
    def title(self) -> str:
        """Label, or name."""
        return self.label or self.name


class Condition(Model):
    """One cell of a comparison: who plays what under which scenario."""

    env: str = "testbed"
    policy: PolicySpec
    reference: str | dict[str, Any] = "hold"
    label: str | None = None
    """How tables and figures call the reference; None for its kind."""
    scenario: str = "nominal"
    env_options: dict[str, Any] = {}
    """Further arguments of the environment, such as stiffness."""
    episodes: int = quantity("1", 1, ge=1, description="number of episodes")
    seed: int = quantity("1", 0, ge=0, description="seed of the first episode; the next ones follow")

    @field_validator("env_options")
    @classmethod
    def _options_are_not_taken(cls, value: dict[str, Any]) -> dict[str, Any]:
        taken = sorted(value.keys() & {"reference", "scenario", "num_envs", "num_threads", "autoreset_mode"})
        if taken:
            raise ValueError(f"{', '.join(taken)} cannot be given here but have keys of their own, or no place")
        return value

    @property
    def reference_name(self) -> str:
        """Label or kind of the reference."""
        if self.label is not None:
            return self.label
        return self.reference if isinstance(self.reference, str) else str(self.reference.get("kind"))


@dataclass
class Evaluation:
    """What came out of a condition.

    Attributes:
        condition: The condition.
        episodes: Flat records, one per episode: seed, metrics, termination.
        trace: Signals of the first episode over time, see `TRACED`.
        points: Static points of the first episode, with reference "hold".
        rest_references: References of the static points, (visits,) [rad].
    """

    condition: Condition
    episodes: list[dict[str, Any]] = field(default_factory=list)
    trace: dict[str, Array] = field(default_factory=dict)
    points: StaticPoints | None = None
    rest_references: Array = field(default_factory=lambda: np.zeros(0))

    def values(self, metric: str) -> Array:
        """A metric over the episodes."""
        return np.array([episode[metric] for episode in self.episodes], dtype=np.float64)


def make_policy(spec: PolicySpec, env: Any) -> Any:
    """The policy of a specification for an environment.

    Raises:
        ConfigurationError: The name is neither a baseline nor an importable function.
    """
    if ":" not in spec.name:
        return baselines.make(spec.name, env, **spec.options)
    module, _, attribute = spec.name.partition(":")
    try:
        function = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ConfigurationError(
            f"policy {spec.name!r}: {error}; give a baseline ({', '.join(baselines.policy_names())}) or "
            '"module:function", a function that takes the environment and returns an object with predict()'
        ) from None
    return function(env, **spec.options)


def make_vector_env(condition: Condition, num_envs: int, num_threads: int = 0) -> Any:
    """The vector environment of a condition.

    Raises:
        ConfigurationError: Unknown environment, scenario, reference or argument.
    """
    if condition.env not in ENVIRONMENTS:
        raise unknown_name("environment", condition.env, ENVIRONMENTS)
    return gymnasium.make_vec(
        ENVIRONMENTS[condition.env],
        num_envs=num_envs,
        vectorization_mode="vector_entry_point",
        num_threads=num_threads,
        autoreset_mode=AutoresetMode.NEXT_STEP,
        reference=condition.reference,
        scenario=condition.scenario,
        **condition.env_options,
    )


def num_steps(condition: Condition) -> int:
    """Control steps that all episodes of a condition take, for progress bars."""
    env = make_vector_env(condition, 1)
    batches = -(-condition.episodes // _MAX_WORLDS)
    return batches * env.unwrapped.task.num_steps


def evaluate(condition: Condition, progress: Progress | None = None, num_threads: int = 0) -> Evaluation:
    """Play all episodes of a condition. Episode i has seed + i, whatever the number of worlds and threads.

    Args:
        condition: What to play.
        progress: Called with the number of control steps done since the last call.
        num_threads: Threads of the physics, 0 for all cores.
    """
    result = Evaluation(condition)
    for first in range(0, condition.episodes, _MAX_WORLDS):
        worlds = min(_MAX_WORLDS, condition.episodes - first)
        _play(condition, first, worlds, num_threads, result, progress)
    return result


def _play(
    condition: Condition, first: int, worlds: int, num_threads: int, result: Evaluation, progress: Progress | None
) -> None:
    """One batch of worlds, each until the end of its first episode."""
    env = make_vector_env(condition, worlds, num_threads)
    policy = make_policy(condition.policy, env)
    task = env.unwrapped.task
    keeper = _FirstWorld(task) if first == 0 else None
    estimates = _EstimateError(worlds) if hasattr(policy, "link_estimate") else None
    observation, info = env.reset(seed=condition.seed + first)
    records: list[dict[str, Any] | None] = [None] * worlds
    state, episode_start, unreported = None, np.ones(worlds, dtype=np.bool_), 0
    while any(record is None for record in records):
        if keeper is not None and records[0] is None:
            keeper.take(observation, info)
        action, state = policy.predict(observation, state=state, episode_start=episode_start, deterministic=True)
        if estimates is not None:
            estimates.take(policy.link_estimate(observation, state), env.unwrapped.truth().q, task.scored())
        observation, _, terminated, truncated, info = env.step(action)
        episode_start = np.zeros(worlds, dtype=np.bool_)
        for world in np.flatnonzero(terminated | truncated):
            if records[world] is None:
                records[world] = _record(condition, first + int(world), info, int(world), estimates)
                if world == 0 and keeper is not None:
                    keeper.take(observation, info)
        unreported += 1
        if progress is not None and unreported == 250:
            progress(unreported)
            unreported = 0
    if progress is not None:
        progress(unreported)
    result.episodes.extend(record for record in records if record is not None)
    if keeper is not None:
        result.trace, result.points, result.rest_references = keeper.trace(), keeper.points(), keeper.references


def _record(
    condition: Condition, episode: int, info: dict[str, Any], world: int, estimates: "_EstimateError | None"
) -> dict[str, Any]:
    metrics = {name: values[world].item() for name, values in info["episode_metrics"].items()}
    if estimates is not None:
        metrics["link_estimate_error_rms_rad"] = estimates.rms(world)
    return {
        "policy": condition.policy.title,
        "scenario": condition.scenario,
        "reference": condition.reference_name,
        "seed": condition.seed + episode,
        "termination": str(info["termination"][world]),
        **metrics,
    }


class _EstimateError:
    """RMS of a policy's estimate of the link angle against the truth, over the scored steps."""

    def __init__(self, worlds: int) -> None:
        self._sum, self._count = np.zeros(worlds), np.zeros(worlds)

    def take(self, estimate: Array, truth: Array, scored: Array) -> None:
        self._sum += np.where(scored, np.square(estimate - truth).mean(axis=1), 0.0)
        self._count += scored

    def rms(self, world: int) -> float:
        return float(np.sqrt(self._sum[world] / self._count[world])) if self._count[world] else float("nan")


class _FirstWorld:
    """Time series and static points of the first world."""

    def __init__(self, task: Any) -> None:
        self._encoder = task.observation_table.names.index("encoder_angle")
        reference = task.config.reference
        self.references, directions = reference.visits if hasattr(reference, "visits") else (np.zeros(0), None)
        self._recorder = HoldRecorder(directions) if directions is not None else None
        self._rows: list[tuple[float, ...]] = []

    def take(self, observation: Array, info: dict[str, Any]) -> None:
        self._rows.append(tuple(float(info[name][0]) for name in TRACED))
        if self._recorder is not None:
            self._recorder.take(observation[:1, self._encoder], info["link_angle_imu"][:1], int(info["rest"][0]))

    def trace(self) -> dict[str, Array]:
        return dict(zip(TRACED, np.array(self._rows).T, strict=True))

    def points(self) -> StaticPoints | None:
        return self._recorder.points()[0] if self._recorder is not None and self._recorder.is_complete else None
