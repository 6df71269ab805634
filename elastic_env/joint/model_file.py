"""Rigid models from files that others wrote, MJCF and URDF, for calculations that need no shapes."""

import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco

from elastic_env.core.errors import ConfigurationError

_LARGEST_BYTES = 50_000_000


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
        spec = mujoco.MjSpec.from_string(_without_shapes(root)) if is_urdf else mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise ConfigurationError(f"MuJoCo cannot read {path}: {error}") from None
    return _compiled(spec, str(path))


def _without_shapes(robot: ET.Element) -> str:
    """A URDF of its inertias alone."""
    for link in robot.iter("link"):
        for shape in [part for part in link if part.tag in ("visual", "collision")]:
            link.remove(shape)
    for own in robot.findall("mujoco"):
        robot.remove(own)
    ET.SubElement(ET.SubElement(robot, "mujoco"), "compiler", fusestatic="false", strippath="true")
    return ET.tostring(robot, encoding="unicode")


def _compiled(spec: mujoco.MjSpec, name: str) -> mujoco.MjModel:
    try:
        return spec.compile()
    except ValueError as error:
        raise ConfigurationError(f"MuJoCo cannot compile {name}: {error}") from None
