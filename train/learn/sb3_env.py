"""Our vector environments for Stable-Baselines3: arrays in, arrays out, no loop over worlds."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv

from elastic_env.core.errors import ConfigurationError
from train.learn.trainer import require_finite

_EMPTY_INFO: dict[str, Any] = {}


class SB3VecEnv(VecEnv):
    """A Gymnasium vector environment with same-step autoreset as an SB3 `VecEnv`.

    As SB3 expects, the infos of worlds that end have the terminal observation, the time limit
    (`TimeLimit.truncated`) and the metrics of the task. They also have the statistics of the
    `episode`: its reward r, and its length l in steps of this environment. A first episode that is
    cut short has no statistics, since its sum of rewards is not that of a complete episode.

    Args:
        env: Environment with `autoreset_mode=SAME_STEP`, such as a `ResidualVectorWrapper`.
        stagger: Generator for the order in which first episodes end early, see
            `ResidualVectorWrapper.stagger`; None to begin all worlds in step.

    Raises:
        ConfigurationError: Another autoreset mode.
    """

    def __init__(
        self,
        env: gymnasium.vector.VectorEnv[Any, Any, Any],
        stagger: np.random.Generator | None = None,
    ) -> None:
        mode = env.metadata.get("autoreset_mode")
        if mode is not AutoresetMode.SAME_STEP:
            raise ConfigurationError(
                f"SB3 restarts worlds in the same step, autoreset_mode must be SameStep, got {mode}"
            )
        self.env = env
        self._stagger = stagger
        self._actions: Any = None
        self._reward = np.zeros(env.num_envs)
        self._length = np.zeros(env.num_envs, dtype=np.int64)
        self._total = 0.0
        self._steps = 0
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> Any:
        """Begin an episode in every world, with the seeds of the last call of `seed`."""
        seeds: Any = None if self._seeds[0] is None else list(self._seeds)
        observation, _ = self.env.reset(seed=seeds)
        if self._stagger is not None:
            self.env.stagger(self._stagger)  # type: ignore[attr-defined]
        self._reset_seeds()
        self._reset_options()
        self._reward[:] = 0.0
        self._length[:] = 0
        self._total = 0.0
        self._steps = 0
        return observation

    def seed_next_reset(self, seed: int, stagger: np.random.Generator) -> None:
        """Seed the next `reset`, world i with seed + i, and the order of its early ends."""
        self.seed(seed)
        self._stagger = stagger

    def step_async(self, actions: Any) -> None:
        """Keep the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, Any, Any, Any]:
        """Step every world.

        Raises:
            DivergedError: An observation or a reward is not finite.
        """
        observation, reward, terminated, truncated, info = self.env.step(self._actions)
        require_finite("the reward", reward)
        require_finite("the observation", observation)
        done = terminated | truncated
        self._reward += reward
        self._length += 1
        self._total += float(reward.sum())
        self._steps += self.num_envs
        # other worlds share an empty info, since SB3 reads only those of worlds that end
        infos: list[dict[str, Any]] = [_EMPTY_INFO] * self.num_envs
        if done.any():
            final = info["final_info"]
            metrics = final.get("episode_metrics", {})
            scored = final.get("_episode_metrics", done)
            for world in np.flatnonzero(done).tolist():
                recorded = metrics if scored[world] else {}
                own_metrics = {k: v[world].item() for k, v in recorded.items()}
                is_cut = bool(truncated[world] and not terminated[world])
                infos[world] = {
                    "terminal_observation": info["final_obs"][world],
                    "TimeLimit.truncated": is_cut,
                    "episode_metrics": own_metrics,
                }
                if own_metrics or self._stagger is None:
                    reward_sum = float(self._reward[world])
                    length = int(self._length[world])
                    infos[world]["episode"] = {"r": reward_sum, "l": length, "t": 0.0}
            self._reward[done] = 0.0
            self._length[done] = 0
        return observation, reward.astype(np.float32), done, infos

    @property
    def reward_per_decision(self) -> float | None:
        """Mean reward of the steps since the last `reset`; None before the first one."""
        return self._total / self._steps if self._steps else None

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of the vector environment, once per world."""
        value = getattr(self.env, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse: worlds have no attributes of their own."""
        raise NotImplementedError(
            "the worlds of a vector environment have no attributes of their own"
        )

    def env_method(
        self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any
    ) -> list[Any]:
        """Call a method of the vector environment once, and return its result for every world."""
        result = getattr(self.env, method_name)(*args, **kwargs)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """True for a Monitor: this environment keeps the statistics of episodes."""
        from stable_baselines3.common.monitor import Monitor

        return [wrapper_class is Monitor for _ in self._get_indices(indices)]
