"""Throughput of the vector environment against raw `mj_step` on the same model, as ratios of one interleaved run."""

import json
import os
import statistics
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import mujoco
import numpy as np
from pydantic import Field
from rich.console import Console
from rich.progress import track
from rich.table import Table

from elastic_env.config import Model, quantity
from elastic_env.signals import Array
from train.conditions import Condition, PolicySpec
from train.environments import environment
from train.evaluate import make_policy, make_vector_env
from train.runs import run_folder

_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


class SpeedConfig(Model):
    """What `elastic speed` measures."""

    env: str = "testbed"
    policy: str | None = None
    """Policy in the loop of the vector environment; None for none."""
    num_envs: list[Annotated[int, Field(ge=1)]] = Field(default=[64, 1024], min_length=1)
    """Numbers of worlds."""
    steps: int = quantity("1", 50, ge=1, description="control steps per round")
    rounds: int = quantity("1", 7, ge=1, description="rounds, of which medians are reported")
    threads: int = quantity("1", 0, ge=0, description="threads of both contenders, 0 for all cores")


@dataclass(frozen=True)
class SpeedResult:
    """Medians over the rounds of one interleaved run.

    Attributes:
        env: Environment.
        policy: Policy in its loop, None for none.
        num_envs: Worlds of the vector environment.
        threads: Threads of both contenders.
        env_steps_per_s: Control steps per second of the vector environment, all worlds together.
        raw_steps_per_s: The same of `mj_step` alone.
        ratio: Median of the rounds' ratios.
    """

    env: str
    policy: str | None
    num_envs: int
    threads: int
    env_steps_per_s: float
    raw_steps_per_s: float
    ratio: float


def measure(
    num_envs: int, steps: int, rounds: int, threads: int = 0, env: str = "testbed", policy: str | None = None
) -> SpeedResult:
    """Time the vector environment, with a policy in its loop or without, and raw stepping in turn.

    Raw stepping starts from the same states and plays the same servo inputs: on every thread nothing but writing `ctrl`
    and one call of `mj_step` with all sub-steps of a control period.

    Args:
        num_envs: Worlds.
        steps: Control steps per round.
        rounds: Rounds; the medians are reported.
        threads: Threads, 0 for all cores.
        env: Environment, with its default motion, scenario nominal.
        policy: Its name; None plays zero offsets.

    Raises:
        ConfigurationError: Environment or policy does not exist.
    """
    threads = min(threads or os.cpu_count() or 1, num_envs)
    loop = _Loop(env, policy, num_envs, threads)
    simulation = loop.env.unwrapped.simulation
    raw = _RawWorlds(loop.env.unwrapped.task, simulation, threads)
    env_times, raw_times = [], []
    for _ in range(rounds + 1):
        controls = np.empty((steps, *simulation.ctrl.shape))
        begin = time.perf_counter()
        for step in range(steps):
            loop.step()
            controls[step] = simulation.ctrl
        env_times.append(time.perf_counter() - begin)
        raw_times.append(raw.run(controls))
    env_times, raw_times = env_times[1:], raw_times[1:]  # the first round warms up
    work = num_envs * steps
    return SpeedResult(
        env=env,
        policy=policy,
        num_envs=num_envs,
        threads=threads,
        env_steps_per_s=work / statistics.median(env_times),
        raw_steps_per_s=work / statistics.median(raw_times),
        ratio=statistics.median(r / e for e, r in zip(env_times, raw_times, strict=True)),
    )


class _Loop:
    """The vector environment in a loop with a policy, or with zero offsets."""

    def __init__(self, env: str, policy: str | None, num_envs: int, threads: int) -> None:
        spec = PolicySpec(name=policy or "zero")
        condition = Condition(env=env, policy=spec, reference=environment(env).default_reference)
        self.env = make_vector_env(condition, num_envs, threads)
        self._policy = None if policy is None else make_policy(spec, self.env)
        self._action = np.zeros(self.env.action_space.shape, dtype=np.float32)
        self._observation, _ = self.env.reset(seed=0)
        self._state: Any = None
        self._start, self._done = np.ones(num_envs, dtype=np.bool_), np.zeros(num_envs, dtype=np.bool_)

    def step(self) -> None:
        """One control period in every world."""
        if self._policy is not None:
            self._action, self._state = self._policy.predict(self._observation, self._state, self._start, True)
        self._observation, _, terminated, truncated, _ = self.env.step(self._action)
        self._start, self._done = self._done, terminated | truncated  # a world that ends begins a step later


class _RawWorlds:
    """`mj_step` and nothing else: threads that share the worlds out, each with one `MjData`, warm in its cache."""

    def __init__(self, task: Any, simulation: Any, threads: int) -> None:
        self._model, self._substeps = task.model, task.num_substeps
        self._data = [mujoco.MjData(self._model) for _ in range(threads)]
        self._states = np.stack([self._state_of(simulation, world) for world in range(task.num_worlds)])

    def run(self, controls: Array) -> float:
        """Time to play servo inputs, (steps, num_worlds, nu), in every world [s]."""
        workers = [threading.Thread(target=self._play, args=(i, controls)) for i in range(len(self._data))]
        begin = time.perf_counter()
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
        return time.perf_counter() - begin

    def _play(self, thread: int, controls: Array) -> None:
        model, data, substeps = self._model, self._data[thread], self._substeps
        for world in range(thread, len(self._states), len(self._data)):
            mujoco.mj_setState(model, data, self._states[world], _STATE)
            ctrl = data.ctrl
            for command in controls[:, world]:
                ctrl[:] = command
                mujoco.mj_step(model, data, substeps)
            mujoco.mj_getState(model, data, self._states[world], _STATE)

    def _state_of(self, simulation: Any, world: int) -> Array:
        """Integration state of a world of the environment."""
        data, state = self._data[0], np.empty(mujoco.mj_stateSize(self._model, _STATE))
        mujoco.mj_resetData(self._model, data)
        data.qpos[:], data.qvel[:] = simulation.qpos[world], simulation.qvel[world]
        data.act[:], data.ctrl[:] = simulation.act[world], simulation.ctrl[world]
        data.qacc_warmstart[:] = simulation.bind("qacc_warmstart")[world]
        mujoco.mj_getState(self._model, data, state, _STATE)
        return state


def measure_all(config: SpeedConfig, console: Console, output: Path | None = None) -> Path:
    """Measure every number of worlds, print the ratios, and write them as JSON.

    Args:
        config: What to measure.
        console: Where progress and table go.
        output: Folder for the results; default runs/speed, numbered if taken.

    Returns:
        The file.

    Raises:
        ConfigurationError: Environment or policy does not exist; found before the work begins.
        ResultsExistError: The output folder holds results.
    """
    _Loop(config.env, config.policy, num_envs=1, threads=1)
    with run_folder("speed", config.model_dump(mode="json"), None, output) as folder:
        results = [
            measure(n, config.steps, config.rounds, config.threads, config.env, config.policy)
            for n in track(config.num_envs, "measuring", console=console, transient=True)
        ]
        path = folder / "speed.json"
        path.write_text(json.dumps([asdict(r) for r in results], indent=2) + "\n")
    loop = "" if config.policy is None else f" with {config.policy}"
    table = Table(title=f"{config.env}{loop} against raw mj_step, medians of one interleaved run")
    for name in ("worlds", "threads", "env steps/s", "raw steps/s", "ratio"):
        table.add_column(name, justify="right")
    for r in results:
        rates = f"{r.env_steps_per_s:,.0f}", f"{r.raw_steps_per_s:,.0f}"
        table.add_row(str(r.num_envs), str(r.threads), *rates, f"{r.ratio:.3f}")
    console.print(table)
    return path
