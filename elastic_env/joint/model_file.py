"""Reader of rigid models: MJCF and URDF, files and texts, specifications, compiled models.

Whoever reads a model reads it here, so that all accept and refuse the same ones, in the same words.
"""

import copy
import threading
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import mujoco
import numpy as np
from mujoco import MjModel, MjSpec

from elastic_env.core.errors import ConfigurationError, quote
from elastic_env.core.files import is_file
from elastic_env.joint.model_bounds import FOLDERS, require_bounds
from elastic_env.joint.model_text import LARGEST_BYTES, ModelText, read_model_text

GivenModel = str | Path | MjSpec | MjModel
"""A file of MJCF (.xml) or URDF (.urdf), the text of one, a specification, or what MuJoCo
compiled.
"""

Result = TypeVar("Result")

_CURES = {
    "mass and inertia of moving bodies": (
        "every link that moves needs a mass [kg] and an inertia [kg·m²] above zero"
    ),
    "inertia m": (
        "the inertia must be that of a body: positive, no main value above the sum of the others"
    ),
    "Error opening file": (
        "put the mesh where the model names it, or take its shape out and give the link's inertia"
    ),
    "no decoder found": (
        "MuJoCo reads meshes of STL, OBJ and MSH; convert it, or take its shape out"
    ),
    "bad format in attribute": "it must be a number",
    "range[0] should be smaller": "the lower limit must be below the upper one",
    "Could not allocate memory": "make the sizes in <size> smaller",
}
"""Cures of MuJoCo's errors, by a part of their text."""
_LONGEST_ERROR = 400
_SHAPES = ("visual", "collision")
_READABLE = (".stl", ".obj")
_PACKAGE = "package://"
_MESH = mujoco.mjtGeom.mjGEOM_MESH
_URDF_OPTIONS = {"fusestatic": "false", "strippath": "false", "discardvisual": "false"}
_REFERRING = "actuators equalities sensors tendons excludes pairs tuples"
"""Elements of a specification that refer to others by name."""


@dataclass(frozen=True)
class ReadModel:
    """A model as it was read.

    Attributes:
        spec: Its specification, which compiles.
        model: What MuJoCo makes of that.
        name: What errors call it.
        lost: Meshes that are not in it, since they are missing or MuJoCo cannot read them.
    """

    spec: MjSpec
    model: MjModel
    name: str
    lost: list[str]


def compiled_model(model: GivenModel) -> MjModel:
    """A compiled rigid model.

    Shapes of a URDF are left out, so that no mesh has to be there; links that are fixed to others
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
    """The specification of a rigid model, which compiles.

    Shapes of a URDF weigh and touch nothing. A mesh that is missing is left out where no mass comes
    from it.

    Args:
        model: See `GivenModel`; a compiled model has no specification. It is not changed.
        shapes: Whether the shapes of a URDF are wanted, for pictures.

    Raises:
        ConfigurationError: It cannot be read or compiled, it is beyond the bounds, or a mass comes
            from a lost mesh.
    """
    if isinstance(model, MjSpec):
        given: Any = model
        name = "the specification"
        return _without_lost_meshes(lambda: _whole_copy(given, name), name)
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
        return _of_urdf(text, shapes)
    return _without_lost_meshes(lambda: _mjcf_spec(text), text.name)


def compiled_spec(spec: MjSpec, name: str) -> MjModel:
    """A specification compiled; `name` is what errors call it.

    Raises:
        ConfigurationError: MuJoCo cannot compile it, or what it compiles contradicts itself.
    """
    model = from_mujoco(spec.compile, name, "compile")
    require_sound(model, name)
    return model


def require_sound(model: MjModel, name: str) -> None:
    """Refuse numbers that MuJoCo takes and that no robot has.

    Raises:
        ConfigurationError: A mass, an inertia or a property of a joint is not finite or negative,
            or a joint's lower limit is above its upper one.
    """
    for what, values, element in (
        ("mass", model.body_mass, model.body),
        ("inertia", model.body_inertia, model.body),
        ("armature", model.dof_armature[model.jnt_dofadr], model.joint),
        ("damping", model.dof_damping[model.jnt_dofadr], model.joint),
        ("frictionloss", model.dof_frictionloss[model.jnt_dofadr], model.joint),
        ("stiffness", model.jnt_stiffness, model.joint),
    ):
        sound = np.isfinite(values) & (np.asarray(values) >= 0.0)
        wrong = np.flatnonzero(~(sound.all(axis=1) if sound.ndim > 1 else sound))
        if wrong.size:
            kind = "body" if element == model.body else "joint"
            raise ConfigurationError(
                f"{what} of {kind} {element(int(wrong[0])).name!r} of {name} must be finite and >="
                f" 0, got {quote(np.ravel(values[wrong[0]]).tolist())}"
            )
    if not np.isfinite(model.opt.gravity).all():
        raise ConfigurationError(
            f"gravity of {name} must be finite [m/s²], got {quote(model.opt.gravity.tolist())}"
        )
    for j in range(model.njnt):
        low, high = map(float, model.jnt_range[j])
        if low > high or np.isnan(low + high):
            raise ConfigurationError(
                f"the limits of joint {model.joint(j).name!r} of {name} contradict themselves:"
                f" {low:g} to {high:g}; the lower limit must be below the upper one"
            )


def keep_shapes(robot: ET.Element, folder: Path | None) -> list[str]:
    """Leave of the shapes of a URDF those that are drawn.

    Of a link whose visual meshes MuJoCo cannot read its collision shapes are drawn, or nothing.

    Args:
        robot: Root of the URDF; it is changed.
        folder: Folder of the URDF, in and above which packages of meshes are looked for; None for
            no shapes.

    Returns:
        Meshes of links that are not drawn.
    """
    lost: list[str] = []
    for link in robot.iter("link"):
        drawn, missing = ([], []) if folder is None else _drawn(link, folder)
        lost += missing
        for shape in [part for part in link if part.tag in _SHAPES]:
            link.remove(shape)
        for shape in drawn:
            shape.tag = "visual"
            link.append(shape)
    return lost


def urdf_spec(robot: ET.Element, name: str) -> MjSpec:
    """The specification of a URDF.

    Links that are fixed to others keep their names; shapes weigh and touch nothing.

    Args:
        robot: Root of the URDF with shapes that MuJoCo reads, see `keep_shapes`; it is changed.
        name: What errors call it.

    Raises:
        ConfigurationError: MuJoCo cannot read it.
    """
    own = robot.find("mujoco")
    own = ET.SubElement(robot, "mujoco") if own is None else own
    compilers = own.findall("compiler") or [ET.SubElement(own, "compiler")]
    for compiler in compilers:
        for key in FOLDERS:
            compiler.attrib.pop(key, None)
        compiler.attrib.update(_URDF_OPTIONS)
    text = ET.tostring(robot, encoding="unicode")
    spec = from_mujoco(lambda: MjSpec.from_string(text), name, "read")
    for mesh in spec.meshes:
        # a mesh that is not closed has no volume
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    for geom in spec.geoms:
        geom.mass = geom.contype = geom.conaffinity = 0
    return spec


def _of_urdf(text: ModelText, shapes: bool) -> ReadModel:
    """A URDF, judged without its shapes."""
    _require_unique_names(text)
    _require_tree(text)
    bare = copy.deepcopy(text.root)
    keep_shapes(bare, None)
    spec = urdf_spec(bare, text.name)
    model = compiled_spec(_whole_copy(spec, text.name), text.name)
    if not shapes:
        return ReadModel(spec, model, text.name, [])
    named = [mesh.get("filename", "") for mesh in text.root.iter("mesh")]
    lost = keep_shapes(text.root, text.folder)
    try:
        drawn = urdf_spec(text.root, text.name)
        return ReadModel(drawn, compiled_spec(drawn.copy(), text.name), text.name, lost)
    except ConfigurationError:  # of a shape: without shapes it compiles
        return ReadModel(spec, model, text.name, named or ["a shape"])


def _require_unique_names(text: ModelText) -> None:
    """Refuse a name that two links or two joints have: MuJoCo drops the second one."""
    for kind in ("link", "joint"):
        names = Counter(element.get("name", "") for element in text.root.findall(kind))
        twice = [name for name, count in names.items() if count > 1 and name]
        if twice:
            raise ConfigurationError(
                f"{text.name} has the {kind} {quote(twice[0])} {names[twice[0]]} times; give each"
                f" {kind} its own name"
            )


def _require_tree(text: ModelText) -> None:
    """Refuse links that are joined in a circle or twice, and joints of links that are not there."""
    links = {link.get("name", "") for link in text.root.findall("link")}
    parents: dict[str, str] = {}
    for joint in text.root.findall("joint"):
        name = quote(joint.get("name", ""))
        found = [joint.find(end) for end in _ENDS]
        ends = ["" if element is None else element.get("link", "") for element in found]
        for end, link in zip(_ENDS, ends, strict=True):
            if link not in links:
                needed = f"joint {name} of {text.name} needs a {end} that is a link of it"
                raise ConfigurationError(f"{needed}, got {quote(link)}")
        if ends[1] in parents:
            raise ConfigurationError(
                f"link {quote(ends[1])} of {text.name} is the child of two joints; cut the loop"
            )
        parents[ends[1]] = ends[0]
    for link in parents:
        seen: set[str] = set()
        while link in parents and link not in seen:
            seen.add(link)
            link = parents[link]
        if link in seen:
            raise ConfigurationError(
                f"the links of {text.name} are joined in a circle at {quote(link)}; cut the loop"
            )


_ENDS = ("parent", "child")


def _mjcf_spec(text: ModelText) -> MjSpec:
    """The specification of MJCF. A file that is not in UTF-8 goes to MuJoCo as a text."""
    if text.file is not None and text.is_utf8:
        file = str(text.file)
        return from_mujoco(lambda: MjSpec.from_file(file), text.name, "read")
    spec = from_mujoco(lambda: MjSpec.from_string(text.text), text.name, "read")
    if text.file is not None:
        spec.modelfiledir = str(text.folder)
    return spec


def _without_lost_meshes(read: Callable[[], MjSpec], name: str) -> ReadModel:
    """A specification that compiles, without its meshes and pictures where these prevent it.

    What is compiled is read for that alone: to compile a specification changes it.
    """
    try:
        model = compiled_spec(read(), name)
        return ReadModel(read(), model, name, [])
    except ConfigurationError as error:
        problem = error
    spec = read()
    lost = [element.file or element.name for element in (*spec.meshes, *spec.textures)]
    if not lost:
        raise problem
    heavy = _bodies_of_meshes(spec)
    for geom in [geom for geom in spec.geoms if _is_of_mesh(geom)]:
        spec.delete(geom)
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    for element in [*spec.skins, *spec.meshes, *spec.textures]:
        spec.delete(element)
    if heavy:
        spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
        for body in heavy:  # of any mass: would it compile if the meshes were there?
            body.mass = 1.0
            body.inertia = np.ones(3)
            body.explicitinertial = True
    model = compiled_spec(_whole_copy(spec, name), name)
    if heavy:
        raise ConfigurationError(
            f"body {heavy[0].name!r} of {name} has its mass from a mesh that cannot be read; give"
            f" the body an <inertial>, or bring the mesh. {problem}"
        )
    return ReadModel(spec, model, name, lost)


def _whole_copy(spec: MjSpec, name: str) -> MjSpec:
    """A copy with all elements: MuJoCo's own leaves out those whose references are wrong.

    Raises:
        ConfigurationError: An element refers to what the specification does not have.
    """
    copied: Any = from_mujoco(spec.copy, name, "copy")
    for kind in _REFERRING.split():
        if len(getattr(copied, kind)) < len(getattr(spec, kind)):
            from_mujoco(spec.compile, name, "compile")  # which says what is wrong
            problem = f"one of the {kind} of {name} cannot be copied by MuJoCo"
            raise ConfigurationError(problem)
    return copied


def _bodies_of_meshes(spec: MjSpec) -> list[mujoco.MjsBody]:
    """Bodies that have their mass from a mesh."""
    rule = spec.compiler.inertiafromgeom
    from_geoms = rule == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    bodies = [body for body in spec.bodies[1:] if from_geoms or not body.explicitinertial]
    return [body for body in bodies if any(map(_is_of_mesh, body.geoms))]


def _is_of_mesh(geom: mujoco.MjsGeom) -> bool:
    """True if a geom is a mesh, or a primitive that is fitted to one."""
    return geom.type == _MESH or bool(geom.meshname)


@contextmanager
def without_log_file(without_console: bool = False) -> Iterator[None]:
    """Let MuJoCo write no MUJOCO_LOG.TXT into the folder of a user, and on request say nothing."""
    before = mujoco.MjLogConfig.get()
    silent = mujoco.MjLogConfig.get()
    silent.logto_file = False
    silent.logto_console &= not without_console
    silent.set()
    try:
        yield
    finally:
        before.set()


def from_mujoco(action: Callable[[], Result], name: str, verb: str) -> Result:
    """The result of an action of MuJoCo; its errors teach.

    It runs in a thread of its own, so that Ctrl-C reaches this one.
    """
    results: list[Result] = []
    errors: list[Exception] = []

    def work() -> None:
        try:
            results.append(action())
        except Exception as error:
            # MuJoCo raises nearly every kind, and "unknown exception"
            errors.append(error)

    thread = threading.Thread(target=work, daemon=True)
    with without_log_file():
        thread.start()
        thread.join()
    if errors:
        problem = _with_cure(errors[0])
        raise ConfigurationError(f"MuJoCo cannot {verb} {name}: {problem}") from None
    return results[0]


def _drawn(link: ET.Element, folder: Path) -> tuple[list[ET.Element], list[str]]:
    """Visual or collision shapes of a link that MuJoCo reads, else the meshes that it does not."""
    missing: list[str] = []
    for tag in _SHAPES:
        shapes = link.findall(tag)
        meshes = [mesh for shape in shapes for mesh in shape.iter("mesh")]
        files = {mesh: _mesh_file(mesh.get("filename", ""), folder) for mesh in meshes}
        lost = [mesh.get("filename", "") for mesh in meshes if files[mesh] is None]
        if shapes and not lost:
            for mesh, path in files.items():
                mesh.set("filename", str(path))
            return shapes, []
        missing = missing or lost
    return [], missing


def _mesh_file(name: str, folder: Path) -> Path | None:
    """A mesh that MuJoCo reads, in the URDF's folder or a package above it, or None."""
    if Path(name).suffix.lower() not in _READABLE:
        return None
    relative = name.removeprefix(_PACKAGE).removeprefix("file://")
    bases = [folder]
    if name.startswith(_PACKAGE):
        bases += folder.resolve().parents
    files = [base / relative for base in bases if is_file(base / relative)]
    return next((file for file in files if file.stat().st_size <= LARGEST_BYTES), None)


def _with_cure(error: Exception) -> str:
    """MuJoCo's error in one line, and what to do about it where that is known."""
    lines = [line.strip() for line in str(error).splitlines()]
    text = ", ".join(filter(None, lines)) or type(error).__name__
    cures = [cure for part, cure in _CURES.items() if part in text]
    if len(text) > _LONGEST_ERROR:
        text = f"{text[:_LONGEST_ERROR]}..."
    return "; ".join([text, *cures])
