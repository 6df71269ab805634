"""Contenders of `elastic speed`: each plays control steps and measures how long they take."""

import itertools
import time
from abc import ABC, abstractmethod
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from typing_extensions import override

from baselines.compensation.inputs import COMMAND, DEFLECTION, inputs_of
from baselines.residual.correction import Corrected
from baselines.residual.features import Features
from baselines.residual.network import Network
from baselines.residual.residual_policy import ResidualPolicy
from baselines.residual.settings import ResidualDescription, ResidualSettings
from elastic_env.core.signals import Array
from train.evaluate.conditions import Condition, PolicySpec
from train.evaluate.rollout import make_policy, make_vector_env, policy_errors

PPO_DECISIONS = 512
"""Decisions that PPO collects before it learns from them."""
IN_PROCESSES = ("Gymnasium AsyncVectorEnv", "SB3 SubprocVecEnv")
IN_THIS_PROCESS = ("Gymnasium SyncVectorEnv", "SB3 DummyVecEnv")
"""Vector environments of others, by whether each world is a process."""
_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


class Contender(ABC):
    """Something that plays control steps.

    Attributes:
        title: Name in tables.
        num_envs: Worlds.
        env: Whatever it plays in.
    """

    title: str
    num_envs: int
    env: Any

    @abstractmethod
    def run(self, steps: int) -> float:
        """Play about so many control steps in every world; steps per second of all worlds."""

    def close(self) -> None:
        """End what it has started."""
        self.env.close()


class _OurLoop(Contender):
    """An environment of ours; keeps the servo inputs of its last run."""

    def __init__(self, env: Any) -> None:
        self.env = env
        self._action = np.zeros(env.action_space.shape, dtype=np.float32)
        self._observation, _ = env.reset(seed=0)
        self.controls = np.empty((0, *env.unwrapped.simulation.ctrl.shape))

    @override
    def run(self, steps: int) -> float:
        ctrl = self.env.unwrapped.simulation.ctrl
        self.controls = np.empty((steps, *ctrl.shape))
        begin = time.perf_counter()
        for step in range(steps):
            self.step()
            self.controls[step] = ctrl
        return self.num_envs * steps / (time.perf_counter() - begin)

    @abstractmethod
    def step(self) -> None:
        """One control period in every world."""


class VectorLoop(_OurLoop):
    """Our vector environment, with zero offsets or a policy in its loop.

    Args:
        env: Environment.
        num_envs: Worlds.
        threads: Of the physics on the CPU.
        policy: In the loop; None for zero offsets.
        residual: Whether an untrained network corrects the policy.
        **backend: Arguments `backend` and `device` of the environment.
    """

    def __init__(
        self,
        env: str,
        num_envs: int,
        threads: int,
        policy: str | None = None,
        residual: bool = False,
        **backend: Any,
    ) -> None:
        on_warp = " on warp" if backend.get("backend") == "warp" else ""
        with_policy = "" if policy is None else f" with {policy}"
        with_network = " and residual network" if residual else ""
        self.title = f"vector env{on_warp}{with_policy}{with_network}"
        self.num_envs = num_envs
        self._condition = _condition(env, policy)
        super().__init__(make_vector_env(self._condition, num_envs, threads, **backend))
        spec = self._condition.policy
        self._policy = None if policy is None else make_policy(spec, self.env)
        if residual:
            self._policy = untrained_residual(self._policy, self.env)
        self._state: Any = None
        self._start = np.ones(num_envs, dtype=np.bool_)
        self._done = np.zeros(num_envs, dtype=np.bool_)

    @override
    def run(self, steps: int) -> float:
        with policy_errors(self._condition):
            return super().run(steps)

    @override
    def step(self) -> None:
        if self._policy is not None:
            seen = (self._observation, self._state, self._start)
            self._action, self._state = self._policy.predict(*seen, deterministic=True)
        self._observation, _, terminated, truncated, _ = self.env.step(self._action)
        # a world that ends begins a step later
        self._start = self._done
        self._done = terminated | truncated


class ScalarLoop(_OurLoop):
    """Our scalar environment under zero offsets, without Gymnasium's checks."""

    title = "scalar env"
    num_envs = 1

    def __init__(self, env: str) -> None:
        super().__init__(_make(env).unwrapped)

    @override
    def step(self) -> None:
        _, _, terminated, truncated, _ = self.env.step(self._action)
        if terminated or truncated:
            self.env.reset()


class RawWorlds(Contender):
    """`mj_step` and nothing else: threads share the worlds, each with one `MjData` in its cache.

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
        worlds = range(self.num_envs)
        self.states = np.stack([self._state_of(simulation, world) for world in worlds])

    @override
    def run(self, steps: int) -> float:
        controls = self._loop.controls
        numbers = range(len(self._data))
        with ThreadPoolExecutor(len(numbers)) as threads:
            begin = time.perf_counter()
            list(threads.map(self._play, numbers, itertools.repeat(controls)))
        return self.num_envs * steps / (time.perf_counter() - begin)

    @override
    def close(self) -> None:
        """Nothing: the environment is the loop's."""

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


class ForeignLoop(Contender):
    """Scalar environments of ours in somebody else's vector environment, under zero offsets.

    Args:
        env: Environment.
        kind: Of `IN_PROCESSES` or `IN_THIS_PROCESS`.
        num_envs: Worlds.
    """

    def __init__(self, env: str, kind: str, num_envs: int) -> None:
        from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

        subprocesses = partial(SubprocVecEnv, start_method="spawn")
        makers = (AsyncVectorEnv, subprocesses, SyncVectorEnv, DummyVecEnv)
        make: Any = makers[[*IN_PROCESSES, *IN_THIS_PROCESS].index(kind)]
        self.title = kind
        self.num_envs = num_envs
        self.env = make([partial(_make, env)] * num_envs)
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
        env: Environment.
        policy: Base.
        n: Worlds.
        threads: Of our vector environment; None for a process for each world.
    """

    def __init__(self, env: str, policy: str, n: int, threads: int | None) -> None:
        import torch
        from stable_baselines3 import PPO
        from stable_baselines3.common.logger import Logger
        from stable_baselines3.common.vec_env import SubprocVecEnv

        from baselines.residual_env import ResidualVectorWrapper
        from train.learn.sb3_env import SB3VecEnv

        where = f"SubprocVecEnv({n})" if threads is None else "vector env"
        self.title = f"PPO with {policy}, {where}"
        self.num_envs = n
        if threads is None:
            maker = partial(_make_corrected, env, policy)
            venv: Any = SubprocVecEnv([maker] * n, start_method="spawn")
        else:
            condition = _condition(env, policy)
            inner = make_vector_env(condition, n, threads, AutoresetMode.SAME_STEP)
            base = make_policy(condition.policy, inner)
            venv = SB3VecEnv(ResidualVectorWrapper(inner, base, acts_on=_acts_on(base)))
        self._period = ResidualSettings().decision_period
        torch.set_num_threads(1)
        self._rollout = max(PPO_DECISIONS // n, 8)
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
        # SB3's own logger makes a folder in /tmp
        self._model.set_logger(Logger(folder=None, output_formats=[]))
        self.env = self._model.get_env()

    @override
    def run(self, steps: int) -> float:
        """Learn for one iteration of `PPO_DECISIONS`, or of 8 in each world: there is no less."""
        before = self._model.num_timesteps
        begin = time.perf_counter()
        self._model.learn(self._rollout * self.num_envs, reset_num_timesteps=False)
        decisions = self._model.num_timesteps - before
        return decisions * self._period / (time.perf_counter() - begin)


def untrained_residual(base: Any, env: Any) -> ResidualPolicy:
    """A residual with an untrained network of 64×64, small random weights, on a base policy."""
    model = env.unwrapped.assumed_model
    corrected = Corrected(base, model, ResidualSettings(acts_on=_acts_on(base)))
    features = Features(corrected).width
    generator = np.random.default_rng(0)
    tensors = {"mean": np.zeros(features), "std": np.ones(features)}
    widths = itertools.pairwise([features, 64, 64, corrected.num_residuals])
    for i, (inputs, outputs) in enumerate(widths):
        tensors[f"weight{i}"] = 0.01 * generator.normal(size=(outputs, inputs))
        tensors[f"bias{i}"] = np.zeros(outputs)
    robot = env.unwrapped.task.name
    description = ResidualDescription(robot=robot, base="", settings=corrected.settings)
    return ResidualPolicy(corrected, Network(description, tensors))


def _acts_on(base: Any) -> dict[str, Any]:
    """The input of a base that a residual acts on, with its default bound."""
    return {DEFLECTION if DEFLECTION in inputs_of(base) else COMMAND: None}


def _condition(env: str, policy: str | None = None) -> Condition:
    spec = PolicySpec(name=policy or "zero")
    return Condition(env=env, policy=spec)


def _make(env: str, policy: str | None = None) -> Any:
    """A scalar environment with what a policy needs, also in a process of its own."""
    condition = _condition(env, policy)
    return gymnasium.make(condition.environment.id, **condition.arguments)


def _make_corrected(env: str, policy: str) -> Any:
    """A scalar environment with the residual of a base policy around it."""
    from baselines.residual_env import ResidualWrapper

    made = _make(env, policy)
    base = make_policy(_condition(env, policy).policy, made)
    return ResidualWrapper(made, base, acts_on=_acts_on(base))
