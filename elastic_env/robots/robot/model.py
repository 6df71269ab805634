"""The rigid model of a robot from a file of MJCF or URDF, with bodies that can be drawn."""

import warnings
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from elastic_env.core.errors import ConfigurationError, shown
from elastic_env.joint.frozen import frozen
from elastic_env.joint.model_file import compiled_spec, keep_shapes, mjcf_spec, urdf_spec, xml_of
from elastic_env.rendering.simple_bodies import add_simple_bodies

GivenModel = str | Path | mujoco.MjSpec
"""A file of MJCF (.xml) or URDF (.urdf), the text of one, or a specification of MuJoCo."""

_MESH = mujoco.mjtGeom.mjGEOM_MESH


def read_robot(model: GivenModel) -> mujoco.MjSpec:
    """The specification of a robot, which compiles.

    Collision shapes of a URDF are left out. What has a mesh that is missing, or that MuJoCo cannot read, is drawn by
    rods between the joints.

    Args:
        model: File, text or specification; it is not changed.

    Raises:
        ConfigurationError: It cannot be read or compiled, or a body has its mass from a mesh that is missing.

    Warns:
        UserWarning: Meshes are replaced.
    """
    if isinstance(model, mujoco.MjSpec):
        return _drawable(_copied(model), "the specification")
    if not isinstance(model, str | Path):
        raise ConfigurationError(
            f"model must be a file of MJCF (.xml) or URDF (.urdf), its text or a mujoco.MjSpec, got {shown(model)}"
        )
    if isinstance(model, str) and model.lstrip().startswith("<"):
        root, name, folder = _parsed(model), "the text of the model", Path.cwd()
    else:
        root, name, folder = xml_of(Path(model)), str(model), Path(model).resolve().parent
    if root.tag == "robot":
        return _of_urdf(root, name, folder)
    if name == str(model):
        return _drawable(mjcf_spec(Path(model)), name)
    try:
        spec = mujoco.MjSpec.from_string(str(model))
    except ValueError as error:
        raise ConfigurationError(f"MuJoCo cannot read {name}: {error}") from None
    return _drawable(spec, name)


class RigidModel:
    """Makes the specification of a robot in which only some hinges move, as `JointRobot` takes it.

    It holds what it was given, so that it can be pickled. Contacts are off. Taken out are actuators, and what elastic
    joints have in their place: armature, dry friction and linear damping of the hinges.

    Args:
        model: As of `read_robot`.
        joints: Hinges that move.
    """

    def __init__(self, model: GivenModel, joints: tuple[str, ...]) -> None:
        self._model, self._joints = model, joints
        self._spec: Any = None

    def __call__(self) -> mujoco.MjSpec:
        """A copy that the caller may change."""
        if self._spec is None:
            with warnings.catch_warnings():  # they were said when it was read for the first time
                warnings.simplefilter("ignore", UserWarning)
                self._spec = _bare(frozen(read_robot(self._model), self._joints), self._joints)
        return self._spec.copy()

    def __getstate__(self) -> dict[str, Any]:
        """Files by name, specifications as text."""
        given: Any = self._model
        if isinstance(given, mujoco.MjSpec):
            given = _copied(given)
            given.compile()
            given = given.to_xml()
        return {"_model": given, "_joints": self._joints, "_spec": None}


def _copied(spec: Any) -> mujoco.MjSpec:
    return spec.copy()


def _bare(spec: mujoco.MjSpec, joints: tuple[str, ...]) -> mujoco.MjSpec:
    """A model without actuators and contacts, whose hinges have nothing of what an `ElasticJoint` says."""
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    for name in joints:
        hinge = spec.joint(name)
        hinge.armature = hinge.frictionloss = 0.0
        damping = np.array(hinge.damping)
        damping[0] = 0.0
        hinge.damping = damping
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    return spec


def _parsed(text: str) -> ET.Element:
    try:
        return ET.fromstring(text)
    except ET.ParseError as error:
        raise ConfigurationError(f"the text of the model is no XML: {error}; give MJCF or URDF") from None


def _of_urdf(root: ET.Element, name: str, folder: Path) -> mujoco.MjSpec:
    """A URDF with the meshes that can be read."""
    lost = keep_shapes(root, folder)
    spec = urdf_spec(root, name)
    if lost:
        _warn_of(name, lost)
        add_simple_bodies(spec)
    return _drawable(spec, name)


def _drawable(spec: mujoco.MjSpec, name: str) -> mujoco.MjSpec:
    """A specification that compiles: without its meshes, where these are why it does not."""
    try:
        spec.copy().compile()
    except ValueError as error:
        meshes = [mesh.file or mesh.name for mesh in spec.meshes]
        if not meshes:
            compiled_spec(spec, name)
        _require_masses(spec, name, str(error))
        _take_meshes(spec)
        compiled_spec(spec, name)
        _warn_of(name, meshes)
        add_simple_bodies(spec)
    return spec


def _require_masses(spec: mujoco.MjSpec, name: str, problem: str) -> None:
    """Refuse a model of which a mass would be lost with a mesh."""
    from_geoms = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    for body in spec.bodies[1:]:
        if any(geom.type == _MESH for geom in body.geoms) and (from_geoms or not body.explicitinertial):
            raise ConfigurationError(
                f"body {body.name!r} of {name} has its mass from a mesh that cannot be read "
                f"({problem.splitlines()[0]}); give the body an <inertial>, or bring the mesh"
            )


def _take_meshes(spec: mujoco.MjSpec) -> None:
    for geom in [geom for geom in spec.geoms if geom.type == _MESH]:
        spec.delete(geom)
    for element in [*spec.skins, *spec.meshes]:
        spec.delete(element)


def _warn_of(name: str, meshes: list[str]) -> None:
    warnings.warn(
        f"{len(meshes)} meshes of {name} are missing or in a format that MuJoCo cannot read, such as {meshes[0]}; "
        "rods between the joints are drawn in their place",
        stacklevel=6,
    )
