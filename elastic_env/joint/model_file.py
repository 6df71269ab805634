"""Rigid models from files that others wrote, MJCF and URDF."""

import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco

from elastic_env.core.errors import ConfigurationError, shortened, shown

_LARGEST_BYTES = 50_000_000
_CURES = {
    "mass and inertia of moving bodies": "every link that moves needs a mass [kg] and an inertia [kg·m²] above zero",
    "inertia must": "the inertia must be that of a body: positive, and no main value above the sum of the other two",
    "Error opening file": "put the mesh where the model names it, or take its shape out and give the link's inertia",
    "no decoder found": "MuJoCo reads meshes of STL, OBJ and MSH; convert it, or take its shape out",
    "bad format in attribute": "it must be a number",
}
"""What to do about errors of MuJoCo, by a part of their text."""
_SHAPES, _READABLE, _PACKAGE = ("visual", "collision"), (".stl", ".obj"), "package://"


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
        return compiled_spec(model, "the specification")
    if not isinstance(model, str | Path):
        raise ConfigurationError(f"a model must be a file, an MjSpec or an MjModel, got {shown(model)}")
    path = Path(model)
    root = xml_of(path)
    if root.tag != "robot":
        return compiled_spec(mjcf_spec(path), str(path))
    keep_shapes(root, None)
    return compiled_spec(urdf_spec(root, str(path)), str(path))


def xml_of(path: Path) -> ET.Element:
    """What a file of MJCF or URDF holds.

    Raises:
        ConfigurationError: There is no such file, it is too large, or it is no XML.
    """
    if not path.is_file():
        raise ConfigurationError(f"no model at {shortened(path)}; give a file of MJCF (.xml) or URDF (.urdf)")
    if path.stat().st_size > _LARGEST_BYTES:
        raise ConfigurationError(f"{path} must have at most {_LARGEST_BYTES} bytes, it has {path.stat().st_size}")
    try:
        return ET.parse(path).getroot()
    except (ET.ParseError, UnicodeDecodeError, OSError) as error:
        raise ConfigurationError(f"{path} is no XML: {error}; give a file of MJCF (.xml) or URDF (.urdf)") from None


def mjcf_spec(path: Path) -> mujoco.MjSpec:
    """The specification that a file of MJCF holds.

    Raises:
        ConfigurationError: MuJoCo cannot read it.
    """
    try:
        return mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise ConfigurationError(f"MuJoCo cannot read {path}: {_with_cure(error)}") from None


def urdf_spec(robot: ET.Element, name: str) -> mujoco.MjSpec:
    """The specification of a URDF. Links that are fixed to others keep their names; shapes weigh and touch nothing.

    Args:
        robot: Root of the URDF with shapes that MuJoCo reads, see `keep_shapes`; it is changed.
        name: What errors call it.

    Raises:
        ConfigurationError: MuJoCo cannot read it.
    """
    for own in robot.findall("mujoco"):
        robot.remove(own)
    options = {"fusestatic": "false", "strippath": "false", "discardvisual": "false"}
    ET.SubElement(ET.SubElement(robot, "mujoco"), "compiler", options)
    try:
        spec = mujoco.MjSpec.from_string(ET.tostring(robot, encoding="unicode"))
    except ValueError as error:
        raise ConfigurationError(f"MuJoCo cannot read {name}: {_with_cure(error)}") from None
    for mesh in spec.meshes:
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # a mesh that is not closed has no volume
    for geom in spec.geoms:
        geom.mass = geom.contype = geom.conaffinity = 0
    return spec


def keep_shapes(robot: ET.Element, folder: Path | None) -> list[str]:
    """Leave of the shapes of a URDF those that are drawn.

    Of a link whose visual meshes MuJoCo cannot read its collision shapes are drawn, or nothing.

    Args:
        robot: Root of the URDF; it is changed.
        folder: Folder of the URDF, in and above which packages of meshes are looked for; None for no shapes.

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


def compiled_spec(spec: mujoco.MjSpec, name: str) -> mujoco.MjModel:
    """A specification compiled; `name` is what errors call it.

    Raises:
        ConfigurationError: MuJoCo cannot compile it.
    """
    try:
        return spec.compile()
    except ValueError as error:
        raise ConfigurationError(f"MuJoCo cannot compile {name}: {_with_cure(error)}") from None


def _drawn(link: ET.Element, folder: Path) -> tuple[list[ET.Element], list[str]]:
    """Visual or collision shapes of a link, whichever MuJoCo reads all of; else the meshes that it does not read."""
    missing: list[str] = []
    for tag in _SHAPES:
        shapes = link.findall(tag)
        named = [(mesh, mesh.get("filename", "")) for shape in shapes for mesh in shape.iter("mesh")]
        found = [(mesh, _mesh_file(name, folder)) for mesh, name in named]
        if shapes and all(path is not None for _, path in found):
            for mesh, path in found:
                mesh.set("filename", str(path))
            return shapes, []
        missing = missing or [name for (_, name), (_, path) in zip(named, found, strict=True) if path is None]
    return [], missing


def _mesh_file(name: str, folder: Path) -> Path | None:
    """A mesh that MuJoCo reads, in the folder of the URDF, or of a package in a folder above; None without one."""
    if Path(name).suffix.lower() not in _READABLE:
        return None
    relative = name.removeprefix(_PACKAGE).removeprefix("file://")
    bases = [folder, *folder.resolve().parents] if name.startswith(_PACKAGE) else [folder]
    return next((base / relative for base in bases if (base / relative).is_file()), None)


def _with_cure(error: ValueError) -> str:
    """MuJoCo's error in one line, and what to do about it where that is known."""
    text = ", ".join(line.strip() for line in str(error).splitlines() if line.strip())
    return "; ".join([text, *(cure for part, cure in _CURES.items() if part in text)])
