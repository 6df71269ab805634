"""Several vector environments as one, for scenarios that cannot share one."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import groupby, pairwise
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, BoolArray
from elastic_env.world.robot_model import RobotModel
from elastic_env.world.task import Task
from elastic_env.world.vector_env import reset_mask
from train.evaluate.conditions import Condition
from train.evaluate.rollout import make_shared_env, shared_settings


class MixedVectorEnv(gymnasium.vector.VectorEnv[Any, Any, Any]):
    """The worlds of several vector environments, one environment after the other.

    One call of a policy for all worlds costs hardly more than for one environment. The environments
    step in parallel on threads, since the physics runs without Python. Give each environment one
    thread of physics, and more to the last ones if they would leave cores idle. The results do not
    depend on it.

    A wrapper resets worlds that end, with options["reset_mask"].

    Args:
        envs: Vector environments of this package with `autoreset_mode=DISABLED`, of the same task
            in different scenarios.
        num_threads: Environments that step at the same time, 0 for the number of cores.
        weights: Factor of every world's rewards; None for equal ones.

    Raises:
        ConfigurationError: There is no environment; they differ in observations, tasks, motions or
            assumed joints; another autoreset mode; or not one weight per world.
    """

    def __init__(
        self,
        envs: Sequence[gymnasium.vector.VectorEnv[Any, Any, Any]],
        num_threads: int = 0,
        weights: Sequence[float] | None = None,
    ) -> None:
        if not envs:
            raise ConfigurationError("a mixture needs at least one environment")
        self.envs: list[Any] = [env.unwrapped for env in envs]
        for env in self.envs:
            if (mode := env.autoreset_mode) is not AutoresetMode.DISABLED:
                raise _mixture_error(f"have autoreset_mode Disabled, got {mode.value}")
            if env.single_observation_space != self.envs[0].single_observation_space:
                raise _mixture_error("have the same observation")
            task = env.task
            if (task.name, task.num_steps) != (self.task.name, self.task.num_steps):
                raise _mixture_error("have the same task and motion")
            if env.assumed_model.joints != self.assumed_model.joints:
                raise _mixture_error(
                    "let a policy assume the same joints: give them the same stiffness, and keep"
                    ' scenarios with "ideal", where no friction is assumed, apart from the others'
                )
        self._threads = ThreadPoolExecutor(min(_num_cores(num_threads), len(envs)))
        ends = np.cumsum([0, *(env.num_envs for env in envs)]).tolist()
        self._worlds = [slice(*span) for span in pairwise(ends)]
        n = self.num_envs = ends[-1]
        self._weights = np.ones(n) if weights is None else np.array(weights)
        if self._weights.shape != (n,):
            count = len(self._weights)
            raise ConfigurationError(f"weights must be one per world, {n}, got {count}")
        self.autoreset_mode = AutoresetMode.DISABLED
        self.metadata = {"autoreset_mode": self.autoreset_mode}
        self.single_observation_space = envs[0].single_observation_space
        self.single_action_space = envs[0].single_action_space
        self.observation_space = batch_space(self.single_observation_space, n)
        self.action_space = batch_space(self.single_action_space, n)

    @property
    def assumed_model(self) -> RobotModel:
        """The robot that compensators assume, the same in all environments."""
        return self.envs[0].assumed_model

    @property
    def task(self) -> Task:
        """The rules of the first environment, whose length and observation are those of all."""
        return self.envs[0].task

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in every world, or in those of options["reset_mask"].

        World i gets seed + i, or the i-th of a list of seeds.
        """
        seeds: Any = seed
        if isinstance(seed, int | np.integer):
            seeds = [int(seed) + i for i in range(self.num_envs)]
        mask = reset_mask(options, self.num_envs)

        def begin(env: Any, worlds: slice) -> Array:
            if not mask[worlds].any():
                return np.asarray(env.task.observe())
            part = None if seeds is None else list(seeds[worlds])
            observation, _ = env.reset(seed=part, options={"reset_mask": mask[worlds]})
            return np.asarray(observation)

        return np.concatenate(self._run_parallel(begin)), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step every world; the info contains only worlds that end."""
        results = self._run_parallel(lambda env, worlds: env.step(actions[worlds]))
        *parts, infos = zip(*results, strict=True)
        observation, reward, terminated, truncated = map(np.concatenate, parts)
        ended = terminated | truncated
        info = self._info(infos, ended) if ended.any() else {}
        return observation, self._weights * reward, terminated, truncated, info

    def close_extras(self, **kwargs: Any) -> None:
        """Close all environments."""
        self._threads.shutdown()
        for env in self.envs:
            env.close(**kwargs)

    def _run_parallel(self, function: Callable[[Any, slice], Any]) -> list[Any]:
        """Call a function with every environment and its worlds, on threads."""
        if len(self.envs) == 1:
            return [function(self.envs[0], self._worlds[0])]
        return list(self._threads.map(function, self.envs, self._worlds))

    def _info(self, infos: Sequence[Any], ended: BoolArray) -> dict[str, Any]:
        metrics: dict[str, Array] = {}
        for info, worlds in zip(infos, self._worlds, strict=True):
            if ended[worlds].any():
                for name, values in info["episode_metrics"].items():
                    empty = np.zeros(self.num_envs, dtype=values.dtype)
                    metrics.setdefault(name, empty)[worlds] = values
        return {
            "termination": np.concatenate([info["termination"] for info in infos]),
            "episode_metrics": metrics,
            "_episode_metrics": ended,
        }


def mixed_env(
    conditions: Sequence[Condition],
    sizes: Sequence[int],
    num_threads: int,
    weights: Sequence[float],
) -> MixedVectorEnv:
    """Worlds of several conditions; neighbours with the same settings share an environment.

    Args:
        conditions: Cells of one environment and motion; their policies are not used.
        sizes: Number of worlds of each condition.
        num_threads: Threads of the physics, 0 for the number of cores.
        weights: Factor of the rewards of each condition.

    Raises:
        ConfigurationError: A name or an option does not exist.
    """
    worlds = [c for c, size in zip(conditions, sizes, strict=True) for _ in range(size)]
    groups = [list(group) for _, group in groupby(worlds, shared_settings)]
    threads = thread_counts(_num_cores(num_threads), len(groups))
    mode = AutoresetMode.DISABLED
    envs = [make_shared_env(*each, mode) for each in zip(groups, threads, strict=True)]
    return MixedVectorEnv(envs, num_threads, np.repeat(weights, sizes).tolist())


def _mixture_error(requirement: str) -> ConfigurationError:
    return ConfigurationError(f"all environments of a mixture must {requirement}")


def _num_cores(num_threads: int) -> int:
    return num_threads or os.cpu_count() or 1


def thread_counts(cores: int, count: int) -> list[int]:
    """Threads of environments that step in parallel: one each, the last ones share the rest."""
    last = count % cores
    return [1] * (count - last) + [cores // max(last, 1)] * last
