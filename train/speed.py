"""Throughput of the vector environment against raw `mj_step` on the same model, as ratios of one interleaved run."""

import json
import os
import statistics
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import gymnasium
import mujoco
import numpy as np
from pydantic import Field
from rich.console import Console
from rich.progress import track
from rich.table import Table

import elastic_env  # noqa: F401  registers the environments
from elastic_env.config import Model, quantity
from elastic_env.signals import Array
from train.evaluate import ENVIRONMENTS
from train.runs import run_folder

_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


class SpeedConfig(Model):
    """What `elastic speed` measures."""

    num_envs: list[Annotated[int, Field(ge=1)]] = Field(default=[64, 1024], min_length=1)
    """Numbers of worlds."""
    steps: int = quantity("1", 50, ge=1, description="control steps per round")
    rounds: int = quantity("1", 7, ge=1, description="rounds, of which medians are reported")
    threads: int = quantity("1", 0, ge=0, description="threads of both contenders, 0 for all cores")


@dataclass(frozen=True)
class SpeedResult:
    """Medians over the rounds of one interleaved run.

    Attributes:
        num_envs: Worlds of the vector environment.
        threads: Threads of both contenders.
        env_steps_per_s: Control steps per second of the vector environment, all worlds together.
        raw_steps_per_s: The same of `mj_step` alone.
        ratio: Median of the rounds' ratios.
    """

    num_envs: int
    threads: int
    env_steps_per_s: float
    raw_steps_per_s: float
    ratio: float


def measure(num_envs: int, steps: int, rounds: int, threads: int = 0, **env_options: Any) -> SpeedResult:
    """Time the vector environment and raw stepping in turn.

    Raw stepping starts from the same states and plays the same servo inputs: on every thread nothing but writing `ctrl`
    and one call of `mj_step` with all sub-steps of a control period.

    Args:
        num_envs: Worlds.
        steps: Control steps per round.
        rounds: Rounds; the medians are reported.
        threads: Threads, 0 for all cores.
        **env_options: Arguments of the environment.
    """
    threads = min(threads or os.cpu_count() or 1, num_envs)
    env: Any = gymnasium.make_vec(
        ENVIRONMENTS["testbed"], num_envs=num_envs, vectorization_mode="vector_entry_point", num_threads=threads,
        **env_options,
    )  # fmt: skip
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape, dtype=np.float32)
    simulation = env.unwrapped.simulation
    raw = _RawWorlds(env.unwrapped.task, simulation, threads)
    env_times, raw_times = [], []
    for _ in range(rounds + 1):
        controls = np.empty((steps, *simulation.ctrl.shape))
        begin = time.perf_counter()
        for step in range(steps):
            env.step(action)
            controls[step] = simulation.ctrl
        env_times.append(time.perf_counter() - begin)
        raw_times.append(raw.run(controls))
    env_times, raw_times = env_times[1:], raw_times[1:]  # the first round warms up
    work = num_envs * steps
    return SpeedResult(
        num_envs=num_envs,
        threads=threads,
        env_steps_per_s=work / statistics.median(env_times),
        raw_steps_per_s=work / statistics.median(raw_times),
        ratio=statistics.median(r / e for e, r in zip(env_times, raw_times, strict=True)),
    )


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
        ResultsExistError: The output folder holds results.
    """
    with run_folder("speed", config.model_dump(mode="json"), None, output) as folder:
        results = [
            measure(n, config.steps, config.rounds, config.threads)
            for n in track(config.num_envs, "measuring", console=console, transient=True)
        ]
        path = folder / "speed.json"
        path.write_text(json.dumps([asdict(r) for r in results], indent=2) + "\n")
    table = Table(title="vector environment against raw mj_step, medians of one interleaved run")
    for name in ("worlds", "threads", "env steps/s", "raw steps/s", "ratio"):
        table.add_column(name, justify="right")
    for r in results:
        rates = f"{r.env_steps_per_s:,.0f}", f"{r.raw_steps_per_s:,.0f}"
        table.add_row(str(r.num_envs), str(r.threads), *rates, f"{r.ratio:.3f}")
    console.print(table)
    return path
