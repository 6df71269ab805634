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
"""Sees number, observation, info and memory of a control step, before the world moves."""


class PolicyFailedError(ElasticError):
    """A policy raised, or commanded what no action can be."""


@dataclass(frozen=True, eq=False)
class ControlStep:
    """One control step of a rollout.

    Attributes:
        number: From 0 on.
        seen: Observation that the policy acted on.
        action: Its command.
        observation: Observation after the step.
        info: Info after the step.
        terminated: Worlds that failed in this step, (num_worlds,); of a scalar environment one
            truth value.
        truncated: Worlds that reached their end.
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
    """Play a policy from a reset on, one control step at a time, in one world or in many.

    A scalar environment stops at the end of its episode. The worlds of a vector environment go on,
    each with the next episode, and whoever reads the steps stops when there are enough. In mode
    `DISABLED` the steps end when all worlds have ended; what one does after its end means nothing.

    Args:
        env: The environment.
        policy: Anything with `predict`.
        seed: Of the reset; of a vector environment one for each world, or one for all.
        condition: What is played, for the errors of the policy; None to let them pass.
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
            answer = policy.predict(
                observation, state=memory, episode_start=begins, deterministic=True
            )
            if not isinstance(answer, tuple) or len(answer) != 2:
                kind = type(answer).__name__
                raise ConfigurationError(f"predict must return (action, state), got {kind}")
            action, memory = answer
            if watch is not None:
                watch(number, observation, info, memory)
            after, _, terminated, truncated, info = env.step(action)
        ends = (terminated, truncated)
        step = ControlStep(number, observation, action, after, info, *ends)
        yield step
        observation = after
        is_over = step.is_over
        has_ended = has_ended | is_over
        if mode in (None, AutoresetMode.DISABLED) and has_ended.all():
            return
        # by itself a world begins anew in the step after its end
        begins = was_over if mode is AutoresetMode.NEXT_STEP else is_over
        was_over = is_over


@contextmanager
def policy_errors(condition: Condition, step: int | None = None) -> Iterator[None]:
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
        options: Options by name instead of its own.

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
        kind = type(function).__name__
        raise _not_a_policy(spec, f"{attribute} is no function but of type {kind}")
    _require_options(spec, function, options)
    try:
        return function(env, **options)
    except ElasticError:
        raise
    except Exception as error:
        place = user_line(error)
        problem = f"{attribute}(env, ...) raised{place} {type(error).__name__}: {error}"
        raise _not_a_policy(spec, problem) from error


def _require_options(spec: PolicySpec, function: Callable[..., Any], options: Any) -> None:
    """Refuse options that a policy's function does not take.

    Raises:
        ConfigurationError: There is one.
    """
    try:
        _, *parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # one that does not say what it takes
        return
    if all(parameter.kind is not parameter.VAR_KEYWORD for parameter in parameters):
        names = [parameter.name for parameter in parameters]
        require_known(f"option of the policy {spec.name!r}", options, names)


def _not_a_policy(spec: PolicySpec, problem: str) -> ConfigurationError:
    return ConfigurationError(
        f"policy {spec.name!r}: {problem}; give a baseline, such as input, or"
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
        autoreset_mode: When worlds begin anew.
        **others: Arguments of the environment in place of the condition's.

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
    """A vector environment with a world of each condition, see `shared_settings`.

    Raises:
        ConfigurationError: Unknown environment, scenario, reference or argument.
    """
    scenario: Any = [condition.scenario_played for condition in conditions]
    first = conditions[0]
    if all(own == scenario[0] for own in scenario):
        scenario = scenario[0]
    others = {"autoreset_mode": autoreset_mode, "scenario": scenario}
    return make_vector_env(first, len(conditions), num_threads, **others)


def shared_settings(condition: Condition) -> str:
    """Settings that conditions must share to share a vector environment.

    That is everything but the scenario of a walker, of which a policy knows the friction and the
    rate of the IMU.
    """
    walks = condition.environment.walks
    scenario = make_scenario(condition.scenario_played, walks)
    known: Any = scenario
    if walks:
        known = (scenario.friction_scale, scenario.pelvis_imu.rate_hz)
    return repr((condition.env, {**condition.arguments, "scenario": known}))


def can_share_worlds(condition: Condition) -> bool:
    """True if its policy does the same beside worlds of other scenarios.

    Nobody knows that of code of one's own. The truth of several scenarios is none, and trials are
    of one.
    """
    name = condition.policy.name
    if ":" in name and not is_saved(name):
        return False
    return track(name, condition.environment.walks) not in (Track.TRUTH, Track.WALKS)


def single_world_envs(conditions: Iterable[Condition]) -> Iterator[tuple[Condition, Any]]:
    """Conditions with an environment of one world, shared by those that differ by the policy."""
    made: dict[str, Any] = {}
    for condition in conditions:
        key = repr((condition.env, condition.arguments))
        if key not in made:
            made[key] = make_vector_env(condition, 1)
        yield condition, made[key]


def num_steps(conditions: Iterable[Condition]) -> list[int]:
    """Control steps that all episodes of each condition take together, for progress bars."""
    return [
        condition.episodes * env.unwrapped.task.num_steps
        for condition, env in single_world_envs(conditions)
    ]
