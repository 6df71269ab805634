"""Throughput in one interleaved run: our vector environment against raw `mj_step`, scalar environments, and PPO."""

import cProfile
import importlib
import json
import os
import pstats
import statistics
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field
from rich.console import Console
from rich.table import Table

from elastic_env.core.config import Model, quantity
from train.evaluate.environments import environment
from train.runs.escaping import write_records
from train.runs.folders import run_folder
from train.runs.progress import plain_progress
from train.speed.contenders import (
    Contender,
    GymnasiumLoop,
    PPOLoop,
    RawWorlds,
    SB3Loop,
    ScalarLoop,
    VectorLoop,
)

_PPO_PROCESSES = 2


class SpeedConfig(Model):
    """What `elastic speed` measures."""

    env: str = "walker"
    policy: str | None = None
    """Policy in the loop of the vector environment, which is timed without, with it, and with a residual network; None
    for input_wrench on the walker, input on the testbed."""
    num_envs: list[Annotated[int, Field(ge=1, le=1_000_000)]] = Field(default=[64, 256], min_length=1, max_length=100)
    """Numbers of worlds."""
    others: bool = True
    """Whether scalar environments are timed too, alone and under Gymnasium's and SB3's vector environments."""
    processes: list[Annotated[int, Field(ge=1, le=1024)]] = Field(default=[2, 4], min_length=1, max_length=100)
    """Numbers of processes to try with them; the fastest counts."""
    ppo: bool = True
    """Whether PPO is timed end to end, with ours and with processes."""
    steps: int = quantity("1", 50, ge=1, le=100_000, description="control steps per round")
    rounds: int = quantity("1", 7, ge=1, le=1000, description="rounds, of which medians are reported")
    threads: int = quantity("1", 0, ge=0, le=1024, description="threads of the physics, 0 for all cores")


@dataclass(frozen=True)
class SpeedResult:
    """Medians over the rounds of one interleaved run.

    Attributes:
        env: Environment.
        contender: What was timed.
        num_envs: Its worlds.
        threads: Threads of the physics.
        steps_per_s: Control steps per second, all worlds together.
        ratio: Median of the rounds' ratios to `against`.
        against: What the ratio refers to, with its worlds.
    """

    env: str
    contender: str
    num_envs: int
    threads: int
    steps_per_s: float
    ratio: float
    against: str


@dataclass(frozen=True)
class _Entry:
    """A contender, and the number of the one that it is compared with."""

    contender: Contender
    against: int


def measure(config: SpeedConfig, progress: Callable[[float], None] | None = None) -> list[SpeedResult]:
    """Time all contenders in turn, round by round; the first round warms up.

    Args:
        config: What to measure.
        progress: Called after every contender of every round with the share of the work that is done.

    Raises:
        ConfigurationError: Environment or policy does not exist.
    """
    entries = _entries(config)
    try:
        rates: list[list[float]] = [[] for _ in entries]
        turns = [*zip(entries, rates, strict=True)] * (config.rounds + 1)
        for done, (entry, found) in enumerate(turns, 1):
            found.append(entry.contender.run(config.steps))
            if progress is not None:
                progress(done / len(turns))
    finally:
        for entry in entries:
            entry.contender.close()
    return [_result(config, entries, rates, number) for number in range(len(entries))]


def _entries(config: SpeedConfig) -> list[_Entry]:
    """What is timed, every reference before or right after what is compared with it."""
    threads, env = config.threads or os.cpu_count() or 1, config.env
    policy = _policy(config)
    entries: list[_Entry] = []
    for n in config.num_envs:
        loop = VectorLoop(env, n, min(threads, n))
        raw = len(entries) + 1
        entries.append(_Entry(loop, raw))
        entries.append(_Entry(RawWorlds(loop, min(threads, n)), raw))
        entries.append(_Entry(VectorLoop(env, n, min(threads, n), policy), raw))
        entries.append(_Entry(VectorLoop(env, n, min(threads, n), policy, residual=True), raw))
    if config.others:
        scalar, raw = ScalarLoop(env), len(entries) + 1
        entries += [_Entry(scalar, raw), _Entry(RawWorlds(scalar, 1), raw)]
        for count in config.processes:
            entries.append(_Entry(GymnasiumLoop(env, "async", count), 0))
            entries.append(_Entry(SB3Loop(env, "SubprocVecEnv", count), 0))
        entries.append(_Entry(GymnasiumLoop(env, "sync", config.processes[0]), 0))
        entries.append(_Entry(SB3Loop(env, "DummyVecEnv", config.processes[0]), 0))
    if config.ppo:
        ours = len(entries)
        entries.append(_Entry(PPOLoop(env, policy, 64, threads), ours))
        entries.append(_Entry(PPOLoop(env, policy, _PPO_PROCESSES, 1, processes=True), ours))
    return entries


def _policy(config: SpeedConfig) -> str:
    """The policy in the loop: the one that is asked for, or the environment's best that needs no truth."""
    return config.policy or environment(config.env).looped_policy


def _result(config: SpeedConfig, entries: Sequence[_Entry], rates: list[list[float]], number: int) -> SpeedResult:
    entry, reference = entries[number], entries[entries[number].against]
    mine, others = rates[number][1:], rates[entry.against][1:]
    return SpeedResult(
        env=config.env,
        contender=entry.contender.title,
        num_envs=entry.contender.num_envs,
        threads=config.threads or os.cpu_count() or 1,
        steps_per_s=statistics.median(mine),
        ratio=statistics.median(a / b for a, b in zip(mine, others, strict=True)),
        against=f"{reference.contender.title}, {reference.contender.num_envs}",
    )


def profile(config: SpeedConfig) -> str:
    """Where the time of the vector environment with its policy goes, as text."""
    threads, n = config.threads or os.cpu_count() or 1, config.num_envs[0]
    loop = VectorLoop(config.env, n, min(threads, n), _policy(config))
    loop.run(config.steps)
    profiler = cProfile.Profile()
    profiler.enable()
    loop.run(config.steps * config.rounds)
    profiler.disable()
    import io

    text = io.StringIO()
    pstats.Stats(profiler, stream=text).strip_dirs().sort_stats("cumulative").print_stats(40)
    return text.getvalue()


def measure_all(config: SpeedConfig, console: Console, output: Path | None = None, with_profile: bool = False) -> Path:
    """Measure, print the ratios, and write them as JSON and CSV.

    Args:
        config: What to measure.
        console: Where progress and table go.
        output: Folder for the results; default runs/speed, numbered if taken.
        with_profile: Whether to print where the time goes, and keep it beside.

    Returns:
        The file.

    Raises:
        ConfigurationError: Environment or policy does not exist; found before the work begins.
        ModuleNotFoundError: Stable-Baselines3 is not installed, and a contender needs it; found before, too.
        ResultsExistError: The output folder holds results.
    """
    if config.others or config.ppo:
        importlib.import_module("stable_baselines3")
    VectorLoop(config.env, 1, 1, config.policy)
    with run_folder("speed", config.model_dump(mode="json"), None, output) as folder:
        console.print("measuring every contender in turn, round by round")
        results = measure(config, plain_progress(console))
        path = folder / "speed.json"
        path.write_text(json.dumps([asdict(r) for r in results], indent=2) + "\n")
        write_records([asdict(r) for r in results], folder / "speed.csv")
        if with_profile:
            text = profile(config)
            (folder / "profile.txt").write_text(text)
            console.print(text, highlight=False, markup=False)
    console.print(_table(config, results))
    return path


def _table(config: SpeedConfig, results: Sequence[SpeedResult]) -> Table:
    table = Table(title=f"{config.env}: control steps per second, medians of one interleaved run")
    for name, justify in (("", "left"), ("worlds", "right"), ("steps/s", "right"), ("ratio", "right"), ("to", "left")):
        table.add_column(name, justify=justify)  # type: ignore[arg-type]
    for r in results:
        row: tuple[Any, ...] = (r.contender, str(r.num_envs), f"{r.steps_per_s:,.0f}", f"{r.ratio:.3f}", r.against)
        table.add_row(*row)
    return table
