"""Commands that guard figures and measure speed: bench, speed."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from train.commands.options import CONSOLE, options_named


@dataclass
class Bench:
    """Guard figures in CI: short rollouts of both environments against what was accepted.

    Exit code 1, and a line for every figure that falls short. Appends its table to the file that $GITHUB_STEP_SUMMARY
    names. Example, to accept new figures: elastic bench --update
    """

    config: Annotated[Path, tyro.conf.Positional] = Path("configs/bench.yaml")
    """Configuration with rollouts and accepted figures; where there is no configs/bench.yaml, that of the package."""
    update: bool = False
    """Accept what is measured now: the figures in the configuration change, and nothing else of it."""
    output: Path | None = None
    """Folder for bench.json and bench.md, new or empty; default runs/bench, numbered if taken."""

    def run(self) -> None:
        """Play and compare."""
        from train.experiments.bench import bench, configuration

        if not bench(configuration(self.config, self.update), CONSOLE, self.update, self.output):
            sys.exit(1)


@dataclass
class Speed:
    """Measure throughput against raw mj_step on the same model, in one interleaved run.

    Timed are the vector environment, without and with a policy and a residual network in its loop; scalar environments,
    under the vector environments of Gymnasium and SB3 too; and PPO end to end.

    Example, the vector environment alone: elastic speed --env testbed --num-envs 64 1024 --no-others --no-ppo

    With --real-time one policy is timed alone, as on a robot: it is called with recorded observations, once in every
    control period. Printed are late cycles and latencies. Example: elastic speed --real-time --policy dynamic
    """

    env: str = "walker"
    """Environment: testbed or walker."""
    policy: str | None = None
    """Baseline in the loop, or "FILE.py:function"; default input_wrench on the walker, input on the testbed; with
    --real-time adaptive_posture on the walker."""
    num_envs: list[int] = field(default_factory=lambda: [64, 256])
    """Numbers of worlds."""
    others: bool = True
    """Time scalar environments too, alone and in vector environments of Gymnasium and SB3."""
    processes: list[int] = field(default_factory=lambda: [2, 4])
    """Numbers of processes to try with them."""
    ppo: bool = True
    """Time PPO end to end too."""
    profile: bool = False
    """Say where the time of the vector environment with its policy goes."""
    steps: int = 50
    """Control steps per round."""
    rounds: int = 7
    """Rounds; medians are reported."""
    threads: int = 0
    """Threads of both contenders, 0 for all cores."""
    real_time: bool = False
    """Time a policy alone against the clock, in place of all that; reads env, policy, seconds and output alone."""
    seconds: float = 60.0
    """How long, with --real-time [s]."""
    output: Path | None = None
    """Folder for speed.json and speed.csv, or real_time.json, new or empty; default runs/speed, numbered if taken."""

    def run(self) -> None:
        """Measure and report."""
        if self.real_time:
            self._run_real_time()
            return
        from train.speed.speed import SpeedConfig, measure_all

        with options_named():
            given = {name: value for name, value in vars(self).items() if name in SpeedConfig.model_fields}
            config = SpeedConfig(**given)
        CONSOLE.print(f"wrote {measure_all(config, CONSOLE, self.output, self.profile)}", soft_wrap=True)

    def _run_real_time(self) -> None:
        from train.speed.real_time import RealTimeConfig, measure_real_time

        with options_named():
            config = RealTimeConfig(env=self.env, policy=self.policy, seconds=self.seconds)
        CONSOLE.print(f"wrote {measure_real_time(config, CONSOLE, self.output)}", soft_wrap=True)
