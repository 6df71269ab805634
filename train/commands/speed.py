"""`elastic speed`: our vector environment against raw `mj_step`, scalar environments and PPO."""

import cProfile
import importlib
import io
import json
import os
import pstats
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field
from rich.console import Console

from elastic_env.core.config import Entries, Model, quantity
from train.evaluate.environments import environment
from train.runs.console import make_table
from train.runs.escaping import write_records
from train.runs.folders import run_folder
from train.runs.progress import plain_progress
from train.speed.contenders import Contender, RawWorlds, ScalarLoop, VectorLoop
from train.speed.foreign_loops import IN_PROCESSES, IN_THIS_PROCESS, ForeignLoop, PPOLoop
from train.speed.real_time import PERCENTILES, play_against_the_clock

_PPO_PROCESSES = 2


class Speed(Model):
    """Measure throughput against raw mj_step on the same model, in one interleaved run.

    It times the vector environment, without and with a policy and a residual network in its loop;
    scalar environments, also in the vector environments of Gymnasium and SB3; and PPO end to end.

    Example, the vector environment alone: elastic speed --env testbed --num-envs 64 1024
        --no-others --no-ppo

    With --backend warp the physics of the vector environment runs on a GPU, and raw mj_step still
    on the CPU. Example: elastic speed --backend warp --num-envs 4096 16384
        --policy input_output --no-others --no-ppo

    With --real-time only one policy is timed, as on a robot: it is called with recorded
    observations, once in every control period. The output is late cycles and latencies. Example:
    elastic speed --real-time --policy dynamic
    """

    env: str = "walker"
    """Environment: testbed or walker."""
    policy: str | None = None
    """Baseline in the loop, or "FILE.py:function"; default input_wrench on the walker, input on the
    testbed; with --real-time adaptive_posture on the walker."""
    num_envs: Entries[Annotated[int, Field(ge=1, le=1_000_000)]] = [64, 256]
    """Numbers of worlds."""
    others: bool = True
    """Time scalar environments too, alone and in vector environments of Gymnasium and SB3."""
    processes: Entries[Annotated[int, Field(ge=1, le=1024)]] = [2, 4]
    """Numbers of processes to try with these vector environments."""
    ppo: bool = True
    """Time PPO end to end too."""
    profile: bool = False
    """Profile the vector environment with its policy."""
    steps: int = quantity("1", 50, ge=1, le=100_000)
    """Control steps per round."""
    rounds: int = quantity("1", 7, ge=1, le=1000)
    """Rounds; medians are reported."""
    threads: int = quantity("1", 0, ge=0, le=1024)
    """Threads of both contenders, 0 for all cores."""
    backend: Literal["mujoco", "warp"] = "mujoco"
    """Physics of the vector environment: "mujoco" on the CPU, or "warp" on a GPU, of the extra
    `gpu`."""
    device: str | None = None
    """Device of --backend warp; default cuda:0."""
    real_time: bool = False
    """Time only a policy, called at the control rate; of the other options env, policy, seconds and
    output apply.
    """
    seconds: float = quantity("s", 60.0, gt=0, le=86_400)
    """Duration with --real-time [s]."""
    output: Path | None = None
    """Folder for speed.json and speed.csv, or real_time.json, new or empty; default runs/speed,
    numbered if taken.
    """

    @property
    def threads_used(self) -> int:
        """Number of threads; one per core for 0."""
        return self.threads or os.cpu_count() or 1

    @property
    def looped_policy(self) -> str:
        """Policy in the loop: the named one, or the environment's best one without ground truth."""
        return self.policy or environment(self.env).looped_policy

    def vector_loop(self, num_envs: int, policy: str | None, residual: bool) -> VectorLoop:
        """Return the loop of the vector environment with a policy, and perhaps a network."""
        threads = min(self.threads_used, num_envs)
        backend = {"backend": self.backend, "device": self.device}
        return VectorLoop(self.env, num_envs, threads, policy, residual, **backend)

    def run(self, console: Console) -> None:
        """Measure, print the figures, and write them."""
        work = measure_real_time if self.real_time else measure_throughput
        for path in work(self, console):
            console.print(f"wrote {path}")


_TIMES = {"latency": "from due to command", "policy": "in the policy"}


def measure_real_time(config: Speed, console: Console) -> list[Path]:
    """Time a policy at the control rate, print its latencies, and write them as JSON."""
    recorded = config.model_dump(mode="json", include={"env", "policy", "seconds"})
    with run_folder("speed", recorded, 0, config.output) as folder:
        console.print(f"recording an episode, then {config.seconds:g} s against the clock")
        figures = play_against_the_clock(config.env, config.policy, config.seconds)
        path = folder / "real_time.json"
        path.write_text(json.dumps(figures, indent=2) + "\n")
    period = f"once in {figures['period_us']:.0f} µs"
    title = f"{figures['policy']} on the {config.env}, {period}; times in µs"
    rows = [
        (label, *(f"{figures[f'{key}_{name}_us']:.0f}" for name in PERCENTILES))
        for key, label in _TIMES.items()
    ]
    console.print(make_table(title, ["", "median", "99 %", "99.9 %", "longest"], rows))
    share = 100.0 * figures["late_share"]
    console.print(f"late: {figures['late']} of {figures['cycles']} cycles, {share:.3f} %")
    if not figures["is_real_time"]:
        console.print("without real-time scheduling, to which this user has no right")
    return [path]


def measure_throughput(config: Speed, console: Console) -> list[Path]:
    """Time all contenders, print their ratios, and write them as JSON and CSV."""
    if config.others or config.ppo:
        # so that a missing package fails before the work
        importlib.import_module("stable_baselines3")
    config.vector_loop(1, config.policy, residual=False)
    unused = {"output", "profile", "real_time", "seconds"}
    recorded = config.model_dump(mode="json", exclude=unused)
    with run_folder("speed", recorded, None, config.output) as folder:
        console.print("measuring every contender in turn, round by round")
        results = measure(config, plain_progress(console))
        path = folder / "speed.json"
        path.write_text(json.dumps(results, indent=2) + "\n")
        files = [path, write_records(results, folder / "speed.csv")]
        if config.profile:
            text = profile(config)
            files.append(folder / "profile.txt")
            files[-1].write_text(text)
            console.print(text)
    title = f"{config.env}: control steps per second, medians of one interleaved run"
    rows = []
    for row in results:
        worlds = str(row["num_envs"])
        figures = (f"{row['steps_per_s']:,.0f}", f"{row['ratio']:.3f}")
        rows.append((row["contender"], worlds, *figures, row["against"]))
    table = make_table(title, ["", "worlds", "steps/s", "ratio", "to"], rows)
    table.columns[-1].justify = "left"
    console.print(table)
    return files


def measure(config: Speed, progress: Callable[[float], None]) -> list[dict[str, Any]]:
    """Time all contenders in turn, round by round; the first round warms up.

    Args:
        config: Options of the command.
        progress: Takes the finished share of the work, after every contender of every round.

    Returns:
        For every contender the medians over the rounds: control steps per second of all its worlds,
        and the ratio to its opponent.
    """
    contenders, against = _contenders(config)
    rates = np.empty((config.rounds + 1, len(contenders)))
    try:
        for turn in range(rates.size):
            number = turn % len(contenders)
            rates.flat[turn] = contenders[number].run(config.steps)
            progress((turn + 1) / rates.size)
    finally:
        for contender in contenders:
            contender.close()
    names = [f"{contender.title}, {contender.num_envs}" for contender in contenders]
    medians = np.median(rates[1:], axis=0)
    ratios = np.median(rates[1:] / rates[1:, against], axis=0)
    return [
        {
            "env": config.env,
            "contender": contender.title,
            "num_envs": contender.num_envs,
            "threads": config.threads_used,
            "steps_per_s": float(medians[number]),
            "ratio": float(ratios[number]),
            "against": names[against[number]],
        }
        for number, contender in enumerate(contenders)
    ]


def _contenders(config: Speed) -> tuple[list[Contender], list[int]]:
    """Return contenders, and for each the number of its opponent.

    An opponent that only one contender has comes directly before or after it.
    """
    env = config.env
    policy = config.looped_policy
    contenders: list[Contender] = []
    against: list[int] = []
    for n in config.num_envs:
        threads = min(config.threads_used, n)
        loop = config.vector_loop(n, None, residual=False)
        with_policy = config.vector_loop(n, policy, residual=False)
        with_network = config.vector_loop(n, policy, residual=True)
        against += [len(contenders) + 1] * 4
        contenders += [loop, RawWorlds(loop, threads), with_policy, with_network]
    if config.others:
        scalar = ScalarLoop(env)
        against += [len(contenders) + 1] * 2
        contenders += [scalar, RawWorlds(scalar, 1)]
        foreign = [(kind, n) for n in config.processes for kind in IN_PROCESSES]
        foreign += [(kind, config.processes[0]) for kind in IN_THIS_PROCESS]
        against += [0] * len(foreign)
        contenders += [ForeignLoop(env, kind, n) for kind, n in foreign]
    if config.ppo:
        against += [len(contenders)] * 2
        contenders.append(PPOLoop(env, policy, 64, config.threads_used))
        contenders.append(PPOLoop(env, policy, _PPO_PROCESSES, None))
    return contenders, against


def profile(config: Speed) -> str:
    """Return a profile of the vector environment with its policy, as text."""
    loop = config.vector_loop(config.num_envs[0], config.looped_policy, residual=False)
    loop.run(config.steps)
    profiler = cProfile.Profile()
    profiler.runcall(loop.run, config.steps * config.rounds)
    text = io.StringIO()
    stats = pstats.Stats(profiler, stream=text).strip_dirs()
    stats.sort_stats("cumulative").print_stats(40)
    return text.getvalue()
