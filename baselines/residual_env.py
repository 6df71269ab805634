"""Environments in which an agent decides the residual of a base policy, for one world and for many.

A step is a decision: the residual is held for `decision_period` control steps behind its low-pass,
the base policy commands the robot, and rewards are summed. The step returns the observation for the
next decision. A world that ends within a decision stops: its observation and reward are up to its
end.
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

from baselines.compensation.memory_rows import put_rows, select_rows
from baselines.compensation.policy import Policy
from baselines.policies import make
from baselines.residual.correction import Corrected
from baselines.residual.features import Features, FeaturesMemory
from baselines.residual.settings import ResidualSettings
from baselines.residual.true_robot import CriticView, truth_of
from elastic_env.core.errors import ActionError, ConfigurationError, quote
from elastic_env.core.signals import Array, BoolArray
from elastic_env.world.control_step import Transition
from elastic_env.world.vector_env import final_of, reset_mask


class _DecisionLoop:
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
        width = self.features.width + (self._critic.width if self._critic else 0)
        self.observation_space = Box(-np.inf, np.inf, (width,), np.float64)
        self.action_space = Box(-1.0, 1.0, (self.corrected.num_residuals,), np.float32)
        # worlds whose episode begins: for the policy, and for the features
        self._start = self._is_new = np.zeros(num_worlds, dtype=np.bool_)
        self._state: Any = None
        self._past: FeaturesMemory | None = None

    def begin(self, worlds: BoolArray) -> None:
        """Begin episodes in some worlds, a (num_worlds,) mask."""
        self._start = self._start | worlds
        self._is_new = self._is_new | worlds
        if worlds.all():
            self._state = self._past = None

    def observe(self, rows: Array, worlds: BoolArray | None = None) -> Array:
        """Features of the coming decision; only some worlds remember the measurements, or all."""
        policy = (self._state, self._start)
        features, past = self.features.at(rows, self._past, self._is_new, *policy)
        if worlds is not None and self._past is not None:
            past = put_rows(self._past, worlds, select_rows(past, worlds))
        self._past = past
        self._is_new = self._is_new & (False if worlds is None else ~worlds)
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
        """Check a residual for the observations of its decision, clip it and turn it back."""
        shape = space.shape
        values = np.asarray(residual, dtype=np.float64)
        if values.shape != shape or not np.isfinite(values).all():
            needed = f"finite numbers of shape {shape} within ±1"
            raise ActionError(f"a residual must be {needed}, got {quote(residual)}")
        clipped = np.clip(values, -1.0, 1.0).reshape(len(rows), -1)
        return self.features.turn_back(rows, clipped).reshape(shape)


class ResidualWrapper(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """One world whose action is the residual of a base policy, [−1, 1]^k.

    Args:
        env: An environment of ours.
        base_policy: A policy for it, or the name of one.
        **settings: Parameters of `ResidualSettings`, such as `acts_on`, inputs of the base with
            bounds for the residual, and `decision_period`, the control steps of a decision.

    Raises:
        ConfigurationError: Settings that are not valid, or that this base cannot have.
    """

    def __init__(
        self, env: gymnasium.Env[Any, Any], base_policy: Policy | str, **settings: Any
    ) -> None:
        RecordConstructorArgs.__init__(self, base_policy=base_policy, **settings)
        gymnasium.Wrapper.__init__(self, env)
        self._loop = _DecisionLoop(env, base_policy, settings, num_worlds=1)
        self.settings = self._loop.settings
        """Settings of the residual."""
        self.observation_space = self._loop.observation_space
        self.action_space = self._loop.action_space
        self._last = np.zeros(0)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        self._last, info = self.env.reset(seed=seed, options=options)
        self._loop.begin(np.ones(1, dtype=np.bool_))
        return self._loop.observe(self._last[None])[0], info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One decision."""
        if not self._last.size:
            raise gymnasium.error.ResetNeeded("reset() comes before the first step()")
        rows = self._last[None]
        residual = self._loop.read_residual(rows, action, self.action_space)[None]
        total = 0.0
        terminated = False
        truncated = False
        info = {}
        for _ in range(self.settings.decision_period):
            command = self._loop.act(self._last[None], residual)[0]
            self._last, reward, terminated, truncated, info = self.env.step(command)
            total += float(reward)
            if terminated or truncated:
                break
        features = self._loop.observe(self._last[None])[0]
        return features, total, terminated, truncated, info


class ResidualVectorWrapper(gymnasium.vector.VectorWrapper[Any, Any, Any]):
    """Many worlds whose actions are residuals of a base policy, (num_envs, k).

    It restarts worlds itself, between decisions only.

    Args:
        env: A vector environment of ours.
        base_policy: A policy for it, or the name of one.
        autoreset_mode: Time at which it restarts worlds; None for the mode of the environment.
        critic_sees: Truth in further columns after the features of the residual, for a critic only.
        **settings: As in `ResidualWrapper`.

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
        n = env.num_envs
        self._loop = _DecisionLoop(env, base_policy, settings, n, critic_sees)
        self.actor_features = self._loop.features.width
        """Number of features of the residual, which are the first columns of the observation."""
        inner: Any = env.unwrapped
        self.autoreset_mode = autoreset_mode or inner.autoreset_mode
        self.settings = self._loop.settings
        """Settings of the residual."""
        self.single_observation_space = self._loop.observation_space
        self.single_action_space = self._loop.action_space
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
        """Begin an episode in every world, or in the worlds of options["reset_mask"]."""
        self._rows, info = self.env.reset(seed=seed, options=options)
        mask = reset_mask(options, self.num_envs)
        self._loop.begin(mask)
        self._done = self._done & ~mask
        features = self._loop.observe(self._rows, mask)
        if self._last is not None:
            features = np.where(mask[:, None], features, self._last)
        self._last = features
        return self._last.copy(), info

    def stagger(self, generator: np.random.Generator) -> None:
        """Cut the first episodes at decisions spread over the shortest episode, in random order.

        Call it after `reset`. The cuts are evenly spaced. Then worlds are in different phases of an
        episode: without it learning would see one phase at a time. A cut episode is truncated, and
        has no metrics.
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
        residual = self._loop.read_residual(self._rows, actions, self.action_space)
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
        self._loop.begin(worlds)
        first = self._loop.observe(self._rows, worlds)
        return np.where(worlds[:, None], first, features)

    def _decide(self, residual: Array, alive: BoolArray) -> Transition:
        """Hold a residual for a decision period in the worlds that are alive; observe features."""
        n = self.num_envs
        reward = np.zeros(n)
        terminated = np.zeros(n, dtype=np.bool_)
        truncated = np.zeros(n, dtype=np.bool_)
        final: Array | None = None
        metrics: dict[str, Any] = {}
        reason = np.full(n, "", dtype="<U16")
        for _ in range(self.settings.decision_period):
            action = self._loop.act(self._rows, residual)
            command = np.where(alive[:, None], action, np.float32(0.0))
            self._rows, step_reward, fell, finished, info = self._step(command)
            reward += np.where(alive, step_reward, 0.0)
            ended = alive & (fell | finished)
            if ended.any():
                # their last observation, with the present memories: the others go on
                last = self._loop.observe(self._rows, ended)
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
        features = self._loop.observe(self._rows, ~done)
        if final is not None:
            features = np.where(done[:, None], final, features)
        return Transition(features, reward, terminated, truncated, info)

    def _step(self, command: Array) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Take a control step without autoreset; afterwards the environment has its mode again."""
        env: Any = self.env.unwrapped
        mode = env.autoreset_mode
        env.autoreset_mode = AutoresetMode.DISABLED
        try:
            return self.env.step(command)
        finally:
            env.autoreset_mode = mode
