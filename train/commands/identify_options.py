"""Options of `elastic identify`: the run, and testbed, arm, geometry and servo."""

from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated, Any, Self

import tyro
from pydantic import model_validator

from baselines.identification.geometry_model import Geometry
from baselines.identification.geometry_problem import GeometryPriors
from baselines.identification.pose_log import Kind
from baselines.identification.pose_plan import MOST_PLANNED
from baselines.identification.pose_unknowns import Frame
from baselines.identification.servo_file import AngleUnit
from elastic_env.core.config import LARGEST_SEED, Locator, Model, Title, quantity
from elastic_env.joint.joint_settings import SOFTEST
from train.figures.plots import FigureFormat
from train.runs.folders import run_folder

_STIFFEST = 1e9
"""Largest K that can be assumed; a stiffer joint is rigid [N·m/rad]."""


class IdentificationRun(Model):
    """Options that all identifications have in common."""

    seed: int = quantity("1", 0, ge=0, le=LARGEST_SEED // 2)
    """Seed of the sensor noise, and of the poses or logs that are held out."""
    output: Path | None = None
    """Folder for the results, new or empty; default runs/identify, numbered if taken."""
    figure_format: FigureFormat = "png"
    """Of the figures: pdf and svg have no resolution, and png has 300 dpi."""

    def folder(self, options: dict[str, Any]) -> AbstractContextManager[Path]:
        """A new folder for results, with the options of the run."""
        return run_folder("identify", {**options, "seed": self.seed}, self.seed, self.output)


class JointOptions(Model):
    """The testbed, which is identified without --log."""

    scenario: Title | None = None
    """Scenario of the simulated testbed, such as nominal (default), ideal, backlash, ideal+soft."""
    stiffness: float | None = quantity("N·m/rad", None, gt=0)
    """True K of the simulated joint [N·m/rad]; default the paper's 1001."""
    second_mass: float | None = quantity("1", None, gt=0)
    """Repeat with the pendulum's mass times this factor, such as 0.5. This separates an IMU error
    ~ sin q from K.
    """
    positions: int = quantity("1", 20, ge=5, le=200)
    """Number of static positions, at least 5; on a real joint 5 take three minutes, 20 take
    five.
    """
    repeats: int = quantity("1", 1, ge=1, le=10_000)
    """Number of seeds to repeat it with; prints how many intervals contain the true stiffness."""

    @model_validator(mode="after")
    def _masses_differ(self) -> Self:
        if self.second_mass == 1.0:
            problem = "second_mass must differ from 1: two equal masses do not separate anything"
            raise ValueError(problem)
        return self


class HoldoutOptions(Model):
    """Poses or logs that a fit does not use, to judge it."""

    holdout: float = quantity("1", 0.3, ge=0, lt=1)
    """Share of the poses or logs that is not fitted, but predicted and compared with rivals; 0 for
    none.
    """
    folds: int = quantity("1", 1, ge=1, le=20)
    """Number of folds, which together hold each pose out once."""

    @model_validator(mode="after")
    def _folds_hold_out(self) -> Self:
        if self.folds > 1 and not self.holdout:
            raise ValueError(
                f"holdout = 0 holds nothing out, got folds = {self.folds}; leave folds at 1, or"
                " give holdout a share > 0"
            )
        return self


class GeometryOptions(Model):
    """Poses with markers: the geometry that is estimated together with K."""

    geometry: Geometry | None = None
    """Estimate encoder offsets, the parameters of Denavit and Hartenberg (dh), or all lengths and
    angles (full), together with K; default offsets for a log of markers.
    """
    lateral: bool = False
    """Estimate the compliance of bearings and links across the axes too."""
    free: tuple[Title, ...] = ()
    """Joints whose frame in the model is a guess: it may be wrong by a metre and a radian."""
    priors: GeometryPriors = GeometryPriors()


class ServoOptions(Model):
    """Logs in time of one servo: its load, and values that the logs do not contain."""

    mass_kg: float | None = quantity("kg", None, gt=0)
    """Mass of a pendulum on the servo, whose logs have time, goal and position [kg]."""
    lever_m: float | None = quantity("m", None, gt=0)
    """Distance of its mass from the axis [m]."""
    gain: float | None = quantity("1", None, gt=0)
    """Value of the servo's gain register, where the logs do not contain it [1]."""
    angles: AngleUnit | None = None
    """Unit of angles in the logs in time; default the unit in their headers, or radians."""
    unfitted: tuple[Locator, ...] = ()
    """Logs in time to replay without a fit; default a share of --log, by --holdout."""


class ArmOptions(Model):
    """An arm by a log of static poses, or a servo by logs in time, instead of the testbed."""

    robot: Locator | None = None
    """Rigid model of an arm, MJCF or URDF."""
    log: tuple[Locator, ...] = ()
    """CSV file of static poses: motor encoders, and link encoders, end-effector positions, an
    IMU or joint torques. Or logs in time of one servo with its goal: CSV, JSON or parquet.
    """
    joints: tuple[Title, ...] = ()
    """Names or patterns of the joints whose stiffness is estimated; default all in the log.

    The others are rigid.
    """
    end_effector: Title | None = None
    """Site or body whose position is measured or that carries the IMU; default the outermost
    body.
    """
    payload: Title | None = None
    """Body or site that carries a payload of unknown mass, which is estimated too."""
    frame: Frame = "offset"
    """Frame of tracker or IMU: known, unknown by an offset, or in pose; for an IMU the last two
    mean an unknown mounting.
    """
    measured_by: Kind | None = None
    """Measurement to use, where the log has several or there is no log."""
    within: float = quantity("1", 0.03, gt=0, lt=1)
    """A joint is told apart if the 95 % interval of 1/K is plus or minus this share or narrower."""
    assume: float | None = quantity("N·m/rad", None, ge=SOFTEST, le=_STIFFEST)
    """K [N·m/rad] to write for joints whose interval reaches to rigid; default each joint's own
    estimate, or rigid.
    """
    plan: int = quantity("1", 0, ge=0, le=MOST_PLANNED)
    """Number of further poses to propose: within limits and without contacts, those that
    determine the stiffness best.
    """
    judged: Annotated[HoldoutOptions, tyro.conf.arg(name="judgement")] = HoldoutOptions()
    markers: Annotated[GeometryOptions, tyro.conf.arg(name="geometry")] = GeometryOptions()
    servo: ServoOptions = ServoOptions()
