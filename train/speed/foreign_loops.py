"""Loops of Gymnasium and Stable-Baselines3: their vector environments, and PPO."""

import time
from functools import partial
from typing import Any

import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from typing_extensions import override

from baselines.residual.settings import ResidualSettings
from train.evaluate.rollout import make_policy, make_vector_env
from train.speed.contenders import Contender, make_condition, make_scalar_env
from train.speed.untrained_residual import residual_input

IN_PROCESSES = ("Gymnasium AsyncVectorEnv", "SB3 SubprocVecEnv")
"""Vector environments with a process for each world."""
IN_THIS_PROCESS = ("Gymnasium SyncVectorEnv", "SB3 DummyVecEnv")
"""Vector environments with all worlds in this process."""
PPO_DECISIONS = 512
"""Decisions that PPO collects before it learns from them."""


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


class PPOLoop(Contender):
    """PPO end to end, collecting and learning, of a residual.

    Args:
        env: Name of the environment.
        policy: Base policy.
        num_envs: Number of worlds.
        threads: Threads of our vector environment; None for one process per world.
    """

    def __init__(self, env: str, policy: str, num_envs: int, threads: int | None) -> None:
        import torch
        from stable_baselines3 import PPO
        from stable_baselines3.common.logger import Logger
        from stable_baselines3.common.vec_env import SubprocVecEnv

        from baselines.residual_env import ResidualVectorWrapper
        from train.learn.sb3_env import SB3VecEnv

        kind = f"SubprocVecEnv({num_envs})" if threads is None else "vector env"
        self.title = f"PPO with {policy}, {kind}"
        self.num_envs = num_envs
        if threads is None:
            maker = partial(_make_residual_env, env, policy)
            venv: Any = SubprocVecEnv([maker] * num_envs, start_method="spawn")
        else:
            condition = make_condition(env, policy)
            inner = make_vector_env(condition, num_envs, threads, AutoresetMode.SAME_STEP)
            base = make_policy(condition.policy, inner)
            residual = ResidualVectorWrapper(inner, base, acts_on=residual_input(base))
            venv = SB3VecEnv(residual)
        self._period = ResidualSettings().decision_period
        torch.set_num_threads(1)
        self._rollout = max(PPO_DECISIONS // num_envs, 8)
        self._model = PPO(
            "MlpPolicy",
            venv,
            n_steps=self._rollout,
            batch_size=512,
            n_epochs=10,
            gamma=0.95,
            device="cpu",
            policy_kwargs={"net_arch": [64, 64]},
        )
        # SB3's default logger makes a folder in /tmp
        self._model.set_logger(Logger(folder=None, output_formats=[]))
        self.env = self._model.get_env()

    @override
    def run(self, steps: int) -> float:
        """Learn for one iteration: `PPO_DECISIONS`, but at least 8 decisions in each world."""
        before = self._model.num_timesteps
        begin = time.perf_counter()
        self._model.learn(self._rollout * self.num_envs, reset_num_timesteps=False)
        decisions = self._model.num_timesteps - before
        return decisions * self._period / (time.perf_counter() - begin)


def _make_residual_env(env: str, policy: str) -> Any:
    """Make a scalar environment with a residual around its base policy."""
    from baselines.residual_env import ResidualWrapper

    inner = make_scalar_env(env, policy)
    base = make_policy(make_condition(env, policy).policy, inner)
    return ResidualWrapper(inner, base, acts_on=residual_input(base))
