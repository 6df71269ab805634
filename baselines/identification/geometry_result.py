"""Result of an identification with geometry: estimates in JSON, K in YAML, a model in MJCF."""

import math
from pathlib import Path

import mujoco
from pydantic import Field

from baselines.identification.geometry_fit import GeometryEstimate, GeometryFit
from baselines.identification.geometry_model import Geometry
from baselines.identification.holdout import HeldOut
from baselines.identification.results import save_result, stiffness_ends, stiffness_line
from baselines.identification.rotations import rotation_of
from elastic_env.core.config import Model
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.quaternions import matrix_of, quaternion_of
from elastic_env.rigid.tree.links import Tree


class JointCompliance(Model):
    """Stiffness of one joint about its own axis."""

    joint: str
    stiffness_nm_per_rad: float = Field(allow_inf_nan=True)
    """Value in `joints.yaml`; infinite for a rigid joint, which JSON has as null."""
    stiffness_low_nm_per_rad: float | None
    stiffness_high_nm_per_rad: float | None
    """Ends of the 95 % interval; None where it reaches to rigid."""


class GeometryIdentification(Model):
    """Result of an identification with geometry; written as `identification.json`."""

    poses: int
    numbers: int
    """Measured coordinates: three for each marker of a pose."""
    geometry: Geometry
    lateral: bool
    noise_mm: float
    """Standard deviation of a coordinate of a marker that is not explained."""
    joints: tuple[JointCompliance, ...]
    parameters: tuple[GeometryEstimate, ...]
    held_out: HeldOut | None = None

    @property
    def prior_parameters(self) -> tuple[str, ...]:
        """Parameters that the poses do not determine, such as `elbow.x length`."""
        return tuple(
            f"{parameter.name} {parameter.kind}"
            for parameter in self.parameters
            if not parameter.is_told
        )

    def save(self, folder: Path, model: mujoco.MjSpec) -> list[Path]:
        """Write `identification.json`, `joints.yaml` and `model.xml`."""
        head = "# stiffness [N·m/rad], by elastic identify --geometry; .inf for a rigid joint"
        lines = [
            stiffness_line(joint.joint, joint.stiffness_nm_per_rad, _interval(joint))
            for joint in self.joints
        ]
        model_file = folder / "model.xml"
        model_file.write_text(model.to_xml(), encoding="utf-8")
        return [*save_result(self, folder, head, lines), model_file]


def describe_geometry(fit: GeometryFit, held_out: HeldOut | None) -> GeometryIdentification:
    """Result of a fit."""
    problem = fit.problem
    compliances = {e.name: e for e in fit.estimates if e.kind == "compliance"}
    joints = [_compliance_of(name, compliances.get(name)) for name in problem.model.joints]
    return GeometryIdentification(
        poses=len(problem.theta),
        numbers=problem.measured.size,
        geometry=problem.geometry,
        lateral=problem.lateral,
        noise_mm=1e3 * fit.noise_m,
        joints=tuple(joints),
        parameters=fit.estimates,
        held_out=held_out,
    )


def correct_model(spec: mujoco.MjSpec, tree: Tree, fit: GeometryFit) -> mujoco.MjSpec:
    """Copy of a model with the identified lengths and angles.

    Its paths of meshes and textures are absolute, so that it may be saved anywhere. A model has no
    encoder offsets: subtract them from the readings of the encoders.

    Args:
        spec: Specification of the rigid model.
        tree: Its links.
        fit: Lengths and angles by which the frames of the joints differ.

    Raises:
        ConfigurationError: A body has two hinges.
    """
    model = spec.compile()
    corrected = spec.copy()
    bodies = sorted(corrected.bodies, key=lambda body: body.id)
    if spec.meshes:
        corrected.meshdir = str(Path(spec.modelfiledir, spec.meshdir).resolve())
    if spec.textures:
        corrected.texturedir = str(Path(spec.modelfiledir, spec.texturedir).resolve())
    problem = fit.problem
    for j, joint in enumerate(problem.model.joints):
        body = int(model.joint(joint).bodyid[0])
        if model.body_jntnum[body] != 1:
            raise ConfigurationError(
                f"body {model.body(body).name!r} has {model.body_jntnum[body]} joints; a model with"
                " identified geometry needs one joint a body"
            )
        above = int(model.body_parentid[body])
        R = tree.R[above]  # from the body above to its link
        turn = problem.model.nominal[j] @ rotation_of(fit.parameters.angle[j])
        turn = R.T @ turn @ problem.model.nominal[j].T @ R
        anchor = R.T @ (problem.model.anchor[j] - tree.place[above])
        shift = R.T @ problem.model.nominal[j] @ fit.parameters.length[j]
        target = bodies[body]
        if target.frame is not None:  # the new pose is in the parent's axes
            target.set_frame(target.parent.add_frame())
        target.pos = anchor + shift + turn @ (model.body_pos[body] - anchor)
        target.quat = quaternion_of(turn @ matrix_of(model.body_quat[body]))
        target.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    return corrected


def _compliance_of(joint: str, estimate: GeometryEstimate | None) -> JointCompliance:
    """Result of a joint; rigid where its compliance is not determined or not above zero."""
    c = h = 0.0
    if estimate is not None and estimate.value > 0.0 and estimate.is_told:
        c = estimate.value
        h = estimate.half_width
    low, high = stiffness_ends(c, h)
    return JointCompliance(
        joint=joint,
        stiffness_nm_per_rad=1.0 / c if c else math.inf,
        stiffness_low_nm_per_rad=low,
        stiffness_high_nm_per_rad=high,
    )


def _interval(joint: JointCompliance) -> str:
    """Interval of a stiffness as text."""
    if joint.stiffness_low_nm_per_rad is None:
        return "rigid"
    high = joint.stiffness_high_nm_per_rad
    upper = "rigid" if high is None else f"{high:.4g}"
    return f"{joint.stiffness_low_nm_per_rad:.4g} to {upper}"
