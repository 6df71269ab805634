"""How well the identification of an arm does over many logs of known truth: `python -m
tests.identification_trials`.

Every trial is a log of 40 poses, which MuJoCo bends, of the arm in docs/identification. It counts
how often an interval holds the true K, and what error of the end effector is left at poses that no
log has. Writes docs/results/arm_identification.csv; some minutes on two cores.
"""

import csv
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing import Pool
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.console import Console

from baselines import PositionCompensator
from baselines.identification.arm_fit import ArmFit, fit_arm
from baselines.identification.arm_result import describe_fit
from elastic_env.core.signals import Array, BoolArray
from elastic_env.core.yaml_text import parse_yaml
from tests.test_arm_identification import (
    ARM,
    FOLDER,
    JOINTS,
    K,
    equilibria,
    log_of,
    model_of,
    poses,
    shown,
)
from train.commands.identify_arm import identify_arm
from train.commands.identify_options import ArmOptions, IdentificationRun
from train.runs.escaping import write_records

POSES = 40
UNUSED = 50
WITHIN = 0.03
FRICTION = {"no friction": 0.0, "friction, sides logged": 1.0}
"""Kinds of logs, and their friction in units of that of the tests."""
FIRST_SEED = 1000


@dataclass(frozen=True)
class Trial:
    """One log. Arrays have a value per joint.

    Attributes:
        holds: Whether the interval of 1/K holds the truth.
        told: Whether the joint is told apart within 3 %.
        off: Relative error of K in `joints.yaml`.
        half_width: Half-width of the interval of 1/K, relative.
        before_m: Error of the end effector at unused poses without compensation, rms.
        after_m: The same with the identified K.
    """

    holds: BoolArray
    told: BoolArray
    off: Array
    half_width: Array
    before_m: float
    after_m: float


def planned_poses() -> Array:
    """Motor angles that `elastic identify --plan` proposes without a log, (40, n) [rad]."""
    config = ArmOptions(
        robot=str(FOLDER / "arm.xml"), end_effector="marker", measured_by="end_effector", plan=POSES
    )
    with tempfile.TemporaryDirectory() as folder:
        run = IdentificationRun(output=Path(folder) / "plan")
        identify_arm(config, run, Console(quiet=True))
        with (Path(folder) / "plan" / "plan.csv").open(newline="", encoding="utf-8") as file:
            return np.array(
                [
                    [float(row[f"theta.{joint} [rad]"]) for joint in JOINTS]
                    for row in csv.DictReader(file)
                ]
            )


def trial(seed: int, friction: float, theta: Array | None) -> Trial:
    """Identify the arm from a log of its own noise, and compensate it at poses that the log does
    not have."""
    options: dict[str, Any] = {} if theta is None else {"theta": theta}
    log = log_of(
        "end_effector", FIRST_SEED + seed, POSES, friction, sides=friction > 0.0, **options
    )
    fit = fit_arm(model_of(log))
    result = describe_fit(fit, WITHIN, assumed=None)
    found = np.array([joint.stiffness_nm_per_rad for joint in result.joints])
    compliance, half = fit.estimate("compliance")
    before_m, after_m = _errors(fit, seed)
    return Trial(
        np.abs(compliance - 1.0 / K) <= half,
        np.array([not joint.reason for joint in result.joints]),
        found / K - 1.0,
        np.array([joint.half_width for joint in result.joints]),
        before_m,
        after_m,
    )


def _errors(fit: ArmFit, seed: int) -> tuple[float, float]:
    """RMS error of the end effector without and with compensation [m]."""
    with tempfile.TemporaryDirectory() as folder:
        describe_fit(fit, WITHIN, assumed=None).save(Path(folder))
        stiffness = parse_yaml((Path(folder) / "joints.yaml").read_text())
    compensator = PositionCompensator.from_model(ARM, stiffness)
    wanted = 0.8 * poses(UNUSED, np.random.default_rng(5000 + seed))
    corrected = np.array([compensator.command(row) for row in wanted])
    there = _where(wanted)
    before, after = (
        _where(equilibria(command, np.zeros_like(wanted))) - there
        for command in (wanted, corrected)
    )
    return tuple(float(np.sqrt(np.mean(np.sum(off**2, axis=1)))) for off in (before, after))  # type: ignore[return-value]


def _where(q: Array) -> Array:
    return shown("end_effector", q, np.zeros_like(q))


def records(chosen: str, log: str, trials: Sequence[Trial]) -> list[dict[str, Any]]:
    """Rows of the table, one per joint; the errors of the end effector are of the whole arm."""
    told = np.array([each.told for each in trials], dtype=np.bool_)
    off = np.abs([each.off for each in trials])
    after = [each.after_m for each in trials]
    arm = {
        "before_median_m": np.median([each.before_m for each in trials]),
        "after_median_m": np.median(after),
        "after_most_m": np.max(after),
    }
    return [
        {
            "poses": chosen,
            "log": log,
            "joint": joint,
            "trials": len(trials),
            "holds": sum(bool(each.holds[i]) for each in trials),
            "told_apart": int(told[:, i].sum()),
            "within": int((told[:, i] & (off[:, i] < WITHIN)).sum()),
            "half_width_median": f"{np.median([each.half_width[i] for each in trials]):.4g}",
            **{name: f"{value:.4g}" for name, value in arm.items()},
        }
        for i, joint in enumerate(JOINTS)
    ]


def main(count: int = 100, jobs: int = 2) -> None:
    """Play the trials and write the table.

    Args:
        count: Logs of each kind.
        jobs: Processes.
    """
    rows = []
    planned = planned_poses()
    with Pool(jobs) as pool:
        for chosen, theta in (("random", None), ("planned", planned)):
            for log, friction in FRICTION.items():
                found = pool.map(
                    partial(trial, friction=friction, theta=theta), range(count), chunksize=5
                )
                rows += records(chosen, log, found)
                print(f"{chosen} poses, {log}: done", flush=True)
    print(f"wrote {write_records(rows, FOLDER.parent / 'results' / 'arm_identification.csv')}")


if __name__ == "__main__":
    tyro.cli(main)
