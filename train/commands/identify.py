"""`elastic identify`: the static experiment of the testbed, its files and its table."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import gymnasium
import pandas as pd
from rich.console import Console
from rich.table import Table

import elastic_env  # noqa: F401  registers the environments
from baselines.identification.identify import Identification, identify
from elastic_env.core.errors import ConfigurationError
from elastic_env.robots.testbed.model import Pendulum
from train.commands.identify_arm import ArmResult, identify_arm
from train.commands.identify_options import ArmOptions, IdentificationRun, JointOptions
from train.commands.options import HardwareOptions, given_options
from train.figures import plots
from train.figures.identification_plots import draw_identification
from train.runs.console import make_table
from train.runs.escaping import write_records
from train.runs.progress import plain_progress, show_progress


class Identify(IdentificationRun):
    """Find the stiffness of the joint from static positions (Fig. 5 of the paper).

    Drives the testbed to its positions from both sides, averages encoder and IMU at rest, and
    separates stiffness, friction, dead band and offset. Writes identification.json, from which the
    environment and the compensators read their K, and a figure. Example: elastic identify
    --scenario backlash

    On a real joint: elastic identify --port /dev/ttyUSB0 --imu-port /dev/ttyACM0

    An arm from a log of static poses, with joints.yaml for compensator and environment, see
    docs/identification.md: elastic identify --robot arm.urdf --log poses.csv --end-effector tool0
    --plan 20

    A servo from logs of its motion under a known load, see the same page: elastic identify --log
    run.csv --mass-kg 0.5 --lever-m 0.1
    """

    testbed: JointOptions = JointOptions()
    hardware: HardwareOptions = HardwareOptions()
    arm: ArmOptions = ArmOptions()

    def run(self, console: Console) -> list[Identification] | ArmResult | None:
        """Identify the testbed, simulated or real, or an arm; write result and figure.

        Returns:
            One result per repetition; of an arm its result, or None for a plan without a log.

        Raises:
            ConfigurationError: A name does not exist, or an option does not go with another.
            ResultsExistError: The output folder contains results.
        """
        if self.arm == ArmOptions():
            return self._identify_testbed(console)
        unused = given_options(self.testbed, JointOptions.model_fields)
        if self.hardware != HardwareOptions():
            unused.append("--port and the like")
        if unused:
            raise ConfigurationError(
                f"options of the testbed: {', '.join(unused)}; leave them out beside --robot and"
                " --log"
            )
        return identify_arm(self.arm, self, console)

    def _identify_testbed(self, console: Console) -> list[Identification]:
        plots.require_matplotlib()
        scenario = self.hardware.scenario(self.testbed.scenario)
        hardware = self.hardware.arguments
        if hardware:
            self._require_real_joint(hardware)
        envs = identified_environments(self)
        options = {**self.testbed.model_dump(mode="json"), "scenario": scenario}
        with self.folder({**options, "hardware": hardware}) as folder:
            try:
                with _show_share(hardware, console) as progress:
                    results, points = identify(envs, self.seed, progress)
            finally:
                for env in envs:
                    env.close()
            files = [folder / f"identification.{end}" for end in ("json", self.figure_format)]
            results[0].save(files[0])
            models = [env.unwrapped.assumed_model for env in envs]
            draw_identification(results[0], points[0], models, files[1])
            console.print(result_table(results[0]))
            if self.testbed.repeats > 1:
                numbered = enumerate(results, self.seed)
                rows = [{"seed": seed, **r.model_dump()} for seed, r in numbered]
                files.append(write_records(rows, folder / "repeats.csv"))
                truth = float(envs[0].unwrapped.truth().model.stiffness[0])
                console.print(_repeats_summary(pd.DataFrame(rows), results, truth))
        for path in files:
            console.print(f"wrote {path}")
        return results

    def _require_real_joint(self, hardware: Mapping[str, Any]) -> None:
        """Refuse options that do not go with a real joint."""
        if hardware.get("imu_port") is None:
            raise ConfigurationError(
                "an identification on hardware needs the link's angle: name the IMU with --imu-port"
            )
        if self.testbed.stiffness is not None or self.testbed.repeats > 1:
            problem = "stiffness and repeats are of a simulated joint; leave them out on hardware"
            raise ConfigurationError(problem)
        if self.testbed.second_mass is not None and not hardware.get("confirm", True):
            problem = "somebody must change the mass between the runs: a second_mass excludes --yes"
            raise ConfigurationError(problem)


@contextmanager
def _show_share(hardware: Mapping[str, Any], console: Console) -> Iterator[Callable[[float], None]]:
    """Show progress, and yield a function that takes the finished share of the work."""
    work = "visiting static positions"
    if hardware:
        console.print(f"{work} at {hardware['port']}")
        yield plain_progress(console)
        return
    with show_progress(console, {f"{work}, in %": 100}, transient=True) as show:
        yield lambda share: show(0, round(100 * share))


def result_table(result: Identification) -> Table:
    """An identification as a table."""
    stiffness = f"{result.stiffness_low_nm_per_rad:.1f} to {result.stiffness_high_nm_per_rad:.1f}"
    line = f"{result.line_stiffness_nm_per_rad:.1f} N·m/rad, Pearson r {result.pearson_r:.4f}"
    friction = f"{result.friction_low_nm:.2f} to {result.friction_high_nm:.2f}"
    sine_rad = result.imu_sine_error_rad
    rows = {
        "stiffness K": f"{result.stiffness_nm_per_rad:.1f} N·m/rad",
        "  95 % interval": f"{stiffness} (± {100 * result.half_width:.2f} %)",
        "  plain line": line,
        "friction": f"{result.friction_nm:.2f} N·m ({friction})",
        "dead band": f"{1e3 * result.dead_band_rad:.2f} mrad",
        "offset": f"{1e3 * result.offset_rad:+.2f} mrad",
        "IMU error ~ sin q": "" if sine_rad is None else f"{1e3 * sine_rad:+.2f} mrad",
        "directions differ": "yes (hysteresis)" if result.hysteresis else "no",
        "residual spread": f"{1e3 * result.residual_rad:.3f} mrad",
        "points": f"{result.points} at {result.positions} positions",
    }
    filled = [row for row in rows.items() if row[1]]
    return make_table("identification", ["", ""], filled, left=2, show_header=False)


def identified_environments(options: Identify) -> list[Any]:
    """The testbed, once per mass; no port is opened yet."""
    arguments = dict(options.hardware.arguments)
    pendulum = Pendulum(**arguments.pop("pendulum", {}))
    pendulums = [pendulum]
    if options.testbed.second_mass is not None:
        pendulums.append(pendulum.with_mass_scaled(options.testbed.second_mass))
    if arguments:
        name = "elastic_env/HardwareTestbed-v0"
        arguments["num_envs"] = 1
    else:
        name = "elastic_env/Testbed-v0"
        arguments = {
            "num_envs": options.testbed.repeats,
            "scenario": options.hardware.scenario(options.testbed.scenario),
            "stiffness": options.testbed.stiffness,
        }
    arguments["reference"] = {"kind": "hold", "positions": options.testbed.positions}
    arguments["vectorization_mode"] = "vector_entry_point"
    return [gymnasium.make_vec(name, pendulum=p, **arguments) for p in pendulums]


def _repeats_summary(table: pd.DataFrame, results: Sequence[Identification], truth: float) -> str:
    """Spread over the seeds, and the number of intervals that contain the truth."""
    stiffness = table["stiffness_nm_per_rad"]
    low = table["stiffness_low_nm_per_rad"]
    high = table["stiffness_high_nm_per_rad"]
    median = table.median(numeric_only=True)
    widest = max(result.half_width for result in results)
    return (
        f"{len(table)} seeds: K median {stiffness.median():.1f}, {stiffness.min():.1f} to"
        f" {stiffness.max():.1f} N·m/rad (true {truth:g}); friction median"
        f" {median['friction_nm']:.2f} N·m; r median {median['pearson_r']:.4f}; plain line median"
        f" {median['line_stiffness_nm_per_rad']:.1f}\nthe 95 % interval holds"
        f" the true K in {((low <= truth) & (truth <= high)).sum()} of {len(table)}, half-width at"
        f" most {100 * widest:.2f} %"
    )
