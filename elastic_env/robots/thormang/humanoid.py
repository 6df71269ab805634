"""Shapes of the walker for pictures: a solid robot, and a translucent one for the plan."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco import MjsGeom, MjSpec

from elastic_env.core.files import read_rows
from elastic_env.core.signals import Array
from elastic_env.rendering.picture import CAMERA, Rgba, set_stage
from elastic_env.robots.thormang.model import SIDES, Thormang, rigid_spec

PLAN = "plan_"
"""Prefix of the names of the translucent robot."""
ZMP = "zmp"
ZMP_REFERENCE = "zmp_reference"
"""Names of the markers on the floor; `mocap_pos` moves them."""

LEFT_RGBA = (0.93, 0.56, 0.20, 1.0)
RIGHT_RGBA = (0.74, 0.37, 0.15, 1.0)
PLAN_RGBA = (0.40, 0.80, 0.52, 0.2)
ZMP_RGBA = (0.90, 0.08, 0.42, 1.0)
ZMP_REFERENCE_RGBA = (0.25, 0.62, 0.38, 1.0)

GRID_M = 0.2
"""Distance of the lines on the floor [m]."""

_COLOURS = {
    "shell": (0.80, 0.82, 0.85, 1.0),
    "frame": (0.24, 0.26, 0.30, 1.0),
    "left": LEFT_RGBA,
    "right": RIGHT_RGBA,
}
_PELVIS_MARGIN_M = 0.03
"""Half width of the pelvis minus half distance of the hips [m]."""
_FLOOR_RGB = (1.0, 1.0, 1.0)
_GRID_RGB = (0.85, 0.87, 0.90)
_SIZE = 720
_EYE = np.array([3.3, 1.6, 2.05])
_TARGET = np.array([0.0, 0.0, 0.69])
_PLAN_INSET_M = 0.008
"""Reduction of the plan's half lengths, at most to half [m]: a robot on its plan hides the plan."""


def display_spec(robot: Thormang) -> MjSpec:
    """Make a model for pictures only: robot, plan with the prefix `PLAN`, floor, markers."""
    spec = _shaped_robot(robot, is_plan=False)
    set_stage(spec, _SIZE, _SIZE)
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    plan = _shaped_robot(robot, is_plan=True)
    spec.attach(plan, prefix=PLAN, frame=spec.worldbody.add_frame())
    _add_floor(spec)
    _add_marker(spec, ZMP_REFERENCE, radius=0.05, height=0.022, rgba=ZMP_REFERENCE_RGBA)
    _add_marker(spec, ZMP, radius=0.03, height=0.0245, rgba=ZMP_RGBA)
    _add_light(spec)
    axes = _camera_axes(_TARGET - _EYE)
    spec.worldbody.add_camera(name=CAMERA, pos=_EYE, xyaxes=axes, fovy=25.5)
    return spec


def solid_spec(robot: Thormang) -> MjSpec:
    """Make the robot alone, without floor and light."""
    spec = _shaped_robot(robot, is_plan=False)
    spec.delete(spec.body("floor"))
    return spec


def set_floor_and_light(spec: MjSpec) -> None:
    """Add floor and light to a scene."""
    spec.worldbody.add_body(name="floor").add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.05]
    )
    _add_floor(spec)
    _add_light(spec)


def _shaped_robot(robot: Thormang, is_plan: bool) -> MjSpec:
    """Make the robot with the shapes of `shapes.csv`; only the solid one has the floor."""
    spec = rigid_spec(robot)
    for site in list(spec.sites):
        spec.delete(site)
    if is_plan:
        spec.delete(spec.body("floor"))
    for row in read_rows(Path(__file__).with_name("shapes.csv")):
        size = [float(number) for number in row["size_m"].split()]
        if row["link"] == "pelvis" and row["kind"] == "block":
            size[1] = robot.hip_half_spacing + _PELVIS_MARGIN_M
        geom = _add_shape(spec, row, _shape_size(size, is_plan))
        geom.rgba = PLAN_RGBA if is_plan else _COLOURS[row["colour"]]
    for side, rgba in zip(SIDES, (LEFT_RGBA, RIGHT_RGBA), strict=True):
        sole = spec.geom(f"{side}_sole")
        sole.rgba = PLAN_RGBA if is_plan else rgba
        sole.size = _shape_size(sole.size, is_plan)
    return spec


def _shape_size(lengths: Any, is_plan: bool) -> list[float]:
    """Half lengths of a shape, reduced for the plan."""
    if not is_plan:
        return list(lengths)
    return [max(length - _PLAN_INSET_M, length / 2) for length in lengths]


def _add_shape(spec: MjSpec, row: Mapping[str, str], size: list[float]) -> MjsGeom:
    """Add a sphere, cylinder, capsule, box, or block with round edges (roundness 0 to 1)."""
    kind = row["kind"]
    place: dict[str, Any] = {"pos": [float(x) for x in row["place_m"].split()]}
    if kind == "block":
        kind = "mesh"
        place["meshname"] = f"block_{len(spec.meshes)}"
        roundness = float(row["roundness"])
        mesh = spec.add_mesh(name=place["meshname"], scale=size)
        mesh.make_supersphere(24, roundness, roundness)
    else:
        place["size"] = [*size, 0, 0][:3]
    if kind == "capsule":
        place["fromto"] = place.pop("pos")
    if row["z_axis"]:
        place["zaxis"] = [float(x) for x in row["z_axis"].split()]
    shape = getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")
    return spec.body(row["link"]).add_geom(type=shape, mass=0.0, **place)


def _add_floor(spec: MjSpec) -> None:
    """Give the floor a light colour and a grid."""
    texture = spec.add_texture(name="grid", width=128, height=128)
    texture.type = mujoco.mjtTexture.mjTEXTURE_2D
    texture.builtin = mujoco.mjtBuiltin.mjBUILTIN_FLAT
    texture.mark = mujoco.mjtMark.mjMARK_EDGE
    texture.rgb1 = texture.rgb2 = _FLOOR_RGB
    texture.markrgb = _GRID_RGB
    repeat = 2.0 / GRID_M  # MuJoCo repeats the texture so often in two meters
    floor = spec.add_material(name="floor", texrepeat=[repeat] * 2, texuniform=True)
    floor.specular = floor.shininess = 0.0
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "grid"
    spec.geom("floor").material = "floor"


def _add_marker(spec: MjSpec, name: str, radius: float, height: float, rgba: Rgba) -> None:
    """Add a disc on the floor, higher than the soles, so that it is visible under a foot."""
    spec.add_material(name=name, rgba=rgba, emission=0.25, specular=0.0)
    body = spec.worldbody.add_body(name=name, mocap=True)
    disc = body.add_geom(name=name, material=name)
    disc.type = mujoco.mjtGeom.mjGEOM_CYLINDER
    disc.size = [radius, height / 2, 0]
    disc.pos = [0, 0, height / 2]


def _add_light(spec: MjSpec) -> None:
    """Add light from above; its shadow shows where the feet leave the floor."""
    spec.stat.extent = 1.6
    spec.stat.center = _TARGET
    spec.visual.map.shadowclip = 1.0
    spec.visual.map.znear = 0.2
    spec.visual.headlight.ambient = [0.6] * 3
    light = spec.worldbody.add_light(pos=[1.2, 1.5, 3.0], dir=[-0.4, -0.45, -1.0])
    light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    light.diffuse = [0.35] * 3
    light.specular = [0.15] * 3


def _camera_axes(direction: Array) -> list[float]:
    """Axes x and y of an upright camera that looks along a direction."""
    right = np.cross(direction, [0.0, 0.0, 1.0])
    up = np.cross(right, direction)
    return [*right / np.linalg.norm(right), *up / np.linalg.norm(up)]
