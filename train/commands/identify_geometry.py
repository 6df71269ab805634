"""`elastic identify --geometry`: encoders, geometry and stiffness of an arm from markers."""

from collections.abc import Sequence

import mujoco
import numpy as np
from rich import box
from rich.console import Console

from baselines.identification.geometry_fit import fit_geometry
from baselines.identification.geometry_model import AxialTorques, GeometryModel
from baselines.identification.geometry_problem import GeometryProblem
from baselines.identification.geometry_result import (
    GeometryIdentification,
    correct_model,
    describe_geometry,
)
from baselines.identification.holdout import HoldoutProblem
from baselines.identification.pose_log import PoseLog
from elastic_env.core.errors import list_names, require_known
from elastic_env.joint.model_file import read_model
from elastic_env.joint.model_joints import held_positions
from elastic_env.rigid.tree.end_effector import site_or_body
from elastic_env.rigid.tree.links import Tree
from train.commands.held_out import judge_poses, number_or_dash, print_held_out
from train.commands.identify_options import ArmOptions, GeometryOptions, IdentificationRun
from train.figures.identification_plots import draw_geometry
from train.runs.console import make_table
from train.runs.progress import show_progress


def identify_geometry(
    options: ArmOptions,
    log: PoseLog,
    elastic: Sequence[str],
    end_effector: str,
    run: IdentificationRun,
    console: Console,
) -> GeometryIdentification:
    """Identify geometry and stiffness, write files and figure, print tables.

    Args:
        options: The arm, and its unknowns.
        log: Poses with places of markers.
        elastic: Joints whose stiffness is estimated.
        end_effector: Site or body that is measured, where the log names no markers.
        run: Seed of the poses that are held out, and folder of the results.
        console: Console for progress and tables.

    Raises:
        ConfigurationError: A name does not exist, or there are too few poses.
        ElasticError: The poses do not fit the arm.
    """
    spec = read_model(str(options.robot)).spec
    problem, tree = pose_problem(options.markers, spec.compile(), log, elastic, end_effector)
    with run.folder(options.model_dump(mode="json")) as folder:
        with show_progress(console, {"fits": 1}, transient=True) as show:
            fit = fit_geometry(problem)
            show(0, 1)
        holdout = HoldoutProblem.from_geometry(problem)
        held_out = judge_poses(holdout, options.judged, console, run.seed)
        result = describe_geometry(fit, held_out)
        files = result.save(folder, correct_model(spec, tree, fit))
        picture = folder / f"identification.{run.figure_format}"
        files.append(draw_geometry(result, picture))
    show_result(result, console)
    for path in files:
        console.print(f"wrote {path}")
    return result


def pose_problem(
    options: GeometryOptions,
    model: mujoco.MjModel,
    log: PoseLog,
    elastic: Sequence[str],
    end_effector: str,
) -> tuple[GeometryProblem, Tree]:
    """The poses of a log as a problem, and the links of the model."""
    require_known("joint of the log", options.free, log.joints)
    tree = Tree.of(model, log.joints, held_positions(model, log.joints))
    names = [end_effector]
    if log.kind == "markers":
        names = [column.removesuffix(".x") for column in log.columns[::3]]
    markers = [(name, *site_or_body(model, name)[:2]) for name in names]
    problem = GeometryProblem(
        model=GeometryModel.from_tree(tree, log.joints, model.opt.gravity, markers),
        theta=log.theta,
        measured=log.measured.reshape(len(log), len(names), 3),
        geometry=options.geometry or "offsets",
        elastic=tuple(elastic),
        lateral=options.lateral,
        priors=options.priors,
        free=options.free,
        axial=_axial_torques(log),
    )
    return problem.align(), tree


def _axial_torques(log: PoseLog) -> AxialTorques | None:
    """Sides of approach and known torques of a log; None where it has neither."""
    if log.direction is None and log.known_torque is None:
        return None
    nothing = np.zeros_like(log.theta)
    return AxialTorques(
        direction=nothing if log.direction is None else log.direction,
        known_torque=nothing if log.known_torque is None else log.known_torque,
    )


def show_result(result: GeometryIdentification, console: Console) -> None:
    """Print held-out errors, stiffness, and parameters that the poses do not determine."""
    if result.held_out is not None:
        print_held_out(result.held_out, console)
    rows = []
    frictions = [p for p in result.parameters if p.kind == "friction"]
    friction = {p.name: p.value if p.is_told else None for p in frictions}
    for joint in result.joints:
        stiffness = number_or_dash(joint.stiffness_nm_per_rad).replace("inf", "rigid")
        ends = (joint.stiffness_low_nm_per_rad, joint.stiffness_high_nm_per_rad)
        rows.append([joint.joint, stiffness, *map(number_or_dash, ends)])
        if friction:
            rows[-1].append(number_or_dash(friction.get(joint.joint)))
    console.print(f"unexplained: {result.noise_mm:.2f} mm in each coordinate of a marker")
    title = f"K [N·m/rad] from {result.poses} poses"
    head = ["joint", "K", "from", "to", *["F [N·m]"] * bool(friction)]
    console.print(make_table(title, head, rows, box=box.SIMPLE))
    if result.numbers < len(result.parameters):
        console.print(
            f"{result.numbers} measured numbers for {len(result.parameters)} parameters: most rests"
            " on the priors; log more poses"
        )
    names = result.prior_parameters
    if names:
        console.print(
            f"{len(names)} of {len(result.parameters)} parameters keep their prior, as the"
            f" poses do not tell them: {list_names(names)}"
        )
