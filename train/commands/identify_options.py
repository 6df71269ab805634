"""Options of `elastic identify`: of the run, and of testbed, arm, geometry and servo."""

from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated, Any, Self

import tyro
from pydantic import model_validator

from baselines.identification.geometry_fit import GeometryPriors
from baselines.identification.geometry_model import Geometry
from baselines.identification.pose_log import Kind
from baselines.identification.pose_model import Frame
from baselines.identification.pose_plan import MOST_PLANNED
from baselines.identification.servo_file import AngleUnit
from elastic_env.core.config import LARGEST_SEED, Locator, Model, Title, quantity
from elastic_env.joint.joint_settings import SOFTEST
from train.figures.plots import FigureFormat
from train.runs.folders import run_folder

_STIFFEST = 1e9
"""Largest K that can be assumed; a stiffer joint is rigid [N·m/rad]."""


class IdentificationRun(Model):
    """What all identifications have in common."""

    seed: int = quantity("1", 0, ge=0, le=LARGEST_SEED // 2)
    """Seed of the sensor noise, and of what is held out."""
    output: Path | None = None
    """Folder for the results, new or empty; default runs/identify, numbered if taken."""
    figure_format: FigureFormat = "png"
    """Of the figures: pdf and svg have no resolution, and png has 300 dpi."""

    def folder(self, asked: dict[str, Any]) -> AbstractContextManager[Path]:
        """A new folder for results, with what was asked for."""
        return run_folder("identify", {**asked, "seed": self.seed}, self.seed, self.output)


class OfTestbed(Model):
    """The testbed, which is identified where no log is named."""

    scenario: Title | None = None
    """Scenario of the simulated testbed, such as nominal (default), ideal, backlash, ideal+soft."""
    stiffness: float | None = quantity("N·m/rad", None, gt=0)
    """True K of the simulated joint [N·m/rad]; default the paper's 1001."""
    second_mass: float | None = quantity("1", None, gt=0)
    """Repeat with the pendulum's mass times this factor, which separates an IMU error ~ sin q
    from K; such as 0.5.
    """
    positions: int = quantity("1", 20, ge=5, le=200)
    """Number of static positions, at least 5; on a real joint 5 take three minutes, 20 take
    five.
    """
    repeats: int = quantity("1", 1, ge=1, le=10_000)
    """Repeat with so many seeds and say how often the interval holds the true stiffness."""

    @model_validator(mode="after")
    def _masses_differ(self) -> Self:
        if self.second_mass == 1.0:
            problem = "second_mass must differ from 1: two equal masses do not separate anything"
            raise ValueError(problem)
        return self


class HoldoutOptions(Model):
    """What `elastic identify` keeps back from a fit, to judge it."""

    holdout: float = quantity("1", 0.3, ge=0, lt=1)
    """Share of the poses or logs that is not fitted, and predicted beside rivals; 0 for none."""
    folds: int = quantity("1", 1, ge=1, le=20)
    """Hold each pose out once, in so many folds."""

    @model_validator(mode="after")
    def _folds_hold_out(self) -> Self:
        if self.folds > 1 and not self.holdout:
            cure = "leave folds at 1, or give holdout a share > 0"
            raise ValueError(f"holdout = 0 holds nothing out, got folds = {self.folds}; {cure}")
        return self


class GeometryOptions(Model):
    """Poses with markers: what of the geometry is sought together with K."""

    geometry: Geometry | None = None
    """Seek encoder offsets, the parameters of Denavit and Hartenberg (dh), or all lengths and
    angles (full), together with K; default offsets for a log of markers.
    """
    lateral: bool = False
    """Seek the compliance of bearings and links across the axes too."""
    free: tuple[Title, ...] = ()
    """Joints whose frame the model only guesses: it may be off by a metre and a radian."""
    priors: GeometryPriors = GeometryPriors()


class ServoOptions(Model):
    """Logs in time of one servo: its load, and what the logs do not say."""

    mass_kg: float | None = quantity("kg", None, gt=0)
    """Mass of a pendulum on the servo, whose logs have time, goal and position [kg]."""
    lever_m: float | None = quantity("m", None, gt=0)
    """Distance of its mass from the axis [m]."""
    gain: float | None = quantity("1", None, gt=0)
    """Value of the servo's gain register, where the logs do not say it [1]."""
    angles: AngleUnit | None = None
    """Unit of angles in the logs in time; default what they say, or radians."""
    unfitted: tuple[Locator, ...] = ()
    """Logs in time to replay without a fit; default a share of --log, by --holdout."""


class ArmOptions(Model):
    """An arm by a log of static poses, or a servo by logs in time, in place of the testbed."""

    robot: Locator | None = None
    """Rigid model of an arm, MJCF or URDF."""
    log: tuple[Locator, ...] = ()
    """CSV file of static poses: motor encoders, and link encoders, end-effector positions, an
    IMU or joint torques. Or logs in time of one servo with its goal: CSV, JSON or parquet.
    """
    joints: tuple[Title, ...] = ()
    """Names or patterns of the joints whose stiffness is sought; default all in the log.

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
    mean its mounting.
    """
    measured_by: Kind | None = None
    """Measurement to use, where the log has several or there is no log."""
    within: float = quantity("1", 0.03, gt=0, lt=1)
    """A joint is told apart where the 95 % interval of 1/K is as narrow as plus or minus this
    share.
    """
    assume: float | None = quantity("N·m/rad", None, ge=SOFTEST, le=_STIFFEST)
    """K [N·m/rad] to write for joints whose interval reaches to rigid; default each joint's own
    estimate, or rigid.
    """
    plan: int = quantity("1", 0, ge=0, le=MOST_PLANNED)
    """Propose so many further poses, within limits and without contacts, that tell the stiffness
    best.
    """
    judged: Annotated[HoldoutOptions, tyro.conf.arg(name="judgement")] = HoldoutOptions()
    markers: Annotated[GeometryOptions, tyro.conf.arg(name="geometry")] = GeometryOptions()
    servo: ServoOptions = ServoOptions()
