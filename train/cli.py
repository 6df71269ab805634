"""The command `elastic`: identify, evaluate, compare, speed, play, demo."""

import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import gymnasium
import tyro
import yaml
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

import elastic_env  # noqa: F401  registers the environments
from elastic_env.config import load_yaml
from elastic_env.errors import ConfigurationError, ElasticError

_CONSOLE = Console()


@dataclass
class Identify:
    """Find the stiffness of the joint from static positions (Fig. 5 of the paper).

    Drives the testbed to its positions from both sides, averages encoder and IMU at rest, and separates stiffness,
    friction, dead band and offset. Writes identification.json, which the environment and the compensators take as their
    K, and a figure. Example: elastic identify --scenario backlash
    """

    scenario: str = "nominal"
    """Scenario of the simulated testbed, such as nominal, ideal, backlash, ideal+soft."""
    stiffness: float | None = None
    """True K of the simulated joint [N·m/rad]; default the paper's 1001."""
    second_mass: float | None = None
    """Repeat with the pendulum's mass times this factor, which separates an IMU error ~ sin q from K; such as 0.5."""
    positions: int = 20
    """Number of static positions."""
    seed: int = 0
    """Seed of the sensor noise."""
    repeats: int = 1
    """Repeat with so many seeds and say how often the interval holds the true stiffness."""
    output: Path | None = None
    """Folder for the results, new or empty; default runs/identify, numbered if taken."""

    def run(self) -> None:
        """Identify, write, print."""
        from baselines.identification import identify
        from elastic_env.robots.testbed import Pendulum
        from train import plots
        from train.runs import new_run

        if self.repeats < 1:
            raise ConfigurationError(f"repeats must be at least 1, got {self.repeats}")
        plots.require_matplotlib()
        pendulums = [Pendulum()]
        if self.second_mass is not None:
            pendulums.append(Pendulum().with_mass_scaled(self.second_mass))
        envs: list[Any] = [
            gymnasium.make_vec(
                "elastic_env/Testbed-v0", num_envs=self.repeats, vectorization_mode="vector_entry_point",
                reference={"kind": "hold", "positions": self.positions}, scenario=self.scenario,
                stiffness=self.stiffness, pendulum=pendulum,
            )
            for pendulum in pendulums
        ]  # fmt: skip
        folder = new_run("identify", _settings(self), self.seed, self.output)
        with _bar("visiting static positions") as (bar, task):
            results, points = identify(envs, self.seed, lambda share: bar.update(task, completed=share))
        results[0].save(folder / "identification.json")
        models = [env.unwrapped.assumed_model for env in envs]
        figure = plots.draw_identification(results[0], points[0], models, folder / "identification.png")
        _print_identification(results[0])
        if self.repeats > 1:
            truth = float(envs[0].unwrapped.truth().model.stiffness[0])
            _print_repeats(results, truth, self.seed, folder / "repeats.csv")
        _CONSOLE.print(f"wrote {folder / 'identification.json'} and {figure}", soft_wrap=True)


@dataclass
class Evaluate:
    """Play episodes of one policy under one scenario and print its metrics.

    Example: elastic evaluate --policy input --scenario soft --reference multisine --episodes 10
    """

    policy: str = "input"
    """Baseline (zero, uncompensated, input, dynamic, oracle), or "module:function" for one's own."""
    env: str = "testbed"
    """Environment."""
    scenario: str = "nominal"
    """Scenario, such as nominal, ideal, soft, stiff, payload, backlash, sensor, ideal+soft."""
    reference: str = "hold"
    """Reference: hold, sine, multisine, steps; or a mapping such as '{kind: sine, amplitude: 0.3}'."""
    episodes: int = 1
    """Number of episodes, seeds following --seed."""
    seed: int = 0
    """Seed of the first episode."""
    stiffness: str | None = None
    """K that the policy assumes: a number [N·m/rad] or the path of an identification.json."""
    output: Path | None = None
    """Folder for the results, new or empty; default runs/evaluate, numbered if taken."""

    def run(self) -> None:
        """Evaluate as a comparison of one cell."""
        from train.compare import CompareConfig, compare
        from train.evaluate import PolicySpec

        options = {} if self.stiffness is None else {"stiffness": _number_or_path(self.stiffness)}
        config = CompareConfig(
            name="evaluate", env=self.env, references=[_name_or_mapping(self.reference)], scenarios=[self.scenario],
            policies=[PolicySpec(name=self.policy, options=options)], episodes=self.episodes, seed=self.seed,
        )  # fmt: skip
        _print_files(compare(config, _CONSOLE, self.output))


@dataclass
class Compare:
    """Compare policies × scenarios × references × seeds as a configuration says.

    Writes episodes.csv (one row per episode), summary.md and figures beside the resolved configuration, seed, versions
    and commit. Example: elastic compare configs/testbed.yaml
    """

    config: Annotated[Path, tyro.conf.Positional]
    """YAML configuration, see configs/."""
    output: Path | None = None
    """Folder for the results, new or empty; default runs/<name>, numbered if taken."""
    jobs: int = 0
    """Conditions that run at the same time, 0 for one per core."""

    def run(self) -> None:
        """Compare."""
        from train.compare import CompareConfig, compare

        _print_files(compare(load_yaml(self.config, CompareConfig), _CONSOLE, self.output, self.jobs))


@dataclass
class Speed:
    """Measure the vector environment against raw mj_step on the same model, in one interleaved run."""

    num_envs: list[int] = field(default_factory=lambda: [64, 1024])
    """Numbers of worlds."""
    steps: int = 50
    """Control steps per round."""
    rounds: int = 7
    """Rounds; medians are reported."""
    threads: int = 0
    """Threads of both contenders, 0 for all cores."""
    output: Path | None = None
    """Folder for speed.json, new or empty; default runs/speed, numbered if taken."""

    def run(self) -> None:
        """Measure and report."""
        from train.speed import measure, report

        results = []
        with _bar("measuring") as (bar, task):
            for i, n in enumerate(self.num_envs):
                results.append(measure(n, self.steps, self.rounds, self.threads))
                bar.update(task, completed=(i + 1) / len(self.num_envs))
        _CONSOLE.print(f"wrote {report(results, _CONSOLE, self.output)}", soft_wrap=True)


@dataclass
class Play:
    """Watch one episode: in a window in real time, or with --video as a file.

    Deviations from the reference are drawn enlarged, by a factor that the picture shows.
    Example: elastic play --policy input --reference sine --video sine.mp4
    """

    policy: str = "uncompensated"
    """Baseline, or "module:function" for one's own."""
    env: str = "testbed"
    """Environment."""
    scenario: str = "nominal"
    """Scenario."""
    reference: str = "sine"
    """Reference: hold, sine, multisine, steps; or a mapping such as '{kind: sine, amplitude: 0.3}'."""
    seed: int = 0
    """Seed of the episode."""
    video: Path | None = None
    """Video file to write (.mp4, .gif); without it a window opens."""
    max_s: float | None = None
    """Stop after this much simulated time [s]."""

    def run(self) -> None:
        """Play."""
        from train.evaluate import ENVIRONMENTS, Condition, PolicySpec
        from train.play import play

        if self.env not in ENVIRONMENTS:
            raise ConfigurationError(f"unknown environment {self.env!r}; choose one of: {', '.join(ENVIRONMENTS)}")
        condition = Condition(
            env=self.env, policy=PolicySpec(name=self.policy), reference=_name_or_mapping(self.reference),
            scenario=self.scenario, seed=self.seed,
        )  # fmt: skip
        play(condition, _CONSOLE, self.video, self.max_s)


@dataclass
class Demo:
    """The paper's two testbed experiments and a motion, in under a minute, with pictures."""

    output: Path | None = None
    """Folder for the results, new or empty; default runs/demo, numbered if taken."""

    def run(self) -> None:
        """Run the demonstration."""
        from train.demo import demo

        demo(_CONSOLE, self.output)


Command = (
    Annotated[Identify, tyro.conf.subcommand("identify")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Compare, tyro.conf.subcommand("compare")]
    | Annotated[Speed, tyro.conf.subcommand("speed")]
    | Annotated[Play, tyro.conf.subcommand("play")]
    | Annotated[Demo, tyro.conf.subcommand("demo")]
)


def main(arguments: list[str] | None = None) -> None:
    """Entry point of the command `elastic`."""
    command: Any = tyro.cli(
        Command, prog="elastic", args=arguments,
        description="Elastic joints: simulate, identify, compensate, compare. `elastic COMMAND --help` explains each.",
    )  # fmt: skip
    try:
        command.run()
    except ElasticError as error:
        Console(stderr=True).print(f"[bold red]error:[/] {error}", highlight=False, soft_wrap=True)
        sys.exit(2)
    except KeyboardInterrupt:
        Console(stderr=True).print("interrupted")
        os._exit(130)  # worker processes must not keep the terminal waiting


def _bar(title: str) -> Any:
    return _ProgressBar(title)


class _ProgressBar:
    """A progress bar from 0 to 1 as a context manager: the bar and its task."""

    def __init__(self, title: str) -> None:
        columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn()
        self._bar, self._title = Progress(*columns, console=_CONSOLE, transient=True), title

    def __enter__(self) -> tuple[Progress, Any]:
        self._bar.start()
        return self._bar, self._bar.add_task(self._title, total=1.0)

    def __exit__(self, *_: object) -> None:
        self._bar.stop()


def _settings(command: Any) -> dict[str, Any]:
    return {name: str(v) if isinstance(v, Path) else v for name, v in vars(command).items() if name != "output"}


def _name_or_mapping(text: str) -> str | dict[str, Any]:
    value = yaml.safe_load(text)
    return value if isinstance(value, dict) else text


def _number_or_path(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def _print_files(comparison: Any) -> None:
    _CONSOLE.print(f"Results in {comparison.folder}:", soft_wrap=True)
    for path in comparison.files:
        _CONSOLE.print(f"  {path}", soft_wrap=True)


def _print_identification(result: Any) -> None:
    from rich.table import Table

    table = Table(title="identification", show_header=False)
    low, high = result.stiffness_low_nm_per_rad, result.stiffness_high_nm_per_rad
    rows = [
        ("stiffness K", f"{result.stiffness_nm_per_rad:.1f} N·m/rad"),
        ("  95 % interval", f"{low:.1f} to {high:.1f} (± {100 * result.half_width:.2f} %)"),
        ("  plain line", f"{result.line_stiffness_nm_per_rad:.1f} N·m/rad, Pearson r {result.pearson_r:.4f}"),
        ("friction", f"{result.friction_nm:.2f} N·m ({result.friction_low_nm:.2f} to {result.friction_high_nm:.2f})"),
        ("dead band", f"{1e3 * result.dead_band_rad:.2f} mrad"),
        ("offset", f"{1e3 * result.offset_rad:+.2f} mrad"),
        ("directions differ", "yes (hysteresis)" if result.hysteresis else "no"),
        ("residual spread", f"{1e3 * result.residual_rad:.3f} mrad"),
        ("points", f"{result.points} at {result.positions} positions"),
    ]
    if result.imu_sine_error_rad is not None:
        rows.insert(6, ("IMU error ~ sin q", f"{1e3 * result.imu_sine_error_rad:+.2f} mrad"))
    for name, value in rows:
        table.add_row(name, value)
    _CONSOLE.print(table)


def _print_repeats(results: list[Any], truth: float, seed: int, path: Path) -> None:
    """Spread over the seeds and coverage of the intervals, and one row per seed in a file."""
    import csv

    import numpy as np

    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, ["seed", *results[0].model_dump()])
        writer.writeheader()
        writer.writerows({"seed": seed + i, **result.model_dump()} for i, result in enumerate(results))
    stiffness = np.array([result.stiffness_nm_per_rad for result in results])
    covered = sum(r.stiffness_low_nm_per_rad <= truth <= r.stiffness_high_nm_per_rad for r in results)
    widest = max(result.half_width for result in results)
    _CONSOLE.print(
        f"{len(results)} seeds: K median {np.median(stiffness):.1f}, {stiffness.min():.1f} to {stiffness.max():.1f} "
        f"N·m/rad (true {truth:g}); friction median {np.median([r.friction_nm for r in results]):.2f} N·m; "
        f"r median {np.median([r.pearson_r for r in results]):.4f}; plain line median "
        f"{np.median([r.line_stiffness_nm_per_rad for r in results]):.1f}\n"
        f"the 95 % interval holds the true K in {covered} of {len(results)}, half-width at most {100 * widest:.2f} %"
    )
    _CONSOLE.print(f"wrote {path}", soft_wrap=True)
