"""`elastic speed`: our vector environment against raw `mj_step`, scalar environments and PPO, in
one run.
"""

import cProfile
import importlib
import io
import json
import os
import pstats
import statistics
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field
from rich.console import Console
from rich.table import Table

from elastic_env.core.config import Model, quantity
from train.evaluate.environments import environment
from train.runs.console import make_table
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
from train.speed.real_time import measure_real_time

_PPO_PROCESSES = 2


class Speed(Model):
    """Measure throughput against raw mj_step on the same model, in one interleaved run.

    Timed are the vector environment, without and with a policy and a residual network in its loop;
    scalar environments, under the vector environments of Gymnasium and SB3 too; and PPO end to end.

    Example, the vector environment alone: elastic speed --env testbed --num-envs 64 1024
        --no-others --no-ppo

    With --real-time one policy is timed alone, as on a robot: it is called with recorded
    observations, once in every control period. Printed are late cycles and latencies. Example:
    elastic speed --real-time --policy dynamic
    """

    env: str = "walker"
    """Environment: testbed or walker."""
    policy: str | None = None
    """Baseline in the loop, or "FILE.py:function"; default input_wrench on the walker, input on the
    testbed; with --real-time adaptive_posture on the walker."""
    num_envs: list[Annotated[int, Field(ge=1, le=1_000_000)]] = Field(
        [64, 256], min_length=1, max_length=100
    )
    """Numbers of worlds."""
    others: bool = True
    """Time scalar environments too, alone and in vector environments of Gymnasium and SB3."""
    processes: list[Annotated[int, Field(ge=1, le=1024)]] = Field(
        [2, 4], min_length=1, max_length=100
    )
    """Numbers of processes to try with them."""
    ppo: bool = True
    """Time PPO end to end too."""
    profile: bool = False
    """Say where the time of the vector environment with its policy goes."""
    steps: int = quantity("1", 50, ge=1, le=100_000)
    """Control steps per round."""
    rounds: int = quantity("1", 7, ge=1, le=1000)
    """Rounds; medians are reported."""
    threads: int = quantity("1", 0, ge=0, le=1024)
    """Threads of both contenders, 0 for all cores."""
    real_time: bool = False
    """Time a policy alone against the clock, in place of all that; reads env, policy, seconds
    and output alone.
    """
    seconds: float = quantity("s", 60.0, gt=0, le=86_400)
    """How long, with --real-time [s]."""
    output: Path | None = None
    """Folder for speed.json and speed.csv, or real_time.json, new or empty; default runs/speed,
    numbered if taken.
    """

    @property
    def threads_used(self) -> int:
        """Threads, one per core for 0."""
        return self.threads or os.cpu_count() or 1

    @property
    def looped_policy(self) -> str:
        """The policy in the loop: the named one, or the environment's best that needs no truth."""
        return self.policy or environment(self.env).looped_policy

    def run(self, console: Console) -> None:
        """Measure and report."""
        if self.real_time:
            path = measure_real_time(self.env, self.policy, self.seconds, console, self.output)
        else:
            path = measure_all(self, console)
        console.print(f"wrote {path}", soft_wrap=True)


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


def measure(config: Speed, progress: Callable[[float], None] | None = None) -> list[SpeedResult]:
    """Time all contenders in turn, round by round; the first round warms up.

    Args:
        config: What to measure.
        progress: Called after every contender of every round with the share of the work that is
            done.

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


def _entries(config: Speed) -> list[_Entry]:
    """Everything that is timed, every reference before or right after what is compared with it."""
    threads = config.threads_used
    env = config.env
    policy = config.looped_policy
    entries: list[_Entry] = []
    for n in config.num_envs:
        loop = VectorLoop(env, n, min(threads, n))
        raw = len(entries) + 1
        entries.append(_Entry(loop, raw))
        entries.append(_Entry(RawWorlds(loop, min(threads, n)), raw))
        entries.append(_Entry(VectorLoop(env, n, min(threads, n), policy), raw))
        entries.append(_Entry(VectorLoop(env, n, min(threads, n), policy, residual=True), raw))
    if config.others:
        scalar = ScalarLoop(env)
        raw = len(entries) + 1
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


def _result(
    config: Speed, entries: Sequence[_Entry], rates: list[list[float]], number: int
) -> SpeedResult:
    entry = entries[number]
    reference = entries[entries[number].against]
    mine = rates[number][1:]
    others = rates[entry.against][1:]
    return SpeedResult(
        env=config.env,
        contender=entry.contender.title,
        num_envs=entry.contender.num_envs,
        threads=config.threads_used,
        steps_per_s=statistics.median(mine),
        ratio=statistics.median(a / b for a, b in zip(mine, others, strict=True)),
        against=f"{reference.contender.title}, {reference.contender.num_envs}",
    )


def profile(config: Speed) -> str:
    """Profile of the vector environment with its policy, as text."""
    n = config.num_envs[0]
    loop = VectorLoop(config.env, n, min(config.threads_used, n), config.looped_policy)
    loop.run(config.steps)
    profiler = cProfile.Profile()
    profiler.enable()
    loop.run(config.steps * config.rounds)
    profiler.disable()
    text = io.StringIO()
    pstats.Stats(profiler, stream=text).strip_dirs().sort_stats("cumulative").print_stats(40)
    return text.getvalue()


def measure_all(config: Speed, console: Console) -> Path:
    """Measure, print the ratios, and write them as JSON and CSV.

    Args:
        config: What to measure.
        console: Where progress and table go.

    Returns:
        The file.

    Raises:
        ConfigurationError: Environment or policy does not exist; found before the work begins.
        ModuleNotFoundError: Stable-Baselines3 is not installed, and a contender needs it; found
            before, too.
        ResultsExistError: The output folder holds results.
    """
    if config.others or config.ppo:
        importlib.import_module("stable_baselines3")
    VectorLoop(config.env, 1, 1, config.policy)
    recorded = config.model_dump(mode="json", exclude={"output", "profile", "real_time", "seconds"})
    with run_folder("speed", recorded, None, config.output) as folder:
        console.print("measuring every contender in turn, round by round")
        results = measure(config, plain_progress(console))
        path = folder / "speed.json"
        path.write_text(json.dumps([asdict(r) for r in results], indent=2) + "\n")
        write_records([asdict(r) for r in results], folder / "speed.csv")
        if config.profile:
            text = profile(config)
            (folder / "profile.txt").write_text(text)
            console.print(text, highlight=False, markup=False)
    console.print(_table(config, results))
    return path


def _table(config: Speed, results: Sequence[SpeedResult]) -> Table:
    title = f"{config.env}: control steps per second, medians of one interleaved run"
    rows = [
        (r.contender, str(r.num_envs), f"{r.steps_per_s:,.0f}", f"{r.ratio:.3f}", r.against)
        for r in results
    ]
    table = make_table(title, ["", "worlds", "steps/s", "ratio", "to"], rows)
    table.columns[-1].justify = "left"
    return table
