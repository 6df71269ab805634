"""An arm, its log and its unknowns, as the options of `elastic identify --robot` name them."""

import fnmatch
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
from rich.console import Console

from baselines.identification.pose_checks import require_poses
from baselines.identification.pose_log import PoseLog, read_log
from baselines.identification.pose_model import PoseModel
from baselines.identification.pose_plan import empty_log
from baselines.identification.pose_unknowns import PoseUnknowns
from baselines.identification.static_arm import StaticArm
from elastic_env.core.errors import unknown_name
from elastic_env.joint.default_hinges import commanded_hinges, coupled_fingers
from elastic_env.joint.model_joints import describe_home, hinges_of
from elastic_env.world.robot_model import joint_ranges
from train.commands.identify_options import ArmOptions


@dataclass(frozen=True)
class ArmProblem:
    """An arm, its log and its unknowns.

    Attributes:
        options: Options of the command.
        arm: The rigid arm.
        log: Its log; without poses where a first plan is made.
        elastic: Joints whose stiffness is estimated.
        seed: Seed of candidate poses and of poses that are held out.
    """

    options: ArmOptions
    arm: StaticArm
    log: PoseLog
    elastic: tuple[str, ...]
    seed: int

    @classmethod
    def from_options(
        cls, options: ArmOptions, model: mujoco.MjModel, console: Console, seed: int
    ) -> "ArmProblem":
        """Read the log, and find everything that the options name.

        Raises:
            ConfigurationError: The log cannot be used, or a name does not exist.

        Warns:
            UserWarning: The log has no encoder of a joint.
        """
        hinges = hinges_of(model)
        log = None
        if options.log:
            ends = zip(*joint_ranges(model, hinges), strict=True)
            ranges = dict(zip(hinges, ends, strict=True))
            log = read_log(Path(options.log[0]), ranges, options.measured_by)
            _warn_of_held(model, log.joints)
        joints = commanded_hinges(model) if log is None else log.joints
        arm = StaticArm(model, joints, options.end_effector, options.payload)
        if log is None:
            log = empty_log(arm, options.measured_by or "end_effector")
        if options.end_effector is None and log.kind in ("end_effector", "imu"):
            console.print(
                f"the log is taken to measure {arm.end_effector!r}; --end-effector names another"
                " site or body"
            )
        elastic = _elastic_joints(options.joints, log.joints)
        problem = cls(options, arm, log, elastic, seed)
        if options.log and not problem.has_unknown_geometry:
            require_poses(problem.model(log))
        return problem

    @property
    def has_unknown_geometry(self) -> bool:
        """True if geometry and stiffness are fitted together, to markers."""
        return self.log.kind == "markers" or self.options.markers.geometry is not None

    def model(self, log: PoseLog) -> PoseModel:
        """The poses of a log as a function of the unknowns."""
        frame = self.options.frame
        has_payload = self.options.payload is not None
        unknowns = PoseUnknowns.from_log(log, self.elastic, frame, has_payload)
        return PoseModel(self.arm, log, unknowns)


def _warn_of_held(model: mujoco.MjModel, logged: Sequence[str]) -> None:
    """Warn of joints that count as held because the log has no encoder of them.

    Coupled fingers need none: the model itself holds them.
    """
    known = {*logged, *coupled_fingers(model)}
    held = [model.joint(name).id for name in hinges_of(model) if name not in known]
    if held:
        text = f"joints without a column theta.JOINT are held: {describe_home(model, held)}"
        warnings.warn(text, stacklevel=3)


def _elastic_joints(patterns: Sequence[str], joints: Sequence[str]) -> tuple[str, ...]:
    """Joints that match a name or pattern, in the order of the log; all without patterns."""
    chosen = set[str]()
    for pattern in patterns:
        matches = fnmatch.filter(joints, pattern)
        if not matches:
            raise unknown_name("joint or pattern of the log's joints", pattern, joints)
        chosen.update(matches)
    return tuple(joint for joint in joints if joint in chosen or not patterns)
