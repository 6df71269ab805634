"""`elastic identify`: the static experiment, its files and its table."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

import gymnasium
import numpy as np
from pydantic import model_validator
from rich.console import Console
from rich.table import Table

import elastic_env  # noqa: F401  registers the environments
from baselines.identification.identify import Identification, identify
from elastic_env.core.config import LARGEST_SEED, Model, Title, quantity
from elastic_env.robots.testbed.model import Pendulum
from train.figures import plots
from train.figures.testbed_plots import draw_identification
from train.runs.escaping import write_records
from train.runs.folders import run_folder
from train.runs.progress import plain_progress, show_progress


class IdentifyConfig(Model):
    """What `elastic identify` does."""

    scenario: Title = "nominal"
    """Scenario of the simulated testbed."""
    stiffness: float | None = quantity("N·m/rad", None, gt=0, description="true K; None for the paper's")
    second_mass: float | None = quantity("1", None, gt=0, description="factor on the pendulum's mass in a second run")
    positions: int = quantity("1", 20, ge=5, le=200, description="number of static positions")
    seed: int = quantity("1", 0, ge=0, le=LARGEST_SEED // 2, description="seed of the first run")
    repeats: int = quantity("1", 1, ge=1, le=10_000, description="number of runs with seeds of their own")
    hardware: dict[str, Any] = {}
    """Arguments of `elastic_env/HardwareTestbed-v0` for a real joint; empty for a simulated one."""

    @model_validator(mode="after")
    def _masses_differ(self) -> Self:
        if self.second_mass == 1.0:
            raise ValueError("second_mass must differ from 1: two equal masses do not separate anything")
        return self

    @model_validator(mode="after")
    def _hardware_is_one_joint_with_an_imu(self) -> Self:
        if not self.hardware:
            return self
        if self.hardware.get("imu_port") is None:
            raise ValueError("an identification on hardware needs the link's angle: name the IMU with --imu-port")
        if self.stiffness is not None or self.repeats > 1:
            raise ValueError("stiffness and repeats are of a simulated joint; leave them out on hardware")
        if self.second_mass is not None and not self.hardware.get("confirm", True):
            raise ValueError("somebody must change the mass between the runs: a second_mass excludes --yes")
        return self


def run_identification(config: IdentifyConfig, console: Console, output: Path | None = None) -> list[Identification]:
    """Identify the testbed, simulated or real, write `identification.json` and the figure, print the result.

    Args:
        config: What to do.
        console: Where progress and table go.
        output: Folder for the results; default runs/identify, numbered if taken.

    Returns:
        One result per repetition.

    Raises:
        ConfigurationError: A name does not exist.
        ResultsExistError: The output folder holds results.
    """
    plots.require_matplotlib()
    envs = identified_environments(config)
    with run_folder("identify", config.model_dump(mode="json"), config.seed, output) as folder:
        try:
            with _progress(config, console) as progress:
                results, points = identify(envs, config.seed, progress)
        finally:
            for env in envs:
                env.close()
        results[0].save(folder / "identification.json")
        models = [env.unwrapped.assumed_model for env in envs]
        files = [
            folder / "identification.json",
            draw_identification(results[0], points[0], models, folder / "identification.png"),
        ]
        console.print(result_table(results[0]))
        if config.repeats > 1:
            repeats = [{"seed": config.seed + i, **result.model_dump()} for i, result in enumerate(results)]
            files.append(write_records(repeats, folder / "repeats.csv"))
            console.print(_spread(results, float(envs[0].unwrapped.truth().model.stiffness[0])))
    for path in files:
        console.print(f"wrote {path}", soft_wrap=True)
    return results


@contextmanager
def _progress(config: IdentifyConfig, console: Console) -> Iterator[Callable[[float], None]]:
    """What takes the share of the work that is done."""
    work = "visiting static positions"
    if config.hardware:
        console.print(f"{work} at {config.hardware['port']}", soft_wrap=True)
        yield plain_progress(console)
        return
    with show_progress(console, {f"{work}, in %": 100}, transient=True) as show:
        yield lambda share: show(0, round(100 * share))


def result_table(result: Identification) -> Table:
    """An identification as a table."""
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
    table = Table(title="identification", show_header=False)
    for name, value in rows:
        table.add_row(name, value)
    return table


def identified_environments(config: IdentifyConfig) -> list[Any]:
    """The testbed, once per mass; nothing is opened yet."""
    reference = {"kind": "hold", "positions": config.positions}
    hardware = dict(config.hardware)
    pendulum = Pendulum(**hardware.pop("pendulum", {}))
    pendulums = [pendulum]
    if config.second_mass is not None:
        pendulums.append(pendulum.with_mass_scaled(config.second_mass))
    where, given = "elastic_env/HardwareTestbed-v0", {"num_envs": 1, **hardware}
    if not hardware:
        where = "elastic_env/Testbed-v0"
        given = {"num_envs": config.repeats, "scenario": config.scenario, "stiffness": config.stiffness}
    return [
        gymnasium.make_vec(
            where, vectorization_mode="vector_entry_point", reference=reference, pendulum=pendulum, **given
        )
        for pendulum in pendulums
    ]


def _spread(results: Sequence[Identification], truth: float) -> str:
    """Spread over the seeds, and how often the intervals hold the truth."""
    stiffness = np.array([result.stiffness_nm_per_rad for result in results])
    covered = sum(r.stiffness_low_nm_per_rad <= truth <= r.stiffness_high_nm_per_rad for r in results)
    widest = max(result.half_width for result in results)
    return (
        f"{len(results)} seeds: K median {np.median(stiffness):.1f}, {stiffness.min():.1f} to {stiffness.max():.1f} "
        f"N·m/rad (true {truth:g}); friction median {np.median([r.friction_nm for r in results]):.2f} N·m; "
        f"r median {np.median([r.pearson_r for r in results]):.4f}; plain line median "
        f"{np.median([r.line_stiffness_nm_per_rad for r in results]):.1f}\n"
        f"the 95 % interval holds the true K in {covered} of {len(results)}, half-width at most {100 * widest:.2f} %"
    )
