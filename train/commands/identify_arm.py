"""`elastic identify --robot`: stiffness of an arm from a log of static poses, and a plan."""

from pathlib import Path

from rich.console import Console

from baselines.identification.arm_fit import (
    USUAL_EVALUATIONS,
    fit_arm,
    residual_summary,
)
from baselines.identification.arm_result import (
    ArmIdentification,
    describe_fit,
)
from baselines.identification.geometry_result import GeometryIdentification
from baselines.identification.holdout import HoldoutProblem
from baselines.identification.pose_log import PoseLog
from baselines.identification.pose_plan import plan_further
from baselines.identification.servo_file import is_servo_log
from baselines.identification.servo_result import ServoIdentification
from elastic_env.core.errors import ConfigurationError, quote
from elastic_env.joint.model_file import compiled_model
from train.commands.arm_problem import ArmProblem
from train.commands.held_out import judge_poses, print_held_out
from train.commands.identify_arm_tables import remarks, result_table
from train.commands.identify_geometry import identify_geometry
from train.commands.identify_options import ArmOptions, IdentificationRun, ServoOptions
from train.commands.identify_plan import find_candidates, plan_first, write_plan
from train.commands.identify_servo import identify_servo
from train.commands.options import given_options
from train.figures import plots
from train.figures.identification_plots import draw_arm_identification
from train.runs.progress import show_progress

ArmResult = ArmIdentification | GeometryIdentification | ServoIdentification


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
            plan_first(problem, folder, console)
            return None
        work = {"fitting, steps": USUAL_EVALUATIONS}
        with show_progress(console, work, transient=True) as show:
            poses = problem.model(problem.log)
            fit = fit_arm(poses, lambda done: show(0, min(done, USUAL_EVALUATIONS)))
        plan = None
        information = None
        if options.plan:
            plan = plan_further(fit, find_candidates(problem, console), options.plan)
            information = plan.information
        held_out = judge_poses(HoldoutProblem.from_poses(poses), options.judged, console, run.seed)
        result = describe_fit(fit, options.within, options.assume, information, held_out)
        files = result.save(folder)
        picture = folder / f"identification.{run.figure_format}"
        files.append(draw_arm_identification(fit, result, picture))
        if plan is not None:
            files.append(write_plan(problem.arm, plan, folder))
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
