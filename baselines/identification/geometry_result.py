"""Result of an identification with geometry: estimates in JSON, K in YAML, a model in MJCF."""

import math
from pathlib import Path

import mujoco
from pydantic import Field

from baselines.identification.geometry_fit import GeometryEstimate, GeometryFit
from baselines.identification.geometry_model import Geometry, rotation_of
from baselines.identification.holdout import HeldOut
from elastic_env.core.config import Model
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.rotations import matrix_of, quaternion_of
from elastic_env.core.yaml_text import yaml_line
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
        """Parameters of which the poses tell no more than the prior, such as `elbow.x length`."""
        return tuple(
            f"{parameter.name} {parameter.kind}"
            for parameter in self.parameters
            if not parameter.is_told
        )

    def save(self, folder: Path, model: mujoco.MjSpec) -> list[Path]:
        """Write `identification.json`, `joints.yaml` and `model.xml`."""
        files = [folder / name for name in ("identification.json", "joints.yaml", "model.xml")]
        files[0].write_text(self.model_dump_json(indent=2) + "\n", encoding="utf-8")
        head = "# stiffness [N·m/rad], by elastic identify --geometry; .inf for a rigid joint"
        known = [(joint, float(f"{joint.stiffness_nm_per_rad:.6g}")) for joint in self.joints]
        lines = [yaml_line(joint.joint, {"stiffness": K}, _interval(joint)) for joint, K in known]
        files[1].write_text("\n".join([head, *lines]) + "\n", encoding="utf-8")
        files[2].write_text(model.to_xml(), encoding="utf-8")
        return files


def describe_geometry(fit: GeometryFit, held_out: HeldOut | None) -> GeometryIdentification:
    """The result of a fit."""
    problem = fit.problem
    told = {estimate.name: estimate for estimate in fit.estimates if estimate.kind == "compliance"}
    return GeometryIdentification(
        poses=len(problem.theta),
        numbers=problem.measured.size,
        geometry=problem.geometry,
        lateral=problem.lateral,
        noise_mm=1e3 * fit.noise_m,
        joints=tuple(_joint(joint, told.get(joint)) for joint in problem.joints),
        parameters=fit.estimates,
        held_out=held_out,
    )


def correct_model(spec: mujoco.MjSpec, tree: Tree, fit: GeometryFit) -> mujoco.MjSpec:
    """A copy of a model with the identified lengths and angles.

    It finds meshes and textures wherever it is written to. Encoder offsets are no part of a model:
    subtract them from what the encoders read.

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
    for j, joint in enumerate(problem.joints):
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
        own = bodies[body]
        if own.frame is not None:  # the pose is in the parent, whatever frame it was written in
            own.set_frame(own.parent.add_frame())
        own.pos = anchor + shift + turn @ (model.body_pos[body] - anchor)
        own.quat = quaternion_of(turn @ matrix_of(model.body_quat[body]))
        own.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    return corrected


def _joint(joint: str, estimate: GeometryEstimate | None) -> JointCompliance:
    """Stiffness by a compliance; rigid where it is not sought, not told, or not above zero."""
    c = h = 0.0
    if estimate is not None and estimate.value > 0.0 and estimate.is_told:
        c = estimate.value
        h = estimate.half_width
    return JointCompliance(
        joint=joint,
        stiffness_nm_per_rad=1.0 / c if c else math.inf,
        stiffness_low_nm_per_rad=1.0 / (c + h) if c else None,
        stiffness_high_nm_per_rad=1.0 / (c - h) if c > h else None,
    )


def _interval(joint: JointCompliance) -> str:
    """How well a stiffness is known."""
    if joint.stiffness_low_nm_per_rad is None:
        return "rigid"
    high = joint.stiffness_high_nm_per_rad
    upper = "rigid" if high is None else f"{high:.4g}"
    return f"{joint.stiffness_low_nm_per_rad:.4g} to {upper}"
