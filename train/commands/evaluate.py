"""`elastic evaluate`: episodes of one policy under one scenario."""

from pathlib import Path

from rich.console import Console

from elastic_env.core.config import Model
from train.commands.compare_config import CompareConfig
from train.commands.comparison import compare
from train.commands.options import HardwareOptions, MotionOrDefault, Stiffness, name_options
from train.evaluate.conditions import NumEpisodes, PolicySpec, Seed
from train.figures.plots import FigureFormat
from train.runs.console import print_files


class Evaluate(Model):
    """Play episodes of one policy under one scenario and print its metrics.

    Example, one joint: elastic evaluate --policy input --scenario soft --reference multisine
        --episodes 10

    Example, a walk: elastic evaluate --env walker --policy input_wrench --reference 3
    """

    policy: str = "input"
    """Baseline, residual:PATH, or "FILE.py:function" or "module:function" for your own.
    Baselines (see Policies in the docs) are
    zero, uncompensated, input, dynamic, link_encoder,
    disturbance_observer, iterative, oracle; on a fixed
    base also friction; on the walker also
    uncompensated_open, input_open, input_output,
    input_wrench, adaptive, posture, adaptive_posture,
    foothold, phase_table, torque_sensor, hip_sensor,
    thormang, talos."""
    env: str = "testbed"
    """Environment: testbed (one joint), hardware (a real one, at --port), walker (a humanoid that
    walks), robot, ROBOT.yaml (a file of any robot, see docs/robots.md), or "FILE.py:ROBOT", a
    JointRobot."""
    scenario: str | None = None
    """Scenario, such as nominal (default), ideal, soft, stiff, spread, payload, backlash,
    sensor, imu, drawn, drawn_beyond, ideal+soft; on the walker also push, slope."""
    reference: MotionOrDefault = None
    """Motion. Testbed: hold (default; takes 20 to 60 s), sine, multisine, steps (some
    seconds), or a mapping such as '{kind: sine, amplitude: 0.3}'. Walker: step period 24, 3
    (default), 1.6 or 1.1 [s], or its durations of double, single, double support '[0.8, 0.6, 0.8]',
    or a mapping such as '{step_period: 3, num_steps: 2}', or to walk forward and turn
    '{step_period: 3, gait: {step_length_m: 0.1, turn_rad: 0.1}}'."""
    episodes: NumEpisodes = 1
    """Number of episodes, seeds following --seed."""
    seed: Seed = 0
    """Seed of the first episode."""
    sensors: tuple[str, ...] = ()
    """Further sensors of the environment, for a policy of your own: joint_torque,
    link_encoder, ..."""
    stiffness: Stiffness = None
    """K that the policy assumes: a number [N·m/rad], a list of one per joint
    such as '[1001]', twelve on the walker, or the path of an identification.json."""
    output: Path | None = None
    """Folder for the results, new or empty; default runs/evaluate, numbered if taken."""
    figure_format: FigureFormat = "png"
    """Of the figures: pdf and svg have no resolution, and png has 300 dpi."""
    hardware: HardwareOptions = HardwareOptions()

    def run(self, console: Console) -> None:
        """Run a comparison of one cell."""
        options = {} if self.stiffness is None else {"stiffness": self.stiffness}
        sensors = {"sensors": list(self.sensors)} if self.sensors else {}
        motion = {} if self.reference is None else {"references": [self.reference]}
        with name_options(references="reference", scenarios="scenario", policies="policy"):
            config = CompareConfig(
                name="evaluate",
                scenarios=[self.hardware.scenario(self.scenario)],
                policies=[PolicySpec(name=self.policy, options=options, env_options=sensors)],
                episodes=self.episodes,
                seed=self.seed,
                **motion,
                **self.hardware.environment(self.env),
            )
        finished = compare(
            config, console, self.output, report=False, figure_format=self.figure_format
        )
        print_files(finished.folder, finished.files, console)
