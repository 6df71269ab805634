"""Commands that play policies: identify, evaluate, compare, play, robot, view, demo."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, cast

import tyro

from elastic_env.core.config import load_yaml
from elastic_env.core.errors import ConfigurationError
from train.commands.options import (
    CONSOLE,
    DEFAULT_SCENARIO,
    OfArm,
    OnHardware,
    motion,
    options_named,
    place,
    scenario_played,
    stiffness_option,
)


@dataclass
class Identify:
    """Find the stiffness of the joint from static positions (Fig. 5 of the paper).

    Drives the testbed to its positions from both sides, averages encoder and IMU at rest, and separates stiffness,
    friction, dead band and offset. Writes identification.json, which the environment and the compensators take as their
    K, and a figure. Example: elastic identify --scenario backlash

    On a real joint: elastic identify --port /dev/ttyUSB0 --imu-port /dev/ttyACM0

    An arm from a log of static poses, with joints.yaml for compensator and environment, see docs/identification.md:
    elastic identify --robot arm.urdf --log poses.csv --end-effector tool0 --plan 20
    """

    scenario: str | None = None
    """Scenario of the simulated testbed, such as nominal (default), ideal, backlash, ideal+soft."""
    stiffness: float | None = None
    """True K of the simulated joint [N·m/rad]; default the paper's 1001."""
    second_mass: float | None = None
    """Repeat with the pendulum's mass times this factor, which separates an IMU error ~ sin q from K; such as 0.5."""
    positions: int = 20
    """Number of static positions, at least 5; on a real joint 5 take three minutes, 20 take five."""
    seed: int = 0
    """Seed of the sensor noise."""
    repeats: int = 1
    """Repeat with so many seeds and say how often the interval holds the true stiffness."""
    output: Path | None = None
    """Folder for the results, new or empty; default runs/identify, numbered if taken."""
    on: OnHardware = field(default_factory=OnHardware)
    arm: OfArm = field(default_factory=OfArm)

    def run(self) -> None:
        """Identify, write, print."""
        if self.arm.given:
            self._run_arm()
            return
        from train.experiments.identify import IdentifyConfig, run_identification

        arguments = self.on.arguments
        with options_named():
            others = ("output", "on", "scenario", "arm")
            given = {name: value for name, value in vars(self).items() if name not in others}
            config = IdentifyConfig(**given, scenario=scenario_played(self.scenario, arguments), hardware=arguments)
        run_identification(config, CONSOLE, self.output)

    def _run_arm(self) -> None:
        """Identify an arm from a log."""
        from train.experiments.identify_arm import IdentifyArmConfig, run_arm_identification

        of_testbed = Identify(seed=self.seed, output=self.output, arm=self.arm)
        if others := [name for name, value in vars(self).items() if value != getattr(of_testbed, name)]:
            names = ", ".join(
                "--port and the like" if name == "on" else f"--{name.replace('_', '-')}" for name in others
            )
            raise ConfigurationError(f"options of the testbed: {names}; leave them out beside --robot and --log")
        with options_named():
            config = IdentifyArmConfig(**self.arm.given, seed=self.seed)
        run_arm_identification(config, CONSOLE, self.output)


@dataclass
class Evaluate:
    """Play episodes of one policy under one scenario and print its metrics.

    Example, one joint: elastic evaluate --policy input --scenario soft --reference multisine --episodes 10

    Example, a walk: elastic evaluate --env walker --policy input_wrench --reference 3
    """

    policy: str = "input"
    """Baseline, residual:PATH, or "FILE.py:function" or "module:function" for one's own.
    Baselines (see Policies in the docs) are
    zero, uncompensated, input, dynamic, link_encoder,
    iterative, oracle; on a fixed base also friction,
    disturbance_observer; on the walker also
    uncompensated_open, input_open, input_output,
    input_wrench, adaptive, posture, adaptive_posture,
    torque_sensor, hip_sensor, thormang, talos."""
    env: str = "testbed"
    """Environment: testbed (one joint; with --port a real one), walker (a humanoid that walks in place),
    robot, ROBOT.yaml (a file of any robot, see docs/robots.md), or "FILE.py:ROBOT", a JointRobot."""
    scenario: str | None = None
    """Scenario, such as nominal (default), ideal, soft, stiff, spread, payload, backlash,
    sensor, ideal+soft; on the walker also imu, push, slope, drawn, drawn_beyond."""
    reference: str | None = None
    """Motion. Testbed: hold (default; takes 20 to 60 s), sine, multisine, steps (some seconds),
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
        from train.evaluate.conditions import PolicySpec
        from train.experiments.compare import CompareConfig, compare

        options = {} if self.stiffness is None else {"stiffness": stiffness_option(self.stiffness)}
        arguments = self.on.arguments
        with options_named():
            config = CompareConfig(
                name="evaluate", references=[motion(self.env, self.reference)],
                **place(self.env, arguments),
                scenarios=[scenario_played(self.scenario, arguments)],
                policies=[PolicySpec(name=self.policy, options=options)],
                episodes=self.episodes, seed=self.seed,
            )  # fmt: skip
        _print_files(compare(config, CONSOLE, self.output, report=False))


@dataclass
class Compare:
    """Compare policies × scenarios × references × seeds as a configuration says.

    Writes episodes.csv (one row per episode), statistics.csv (paired changes), report.html (charts and tables, works
    offline), report.md, summary.md and figures beside the resolved configuration, seed, versions and commit.

    A policy residual:PATH may have a * in its path, such as residual:runs/NAME/seed_*/last: all training seeds of a
    residual, compared with their base on the same episodes, with intervals over training seeds. The base is added if
    it is not among the policies. residual:walker_3s/seed_* and the like are the trained ones of the package.

    Example, one joint: elastic compare configs/testbed.yaml

    Example, the paper's walks: elastic compare configs/paper.yaml

    Example, trained residuals: elastic compare configs/learned_testbed.yaml

    Example, all policies in tracks by what they need: elastic compare configs/leaderboard.yaml

    Example, heat maps over two axes: elastic compare configs/map_payload_slope.yaml
    """

    config: Annotated[Path | None, tyro.conf.Positional] = None
    """YAML configuration, see configs/; with --resume the one of the run unless another is named."""
    output: Path | None = None
    """Folder for the results, new or empty; default runs/<name>, numbered if taken."""
    jobs: int = 0
    """Conditions that run at the same time, 0 for one per core; on hardware they come one after the other."""
    on: str = "local"
    """Where they run: local, dask://HOST:PORT of a scheduler, slurm, or slurm:FILE.yaml; see docs/cluster.md."""
    resume: Path | None = None
    """Folder of a run to go on with: what is missing or has changed is played."""
    fresh: bool = False
    """With --resume: play all cells again."""
    trust_code: bool = False
    """With --resume and no configuration: run the code that the run's own names."""
    hardware: OnHardware = field(default_factory=OnHardware)

    def run(self) -> None:
        """Compare."""
        from train.experiments.compare import CompareConfig, Work, compare, recorded
        from train.workers.places import Place

        self._require()
        if self.config is not None:
            config = load_yaml(self.config, CompareConfig)
        else:
            config = recorded(cast(Path, self.resume), self.trust_code)
        if arguments := self.hardware.arguments:
            real = place(config.env, arguments)
            real["env_options"] = {**config.env_options, **real["env_options"]}
            config = config.replace(scenarios=["hardware"], scenario_episodes={}, groups={}, **real)
        work = Work(Place(self.on, self.jobs), self.resume is not None, self.fresh)
        _print_files(compare(config, CONSOLE, self.resume or self.output, work))

    def _require(self) -> None:
        if self.config is None and self.resume is None:
            raise ConfigurationError("name a configuration or, with --resume, the run to go on with")
        if self.resume is not None and self.output is not None:
            raise ConfigurationError("a run goes on in its own folder: --resume takes no --output")
        if self.resume is None and self.fresh:
            raise ConfigurationError("--fresh needs --resume; a new run plays all of its cells")


@dataclass
class Play:
    """Watch one episode: in a window in real time, or with --video as a file.

    Deviations from the reference are drawn enlarged, by a factor that the picture shows.

    Example, one joint: elastic play --policy input --reference sine --video sine.mp4

    Example, a walk: elastic play --env walker --policy input_output --video walk.mp4
    """

    policy: str = "uncompensated"
    """Baseline, residual:PATH, or "FILE.py:function" for one's own; see elastic evaluate --help."""
    env: str = "testbed"
    """Environment: testbed, walker, robot, ROBOT.yaml (a file of any robot, see docs/robots.md),
    or "FILE.py:ROBOT", a JointRobot."""
    scenario: str = DEFAULT_SCENARIO
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
        from train.experiments.play import play

        play(_watched(self), CONSOLE, self.video, self.max_s)


@dataclass
class Robot:
    """Try a robot of your own: make its joints elastic, play it with and without compensation, and say what it gains.

    Plays static poses and a motion with the policies uncompensated, input and dynamic, in the scenario nominal: with
    friction and encoders as the joints file has them. Prints the error of the end effector [mm], and how much of it
    comes from each joint. The folder has robot.yaml (for --env of the other commands), joints.yaml, picture.png,
    end_effector.csv, joints.csv, and a comparison with report.html.

    Example: elastic robot arm.urdf --stiffness joints.yaml --end-effector tool0

    Example, one K for all hinges: elastic robot arm.xml --stiffness 1000

    Example, an arm of the gallery (extra robots): elastic robot panda
    """

    model: Annotated[str, tyro.conf.Positional]
    """File of MJCF (.xml) or URDF (.urdf) of a robot on a fixed base, ROBOT.yaml (a file of a robot, see
    docs/robots.md), or a name of the gallery, such as panda, ur5, xarm7, so101."""
    stiffness: str | None = None
    """YAML file of the elastic joints, or one K of all hinges [N·m/rad]. Has no default, as K is a property of your
    robot; elastic identify --robot finds it. K of the gallery is assumed."""
    end_effector: str | None = None
    """Site or body that is to be placed; default that of the robot's file or of the gallery, or the outermost body."""
    motion: str = "{kind: moves, positions: 4}"
    """Motion beside the static poses: moves, line, circle, sine, multisine, or a mapping of kind and parameters."""
    seed: int = 0
    """Seed of the episodes."""
    output: Path | None = None
    """Folder for the results, new or empty; default runs/robot, numbered if taken."""
    video: bool = False
    """Film the motion, uncompensated and with input. Off by default: a second of motion is 50 frames to draw."""

    def run(self) -> None:
        """Play, write, print."""
        from train.experiments.robot import RobotTrial, try_robot

        stiffness: Any = None if self.stiffness is None else stiffness_option(self.stiffness)
        with options_named():
            trial = RobotTrial(
                model=self.model, stiffness=stiffness, end_effector=self.end_effector,
                motion=motion("robot", self.motion), seed=self.seed,
            )  # fmt: skip
        result = try_robot(trial, CONSOLE, self.output, self.video)
        CONSOLE.print(f"Results in {result.folder}:", soft_wrap=True)
        for path in result.files:
            CONSOLE.print(f"  {path}", soft_wrap=True)


@dataclass
class View:
    """Look at one episode in the browser: reference, motor side and link side of the robot, side by side.

    The episode is played first, then shown again and again by MuJoCo's web viewer until Ctrl-C. Sliders set the time,
    and the factor by which deviations from the reference are enlarged. The page is reached from this machine alone, at
    the address that is printed, with its token; from elsewhere by: ssh -L 8080:127.0.0.1:8080 MACHINE

    Example, one joint: elastic view --policy input --reference sine

    Example, a walk: elastic view --env walker --policy input_output --scenario soft
    """

    policy: str = "uncompensated"
    """Baseline, residual:PATH, or "FILE.py:function" for one's own; see elastic evaluate --help."""
    env: str = "testbed"
    """Environment: testbed, walker, or "FILE.py:ROBOT", an elastic_env.JointRobot of one's own."""
    scenario: str = DEFAULT_SCENARIO
    """Scenario."""
    reference: str | None = None
    """Motion, as in elastic evaluate; default sine, on the walker 3."""
    seed: int = 0
    """Seed of the episode."""
    host: str = "127.0.0.1"
    """Address or name of this machine at which the page listens; 0.0.0.0 for all, then others reach it too."""
    port: int = 0
    """Port of the page; 0 takes the first free one from 8080 on."""
    max_s: float | None = None
    """Show the first so many seconds only [s]."""

    def run(self) -> None:
        """Play and show."""
        from train.experiments.view import PageOptions, view

        view(_watched(self), CONSOLE, PageOptions(self.host, self.port, self.max_s))


@dataclass
class Demo:
    """The paper's experiments in short, on testbed and walker, in some minutes, with pictures."""

    output: Path | None = None
    """Folder for the results, new or empty; default runs/demo, numbered if taken."""

    def run(self) -> None:
        """Run the demonstration."""
        from train.experiments.demo import demo

        demo(CONSOLE, self.output)


def _watched(command: Play | View) -> Any:
    """The condition of an episode that somebody watches."""
    from train.evaluate.conditions import Condition, PolicySpec
    from train.evaluate.environments import environment

    watched = environment(command.env).watched_reference if command.reference is None else None
    with options_named():
        return Condition(
            env=command.env, policy=PolicySpec(name=command.policy), scenario=command.scenario, seed=command.seed,
            reference=motion(command.env, command.reference) if watched is None else watched,
        )  # fmt: skip


def _print_files(comparison: Any) -> None:
    """Say what a comparison wrote."""
    CONSOLE.print(f"Results in {comparison.folder}:", soft_wrap=True)
    for path in comparison.files:
        CONSOLE.print(f"  {path}", soft_wrap=True)
