"""Rigid models from files that others wrote, MJCF and URDF, for calculations that need no shapes."""

import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco

from elastic_env.core.errors import ConfigurationError, shown

_LARGEST_BYTES = 50_000_000
_CURES = {
    "mass and inertia of moving bodies": "every link that moves needs a mass [kg] and an inertia [kg·m²] above zero",
    "inertia must": "the inertia must be that of a body: positive, and no main value above the sum of the other two",
    "Error opening file": "put the mesh where the model names it, or take its shape out and give the link's inertia",
    "no decoder found": "MuJoCo reads meshes of STL, OBJ and MSH; convert it, or take its shape out",
    "bad format in attribute": "it must be a number",
}
"""What to do about errors of MuJoCo, by a part of their text."""
_SHAPES, _READABLE = ("visual", "collision"), (".stl", ".obj")


def compiled_model(model: "str | Path | mujoco.MjSpec | mujoco.MjModel") -> mujoco.MjModel:
    """A compiled rigid model.

    Shapes of a URDF are left out, so that no mesh has to be there; links that are fixed to others keep their names.

    Args:
        model: File of MJCF (.xml) or URDF (.urdf), or what MuJoCo made of one.

    Raises:
        ConfigurationError: There is no such file, or MuJoCo cannot read or compile it.
    """
    if isinstance(model, mujoco.MjModel):
        return model
    if isinstance(model, mujoco.MjSpec):
        return _compiled(model, "the specification")
    if not isinstance(model, str | Path):
        raise ConfigurationError(f"a model must be a file, an MjSpec or an MjModel, got {shown(model)}")
    path = Path(model)
    if not path.is_file():
        raise ConfigurationError(f"no model at {path}; give a file of MJCF (.xml) or URDF (.urdf)")
    if path.stat().st_size > _LARGEST_BYTES:
        raise ConfigurationError(f"{path} must have at most {_LARGEST_BYTES} bytes, it has {path.stat().st_size}")
    try:
        root = ET.parse(path).getroot()
    except (ET.ParseError, UnicodeDecodeError, OSError) as error:
        raise ConfigurationError(f"{path} is no XML: {error}; give a file of MJCF (.xml) or URDF (.urdf)") from None
    try:
        is_urdf = root.tag == "robot"
        spec = urdf_spec(root) if is_urdf else mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise ConfigurationError(f"MuJoCo cannot read {path}: {_with_cure(error)}") from None
    return _compiled(spec, str(path))


def urdf_spec(robot: ET.Element, meshes: Path | None = None) -> mujoco.MjSpec:
    """A specification from the root of a URDF; links that are fixed to others keep their names.

    Args:
        robot: It is changed: of its shapes those are left that are drawn.
        meshes: Folder under which meshes of the URDF are drawn, found by the end of their path; None for no shapes.
            They have no mass and touch nothing. Of a link whose visual meshes MuJoCo cannot read its collision meshes
            are drawn, or nothing.

    Raises:
        ValueError: MuJoCo cannot read it.
    """
    for link in robot.iter("link"):
        drawn = [] if meshes is None else _drawn(link, meshes)
        for shape in [part for part in link if part.tag in _SHAPES]:
            link.remove(shape)
        for shape in drawn:
            shape.tag = "visual"
            link.append(shape)
    for own in robot.findall("mujoco"):
        robot.remove(own)
    options = {"fusestatic": "false", "strippath": "false", "discardvisual": "false"}
    ET.SubElement(ET.SubElement(robot, "mujoco"), "compiler", options)
    spec = mujoco.MjSpec.from_string(ET.tostring(robot, encoding="unicode"))
    for mesh in spec.meshes:
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # a mesh that is not closed has no volume
    for geom in spec.geoms:
        geom.mass = geom.contype = geom.conaffinity = 0
    return spec


def _drawn(link: ET.Element, meshes: Path) -> list[ET.Element]:
    """Visual or collision shapes of a link, whichever MuJoCo reads all of, with the paths of their meshes."""
    for tag in _SHAPES:
        shapes = link.findall(tag)
        found = [(mesh, _mesh_file(mesh.get("filename", ""), meshes)) for s in shapes for mesh in s.iter("mesh")]
        if shapes and all(path is not None for _, path in found):
            for mesh, path in found:
                mesh.set("filename", str(path))
            return shapes
    return []


def _mesh_file(name: str, meshes: Path) -> Path | None:
    """The file of a mesh, whose name in a URDF may begin with `package://`; None if MuJoCo cannot read it."""
    parts = Path(name.removeprefix("package://")).parts
    candidates = [meshes.joinpath(*parts[first:]) for first in range(len(parts))]
    path = next((path for path in candidates if path.is_file()), None)
    return path if path is not None and path.suffix.lower() in _READABLE else None


def _compiled(spec: mujoco.MjSpec, name: str) -> mujoco.MjModel:
    try:
        return spec.compile()
    except ValueError as error:
        raise ConfigurationError(f"MuJoCo cannot compile {name}: {_with_cure(error)}") from None


def _with_cure(error: ValueError) -> str:
    """MuJoCo's error in one line, and what to do about it where that is known."""
    text = ", ".join(line.strip() for line in str(error).splitlines() if line.strip())
    return "; ".join([text, *(cure for part, cure in _CURES.items() if part in text)])
