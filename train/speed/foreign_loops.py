"""Our scalar environments in vector environments of Gymnasium and Stable-Baselines3."""

import time
from functools import partial
from typing import Any

import numpy as np
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from typing_extensions import override

from train.speed.contenders import Contender, make_scalar_env

IN_PROCESSES = ("Gymnasium AsyncVectorEnv", "SB3 SubprocVecEnv")
"""Vector environments with a process for each world."""
IN_THIS_PROCESS = ("Gymnasium SyncVectorEnv", "SB3 DummyVecEnv")
"""Vector environments with all worlds in this process."""


class ForeignLoop(Contender):
    """Our scalar environments in a vector environment of Gymnasium or SB3, under zero offsets.

    Args:
        env: Name of the environment.
        kind: One of `IN_PROCESSES` or `IN_THIS_PROCESS`.
        num_envs: Number of worlds.
    """

    def __init__(self, env: str, kind: str, num_envs: int) -> None:
        from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

        subprocesses = partial(SubprocVecEnv, start_method="spawn")
        makers = (AsyncVectorEnv, subprocesses, SyncVectorEnv, DummyVecEnv)
        make_vector: Any = makers[[*IN_PROCESSES, *IN_THIS_PROCESS].index(kind)]
        self.title = kind
        self.num_envs = num_envs
        self.env = make_vector([partial(make_scalar_env, env)] * num_envs)
        self.env.reset()
        one_world = getattr(self.env, "single_action_space", self.env.action_space)
        self._action = np.zeros((num_envs, *one_world.shape), dtype=np.float32)

    @override
    def run(self, steps: int) -> float:
        begin = time.perf_counter()
        for _ in range(steps):
            self.env.step(self._action)
        return self.num_envs * steps / (time.perf_counter() - begin)
