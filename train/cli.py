"""The command `elastic`: identify, evaluate, compare, train, export, bench, speed, play, hardware, demo."""

import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro
import yaml
from rich.console import Console
from rich.markup import escape

from elastic_env.config import load_yaml, parse_yaml
from elastic_env.errors import ConfigurationError, ElasticError

_CONSOLE = Console()


@dataclass
class OnHardware:
    """Options of commands that run on the simulated testbed, or with --port on a real one."""

    port: str | None = None
    """Port of a real servo, such as /dev/ttyUSB0, in place of the simulation."""
    imu_port: str | None = None
    """Port of the IMU on its link."""
    mounting: Path | None = None
    """YAML file of signs, zeros, ids and limits of the real testbed, see docs/hardware.md."""
    yes: bool = False
    """Begin to move without asking."""

    @property
    def arguments(self) -> dict[str, Any]:
        """Arguments of the environment on hardware; empty for the simulation."""
        if self.port is None and self.mounting is None and self.imu_port is None and not self.yes:
            return {}
        from train.hardware import hardware_arguments

        return hardware_arguments(self.port, self.imu_port, self.mounting, self.yes)


@dataclass
class Identify:
    """Find the stiffness of the joint from static positions (Fig. 5 of the paper).

    Drives the testbed to its positions from both sides, averages encoder and IMU at rest, and separates stiffness,
    friction, dead band and offset. Writes identification.json, which the environment and the compensators take as their
    K, and a figure. Example: elastic identify --scenario backlash

    On a real joint: elastic identify --port /dev/ttyUSB0 --imu-port /dev/ttyACM0
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
    on: OnHardware = field(default_factory=OnHardware)

    def run(self) -> None:
        """Identify, write, print."""
        from train.identify import IdentifyConfig, run_identification

        with _options_named():
            given = {name: value for name, value in vars(self).items() if name not in ("output", "on")}
            config = IdentifyConfig(**given, hardware=self.on.arguments)
        run_identification(config, _CONSOLE, self.output)


@dataclass
class Evaluate:
    """Play episodes of one policy under one scenario and print its metrics.

    Example, one joint: elastic evaluate --policy input --scenario soft --reference multisine --episodes 10

    Example, a walk: elastic evaluate --env walker --policy input_wrench --reference 3
    """

    policy: str = "input"
    """Baseline, or "module:function" for one's own. Baselines are
    zero, uncompensated, input, dynamic, oracle; on the walker also
    uncompensated_open, input_open, input_output, input_wrench."""
    env: str = "testbed"
    """Environment: testbed (one joint; with --port a real one) or walker (a humanoid that walks in place)."""
    scenario: str = "nominal"
    """Scenario, such as nominal, ideal, soft, stiff, payload, backlash,
    sensor, ideal+soft; on the walker also spread, push, slope."""
    reference: str | None = None
    """Motion. Testbed: hold (default), sine, multisine, steps,
    or a mapping such as '{kind: sine, amplitude: 0.3}'.
    Walker: step period 24, 3 (default), 1.6 or 1.1 [s],
    or its durations of double, single, double support '[0.8, 0.6, 0.8]',
    or a mapping such as '{step_period: 3, num_steps: 2}'."""
    episodes: int = 1
    """Number of episodes, seeds following --seed."""
    seed: int = 0
    """Seed of the first episode."""
    stiffness: str | None = None
    """K that the policy assumes: a number [N·m/rad], a list of one per joint
    such as '[1001]', twelve on the walker, or the path of an identification.json."""
    output: Path | None = None
    """Folder for the results, new or empty; default runs/evaluate, numbered if taken."""
    on: OnHardware = field(default_factory=OnHardware)

    def run(self) -> None:
        """Evaluate as a comparison of one cell."""
        from train.compare import CompareConfig, compare
        from train.conditions import PolicySpec

        options = {} if self.stiffness is None else {"stiffness": _stiffness(self.stiffness)}
        arguments = self.on.arguments
        with _options_named():
            config = CompareConfig(
                name="evaluate", references=[_motion(self.env, self.reference)], **_place(self.env, arguments),
                scenarios=["hardware" if arguments else self.scenario],
                policies=[PolicySpec(name=self.policy, options=options)],
                episodes=self.episodes, seed=self.seed,
            )  # fmt: skip
        _print_files(compare(config, _CONSOLE, self.output, report=False))


@dataclass
class Compare:
    """Compare policies × scenarios × references × seeds as a configuration says.

    Writes episodes.csv (one row per episode), statistics.csv (paired changes), report.html (charts and tables, works
    offline), report.md, summary.md and figures beside the resolved configuration, seed, versions and commit.

    A policy residual:PATH may have a * in its path, such as residual:runs/NAME/seed_*/last: all training seeds of a
    residual, compared with their base on the same episodes, with intervals over training seeds. The base is added if
    it is not among the policies.

    Example, one joint: elastic compare configs/testbed.yaml

    Example, the paper's walks: elastic compare configs/paper.yaml

    Example, trained residuals: elastic compare configs/learned_testbed.yaml
    """

    config: Annotated[Path, tyro.conf.Positional]
    """YAML configuration, see configs/."""
    output: Path | None = None
    """Folder for the results, new or empty; default runs/<name>, numbered if taken."""
    jobs: int = 0
    """Conditions that run at the same time, 0 for one per core; on hardware they come one after the other."""
    on: OnHardware = field(default_factory=OnHardware)

    def run(self) -> None:
        """Compare."""
        from train.compare import CompareConfig, compare

        config, arguments = load_yaml(self.config, CompareConfig), self.on.arguments
        if arguments:
            place = _place(config.env, arguments)
            place["env_options"] = {**config.env_options, **place["env_options"]}
            config = config.replace(scenarios=["hardware"], scenario_episodes={}, **place)
        _print_files(compare(config, _CONSOLE, self.output, self.jobs))


@dataclass
class Train:
    """Train a residual on top of a base policy, for every training seed of a configuration.

    Example: elastic train configs/train_walker_3s.yaml, and if it was interrupted: elastic train --resume runs/NAME.
    A run keeps, for every seed, checkpoint/ to go on from, best/ and last/ as policies, which elastic evaluate and
    compare take as residual:PATH, progress.csv, and files for TensorBoard.
    """

    config: Annotated[Path | None, tyro.conf.Positional] = None
    """Configuration; those in configs/train_*.yaml are examples."""
    resume: Path | None = None
    """Folder of a run to go on with."""
    seeds: list[int] | None = None
    """Training seeds instead of the configuration's."""
    decisions: int | None = None
    """Decisions of all worlds together instead of the configuration's."""
    output: Path | None = None
    """Folder for the run, new or empty; default runs/<name>, numbered if taken."""
    jobs: int = 1
    """Seeds at a time, 0 for one per core; several share the cores, and all of them end sooner than one by one."""

    def run(self) -> None:
        """Train, or go on with it."""
        if self.jobs < 0:
            raise ConfigurationError(f"jobs must be >= 0, 0 for one per core, got {self.jobs}")
        if (self.config is None) == (self.resume is None):
            raise ConfigurationError("name either a configuration or, with --resume, the run to go on with")
        given = {"seeds": self.seeds, "decisions": self.decisions}
        changes = {name: value for name, value in given.items() if value is not None}
        if self.resume is not None and (changes or self.output is not None):
            raise ConfigurationError(
                "a run goes on as it was begun: --resume takes no --seeds, --decisions or --output"
            )
        try:
            from train.run_training import resume, start
            from train.train_config import TrainConfig
        except ModuleNotFoundError as error:
            raise ConfigurationError(
                f"training needs {error.name}; install the extra: pip install 'elastic-env[train]'"
            ) from None
        if self.resume is not None:
            folder = resume(self.resume, _CONSOLE, self.jobs)
        else:
            config = load_yaml(self.config, TrainConfig)  # type: ignore[arg-type]
            with _options_named():
                config = config.replace(**changes)
            folder = start(config, _CONSOLE, self.output, self.jobs)
        _CONSOLE.print(f"policies in {folder}/seed_*/best and last", soft_wrap=True)


@dataclass
class Export:
    """Turn a model that Stable-Baselines3 saved into a residual folder, which plays without torch and runs no code.

    Example: elastic export model.zip configs/train_walker_3s.yaml --normaliser normaliser.pkl --trust-pickle
    """

    model: Annotated[Path, tyro.conf.Positional]
    """Zip of model.save()."""
    config: Annotated[Path, tyro.conf.Positional]
    """Configuration of its training: algorithm, base, settings."""
    normaliser: Path | None = None
    """File of VecNormalize.save(); leave it out where observations were not normalised."""
    trust_pickle: bool = False
    """SB3 keeps models as pickles: loading one runs code from it."""
    output: Path | None = None
    """Folder for the residual, new or empty; default runs/<name of the zip>, numbered if taken."""

    def run(self) -> None:
        """Export."""
        from train.export import export_zip
        from train.runs import free_folder
        from train.train_config import TrainConfig

        folder = free_folder(self.model.stem, self.output)
        export_zip(self.model, load_yaml(self.config, TrainConfig), folder, self.normaliser, self.trust_pickle)
        _CONSOLE.print(f"play it as residual:{folder}", soft_wrap=True)


@dataclass
class Bench:
    """Guard figures in CI: short rollouts of both environments against what was accepted.

    Exit code 1, and a line for every figure that falls short. Appends its table to the file that $GITHUB_STEP_SUMMARY
    names. Example, to accept new figures: elastic bench --update
    """

    config: Annotated[Path, tyro.conf.Positional] = Path("configs/bench.yaml")
    """Configuration with rollouts and accepted figures."""
    update: bool = False
    """Accept what is measured now, and write the configuration anew."""
    output: Path | None = None
    """Folder for bench.json and bench.md, new or empty; default runs/bench, numbered if taken."""

    def run(self) -> None:
        """Play and compare."""
        from train.bench import bench

        if not bench(self.config, _CONSOLE, self.update, self.output):
            sys.exit(1)


@dataclass
class Speed:
    """Measure throughput against raw mj_step on the same model, in one interleaved run.

    Timed are the vector environment, without and with a policy and a residual network in its loop; scalar environments,
    under the vector environments of Gymnasium and SB3 too; and PPO end to end.

    Example, the vector environment alone: elastic speed --env testbed --num-envs 64 1024 --no-others --no-ppo
    """

    env: str = "walker"
    """Environment: testbed or walker."""
    policy: str | None = None
    """Baseline in the loop, or "module:function"; default input_wrench on the walker, input on the testbed."""
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
    output: Path | None = None
    """Folder for speed.json, new or empty; default runs/speed, numbered if taken."""

    def run(self) -> None:
        """Measure and report."""
        from train.speed import SpeedConfig, measure_all

        with _options_named():
            given = {name: value for name, value in vars(self).items() if name not in ("output", "profile")}
            config = SpeedConfig(**given)
        _CONSOLE.print(f"wrote {measure_all(config, _CONSOLE, self.output, self.profile)}", soft_wrap=True)


@dataclass
class Play:
    """Watch one episode: in a window in real time, or with --video as a file.

    Deviations from the reference are drawn enlarged, by a factor that the picture shows.

    Example, one joint: elastic play --policy input --reference sine --video sine.mp4

    Example, a walk: elastic play --env walker --policy input_output --video walk.mp4
    """

    policy: str = "uncompensated"
    """Baseline, or "module:function" for one's own; see elastic evaluate --help."""
    env: str = "testbed"
    """Environment: testbed or walker."""
    scenario: str = "nominal"
    """Scenario."""
    reference: str | None = None
    """Motion, as in elastic evaluate; default sine, on the walker 3."""
    seed: int = 0
    """Seed of the episode."""
    video: Path | None = None
    """Video file to write (.mp4, .gif); without it a window opens."""
    max_s: float | None = None
    """Stop after this much simulated time [s]."""

    def run(self) -> None:
        """Play."""
        from train.conditions import Condition, PolicySpec
        from train.play import play

        reference = "sine" if self.reference is None and self.env == "testbed" else self.reference
        with _options_named():
            condition = Condition(
                env=self.env, policy=PolicySpec(name=self.policy), reference=_motion(self.env, reference),
                scenario=self.scenario, seed=self.seed,
            )  # fmt: skip
        play(condition, _CONSOLE, self.video, self.max_s)


@dataclass
class Demo:
    """The paper's experiments in short, on testbed and walker, in under two minutes, with pictures."""

    output: Path | None = None
    """Folder for the results, new or empty; default runs/demo, numbered if taken."""

    def run(self) -> None:
        """Run the demonstration."""
        from train.demo import demo

        demo(_CONSOLE, self.output)


@dataclass
class Scan:
    """List the servos at a port, with model and firmware; nothing moves."""

    port: Annotated[str, tyro.conf.Positional]
    """Port, such as /dev/ttyUSB0."""
    baudrate: int | None = None
    """Bits per second; default: the usual rates, one after the other."""

    def run(self) -> None:
        """Scan."""
        from train.hardware import scan

        if not scan(self.port, self.baudrate, _CONSOLE):
            sys.exit(1)


@dataclass
class Check:
    """Look at port, servos and IMU before anything moves, and say what to do; exit code 1 where something is."""

    port: Annotated[str, tyro.conf.Positional]
    """Port, such as /dev/ttyUSB0."""
    ids: list[int] = field(default_factory=lambda: [1])
    """Ids of the servos."""
    baudrate: int = 3_000_000
    """Bits per second."""
    imu_port: str | None = None
    """Port of the IMU."""

    def run(self) -> None:
        """Check."""
        from train.hardware import check

        if not check(self.port, self.ids, self.baudrate, self.imu_port, _CONSOLE):
            sys.exit(1)


@dataclass
class Run:
    """Play one episode on the real testbed, show it as it goes, and keep every step.

    Example: elastic hardware run --port /dev/ttyUSB0 --imu-port /dev/ttyACM0 --policy input --reference sine
    """

    policy: str = "uncompensated"
    """Baseline, residual:PATH, or "module:function" for one's own."""
    reference: str | None = None
    """Motion, as in elastic evaluate; default hold."""
    output: Path | None = None
    """Folder for log.csv and metrics.json, new or empty; default runs/hardware, numbered if taken."""
    on: OnHardware = field(default_factory=OnHardware)

    def run(self) -> None:
        """Play."""
        from train.conditions import PolicySpec
        from train.hardware import run

        if not (arguments := self.on.arguments):
            raise ConfigurationError("--port is needed; see: elastic hardware scan, elastic hardware emulate")
        path = run(arguments, _motion("hardware", self.reference), PolicySpec(name=self.policy), _CONSOLE, self.output)
        _CONSOLE.print(f"wrote {path}", soft_wrap=True)


@dataclass
class Emulate:
    """Emulate servos and an IMU on pseudo-terminals until Ctrl-C, for trying everything without hardware.

    Behind them moves the simulated joint, in real time. Example, a bad cable: elastic hardware emulate --lost 0.01
    """

    ids: list[int] = field(default_factory=lambda: [1])
    """Ids of the servos; the IMU is on the link of the first."""
    model_number: int = 54024
    """Type of the servos: 54024, 54025 or 2020."""
    scenario: str = "nominal"
    """Scenario of the joint and of the IMU, as in elastic identify."""
    stiffness: float | None = None
    """K of the joint [N·m/rad]; default the paper's 1001."""
    lost: float = 0.0
    """Share of replies that do not come."""
    late: float = 0.0
    """Share of replies that come 6 ms late."""
    corrupted: float = 0.0
    """Share of replies with a flipped bit."""
    truncated: float = 0.0
    """Share of replies that end too early."""
    latency_ms: float = 1.0
    """Latency timer of the emulated USB adapter."""
    seed: int = 0
    """Seed of noise and faults."""

    def run(self) -> None:
        """Emulate."""
        from elastic_env.entry_points import configure_testbed
        from elastic_env.hardware.emulator.config import EmulatorConfig
        from elastic_env.hardware.emulator.faults import Faults
        from train.hardware import emulate

        faults = Faults(
            lost=self.lost, late=self.late, corrupted=self.corrupted, truncated=self.truncated,
            latency_s=1e-3 * self.latency_ms,
        )  # fmt: skip
        config = EmulatorConfig(
            ids=tuple(self.ids), model_number=self.model_number, faults=faults, seed=self.seed,
            testbed=configure_testbed(scenario=self.scenario, stiffness=self.stiffness),
        )  # fmt: skip
        emulate(config, _CONSOLE)


@dataclass
class Prove:
    """Measure what driver, limits and supervisor do when things go wrong, against an emulated bus.

    Long: about 25 minutes; --share 0.02 makes a short one. Exit code 1 if something is not as it must be.
    """

    share: float = 1.0
    """Share of the repetitions and durations."""
    only: list[str] = field(default_factory=list)
    """Names of the measurements; default all."""
    output: Path | None = None
    """Folder for hardware.json, new or empty; default runs/prove, numbered if taken."""

    def run(self) -> None:
        """Measure."""
        from train.prove_hardware import prove

        if not prove(self.share, self.only, _CONSOLE, self.output):
            sys.exit(1)


@dataclass
class Hardware:
    """The testbed on real hardware, or on an emulated bus: scan, check, run, emulate, prove."""

    command: (
        Annotated[Scan, tyro.conf.subcommand("scan")]
        | Annotated[Check, tyro.conf.subcommand("check")]
        | Annotated[Run, tyro.conf.subcommand("run")]
        | Annotated[Emulate, tyro.conf.subcommand("emulate")]
        | Annotated[Prove, tyro.conf.subcommand("prove")]
    )

    def run(self) -> None:
        """Do what was asked for."""
        self.command.run()


Command = (
    Annotated[Identify, tyro.conf.subcommand("identify")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Compare, tyro.conf.subcommand("compare")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
    | Annotated[Speed, tyro.conf.subcommand("speed")]
    | Annotated[Play, tyro.conf.subcommand("play")]
    | Annotated[Hardware, tyro.conf.subcommand("hardware")]
    | Annotated[Demo, tyro.conf.subcommand("demo")]
)


def main(arguments: list[str] | None = None) -> None:
    """Entry point of the command `elastic`."""
    if "" not in sys.path and str(Path.cwd()) not in sys.path:
        sys.path.append(str(Path.cwd()))  # as with python -m, for --policy module:function
    command: Any = tyro.cli(
        Command, prog="elastic", args=arguments,
        config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes),
        description="Elastic joints: simulate, identify, compensate, compare. `elastic COMMAND --help` explains each.",
    )  # fmt: skip
    try:
        command.run()
    except ElasticError as error:
        Console(stderr=True).print(f"[bold red]error:[/] {escape(str(error))}", highlight=False, soft_wrap=True)
        sys.exit(2)
    except KeyboardInterrupt:
        Console(stderr=True).print("interrupted")
        os._exit(130)  # worker processes must not keep the terminal waiting


def _place(env: str, arguments: dict[str, Any]) -> dict[str, Any]:
    """Where a comparison plays: the named environment, or with arguments of hardware a real testbed."""
    if not arguments:
        return {"env": env}
    if env not in ("testbed", "hardware"):
        raise ConfigurationError(f"--port is of the testbed, got the environment {env!r}")
    return {"env": "hardware", "env_options": arguments}


_PARAMETER = re.compile(r"^(?:(?:\w+Config|Condition)\.(\w+)|(reference)s?)(?:\.\d+)?(?=:| must be )", re.MULTILINE)


@contextmanager
def _options_named() -> Iterator[None]:
    """Errors of a configuration that is made from options name the options in place of its parameters."""
    try:
        yield
    except ConfigurationError as error:
        named = _PARAMETER.sub(lambda found: "--" + (found[1] or found[2]).replace("_", "-"), str(error))
        raise ConfigurationError(named) from None


def _motion(env: str, text: str | None) -> Any:
    """A reference as it is written: a name, a number, durations or a mapping; the environment's default for None."""
    from train.environments import environment

    default = environment(env).default_reference
    if text is None:
        return default
    try:
        value = parse_yaml(text)
    except yaml.YAMLError:
        raise ConfigurationError(
            f"{text!r} is no name, number, list or mapping such as '{{kind: sine, amplitude: 0.3}}' or "
            "'{step_period: 3, num_steps: 2}'"
        ) from None
    return value if isinstance(value, int | float | list | dict) else text


def _stiffness(text: str) -> float | list[Any] | str:
    """A stiffness as it is written: a number, a list of numbers, or else the path of a file."""
    try:
        value = parse_yaml(text)
    except yaml.YAMLError:
        return text
    return value if isinstance(value, int | float | list) and not isinstance(value, bool) else text


def _print_files(comparison: Any) -> None:
    _CONSOLE.print(f"Results in {comparison.folder}:", soft_wrap=True)
    for path in comparison.files:
        _CONSOLE.print(f"  {path}", soft_wrap=True)
