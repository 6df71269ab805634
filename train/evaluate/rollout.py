"""The rollout of a policy: its environment, the policy, and one generator of control steps."""

import inspect
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from itertools import count
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.catalogue import Track
from baselines.policies import is_saved, track
from elastic_env.core.errors import (
    ConfigurationError,
    ElasticError,
    SystemFailedError,
    require_known,
)
from elastic_env.core.signals import BoolArray
from elastic_env.world.scenario import make_scenario
from train.evaluate.conditions import Condition, PolicySpec
from train.runs.failures import is_disk_full
from train.runs.user_code import named_object, user_line

Watch = Callable[[int, Any, Any, Any], None]
"""Called with number, observation, info and memory of a control step, before the world moves."""


class PolicyFailedError(ElasticError):
    """A policy raised an exception, or returned an invalid action."""


@dataclass(frozen=True, eq=False)
class ControlStep:
    """One control step of a rollout.

    Attributes:
        number: From 0 on.
        seen: Observation that the policy acted on.
        action: Its command.
        observation: Observation after the step.
        info: Info after the step.
        terminated: True for worlds that failed in this step, (num_worlds,); one value for a scalar
            environment.
        truncated: True for worlds that reached their end in this step.
    """

    number: int
    seen: Any
    action: Any
    observation: Any
    info: Any
    terminated: Any
    truncated: Any

    @property
    def is_over(self) -> BoolArray:
        """Worlds whose episode ended in this step."""
        return np.asarray(self.terminated) | np.asarray(self.truncated)


def control_steps(
    env: Any,
    policy: Any,
    seed: Any,
    condition: Condition | None = None,
    watch: Watch | None = None,
) -> Iterator[ControlStep]:
    """Play a policy after a reset, one control step at a time, in one world or in many.

    A scalar environment stops at the end of its episode. Each world of a vector environment goes on
    with its next episode, until the caller takes no further step. In mode `DISABLED` the steps end
    when all worlds have ended; steps of a world after its end have no meaning.

    Args:
        env: The environment.
        policy: Any object with `predict`.
        seed: Seed of the reset; for a vector environment one for each world, or one for all.
        condition: Condition that errors of the policy name; None to raise them unchanged.
        watch: Called between the command and the step.

    Raises:
        PolicyFailedError: The policy of the condition failed.
    """
    is_vector = hasattr(env, "num_envs")
    mode = env.metadata.get("autoreset_mode") if is_vector else None
    observation, info = env.reset(seed=seed)
    memory: Any = None
    begins = np.ones(env.num_envs if is_vector else (), dtype=np.bool_)
    was_over = np.zeros_like(begins)
    has_ended = np.zeros_like(begins)
    for number in count():
        with nullcontext() if condition is None else policy_errors(condition, number):
            result = policy.predict(
                observation, state=memory, episode_start=begins, deterministic=True
            )
            if not isinstance(result, tuple) or len(result) != 2:
                kind = type(result).__name__
                raise ConfigurationError(f"predict must return (action, state), got {kind}")
            action, memory = result
            if watch is not None:
                watch(number, observation, info, memory)
            next_observation, _, terminated, truncated, info = env.step(action)
        ends = (terminated, truncated)
        step = ControlStep(number, observation, action, next_observation, info, *ends)
        yield step
        observation = next_observation
        is_over = step.is_over
        has_ended = has_ended | is_over
        if mode in (None, AutoresetMode.DISABLED) and has_ended.all():
            return
        # in mode NEXT_STEP a world begins its next episode in the step after its end
        begins = was_over if mode is AutoresetMode.NEXT_STEP else is_over
        was_over = is_over


@contextmanager
def policy_errors(condition: Condition, step: int | None = None) -> Iterator[None]:
    """Name the policy and the place in errors that a policy raises within the context.

    Args:
        condition: Condition that is played.
        step: Control step; None if steps are not counted.

    Raises:
        PolicyFailedError: The policy raises, ends the program, or its action is invalid.
    """
    try:
        yield
    except (SystemFailedError, MemoryError):
        raise
    except (Exception, SystemExit) as error:
        if is_disk_full(error):
            raise
        kind = "" if isinstance(error, ElasticError) else f"{type(error).__name__}: "
        when = "" if step is None else f", at control step {step}"
        raise PolicyFailedError(
            f"the policy {condition.policy.title!r} failed in scenario {condition.scenario!r}, "
            f"{condition.reference_name}{when}{user_line(error)}: {kind}{error}"
        ) from error


def make_policy(spec: PolicySpec, env: Any, options: Any = None) -> Any:
    """The policy of a specification for an environment.

    Args:
        spec: The specification.
        env: The environment.
        options: Options by name that replace those of the specification; None for these.

    Raises:
        ConfigurationError: The name is neither a baseline nor an importable function.
    """
    options = spec.options if options is None else options
    if ":" not in spec.name or is_saved(spec.name):
        return baselines.make(spec.name, env, **options)
    try:
        function = named_object(spec.name)
    except ConfigurationError as error:
        raise _policy_error(spec, str(error)) from error
    attribute = spec.name.rpartition(":")[2]
    if not callable(function):
        kind = type(function).__name__
        raise _policy_error(spec, f"{attribute} is no function but of type {kind}")
    _require_options(spec, function, options)
    try:
        return function(env, **options)
    except ElasticError:
        raise
    except Exception as error:
        place = user_line(error)
        problem = f"{attribute}(env, ...) raised{place} {type(error).__name__}: {error}"
        raise _policy_error(spec, problem) from error


def _require_options(spec: PolicySpec, function: Callable[..., Any], options: Any) -> None:
    """Refuse options that the function of a policy does not accept.

    Raises:
        ConfigurationError: The function does not accept an option.
    """
    try:
        _, *parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # a callable without a signature
        return
    if all(parameter.kind is not parameter.VAR_KEYWORD for parameter in parameters):
        names = [parameter.name for parameter in parameters]
        require_known(f"option of the policy {spec.name!r}", options, names)


def _policy_error(spec: PolicySpec, problem: str) -> ConfigurationError:
    end = "" if problem.endswith((".", "?")) else "."
    return ConfigurationError(
        f"policy {spec.name!r}: {problem}{end} Give a baseline, such as input, or"
        ' "FILE.py:function" or "module:function", a function or class that takes the environment'
        " and returns an object with predict()"
    )


def make_vector_env(
    condition: Condition,
    num_envs: int,
    num_threads: int = 0,
    autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
    **others: Any,
) -> Any:
    """The vector environment of a condition.

    Args:
        condition: The condition.
        num_envs: Worlds.
        num_threads: Threads of the physics, 0 for all cores.
        autoreset_mode: When worlds begin their next episode.
        **others: Arguments of the environment that replace those of the condition.

    Raises:
        ConfigurationError: Unknown environment, scenario, reference or argument.
    """
    return gymnasium.make_vec(
        condition.environment.id,
        num_envs=num_envs,
        vectorization_mode="vector_entry_point",
        num_threads=num_threads,
        autoreset_mode=autoreset_mode,
        **{**condition.arguments, **others},
    )


def make_shared_env(
    conditions: Sequence[Condition],
    num_threads: int = 0,
    autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
) -> Any:
    """A vector environment with one world of each condition, see `shared_settings`.

    Raises:
        ConfigurationError: Unknown environment, scenario, reference or argument.
    """
    scenario: Any = [condition.scenario_played for condition in conditions]
    if all(each == scenario[0] for each in scenario):
        scenario = scenario[0]
    others = {"autoreset_mode": autoreset_mode, "scenario": scenario}
    return make_vector_env(conditions[0], len(conditions), num_threads, **others)


def shared_settings(condition: Condition) -> str:
    """Settings that conditions of one vector environment have in common, as a text.

    These are all settings. From the scenario of a walker they are only the friction and the rate of
    the IMU, which a policy knows.
    """
    walks = condition.environment.walks
    scenario: Any = make_scenario(condition.scenario_played, walks)
    if walks:
        scenario = (scenario.friction_scale, scenario.pelvis_imu.rate_hz)
    return repr((condition.env, {**condition.arguments, "scenario": scenario}))


def can_share_worlds(condition: Condition) -> bool:
    """True if its policy acts the same in a vector environment with other scenarios.

    A user's own code may not. A policy that reads the truth, or learns in trials, needs one
    scenario.
    """
    name = condition.policy.name
    if ":" in name and not is_saved(name):
        return False
    return track(name, condition.environment.walks) not in (Track.TRUTH, Track.WALKS)


def single_world_envs(conditions: Iterable[Condition]) -> Iterator[tuple[Condition, Any]]:
    """Yield conditions with an environment of one world; those of the same world share it."""
    envs: dict[str, Any] = {}
    for condition in conditions:
        key = repr((condition.env, condition.arguments))
        if key not in envs:
            envs[key] = make_vector_env(condition, 1)
        yield condition, envs[key]


def num_steps(conditions: Iterable[Condition]) -> list[int]:
    """Control steps that all episodes of each condition take together, for progress bars."""
    return [
        condition.episodes * env.unwrapped.task.num_steps
        for condition, env in single_world_envs(conditions)
    ]
