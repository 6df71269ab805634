"""`elastic identify --robot`: stiffness of an arm from a log of static poses, and poses that
would tell more.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

import mujoco
import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from baselines.identification.arm_fit import (
    FAR_BEYOND,
    USUAL_EVALUATIONS,
    USUAL_NOISE,
    fit_arm,
    in_unit,
    require_poses,
    summed_up,
)
from baselines.identification.arm_result import (
    NEGATIVE,
    ArmIdentification,
    JointStiffness,
    Source,
    describe_fit,
)
from baselines.identification.pose_log import Kind, PoseLog, read_log, write_poses
from baselines.identification.pose_model import Frame, PoseModel, Unknowns
from baselines.identification.pose_plan import (
    MOST_PLANNED,
    PosePlan,
    candidate_poses,
    empty_log,
    plan_further,
    plan_poses,
)
from baselines.identification.static_arm import StaticArm
from elastic_env.core.config import Locator, Model, Title, quantity
from elastic_env.core.errors import ConfigurationError, unknown_name
from elastic_env.joint.joint_settings import SOFTEST
from elastic_env.joint.known_torque import commanded_hinges, hinges_of
from elastic_env.joint.model_file import compiled_model, from_mujoco
from train.figures import plots
from train.figures.arm_plots import draw_arm_identification
from train.runs.console import make_table
from train.runs.folders import run_folder
from train.runs.progress import show_progress

_ASSUMED_DEFLECTION_RAD = 0.01
"""Deflection under the largest gravity torque that a plan without a log assumes."""
_STIFFEST = 1e9
"""Largest K that can be assumed; a stiffer joint is rigid [N·m/rad]."""


class ArmOptions(Model):
    """Options of `elastic identify` for an arm of which there is a log of static poses."""

    robot: Locator | None = None
    """Rigid model of an arm, MJCF or URDF, in place of the testbed; the options from here on are
    of an arm.
    """
    log: Locator | None = None
    """CSV file of static poses: motor encoders, and link encoders, end-effector positions, an
    IMU or joint torques.
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


@dataclass(frozen=True)
class _Setting:
    """An arm, its log, the joints that are sought, and how."""

    options: ArmOptions
    arm: StaticArm
    log: PoseLog
    elastic: tuple[str, ...]
    seed: int

    def model(self, log: PoseLog | None = None) -> PoseModel:
        """The poses of a log as a function of the unknowns."""
        own = self.log if log is None else log
        has_payload = self.options.payload is not None
        return PoseModel(
            self.arm, own, Unknowns.of(own, self.elastic, self.options.frame, has_payload)
        )


def run_arm_identification(
    options: ArmOptions, console: Console, seed: int = 0, output: Path | None = None
) -> ArmIdentification | None:
    """Identify an arm, write `identification.json`, `joints.yaml` and the figure, print the result;
    or plan.

    Args:
        options: What to do.
        console: Where progress and table go.
        seed: Seed of the poses from which the plan chooses.
        output: Folder for the results; default runs/identify, numbered if taken.

    Returns:
        The result; None for a plan without a log.

    Raises:
        ConfigurationError: Model, log or a name cannot be used.
        ResultsExistError: The output folder holds results.
    """
    if options.robot is None:
        raise ConfigurationError(
            "--robot is missing; name the arm's model, a file of MJCF (.xml) or URDF (.urdf)"
        )
    if options.log is None and (not options.plan or options.measured_by is None):
        raise ConfigurationError(
            "give the CSV file of static poses by --log, or plan the first poses by --plan 40"
            " --measured-by end_effector (or link_encoders, imu, torques)"
        )
    plots.require_matplotlib()
    setting = _setting(options, compiled_model(options.robot), console, seed)
    recorded = {**options.model_dump(mode="json"), "seed": seed}
    with run_folder("identify", recorded, seed, output) as folder:
        if options.log is None:
            _plan_first(setting, folder, console)
            return None
        with show_progress(console, {"fitting, steps": USUAL_EVALUATIONS}, transient=True) as show:
            fit = fit_arm(setting.model(), lambda done: show(0, min(done, USUAL_EVALUATIONS)))
        plan = (
            plan_further(fit, _candidates(setting, console), options.plan) if options.plan else None
        )
        information = None if plan is None else plan.information
        result = describe_fit(fit, options.within, options.assume, information)
        files = result.save(folder)
        files.append(draw_arm_identification(fit, result, folder / "identification.png"))
        files += [] if plan is None else [_write_plan(setting.arm, plan, folder / "plan.csv")]
    console.print(result_table(result))
    for line in [summed_up(fit), *remarks(result)]:
        console.print(line, highlight=False)
    for path in files:
        console.print(f"wrote {path}", soft_wrap=True)
    return result


def result_table(result: ArmIdentification) -> Table:
    """An identification as a table."""
    has_friction = not result.friction_is_noise
    has_plan = result.joints[0].planned_half_width is not None
    title = f"K [N·m/rad] from {result.poses} poses, by {result.measurement.replace('_', ' ')}"
    head = [
        "joint",
        "K",
        "95 % interval",
        "±",
        *["planned ±"] * has_plan,
        *["F [N·m]"] * has_friction,
        "o [mrad]",
    ]
    rows = [
        [
            joint.joint,
            *_stiffness_cells(joint),
            *[_percent(joint.planned_half_width)] * has_plan,
            *[_number(joint.friction_nm)] * has_friction,
            _number(joint.offset_rad, 1e3),
        ]
        for joint in result.joints
    ]
    table = make_table(title, head, rows, box=box.SIMPLE, padding=(0, 1, 0, 0))
    for column in table.columns:
        column.no_wrap = True
    return table


def remarks(result: ArmIdentification) -> list[str]:
    """Remarks beside the table: the payload, joints that are not told apart, and poses that do
    not fit.
    """
    lines = []
    if result.payload_half_width_kg is not None:
        lines.append(_payload_line(result.payload_kg, result.payload_half_width_kg))
    for why in dict.fromkeys(joint.reason for joint in result.joints if joint.reason):
        names = ", ".join(joint.joint for joint in result.joints if joint.reason == why)
        lines.append(f"not told apart to {100 * result.within:g} %: {names}; {why}")
    if negative := [joint.joint for joint in result.joints if joint.is_negative]:
        lines.append(f"{', '.join(negative)}: {NEGATIVE}")
    lines += _written_lines(result.joints)
    usual = USUAL_NOISE[result.measurement]
    if result.residual_spread > FAR_BEYOND * usual:
        lines.append(
            f"the residuals are far beyond the usual noise of {in_unit(usual, result.measurement)}:"
            " look for other elastic joints, another frame (--frame) or body (--end-effector),"
            " friction, and errors of the model"
        )
    if result.outlying_poses:
        lines.append(
            f"poses that do not fit the others: {', '.join(map(str, result.outlying_poses))}; check"
            " them"
        )
    if result.held_joints:
        lines.append(
            "not in the log, and taken as held where the model has them:"
            f" {', '.join(result.held_joints)}"
        )
    if any(joint.reason for joint in result.joints) and result.joints[0].planned_half_width is None:
        lines.append("--plan 20 proposes poses that tell more")
    return lines + _beyond_any_plan(result.joints)


def _payload_line(mass_kg: float | None, half_width_kg: float) -> str:
    """The payload, or why there is none."""
    if mass_kg is None:
        return f"the poses do not tell the payload: its interval is ± {half_width_kg:.3g} kg wide"
    return f"payload {mass_kg:.3f} ± {half_width_kg:.3f} kg"


def _written_lines(joints: Sequence[JointStiffness]) -> list[str]:
    """Values in `joints.yaml` of joints whose interval reaches to rigid."""
    says: dict[Source, str] = {
        "no upper end": (
            "joints.yaml has the estimate, {}, although the interval reaches to rigid; --assume"
            " changes it"
        ),
        "rigid": "joints.yaml has {} as rigid (.inf); --assume changes it",
        "assumed": "joints.yaml has the assumed K for {}",
    }
    lines = []
    for source, text in says.items():
        own = [joint for joint in joints if joint.source == source]
        names = ", ".join(
            (
                joint.joint
                if source == "rigid"
                else f"{joint.joint} {joint.stiffness_nm_per_rad:.4g} N·m/rad"
            )
            for joint in own
        )
        if own:
            lines.append(text.format(names))
    return lines


def _beyond_any_plan(joints: Sequence[JointStiffness]) -> list[str]:
    """Joints for which no proposed pose helps."""
    helpless = [
        j.joint
        for j in joints
        if j.planned_half_width is not None and j.reason and j.planned_half_width > 1.0
    ]
    if not helpless:
        return []
    return [
        f"no proposed pose tells {', '.join(helpless)}: gravity must load the joint, and the"
        " measurement must show it; tilt the base, hang on a weight, or measure it by hand"
    ]


def _candidates(setting: _Setting, console: Console) -> PoseLog:
    """Poses to choose from; says where contacts of the arm are not known."""
    shapes = shaped_model(str(setting.options.robot))
    if not (shapes.geom_contype.any() or shapes.geom_conaffinity.any()):
        console.print(
            "the model has no shapes that MuJoCo can read: check the proposed poses for contacts"
            " yourself"
        )
    return candidate_poses(setting.arm, shapes, setting.log, np.random.default_rng(setting.seed))


def shaped_model(path: str) -> mujoco.MjModel:
    """The model with its collision shapes; that of `compiled_model` where MuJoCo cannot read the
    shapes.
    """
    plain = compiled_model(path)
    try:
        shaped = from_mujoco(
            lambda: mujoco.MjSpec.from_file(path).compile(), "the shapes of the model", "read"
        )
    except ConfigurationError:
        return plain
    return shaped if set(hinges_of(plain)) <= set(hinges_of(shaped)) else plain


def _setting(options: ArmOptions, model: mujoco.MjModel, console: Console, seed: int) -> _Setting:
    """Read the log, and look everything up that is named."""
    hinges = hinges_of(model)
    ranges = {name: _range(model, name) for name in hinges}
    log = None if options.log is None else read_log(Path(options.log), ranges, options.measured_by)
    joints = commanded_hinges(model) if log is None else log.joints
    arm = StaticArm(model, joints, options.end_effector, options.payload)
    arm.require_gravity()
    if log is None:
        log = empty_log(arm, options.measured_by or "end_effector")
    if options.end_effector is None and log.kind in ("end_effector", "imu"):
        console.print(
            f"measured is taken to be {arm.end_effector!r}; --end-effector names another site or"
            " body"
        )
    setting = _Setting(options, arm, log, _elastic_joints(options.joints, log.joints), seed)
    if options.log is not None:
        require_poses(setting.model())
    return setting


def _range(model: mujoco.MjModel, joint: str) -> tuple[float, float]:
    low, high = (
        model.joint(joint).range if model.jnt_limited[model.joint(joint).id] else (-np.inf, np.inf)
    )
    return float(low), float(high)


def _elastic_joints(patterns: Sequence[str], joints: Sequence[str]) -> tuple[str, ...]:
    """Joints that a name or pattern fits, in the order of the log."""
    for pattern in patterns:
        if not any(fnmatchcase(joint, pattern) for joint in joints):
            raise unknown_name("joint or pattern of the log's joints", pattern, joints)
    return tuple(
        joint for joint in joints if not patterns or any(fnmatchcase(joint, p) for p in patterns)
    )


def _plan_first(setting: _Setting, folder: Path, console: Console) -> None:
    """Plan without a log: with usual noise, and deflections of a usual size."""
    candidates = _candidates(setting, console)
    model = setting.model(candidates)
    noise = USUAL_NOISE[setting.log.kind]
    start = model.start_with(_ASSUMED_DEFLECTION_RAD)
    plan = plan_poses(model, start, noise, np.eye(len(start)), candidates, setting.options.plan)
    own = model.unknowns.slices["compliance"]
    half = (
        1.96
        * np.sqrt(np.diag(np.linalg.inv(plan.information))[own])
        * model.scale[own]
        / start[own]
    )
    rows = [
        (joint, _percent(float(width))) for joint, width in zip(setting.elastic, half, strict=True)
    ]
    console.print(
        make_table(f"{len(plan.theta)} proposed poses", ["joint", "expected ± of K"], rows)
    )
    console.print(
        f"expected for noise of {in_unit(noise, setting.log.kind)} and"
        f" {1e3 * _ASSUMED_DEFLECTION_RAD:g} mrad of deflection under the largest gravity torque of"
        " each joint; half the deflection doubles it",
        highlight=False,
    )
    console.print(f"wrote {_write_plan(setting.arm, plan, folder / 'plan.csv')}", soft_wrap=True)


def _write_plan(arm: StaticArm, plan: PosePlan, path: Path) -> Path:
    columns = {f"theta.{joint}": plan.theta[:, i] for i, joint in enumerate(arm.joints)}
    if plan.direction is not None:
        columns |= {
            f"direction.{joint}": plan.direction[:, i] for i, joint in enumerate(arm.joints)
        }
    return write_poses(path, columns)


def _stiffness_cells(joint: JointStiffness) -> list[str]:
    low = joint.stiffness_low_nm_per_rad
    high = joint.stiffness_high_nm_per_rad
    if low is None or high is None:
        return ["–", "–", _percent(joint.half_width)]
    return [
        f"{joint.stiffness_nm_per_rad:.4g}",
        f"{low:.4g} to {high:.4g}",
        _percent(joint.half_width),
    ]


def _number(value: float | None, scale: float = 1.0) -> str:
    return "–" if value is None else f"{scale * value:.2f}"


def _percent(half: float | None) -> str:
    return "> 100 %" if half is None or half > 1.0 else f"{100 * half:.2g} %"
