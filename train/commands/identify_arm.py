"""`elastic identify --robot`: stiffness of an arm from a log of static poses, and a plan."""

from pathlib import Path

import mujoco
import numpy as np
from rich.console import Console

from baselines.identification.arm_fit import (
    USUAL_EVALUATIONS,
    USUAL_NOISE,
    deviations,
    fit_arm,
    noise_text,
    residual_summary,
)
from baselines.identification.arm_result import ArmIdentification, describe_fit
from baselines.identification.geometry_result import GeometryIdentification
from baselines.identification.holdout import HoldoutProblem
from baselines.identification.pose_log import PoseLog, write_poses
from baselines.identification.pose_plan import PosePlan, candidate_poses, plan_further, plan_poses
from baselines.identification.servo_file import is_servo_log, read_content
from baselines.identification.servo_result import ServoIdentification
from baselines.identification.static_arm import StaticArm
from elastic_env.core.errors import ConfigurationError, quote
from elastic_env.joint.model_file import call_mujoco, compiled_model
from elastic_env.joint.model_joints import hinges_of
from train.commands.arm_problem import ArmProblem
from train.commands.held_out import judge_poses, print_held_out
from train.commands.identify_arm_tables import percent, remarks, result_table
from train.commands.identify_geometry import identify_geometry
from train.commands.identify_options import ArmOptions, IdentificationRun, ServoOptions
from train.commands.identify_servo import identify_servo
from train.commands.options import given_options
from train.figures import plots
from train.figures.identification_plots import draw_arm_identification
from train.runs.console import make_table
from train.runs.progress import show_progress

ArmResult = ArmIdentification | GeometryIdentification | ServoIdentification
_ASSUMED_DEFLECTION_RAD = 0.01
"""Deflection under the largest gravity torque that a plan without a log assumes."""


def identify_arm(options: ArmOptions, run: IdentificationRun, console: Console) -> ArmResult | None:
    """Identify an arm or a servo, write files and print the result; or plan poses.

    Args:
        options: Options of the command.
        run: Seed, and folder of the results.
        console: Console for progress and table.

    Returns:
        The result; None for a plan without a log.

    Raises:
        ConfigurationError: Model, log or a name cannot be used.
        ResultsExistError: The output folder contains results.
    """
    if options.log and is_servo_log(Path(options.log[0])):
        return identify_servo(options, run, console)
    _require_poses(options)
    plots.require_matplotlib()
    model = compiled_model(str(options.robot))
    problem = ArmProblem.from_options(options, model, console, run.seed)
    if problem.has_unknown_geometry:
        _require_positions(options, problem.log)
        tool = problem.arm.end_effector
        return identify_geometry(options, problem.log, problem.elastic, tool, run, console)
    if unused := given_options(options.markers, ["lateral", "free"]):
        raise ConfigurationError(
            f"{', '.join(unused)}: for a fit of the geometry only; ask for one by --geometry"
        )
    with run.folder(options.model_dump(mode="json")) as folder:
        if not options.log:
            _plan_first(problem, folder, console)
            return None
        work = {"fitting, steps": USUAL_EVALUATIONS}
        with show_progress(console, work, transient=True) as show:
            poses = problem.model(problem.log)
            fit = fit_arm(poses, lambda done: show(0, min(done, USUAL_EVALUATIONS)))
        plan = None
        if options.plan:
            plan = plan_further(fit, _find_candidates(problem, console), options.plan)
        information = None if plan is None else plan.information
        holdout = HoldoutProblem.from_poses(poses)
        held_out = judge_poses(holdout, options.judged, console, run.seed)
        result = describe_fit(fit, options.within, options.assume, information, held_out)
        files = result.save(folder)
        picture = folder / f"identification.{run.figure_format}"
        files.append(draw_arm_identification(fit, result, picture))
        if plan is not None:
            files.append(_write_plan(problem.arm, plan, folder))
    if result.held_out is not None:
        print_held_out(result.held_out, console)
    console.print(result_table(result))
    written = [f"wrote {path}" for path in files]
    for line in (residual_summary(fit), *remarks(result), *written):
        console.print(line)
    return result


def _require_poses(options: ArmOptions) -> None:
    """Refuse options that name neither static poses of an arm nor a first plan of them."""
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
        problem = "--mass-kg, --lever-m, --gain, --angles and --unfitted are for logs in time"
        try:
            for log in logs:
                read_content(log, None)
        except ConfigurationError as error:
            raise ConfigurationError(f"{problem}; {error}") from None
        cure = "name one with columns time, goal and position by --log"
        raise ConfigurationError(f"{problem}; {cure}")
    if options.robot is None:
        problem = "--robot is missing; name the arm's model, a file of MJCF (.xml) or URDF (.urdf)"
        raise ConfigurationError(problem)
    if not logs and (not options.plan or options.measured_by is None):
        raise ConfigurationError(
            "give the CSV file of static poses by --log, or plan the first poses by --plan 40"
            " --measured-by end_effector (or link_encoders, imu, torques)"
        )
    if len(logs) > 1:
        problem = f"static poses must be in one file, got {len(logs)}; write one table"
        raise ConfigurationError(problem)


def _require_positions(options: ArmOptions, log: PoseLog) -> None:
    """Refuse measurements and options that a fit of the geometry does not use.

    Raises:
        ConfigurationError: The log has no positions, or one of the options is given.
    """
    others = ["plan", "payload", "assume", "frame", "within"]
    if log.kind == "markers":
        others.append("end_effector")
    if unused := given_options(options, others):
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


def _plan_first(problem: ArmProblem, folder: Path, console: Console) -> None:
    """Plan poses without a log: with usual noise, and deflections of a usual size."""
    candidates = _find_candidates(problem, console)
    model = problem.model(candidates)
    noise = USUAL_NOISE[problem.log.kind]
    start = model.start_with(_ASSUMED_DEFLECTION_RAD)
    prior = np.eye(len(start))
    plan = plan_poses(model, start, noise, prior, candidates, problem.options.plan)
    compliance = start[model.unknowns.slices["compliance"]]
    half = 1.96 * deviations(model, plan.information, "compliance") / compliance
    rows = list(zip(problem.elastic, map(percent, half.tolist()), strict=True))
    head = ["joint", "expected ± of K"]
    console.print(make_table(f"{len(plan.theta)} proposed poses", head, rows))
    console.print(
        f"expected for noise of {noise_text(noise, problem.log.kind)} and"
        f" {1e3 * _ASSUMED_DEFLECTION_RAD:g} mrad of deflection under the largest gravity torque of"
        " each joint; half the deflection doubles it"
    )
    console.print(f"wrote {_write_plan(problem.arm, plan, folder)}")


def _write_plan(arm: StaticArm, plan: PosePlan, folder: Path) -> Path:
    """Write the poses as `plan.csv`, and return its path."""
    columns = {f"theta.{joint}": plan.theta[:, i] for i, joint in enumerate(arm.joints)}
    if plan.direction is not None:
        for i, joint in enumerate(arm.joints):
            columns[f"direction.{joint}"] = plan.direction[:, i]
    return write_poses(folder / "plan.csv", columns)


def _find_candidates(problem: ArmProblem, console: Console) -> PoseLog:
    """Poses to choose from; warns where contacts of the arm are not known."""
    shapes = _model_with_shapes(str(problem.options.robot))
    if not (shapes.geom_contype.any() or shapes.geom_conaffinity.any()):
        console.print(
            "the model has no shapes that MuJoCo can read: check the proposed poses for contacts"
            " yourself"
        )
    generator = np.random.default_rng(problem.seed)
    return candidate_poses(problem.arm, shapes, problem.log, generator)


def _model_with_shapes(path: str) -> mujoco.MjModel:
    """The model with its collision shapes, or without them where MuJoCo cannot read them."""
    plain = compiled_model(path)

    def compile_shapes() -> mujoco.MjModel:
        return mujoco.MjSpec.from_file(path).compile()

    try:
        shaped = call_mujoco(compile_shapes, "the shapes of the model", "read")
    except ConfigurationError:
        return plain
    return shaped if set(hinges_of(plain)) <= set(hinges_of(shaped)) else plain
