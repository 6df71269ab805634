"""Environments in which an agent decides the residual of a base policy, for one world and for many.

A step is a decision: the residual is held for `decision_period` control steps behind its low-pass,
the base policy commands the robot, rewards are summed, and the next observation is that of the next
decision. A world that ends inside a decision takes no further part in it: its observation and
reward are those up to its end.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from baselines.compensation.memory import put_rows, select_rows
from baselines.compensation.policy import Policy
from baselines.policies import make
from baselines.residual.correction import Corrected
from baselines.residual.features import Features, FeaturesMemory
from baselines.residual.settings import ResidualSettings
from baselines.residual.true_robot import CriticView, truth_of
from elastic_env.core.errors import ActionError, ConfigurationError, quote
from elastic_env.core.signals import Array, BoolArray
from elastic_env.world.envs import final_of, reset_mask
from elastic_env.world.task import Transition


class _Deciding:
    """Base policy, correction and features of some worlds, and their memories."""

    def __init__(
        self,
        env: Any,
        base: Policy | str,
        settings: Mapping[str, Any],
        num_worlds: int,
        critic_sees: Sequence[str] = (),
    ) -> None:
        self.settings = ResidualSettings(**settings)
        if not hasattr(env.unwrapped, "assumed_model"):
            raise ConfigurationError(
                f"a residual needs an environment of ours, got {type(env.unwrapped).__name__}"
            )
        policy = make(base, env) if isinstance(base, str) else base
        model = env.unwrapped.assumed_model
        self.corrected = Corrected(policy, model, self.settings, truth_of(env))
        self.features = Features(self.corrected)
        self._critic = CriticView(critic_sees, self.corrected) if critic_sees else None
        further = 0 if self._critic is None else self._critic.width
        seen = (self.features.width + further,)
        decided = (self.corrected.num_residuals,)
        self.observation_space = Box(-np.inf, np.inf, seen, np.float64)
        self.action_space = Box(-1.0, 1.0, decided, np.float32)
        self._start = self._fresh = np.zeros(num_worlds, dtype=np.bool_)
        self._state: Any = None
        self._past: FeaturesMemory | None = None

    def begin(self, worlds: BoolArray) -> None:
        """Episodes begin in some worlds, a (num_worlds,) mask."""
        self._start = self._start | worlds
        self._fresh = self._fresh | worlds
        if worlds.all():
            self._state = self._past = None

    def observe(self, rows: Array, worlds: BoolArray | None = None) -> Array:
        """Features of the coming decision.

        The measurements count for some worlds only, or for all.
        """
        policy = (self._state, self._start)
        features, past = self.features.at(rows, self._past, self._fresh, *policy)
        if worlds is not None and self._past is not None:
            past = put_rows(self._past, worlds, select_rows(past, worlds))
        self._past = past
        self._fresh = self._fresh & (False if worlds is None else ~worlds)
        if self._critic is None:
            return features
        return np.hstack([features, self._critic.at(rows)])

    def act(self, observation: Array, residual: Array) -> npt.NDArray[np.float32]:
        """Commands of the corrected base for a control step."""
        policy = (self._state, self._start)
        action, self._state = self.corrected.act(observation, residual, *policy)
        self._start = np.zeros_like(self._start)
        return action

    def read_residual(self, rows: Array, residual: Any, space: Any) -> Array:
        """A residual for the observations of its decision, clipped and out of the mirror."""
        shape = space.shape
        given = np.asarray(residual, dtype=np.float64)
        if given.shape != shape or not np.isfinite(given).all():
            needed = f"finite numbers of shape {shape} within ±1"
            raise ActionError(f"a residual must be {needed}, got {quote(residual)}")
        clipped = np.clip(given, -1.0, 1.0).reshape(len(rows), -1)
        return self.features.turn_back(rows, clipped).reshape(shape)


class ResidualWrapper(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """One world whose action is the residual of a base policy, [−1, 1]^k.

    Args:
        env: An environment of ours.
        base_policy: A policy for it, or the name of one.
        **settings: Parameters of `ResidualSettings`, such as `acts_on`, the inputs of the base that
            the residual acts on with their bounds, and `decision_period`, the control steps of a
            decision.

    Raises:
        ConfigurationError: Settings that are not valid, or that this base cannot have.
    """

    def __init__(
        self, env: gymnasium.Env[Any, Any], base_policy: Policy | str, **settings: Any
    ) -> None:
        RecordConstructorArgs.__init__(self, base_policy=base_policy, **settings)
        gymnasium.Wrapper.__init__(self, env)
        self._deciding = _Deciding(env, base_policy, settings, num_worlds=1)
        self.settings = self._deciding.settings
        """How the residual acts."""
        self.observation_space = self._deciding.observation_space
        self.action_space = self._deciding.action_space
        self._last = np.zeros(0)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        self._last, info = self.env.reset(seed=seed, options=options)
        self._deciding.begin(np.ones(1, dtype=np.bool_))
        return self._deciding.observe(self._last[None])[0], info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One decision."""
        if not self._last.size:
            raise gymnasium.error.ResetNeeded("reset() comes before the first step()")
        rows = self._last[None]
        residual = self._deciding.read_residual(rows, action, self.action_space)[None]
        total = 0.0
        terminated = False
        truncated = False
        info = {}
        for _ in range(self.settings.decision_period):
            command = self._deciding.act(self._last[None], residual)[0]
            self._last, reward, terminated, truncated, info = self.env.step(command)
            total += float(reward)
            if terminated or truncated:
                break
        features = self._deciding.observe(self._last[None])[0]
        return features, total, terminated, truncated, info


class ResidualVectorWrapper(gymnasium.vector.VectorWrapper[Any, Any, Any]):
    """Many worlds whose actions are residuals of a base policy, (num_envs, k).

    It restarts worlds itself, between decisions only.

    Args:
        env: A vector environment of ours.
        base_policy: A policy for it, or the name of one.
        autoreset_mode: When it restarts them; None as the environment would.
        critic_sees: Truth that stands behind the features of the residual, for a critic alone.
        **settings: As of `ResidualWrapper`.

    Raises:
        ConfigurationError: Settings that are not valid, or that this base cannot have.
    """

    def __init__(
        self,
        env: gymnasium.vector.VectorEnv[Any, Any, Any],
        base_policy: Policy | str,
        autoreset_mode: AutoresetMode | None = None,
        critic_sees: Sequence[str] = (),
        **settings: Any,
    ) -> None:
        super().__init__(env)
        self._deciding = _Deciding(env, base_policy, settings, env.num_envs, critic_sees)
        self.actor_features = self._deciding.features.width
        """Columns of the observation that the residual decides by, the first ones."""
        inner: Any = env.unwrapped
        self.autoreset_mode = autoreset_mode or inner.autoreset_mode
        self.settings = self._deciding.settings
        """How the residual acts."""
        n = env.num_envs
        self.single_observation_space = self._deciding.observation_space
        self.single_action_space = self._deciding.action_space
        self.observation_space = batch_space(self.single_observation_space, n)

        self.action_space = batch_space(self.single_action_space, n)
        self._rows = np.zeros((n, 0))
        self._last: Array | None = None
        self._done = np.zeros(n, dtype=np.bool_)
        self._decisions = 0
        self._cut_at = np.zeros(n, dtype=np.int64)

    @property
    def metadata(self) -> dict[str, Any]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Metadata that Gymnasium's wrappers ask for."""
        return {**self.env.metadata, "autoreset_mode": self.autoreset_mode}

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in every world, or in those of options["reset_mask"]."""
        self._rows, info = self.env.reset(seed=seed, options=options)
        mask = reset_mask(options, self.num_envs)
        self._deciding.begin(mask)
        self._done = self._done & ~mask
        features = self._deciding.observe(self._rows, mask)
        if self._last is not None:
            features = np.where(mask[:, None], features, self._last)
        self._last = features
        return self._last.copy(), info

    def stagger(self, generator: np.random.Generator) -> None:
        """Cut the first episodes at decisions spread evenly over their fewest, in random order.

        Call it after `reset`. From the end of the first whole episode on the worlds are all over
        it; learning that saw all worlds in the same phase would see one phase at a time. What is
        cut counts as truncated, and has no metrics.
        """
        env: Any = self.env.unwrapped
        length = -(-env.task.fewest_control_steps // self.settings.decision_period)
        order = generator.permutation(np.arange(1, self.num_envs + 1))
        self._decisions = 0
        self._cut_at = -(-order * length // self.num_envs)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One decision in every world."""
        if self._last is None:
            raise gymnasium.error.ResetNeeded("reset() comes before the first step()")
        residual = self._deciding.read_residual(self._rows, actions, self.action_space)
        waiting = self._done & (self.autoreset_mode is AutoresetMode.NEXT_STEP)
        features, reward, terminated, truncated, info = self._decide(residual, ~waiting)
        self._decisions += 1
        truncated |= (self._cut_at == self._decisions) & ~terminated & ~waiting
        self._done = terminated | truncated
        if waiting.any():
            features = self._restart(waiting, features)
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._done.any():
            ended = self._done.copy()
            info = final_of(features, info, ended)
            features = self._restart(ended, features)
        self._last = features.copy()
        return features, reward, terminated, truncated, info

    def _restart(self, worlds: BoolArray, features: Array) -> Array:
        """Features with those of new episodes in some worlds."""
        self._rows, _ = self.env.reset(options={"reset_mask": worlds})
        self._done = self._done & ~worlds
        self._deciding.begin(worlds)
        begun = self._deciding.observe(self._rows, worlds)
        return np.where(worlds[:, None], begun, features)

    def _decide(self, residual: Array, alive: BoolArray) -> Transition:
        """Hold a residual for a decision period in the worlds that are alive.

        The observation is of features.
        """
        n = self.num_envs
        reward = np.zeros(n)
        terminated = np.zeros(n, dtype=np.bool_)
        truncated = np.zeros(n, dtype=np.bool_)
        final: Array | None = None
        metrics: dict[str, Any] = {}
        reason = np.full(n, "", dtype="<U16")
        for _ in range(self.settings.decision_period):
            action = self._deciding.act(self._rows, residual)
            command = np.where(alive[:, None], action, np.float32(0.0))
            self._rows, gained, fell, finished, info = self._step(command)
            reward += np.where(alive, gained, 0.0)
            ended = alive & (fell | finished)
            if ended.any():
                # what they see last, with the memories as they are now: the others go on
                last = self._deciding.observe(self._rows, ended)
                final = last if final is None else np.where(ended[:, None], last, final)
                terminated = terminated | (ended & fell)
                truncated = truncated | (ended & finished)
                reason = np.where(ended, info["termination"], reason)
                for name, values in info["episode_metrics"].items():
                    before = metrics.get(name, np.zeros_like(values))
                    metrics[name] = np.where(ended, values, before)
                alive = alive & ~ended
                if not alive.any():
                    break
        done = terminated | truncated
        info = {"termination": reason}
        if metrics:
            info |= {"episode_metrics": metrics, "_episode_metrics": done}
        features = self._deciding.observe(self._rows, ~done)
        if final is not None:
            features = np.where(done[:, None], final, features)
        return Transition(features, reward, terminated, truncated, info)

    def _step(self, command: Array) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """A control step after which worlds that end stay as they are.

        Whoever steps the environment itself finds it unchanged.
        """
        env: Any = self.env.unwrapped
        mode = env.autoreset_mode
        env.autoreset_mode = AutoresetMode.DISABLED
        try:
            return self.env.step(command)
        finally:
            env.autoreset_mode = mode
