"""Several vector environments as one: worlds of different scenarios that one agent learns from."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from elastic_env.errors import ConfigurationError
from elastic_env.signals import Array, BoolArray


class MixedVectorEnv(gymnasium.vector.VectorEnv[Any, Any, Any]):
    """The worlds of several vector environments with same-step autoreset, one environment's after the other's.

    They step side by side on threads: while the physics of one runs without Python, another's policy runs in it. Give
    each one thread of physics then; the results do not depend on it.

    Args:
        envs: With equal spaces, such as `ResidualVectorWrapper`s of the same settings in different scenarios.
        num_threads: Environments that step at a time, 0 for as many as there are cores.
        weights: Factor of each environment's rewards; None for equal ones.

    Raises:
        ConfigurationError: None, spaces that differ, another autoreset mode, or not one weight per environment.
    """

    def __init__(
        self,
        envs: Sequence[gymnasium.vector.VectorEnv[Any, Any, Any]],
        num_threads: int = 0,
        weights: Sequence[float] | None = None,
    ) -> None:
        if not envs:
            raise ConfigurationError("a mixture needs at least one environment")
        for env in envs:
            if env.metadata.get("autoreset_mode") is not AutoresetMode.SAME_STEP:
                raise ConfigurationError("all environments of a mixture must have autoreset_mode SameStep")
            if (env.single_observation_space, env.single_action_space) != (
                envs[0].single_observation_space,
                envs[0].single_action_space,
            ):
                raise ConfigurationError("all environments of a mixture must have the same spaces")
        factors = [1.0] * len(envs) if weights is None else list(weights)
        if len(factors) != len(envs):
            raise ConfigurationError(f"weights must be one per environment, {len(envs)}, got {factors}")
        self.envs = list(envs)
        self._threads = ThreadPoolExecutor(min(num_threads or os.cpu_count() or 1, len(envs)))
        self.num_envs = sum(env.num_envs for env in envs)
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self.single_observation_space = envs[0].single_observation_space
        self.single_action_space = envs[0].single_action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        ends = np.cumsum([env.num_envs for env in envs]).tolist()
        self._weights = np.repeat(factors, [env.num_envs for env in envs])
        self._weights.flags.writeable = False  # no state
        self._worlds = [slice(end - env.num_envs, end) for env, end in zip(envs, ends, strict=True)]

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in every world, or in those of options["reset_mask"].

        World i gets seed + i, or the i-th of a list of seeds.
        """
        seeds: Any = [int(seed) + i for i in range(self.num_envs)] if isinstance(seed, int | np.integer) else seed
        mask = None if options is None else options.get("reset_mask")
        observations = []
        for env, worlds in zip(self.envs, self._worlds, strict=True):
            own: Any = None if seeds is None else list(seeds[worlds])
            chosen = options if mask is None else {**(options or {}), "reset_mask": np.asarray(mask)[worlds]}
            observations.append(env.reset(seed=own, options=chosen)[0])
        return np.concatenate(observations), {}

    def spread(self, observation: Array, generator: np.random.Generator) -> Array:
        """Spread the worlds of every environment over the episode, see `ResidualVectorWrapper.spread`."""
        own = generator.spawn(len(self.envs))
        parts = [observation[worlds] for worlds in self._worlds]
        spread: Any = self._threads.map(lambda env, part, mine: env.spread(part, mine), self.envs, parts, own)
        return np.concatenate(list(spread))

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One step in every world; the infos are those of worlds that end."""
        parts = [actions[worlds] for worlds in self._worlds]
        results = list(self._threads.map(lambda env, part: env.step(part), self.envs, parts))
        observation, reward, terminated, truncated = (
            np.concatenate([np.asarray(result[part]) for result in results]) for part in range(4)
        )
        return observation, self._weights * reward, terminated, truncated, self._info([result[4] for result in results])

    def close(self, **kwargs: Any) -> None:
        """Close all environments."""
        self._threads.shutdown()
        for env in self.envs:
            env.close(**kwargs)

    def _info(self, infos: list[dict[str, Any]]) -> dict[str, Any]:
        ended = [
            info.get("_final_info", np.zeros(env.num_envs, bool)) for info, env in zip(infos, self.envs, strict=True)
        ]
        mask: BoolArray = np.concatenate(ended)
        if not mask.any():
            return {}
        final_obs = np.full(self.num_envs, None, dtype=object)
        metrics: dict[str, Array] = {}
        for info, worlds, some in zip(infos, self._worlds, ended, strict=True):
            if some.any():
                final_obs[worlds] = info["final_obs"]
                for name, values in info["final_info"]["episode_metrics"].items():
                    whole = metrics.setdefault(name, np.zeros(self.num_envs, dtype=np.asarray(values).dtype))
                    whole[worlds] = values
        final_info = {"episode_metrics": metrics, "_episode_metrics": mask}
        return {"final_obs": final_obs, "_final_obs": mask, "final_info": final_info, "_final_info": mask}
