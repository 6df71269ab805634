"""Poses that `elastic identify --plan` proposes."""

from pathlib import Path

import mujoco
import numpy as np
from rich.console import Console

from baselines.identification.arm_fit import USUAL_NOISE, deviations, noise_text
from baselines.identification.pose_log import PoseLog, write_poses
from baselines.identification.pose_plan import PosePlan, candidate_poses, plan_poses
from baselines.identification.static_arm import StaticArm
from elastic_env.core.errors import ConfigurationError
from elastic_env.joint.model_file import call_mujoco, compiled_model
from elastic_env.joint.model_joints import hinges_of
from train.commands.arm_problem import ArmProblem
from train.commands.identify_arm_tables import percent
from train.runs.console import make_table

_ASSUMED_DEFLECTION_RAD = 0.01
"""Deflection under the largest gravity torque that a plan without a log assumes."""


def plan_first(problem: ArmProblem, folder: Path, console: Console) -> None:
    """Plan poses without a log: with usual noise, and deflections of a usual size."""
    candidates = find_candidates(problem, console)
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
    console.print(f"wrote {write_plan(problem.arm, plan, folder)}")


def write_plan(arm: StaticArm, plan: PosePlan, folder: Path) -> Path:
    """Write the poses as `plan.csv`, and return its path."""
    columns = {f"theta.{joint}": plan.theta[:, i] for i, joint in enumerate(arm.joints)}
    if plan.direction is not None:
        for i, joint in enumerate(arm.joints):
            columns[f"direction.{joint}"] = plan.direction[:, i]
    return write_poses(folder / "plan.csv", columns)


def find_candidates(problem: ArmProblem, console: Console) -> PoseLog:
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
