"""Contenders of `elastic speed`: each plays control steps of one environment and says how long
it took.
"""

import itertools
import threading
import time
from abc import ABC, abstractmethod
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium.vector import AutoresetMode

from baselines.compensation.inputs import COMMAND, DEFLECTION, inputs_of
from baselines.residual.correction import Corrected
from baselines.residual.features import Features
from baselines.residual.network import Network
from baselines.residual.residual_policy import ResidualPolicy
from baselines.residual.settings import ResidualDescription, ResidualSettings
from elastic_env.core.signals import Array
from train.evaluate.conditions import Condition, PolicySpec
from train.evaluate.environments import environment
from train.evaluate.rollout import make_policy, make_vector_env, policy_errors

PPO_DECISIONS = 512
"""Decisions that PPO collects before it learns from them."""
_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


class Contender(ABC):
    """Something that plays control steps.

    Attributes:
        title: What it is.
        num_envs: Worlds.
        env: Whatever it plays in.
    """

    title: str
    num_envs: int
    env: Any

    @abstractmethod
    def run(self, steps: int) -> float:
        """Play about so many control steps in every world; control steps per second of all
        worlds together.
        """

    def close(self) -> None:
        """End what it has started."""
        self.env.close()


class VectorLoop(Contender):
    """Our vector environment, with zero offsets or a policy in its loop; keeps the servo inputs
    of its last run.
    """

    def __init__(
        self,
        env: str,
        num_envs: int,
        threads: int,
        policy: str | None = None,
        residual: bool = False,
    ) -> None:
        self.title = f"vector env{_with(policy, residual)}"
        self.num_envs = num_envs
        self._condition = _condition(env, policy)
        self.env = make_vector_env(self._condition, num_envs, threads)
        self._policy = None if policy is None else make_policy(PolicySpec(name=policy), self.env)
        if residual:
            self._policy = untrained_residual(self._policy, self.env)
        self._action = np.zeros(self.env.action_space.shape, dtype=np.float32)
        self._observation, _ = self.env.reset(seed=0)
        self._state: Any = None
        self._start = np.ones(num_envs, dtype=np.bool_)
        self._done = np.zeros(num_envs, dtype=np.bool_)
        self.controls = np.empty((0, *self.env.unwrapped.simulation.ctrl.shape))

    def run(self, steps: int) -> float:
        """Play about so many control steps in every world; control steps per second of all
        worlds.
        """
        ctrl = self.env.unwrapped.simulation.ctrl
        self.controls = np.empty((steps, *ctrl.shape))
        begin = time.perf_counter()
        with policy_errors(self._condition):
            for step in range(steps):
                self.step()
                self.controls[step] = ctrl
        return self.num_envs * steps / (time.perf_counter() - begin)

    def step(self) -> None:
        """One control period in every world."""
        if self._policy is not None:
            self._action, self._state = self._policy.predict(
                self._observation, self._state, self._start, True
            )
        self._observation, _, terminated, truncated, _ = self.env.step(self._action)
        # a world that ends begins a step later
        self._start = self._done
        self._done = terminated | truncated


class ScalarLoop(Contender):
    """Our scalar environment under zero offsets, without Gymnasium's checks; keeps the servo
    inputs of its last run.
    """

    title = "scalar env"
    num_envs = 1

    def __init__(self, env: str) -> None:
        self.env: Any = _make(env).unwrapped
        self._action = np.zeros(self.env.action_space.shape or (), dtype=np.float32)
        self.env.reset(seed=0)
        self.controls = np.empty((0, *self.env.simulation.ctrl.shape))

    def run(self, steps: int) -> float:
        """Play about so many control steps in every world; control steps per second of all
        worlds.
        """
        ctrl = self.env.simulation.ctrl
        self.controls = np.empty((steps, *ctrl.shape))
        begin = time.perf_counter()
        for step in range(steps):
            _, _, terminated, truncated, _ = self.env.step(self._action)
            self.controls[step] = ctrl
            if terminated or truncated:
                self.env.reset()
        return steps / (time.perf_counter() - begin)


class RawWorlds(Contender):
    """`mj_step` and nothing else: threads that share the worlds out, each with one `MjData`, warm
    in its cache.

    It starts from the states of an environment and plays the servo inputs of its last run: on a
    thread nothing but writing `ctrl` and one call of `mj_step` with all sub-steps of a control
    period.
    """

    title = "raw mj_step"

    def __init__(self, loop: VectorLoop | ScalarLoop, threads: int) -> None:
        task = loop.env.unwrapped.task
        simulation = loop.env.unwrapped.simulation
        self._loop = loop
        self.num_envs = loop.num_envs
        self._model = task.model
        self._substeps = task.num_substeps
        self._data = [mujoco.MjData(self._model) for _ in range(threads)]
        self.states = np.stack(
            [self._state_of(simulation, world) for world in range(self.num_envs)]
        )

    def run(self, steps: int) -> float:
        """Play as many steps as the environment played last."""
        return self.num_envs * steps / self.play(self._loop.controls)

    def play(self, controls: Array) -> float:
        """Time to play servo inputs, (steps, num_worlds, nu), in every world [s]."""
        workers = [
            threading.Thread(target=self._play, args=(i, controls)) for i in range(len(self._data))
        ]
        begin = time.perf_counter()
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
        return time.perf_counter() - begin

    def close(self) -> None:
        """Play about so many control steps in every world; control steps per second of all
        worlds.
        """

    def _play(self, thread: int, controls: Array) -> None:
        model = self._model
        data = self._data[thread]
        substeps = self._substeps
        for world in range(thread, len(self.states), len(self._data)):
            mujoco.mj_setState(model, data, self.states[world], _STATE)
            ctrl = data.ctrl
            for command in controls[:, world]:
                ctrl[:] = command
                mujoco.mj_step(model, data, substeps)
            mujoco.mj_getState(model, data, self.states[world], _STATE)

    def _state_of(self, simulation: Any, world: int) -> Array:
        """Integration state of a world of the environment."""
        data = self._data[0]
        state = np.empty(mujoco.mj_stateSize(self._model, _STATE))
        mujoco.mj_resetData(self._model, data)
        data.qpos[:] = simulation.qpos[world]
        data.qvel[:] = simulation.qvel[world]
        data.act[:] = simulation.act[world]
        data.ctrl[:] = simulation.ctrl[world]
        data.qacc_warmstart[:] = simulation.bind("qacc_warmstart")[world]
        mujoco.mj_getState(self._model, data, state, _STATE)
        return state


class _ForeignLoop(Contender):
    """Scalar environments of ours in somebody else's vector environment, under zero offsets."""

    _action: Array

    def run(self, steps: int) -> float:
        """Play about so many control steps in every world; control steps per second of all
        worlds.
        """
        begin = time.perf_counter()
        for _ in range(steps):
            self.env.step(self._action)
        return self.num_envs * steps / (time.perf_counter() - begin)


class GymnasiumLoop(_ForeignLoop):
    """Scalar environments of ours under Gymnasium's SyncVectorEnv or AsyncVectorEnv, one process
    each in the latter.
    """

    def __init__(self, env: str, kind: str, num_envs: int) -> None:
        self.title = f"Gymnasium {kind.capitalize()}VectorEnv"
        self.num_envs = num_envs
        self.env = gymnasium.make_vec(
            environment(env).id, num_envs=num_envs, vectorization_mode=kind, **_arguments(env)
        )
        self.env.reset(seed=0)
        self._action = np.zeros(self.env.action_space.shape or (), dtype=np.float32)


class SB3Loop(_ForeignLoop):
    """Scalar environments of ours under SB3's DummyVecEnv or SubprocVecEnv, one process each in
    the latter.
    """

    def __init__(self, env: str, kind: str, num_envs: int) -> None:
        from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

        self.title = f"SB3 {kind}"
        self.num_envs = num_envs
        makers = [_Maker(env)] * num_envs
        self.env = (
            DummyVecEnv(makers)
            if kind == "DummyVecEnv"
            else SubprocVecEnv(makers, start_method="spawn")
        )
        self.env.reset()
        self._action = np.zeros((num_envs, *(self.env.action_space.shape or ())), dtype=np.float32)


class PPOLoop(Contender):
    """PPO end to end, collecting and learning, of a residual on a base policy: our vector
    environment, or processes.
    """

    def __init__(
        self, env: str, policy: str, num_envs: int, threads: int, processes: bool = False
    ) -> None:
        import torch
        from stable_baselines3 import PPO
        from stable_baselines3.common.logger import Logger
        from stable_baselines3.common.vec_env import SubprocVecEnv

        from baselines.residual_env import ResidualVectorWrapper
        from train.learn.sb3_env import SB3VecEnv

        where = f"SubprocVecEnv({num_envs})" if processes else "vector env"
        self.title = f"PPO with {policy}, {where}"
        self.num_envs = num_envs
        acts_on = (
            COMMAND if policy in ("zero", "uncompensated", "uncompensated_open") else DEFLECTION
        )
        if processes:
            venv: Any = SubprocVecEnv(
                [_Maker(env, policy, acts_on)] * num_envs, start_method="spawn"
            )
        else:
            inner = make_vector_env(
                _condition(env, policy), num_envs, threads, AutoresetMode.SAME_STEP
            )
            venv = SB3VecEnv(ResidualVectorWrapper(inner, policy, acts_on={acts_on: None}))
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
        self._model.set_logger(
            Logger(folder=None, output_formats=[])
        )  # SB3's own makes a folder in /tmp
        self.env = self._model.get_env()

    def run(self, steps: int) -> float:  # noqa: ARG002  a whole iteration is the least there is
        """Learn for one iteration of `PPO_DECISIONS`, or of 8 in each world."""
        before = self._model.num_timesteps
        begin = time.perf_counter()
        self._model.learn(self._rollout * self.num_envs, reset_num_timesteps=False)
        return (self._model.num_timesteps - before) * self._period / (time.perf_counter() - begin)


def untrained_residual(base: Any, env: Any) -> ResidualPolicy:
    """A residual with a network of 64×64 as it is before training, small random weights, around
    a base policy.
    """
    acts_on = DEFLECTION if DEFLECTION in inputs_of(base) else COMMAND
    corrected = Corrected(
        base, env.unwrapped.assumed_model, ResidualSettings(acts_on={acts_on: None})
    )
    features = Features(corrected).width
    generator = np.random.default_rng(0)
    widths = [features, 64, 64, corrected.num_residuals]
    tensors = {"mean": np.zeros(features), "std": np.ones(features)}
    for i, (inputs, outputs) in enumerate(itertools.pairwise(widths)):
        tensors |= {
            f"weight{i}": 0.01 * generator.normal(size=(outputs, inputs)),
            f"bias{i}": np.zeros(outputs),
        }
    description = ResidualDescription(
        robot=env.unwrapped.task.name, base="", settings=corrected.settings
    )
    return ResidualPolicy(corrected, Network(description, tensors))


class _Maker:
    """Makes a scalar environment in a process of its own, with the residual of a base policy
    around it or without.
    """

    def __init__(self, env: str, policy: str | None = None, acts_on: str = DEFLECTION) -> None:
        self._env = env
        self._policy = policy
        self._acts_on = acts_on

    def __call__(self) -> Any:
        """The environment."""
        made = _make(self._env)
        if self._policy is None:
            return made
        from baselines.residual_env import ResidualWrapper

        return ResidualWrapper(made, self._policy, acts_on={self._acts_on: None})


def _condition(env: str, policy: str | None) -> Condition:
    return Condition(
        env=env,
        policy=PolicySpec(name=policy or "zero"),
        reference=environment(env).default_reference,
    )


def _arguments(env: str) -> dict[str, Any]:
    return _condition(env, None).arguments


def _make(env: str) -> gymnasium.Env[Any, Any]:
    import elastic_env  # noqa: F401  registers the environments, also in a process of its own

    return gymnasium.make(environment(env).id, **_arguments(env))


def _with(policy: str | None, residual: bool) -> str:
    parts = [
        part for part in (policy, "residual network" if residual else None) if part is not None
    ]
    return f" with {' and '.join(parts)}" if parts else ""
