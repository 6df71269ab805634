"""URDF for MuJoCo: checks of links and joints, the shapes that MuJoCo reads, the specification."""

import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path

import mujoco
from mujoco import MjSpec

from elastic_env.core.errors import ConfigurationError, quote
from elastic_env.core.files import is_file
from elastic_env.joint.compile_model import call_mujoco
from elastic_env.joint.model_bounds import FOLDERS
from elastic_env.joint.model_text import LARGEST_BYTES, ModelText

_ENDS = ("parent", "child")
_SHAPES = ("visual", "collision")
_READABLE = (".stl", ".obj")
_PACKAGE = "package://"
_URDF_OPTIONS = {"fusestatic": "false", "strippath": "false", "discardvisual": "false"}


def require_unique_names(text: ModelText) -> None:
    """Refuse a name that two links or two joints have: MuJoCo drops the second one.

    Raises:
        ConfigurationError: There is such a name.
    """
    for kind in ("link", "joint"):
        names = Counter(element.get("name", "") for element in text.root.findall(kind))
        twice = [name for name, count in names.items() if count > 1 and name]
        if twice:
            raise ConfigurationError(
                f"{text.name} has the {kind} {quote(twice[0])} {names[twice[0]]} times;"
                f" give each {kind} its own name"
            )


def require_tree(text: ModelText) -> None:
    """Refuse links that form a loop, and joints with links that do not exist.

    Raises:
        ConfigurationError: There is such a link or joint.
    """
    links = {link.get("name", "") for link in text.root.findall("link")}
    parents: dict[str, str] = {}
    for joint in text.root.findall("joint"):
        name = quote(joint.get("name", ""))
        parts = [joint.find(end) for end in _ENDS]
        ends = ["" if part is None else part.get("link", "") for part in parts]
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


def keep_shapes(robot: ET.Element, folder: Path | None) -> list[str]:
    """Remove the shapes of a URDF that are not drawn.

    If MuJoCo cannot read the visual meshes of a link, its collision shapes are drawn, or nothing.

    Args:
        robot: Root of the URDF; it is changed.
        folder: Folder of the URDF: packages of meshes are in it or above it. None for no shapes.

    Returns:
        Meshes of links that are not drawn.
    """
    lost: list[str] = []
    for link in robot.iter("link"):
        shapes, missing = ([], []) if folder is None else _drawn_shapes(link, folder)
        lost += missing
        for shape in [part for part in link if part.tag in _SHAPES]:
            link.remove(shape)
        for shape in shapes:
            shape.tag = "visual"
            link.append(shape)
    return lost


def urdf_spec(robot: ET.Element, name: str) -> MjSpec:
    """Return the specification of a URDF.

    Links that are fixed to others keep their names. Shapes have no mass and touch nothing.

    Args:
        robot: Root of the URDF with shapes that MuJoCo reads, see `keep_shapes`; it is changed.
        name: Its name in errors.

    Raises:
        ConfigurationError: MuJoCo cannot read it.
    """
    options = robot.find("mujoco")
    options = ET.SubElement(robot, "mujoco") if options is None else options
    compilers = options.findall("compiler") or [ET.SubElement(options, "compiler")]
    for compiler in compilers:
        for key in FOLDERS:
            compiler.attrib.pop(key, None)
        compiler.attrib.update(_URDF_OPTIONS)
    text = ET.tostring(robot, encoding="unicode")
    spec = call_mujoco(lambda: MjSpec.from_string(text), name, "read")
    for mesh in spec.meshes:
        # an open mesh has no volume
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    for geom in spec.geoms:
        geom.mass = geom.contype = geom.conaffinity = 0
    return spec


def _drawn_shapes(link: ET.Element, folder: Path) -> tuple[list[ET.Element], list[str]]:
    """Return the shapes of a link that MuJoCo can draw, or else the meshes that it cannot read."""
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
    """Find a mesh that MuJoCo reads, in the URDF's folder or a package above it, or None."""
    if Path(name).suffix.lower() not in _READABLE:
        return None
    relative = name.removeprefix(_PACKAGE).removeprefix("file://")
    bases = [folder]
    if name.startswith(_PACKAGE):
        bases += folder.resolve().parents
    files = [base / relative for base in bases if is_file(base / relative)]
    return next((file for file in files if file.stat().st_size <= LARGEST_BYTES), None)
