"""`elastic identify --robot`: stiffness of an arm from a log of static poses, and a plan."""

import fnmatch
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
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
from baselines.identification.geometry_result import GeometryIdentification
from baselines.identification.holdout import Judged
from baselines.identification.pose_log import PoseLog, read_log, write_poses
from baselines.identification.pose_model import PoseModel, Unknowns
from baselines.identification.pose_plan import (
    PosePlan,
    candidate_poses,
    empty_log,
    plan_further,
    plan_poses,
)
from baselines.identification.servo_file import is_servo_log
from baselines.identification.servo_result import ServoIdentification
from baselines.identification.static_arm import StaticArm
from elastic_env.core.errors import ConfigurationError, quote, unknown_name
from elastic_env.joint.model_file import compiled_model, from_mujoco
from elastic_env.joint.supported_models import commanded_hinges, hinges_of
from elastic_env.world.robot_model import joint_ranges
from train.commands.held_out import judge_poses, number_or_dash, print_held_out
from train.commands.identify_geometry import identify_geometry
from train.commands.identify_options import ArmOptions, IdentificationRun, ServoOptions
from train.commands.identify_servo import identify_servo
from train.commands.options import given_options
from train.figures import plots
from train.figures.identification_plots import draw_arm_identification
from train.runs.console import make_table
from train.runs.progress import show_progress

IdentifiedArm = ArmIdentification | GeometryIdentification | ServoIdentification
_ASSUMED_DEFLECTION_RAD = 0.01
"""Deflection under the largest gravity torque that a plan without a log assumes."""


@dataclass(frozen=True)
class _Setting:
    """An arm, its log, the joints that are sought, and how."""

    options: ArmOptions
    arm: StaticArm
    log: PoseLog
    elastic: tuple[str, ...]
    seed: int

    @property
    def seeks_geometry(self) -> bool:
        """Whether markers tell geometry and stiffness together."""
        return self.log.kind == "markers" or self.options.markers.geometry is not None

    def model(self, log: PoseLog) -> PoseModel:
        """The poses of a log as a function of the unknowns."""
        has_payload = self.options.payload is not None
        unknowns = Unknowns.of(log, self.elastic, self.options.frame, has_payload)
        return PoseModel(self.arm, log, unknowns)


def identify_arm(
    options: ArmOptions, run: IdentificationRun, console: Console
) -> IdentifiedArm | None:
    """Identify an arm or a servo, write files and print the result; or plan poses.

    Args:
        options: What to do.
        run: Seed of what is drawn, and where results go.
        console: Where progress and table go.

    Returns:
        The result; None for a plan without a log.

    Raises:
        ConfigurationError: Model, log or a name cannot be used.
        ResultsExistError: The output folder holds results.
    """
    if options.log and is_servo_log(Path(options.log[0])):
        return identify_servo(options, run, console)
    _require_poses(options)
    plots.require_matplotlib()
    setting = _setting(options, compiled_model(str(options.robot)), console, run.seed)
    if setting.seeks_geometry:
        _require_positions(options, setting.log)
        tool = setting.arm.end_effector
        return identify_geometry(options, setting.log, setting.elastic, tool, run, console)
    if of_geometry := given_options(options.markers, ["lateral", "free"]):
        raise ConfigurationError(
            f"{', '.join(of_geometry)}: for a fit of the geometry only; ask for one by --geometry"
        )
    with run.folder(options.model_dump(mode="json")) as folder:
        if not options.log:
            _plan_first(setting, folder, console)
            return None
        work = {"fitting, steps": USUAL_EVALUATIONS}
        with show_progress(console, work, transient=True) as show:
            model = setting.model(setting.log)
            fit = fit_arm(model, lambda done: show(0, min(done, USUAL_EVALUATIONS)))
        plan = None
        if options.plan:
            plan = plan_further(fit, _candidates(setting, console), options.plan)
        information = None if plan is None else plan.information
        held_out = judge_poses(Judged.of_poses(model), options.judged, console, run.seed)
        result = describe_fit(fit, options.within, options.assume, information, held_out)
        files = result.save(folder)
        picture = folder / f"identification.{run.figure_format}"
        files.append(draw_arm_identification(fit, result, picture))
        if plan is not None:
            files.append(_write_plan(setting.arm, plan, folder / "plan.csv"))
    if result.held_out is not None:
        print_held_out(result.held_out, console)
    console.print(result_table(result))
    written = [f"wrote {path}" for path in files]
    for line in (summed_up(fit), *remarks(result), *written):
        console.print(line)
    return result


def _require_poses(options: ArmOptions) -> None:
    """Refuse options that do not name static poses of an arm, or the first plan of them."""
    logs = [Path(log) for log in options.log]
    for log in logs:
        if not log.exists():
            raise ConfigurationError(f"no log at {quote(str(log))[1:-1]}; name a file")
        if log.is_file() and log.stat().st_size == 0:
            raise ConfigurationError(
                f"the log {quote(str(log))[1:-1]} is empty; a log in time has the columns time,"
                " goal and position, one of poses those of docs/identification.md"
            )
    if options.servo != ServoOptions():
        raise ConfigurationError(
            "--mass-kg, --lever-m, --gain, --angles and --unfitted are for logs in time; name one"
            " with columns time, goal and position by --log"
        )
    if options.robot is None:
        problem = "--robot is missing; name the arm's model, a file of MJCF (.xml) or URDF (.urdf)"
        raise ConfigurationError(problem)
    if not logs and (not options.plan or options.measured_by is None):
        raise ConfigurationError(
            "give the CSV file of static poses by --log, or plan the first poses by --plan 40"
            " --measured-by end_effector (or link_encoders, imu, torques)"
        )
    if len(logs) > 1:
        raise ConfigurationError(
            f"static poses must be in one file, got {len(logs)}; write one table"
        )


def result_table(result: ArmIdentification) -> Table:
    """An identification as a table."""
    joints = result.joints
    intervals = [_interval(joint) for joint in joints]
    stiffness = [number_or_dash(joint.stiffness_nm_per_rad) for joint in joints]
    told = zip(stiffness, intervals, strict=True)
    columns: dict[str, Sequence[str]] = {
        "joint": [joint.joint for joint in joints],
        "K": [interval if interval == "–" else own for own, interval in told],
        "95 % interval": intervals,
        "±": [_percent(joint.half_width) for joint in joints],
    }
    if joints[0].planned_half_width is not None:
        columns["planned ±"] = [_percent(joint.planned_half_width) for joint in joints]
    if not result.friction_is_noise:
        columns["F [N·m]"] = [number_or_dash(joint.friction_nm, ".2f") for joint in joints]
    columns["o [mrad]"] = [number_or_dash(joint.offset_rad, ".2f", 1e3) for joint in joints]
    title = f"K [N·m/rad] from {result.poses} poses, by {result.measurement.replace('_', ' ')}"
    rows = zip(*columns.values(), strict=True)
    table = make_table(title, list(columns), rows, box=box.SIMPLE, padding=(0, 1, 0, 0))
    for column in table.columns:
        column.no_wrap = True
    return table


def remarks(result: ArmIdentification) -> Iterator[str]:
    """Remarks beside the table: payload, joints that are not told apart, poses that do not fit."""
    joints = result.joints
    half_width_kg = result.payload_half_width_kg
    if half_width_kg is not None and result.payload_kg is None:
        width = f"± {half_width_kg:.3g} kg"
        yield f"the poses do not tell the payload: its interval is {width} wide"
    elif half_width_kg is not None:
        yield f"payload {result.payload_kg:.3f} ± {half_width_kg:.3f} kg"
    for why in dict.fromkeys(joint.reason for joint in joints if joint.reason):
        names = ", ".join(joint.joint for joint in joints if joint.reason == why)
        yield f"not told apart to {100 * result.within:g} %: {names}; {why}"
    if negative := [joint.joint for joint in joints if joint.is_negative]:
        yield f"{', '.join(negative)}: {NEGATIVE}"
    for source, text in _WRITTEN.items():
        own = [joint for joint in joints if joint.source == source]
        names = ", ".join(
            joint.joint
            if source == "rigid"
            else f"{joint.joint} {joint.stiffness_nm_per_rad:.4g} N·m/rad"
            for joint in own
        )
        if own:
            yield text.format(names)
    usual = USUAL_NOISE[result.measurement]
    if result.residual_spread > FAR_BEYOND * usual:
        yield (
            f"the residuals are far beyond the usual noise of {in_unit(usual, result.measurement)}:"
            " look for other elastic joints, another frame (--frame) or body (--end-effector),"
            " friction, and errors of the model"
        )
    if result.outlying_poses:
        poses = ", ".join(map(str, result.outlying_poses))
        yield f"poses that do not fit the others: {poses}; check them"
    if result.held_joints:
        held = ", ".join(result.held_joints)
        yield f"not in the log, and taken as held where the model has them: {held}"
    unknown = [joint for joint in joints if joint.reason]
    if unknown and joints[0].planned_half_width is None:
        yield "--plan 20 proposes poses that tell more"
    helpless = [one.joint for one in unknown if (one.planned_half_width or 0.0) > 1.0]
    if helpless:
        yield (
            f"no proposed pose tells {', '.join(helpless)}: gravity must load the joint, and the"
            " measurement must show it; tilt the base, hang on a weight, or measure it by hand"
        )


_WRITTEN: dict[Source, str] = {
    "no upper end": (
        "joints.yaml has the estimate, {}, although the interval reaches to rigid; --assume"
        " changes it"
    ),
    "rigid": "joints.yaml has {} as rigid (.inf); --assume changes it",
    "assumed": "joints.yaml has the assumed K for {}",
}
"""Remarks on joints whose interval reaches to rigid."""


def _candidates(setting: _Setting, console: Console) -> PoseLog:
    """Poses to choose from; says where contacts of the arm are not known."""
    shapes = shaped_model(str(setting.options.robot))
    if not (shapes.geom_contype.any() or shapes.geom_conaffinity.any()):
        console.print(
            "the model has no shapes that MuJoCo can read: check the proposed poses for contacts"
            " yourself"
        )
    generator = np.random.default_rng(setting.seed)
    return candidate_poses(setting.arm, shapes, setting.log, generator)


def shaped_model(path: str) -> mujoco.MjModel:
    """The model with its collision shapes, or without them where MuJoCo cannot read them."""
    plain = compiled_model(path)

    def read() -> mujoco.MjModel:
        return mujoco.MjSpec.from_file(path).compile()

    try:
        shaped = from_mujoco(read, "the shapes of the model", "read")
    except ConfigurationError:
        return plain
    return shaped if set(hinges_of(plain)) <= set(hinges_of(shaped)) else plain


def _require_positions(options: ArmOptions, log: PoseLog) -> None:
    """Refuse measurements and options that a fit of the geometry has no use for.

    Raises:
        ConfigurationError: The log has no positions, or one of the options is given.
    """
    of_site = ["end_effector"] if log.kind == "markers" else []
    of_poses = ["plan", "payload", "assume", "frame", "within", *of_site]
    if unused := given_options(options, of_poses):
        raise ConfigurationError(
            f"{', '.join(unused)} {'is' if len(unused) == 1 else 'are'} not for a fit of the"
            " geometry from markers; leave it out"
        )
    if log.kind not in ("markers", "end_effector"):
        raise ConfigurationError(
            "a fit of the geometry needs positions, in columns marker.NAME.x, .y, .z or"
            f" end_effector.x, .y, .z, and {options.log[0]} is used for its"
            f" {log.kind.replace('_', ' ')}; leave --geometry out"
        )


def _setting(options: ArmOptions, model: mujoco.MjModel, console: Console, seed: int) -> _Setting:
    """Read the log, and look everything up that is named."""
    hinges = hinges_of(model)
    log = None
    if options.log:
        ranges = dict(zip(hinges, zip(*joint_ranges(model, hinges), strict=True), strict=True))
        log = read_log(Path(options.log[0]), ranges, options.measured_by)
    joints = commanded_hinges(model) if log is None else log.joints
    arm = StaticArm(model, joints, options.end_effector, options.payload)
    if log is None:
        log = empty_log(arm, options.measured_by or "end_effector")
    if options.end_effector is None and log.kind in ("end_effector", "imu"):
        console.print(
            f"measured is taken to be {arm.end_effector!r}; --end-effector names another site or"
            " body"
        )
    elastic = _elastic_joints(options.joints, log.joints)
    setting = _Setting(options, arm, log, elastic, seed)
    if options.log and not setting.seeks_geometry:
        require_poses(setting.model(log))
    return setting


def _elastic_joints(patterns: Sequence[str], joints: Sequence[str]) -> tuple[str, ...]:
    """Joints that a name or pattern fits, in the order of the log."""
    chosen = set[str]()
    for pattern in patterns:
        fitting = fnmatch.filter(joints, pattern)
        if not fitting:
            raise unknown_name("joint or pattern of the log's joints", pattern, joints)
        chosen.update(fitting)
    return tuple(joint for joint in joints if joint in chosen or not patterns)


def _plan_first(setting: _Setting, folder: Path, console: Console) -> None:
    """Plan without a log: with usual noise, and deflections of a usual size."""
    candidates = _candidates(setting, console)
    model = setting.model(candidates)
    noise = USUAL_NOISE[setting.log.kind]
    start = model.start_with(_ASSUMED_DEFLECTION_RAD)
    prior = np.eye(len(start))
    plan = plan_poses(model, start, noise, prior, candidates, setting.options.plan)
    own = model.unknowns.slices["compliance"]
    spread = np.sqrt(np.diag(np.linalg.inv(plan.information))[own])
    half = 1.96 * spread * model.scale[own] / start[own]
    rows = list(zip(setting.elastic, map(_percent, half.tolist()), strict=True))
    head = ["joint", "expected ± of K"]
    console.print(make_table(f"{len(plan.theta)} proposed poses", head, rows))
    console.print(
        f"expected for noise of {in_unit(noise, setting.log.kind)} and"
        f" {1e3 * _ASSUMED_DEFLECTION_RAD:g} mrad of deflection under the largest gravity torque of"
        " each joint; half the deflection doubles it"
    )
    console.print(f"wrote {_write_plan(setting.arm, plan, folder / 'plan.csv')}")


def _write_plan(arm: StaticArm, plan: PosePlan, path: Path) -> Path:
    columns = {f"theta.{joint}": plan.theta[:, i] for i, joint in enumerate(arm.joints)}
    if plan.direction is not None:
        for i, joint in enumerate(arm.joints):
            columns[f"direction.{joint}"] = plan.direction[:, i]
    return write_poses(path, columns)


def _interval(joint: JointStiffness) -> str:
    low = number_or_dash(joint.stiffness_low_nm_per_rad)
    high = number_or_dash(joint.stiffness_high_nm_per_rad)
    return "–" if "–" in (low, high) else f"{low} to {high}"


def _percent(half: float | None) -> str:
    return "> 100 %" if half is None or half > 1.0 else f"{100 * half:.2g} %"
