"""Contenders of `elastic speed`: our environments and raw physics, timed over control steps."""

import itertools
import time
from abc import ABC, abstractmethod
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import gymnasium
import mujoco
import numpy as np
from typing_extensions import override

from elastic_env.core.signals import Array
from train.evaluate.conditions import Condition, PolicySpec
from train.evaluate.rollout import make_policy, make_vector_env, policy_errors
from train.speed.untrained_residual import untrained_residual

_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


class Contender(ABC):
    """A loop over control steps.

    Attributes:
        title: Name in tables.
        num_envs: Number of worlds.
        env: Environment that plays the steps.
    """

    title: str
    num_envs: int
    env: Any

    @abstractmethod
    def run(self, steps: int) -> float:
        """Play about `steps` control steps in each world; return steps per second of all worlds."""

    def close(self) -> None:
        """Close the environment."""
        self.env.close()


class _OurLoop(Contender):
    """An environment of this package; keeps the servo inputs of its last run."""

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
        """Play one control step in every world."""


class VectorLoop(_OurLoop):
    """Our vector environment, with zero offsets or a policy in its loop.

    Args:
        env: Name of the environment.
        num_envs: Number of worlds.
        threads: Threads of the physics on the CPU.
        policy: Policy in the loop; None for zero offsets.
        residual: Correct the policy by an untrained network.
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
        self._condition = make_condition(env, policy)
        super().__init__(make_vector_env(self._condition, num_envs, threads, **backend))
        self._policy = None if policy is None else make_policy(self._condition.policy, self.env)
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
        # a world that ends starts again one step later
        self._start = self._done
        self._done = terminated | truncated


class ScalarLoop(_OurLoop):
    """Our scalar environment under zero offsets, without Gymnasium's checks."""

    title = "scalar env"
    num_envs = 1

    def __init__(self, env: str) -> None:
        super().__init__(make_scalar_env(env).unwrapped)

    @override
    def step(self) -> None:
        _, _, terminated, truncated, _ = self.env.step(self._action)
        if terminated or truncated:
            self.env.reset()


class RawWorlds(Contender):
    """`mj_step` alone: threads share the worlds, each thread with one `MjData` in its cache.

    It starts from the states of an environment and plays the servo inputs of its last run. In a
    control period a thread only writes `ctrl` and calls `mj_step` once, with all sub-steps.
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
        controls = itertools.repeat(self._loop.controls)
        numbers = range(len(self._data))
        with ThreadPoolExecutor(len(numbers)) as threads:
            begin = time.perf_counter()
            list(threads.map(self._play, numbers, controls))
        return self.num_envs * steps / (time.perf_counter() - begin)

    @override
    def close(self) -> None:
        """Do nothing, since the loop closes its environment."""

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
        """Return the integration state of a world of the environment."""
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


def make_condition(env: str, policy: str | None = None) -> Condition:
    """Return the condition of an environment with a policy, `zero` by default."""
    return Condition(env=env, policy=PolicySpec(name=policy or "zero"))


def make_scalar_env(env: str, policy: str | None = None) -> Any:
    """Make a scalar environment with the sensors that a policy needs, in any process."""
    condition = make_condition(env, policy)
    return gymnasium.make(condition.environment.id, **condition.arguments)
