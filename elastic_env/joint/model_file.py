"""Reader of rigid models: MJCF and URDF, files and texts, specifications, compiled models.

It is the only reader: all commands accept and refuse the same models, with the same errors.
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco import MjModel, MjSpec

from elastic_env.core.errors import ConfigurationError, quote
from elastic_env.joint import urdf
from elastic_env.joint.compile_model import call_mujoco, compile_spec, require_sound
from elastic_env.joint.model_bounds import require_bounds
from elastic_env.joint.model_text import ModelText, read_model_text

GivenModel = str | Path | MjSpec | MjModel
"""A file of MJCF (.xml) or URDF (.urdf), the text of one, a specification, or a compiled model."""

_MESH = mujoco.mjtGeom.mjGEOM_MESH
_FROM_GEOMS = mujoco.mjtInertiaFromGeom
_REFERRING = "actuators equalities sensors tendons excludes pairs tuples"
"""Elements of a specification that refer to others by name."""


@dataclass(frozen=True)
class ReadModel:
    """A model as it was read.

    Attributes:
        spec: Its specification, which compiles.
        model: The specification, compiled.
        name: Its name in errors.
        lost: Meshes that it lacks, since they are missing or MuJoCo cannot read them.
    """

    spec: MjSpec
    model: MjModel
    name: str
    lost: list[str]


def compiled_model(model: GivenModel) -> MjModel:
    """Return a compiled rigid model.

    Shapes of a URDF are left out, so that its meshes may be missing. Links that are fixed to others
    keep their names.

    Args:
        model: See `GivenModel`.

    Raises:
        ConfigurationError: There is no such file, or MuJoCo cannot read or compile it.
    """
    if isinstance(model, MjModel):
        require_sound(model, "the model")
        return model
    return read_model(model).model


def read_model(model: GivenModel, shapes: bool = False) -> ReadModel:
    """Read a rigid model into a specification that compiles.

    Shapes of a URDF have no mass and touch nothing. A missing mesh is left out if no mass comes
    from it.

    Args:
        model: See `GivenModel`; a compiled model has no specification. It is not changed.
        shapes: True to keep the shapes of a URDF, for pictures.

    Raises:
        ConfigurationError: It cannot be read or compiled, it exceeds the bounds, or a mass comes
            from a lost mesh.
    """
    if isinstance(model, MjSpec):
        spec: Any = model
        name = "the specification"
        return _without_lost_meshes(lambda: _whole_copy(spec, name), name)
    if isinstance(model, MjModel):
        raise ConfigurationError(
            "a compiled model cannot be made elastic; give its file (.xml, .urdf) or its MjSpec"
        )
    if not isinstance(model, str | Path):
        raise ConfigurationError(
            "a model must be a file of MJCF (.xml) or URDF (.urdf), the text of one, a"
            f" mujoco.MjSpec or a mujoco.MjModel, got {quote(model)}"
        )
    text = read_model_text(model)
    require_bounds(text)
    if text.is_urdf:
        return _read_urdf(text, shapes)
    return _without_lost_meshes(lambda: _mjcf_spec(text), text.name)


def _read_urdf(text: ModelText, shapes: bool) -> ReadModel:
    """Read a URDF, and check it without its shapes."""
    urdf.require_unique_names(text)
    urdf.require_tree(text)
    bare = copy.deepcopy(text.root)
    urdf.keep_shapes(bare, None)
    spec = urdf.urdf_spec(bare, text.name)
    model = compile_spec(_whole_copy(spec, text.name), text.name)
    if not shapes:
        return ReadModel(spec, model, text.name, [])
    meshes = [mesh.get("filename", "") for mesh in text.root.iter("mesh")]
    lost = urdf.keep_shapes(text.root, text.folder)
    try:
        with_shapes = urdf.urdf_spec(text.root, text.name)
        model_with_shapes = compile_spec(with_shapes.copy(), text.name)
        return ReadModel(with_shapes, model_with_shapes, text.name, lost)
    except ConfigurationError:  # about a shape: without shapes it compiles
        return ReadModel(spec, model, text.name, meshes or ["a shape"])


def _mjcf_spec(text: ModelText) -> MjSpec:
    """Read MJCF into a specification. MuJoCo gets a file that is not in UTF-8 as a text."""
    if text.file is not None and text.is_utf8:
        return call_mujoco(lambda: MjSpec.from_file(str(text.file)), text.name, "read")
    spec = call_mujoco(lambda: MjSpec.from_string(text.text), text.name, "read")
    if text.file is not None:
        spec.modelfiledir = str(text.folder)
    return spec


def _without_lost_meshes(read: Callable[[], MjSpec], name: str) -> ReadModel:
    """Return a specification that compiles, without meshes and pictures if these prevent it.

    Compiling changes a specification: each one that is compiled is read for this only.
    """
    try:
        model = compile_spec(read(), name)
        return ReadModel(read(), model, name, [])
    except ConfigurationError as error:
        problem = error
    spec = read()
    lost = [element.file or element.name for element in (*spec.meshes, *spec.textures)]
    if not lost:
        raise problem
    heavy = _bodies_with_mesh_mass(spec)
    for geom in [geom for geom in spec.geoms if _uses_mesh(geom)]:
        spec.delete(geom)
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    for element in [*spec.skins, *spec.meshes, *spec.textures]:
        spec.delete(element)
    if heavy:
        spec.compiler.inertiafromgeom = _FROM_GEOMS.mjINERTIAFROMGEOM_AUTO
        # with any mass: other errors come before the one about the meshes
        for body in heavy:
            body.mass = 1.0
            body.inertia = np.ones(3)
            body.explicitinertial = True
    model = compile_spec(_whole_copy(spec, name), name)
    if heavy:
        raise ConfigurationError(
            f"body {heavy[0].name!r} of {name} has its mass from a mesh that cannot be"
            f" read; give the body an <inertial>, or bring the mesh. {problem}"
        )
    return ReadModel(spec, model, name, lost)


def _whole_copy(spec: MjSpec, name: str) -> MjSpec:
    """Copy all elements: MuJoCo's own copy leaves out those with wrong references.

    Raises:
        ConfigurationError: An element refers to one that does not exist.
    """
    whole: Any = call_mujoco(spec.copy, name, "copy")
    for kind in _REFERRING.split():
        if len(getattr(whole, kind)) < len(getattr(spec, kind)):
            call_mujoco(spec.compile, name, "compile")  # its error names the reference
            problem = f"one of the {kind} of {name} cannot be copied by MuJoCo"
            raise ConfigurationError(problem)
    return whole


def _bodies_with_mesh_mass(spec: MjSpec) -> list[mujoco.MjsBody]:
    """Return the bodies whose mass comes from a mesh."""
    from_geoms = spec.compiler.inertiafromgeom == _FROM_GEOMS.mjINERTIAFROMGEOM_TRUE
    bodies = [b for b in spec.bodies[1:] if from_geoms or not b.explicitinertial]
    return [body for body in bodies if any(map(_uses_mesh, body.geoms))]


def _uses_mesh(geom: mujoco.MjsGeom) -> bool:
    """Return True if a geom is a mesh, or a primitive that is fitted to one."""
    return geom.type == _MESH or bool(geom.meshname)
