"""The walker as it is drawn: shapes on its links, solid, and translucent for the plan."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from elastic_env.core.signals import Array
from elastic_env.rendering.picture import CAMERA, Rgba, set_stage
from elastic_env.robots.thormang.model import LEG, SIDES, Thormang, rigid_spec

PLAN = "plan_"
"""Prefix of the names of the translucent robot."""
ZMP = "zmp"
ZMP_REFERENCE = "zmp_reference"
"""Names of the markers on the floor, which are moved by `mocap_pos`."""

LEFT_RGBA = (0.93, 0.56, 0.20, 1.0)
RIGHT_RGBA = (0.74, 0.37, 0.15, 1.0)
PLAN_RGBA = (0.40, 0.80, 0.52, 0.2)
ZMP_RGBA = (0.90, 0.08, 0.42, 1.0)
ZMP_REFERENCE_RGBA = (0.25, 0.62, 0.38, 1.0)

GRID_M = 0.2
"""Distance of the lines on the floor [m]."""

_SHELL_RGBA = (0.80, 0.82, 0.85, 1.0)
_FRAME_RGBA = (0.24, 0.26, 0.30, 1.0)
_FLOOR_RGB = (1.0, 1.0, 1.0)
_GRID_RGB = (0.85, 0.87, 0.90)
_SIZE = 720
_EYE = np.array([3.3, 1.6, 2.05])
_TARGET = np.array([0.0, 0.0, 0.69])
_PLAN_INSET_M = 0.008
"""By how much the plan's shapes are smaller, at most to half: the robot hides its plan where it
follows it.
"""


def display_spec(robot: Thormang) -> mujoco.MjSpec:
    """A model for drawing only: robot, plan with the prefix `PLAN`, floor, markers."""
    spec = _dress(robot, is_plan=False)
    set_stage(spec, _SIZE, _SIZE)
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    spec.attach(_dress(robot, is_plan=True), prefix=PLAN, frame=spec.worldbody.add_frame())
    _add_floor(spec)
    _add_marker(spec, ZMP_REFERENCE, radius=0.05, height=0.022, rgba=ZMP_REFERENCE_RGBA)
    _add_marker(spec, ZMP, radius=0.03, height=0.0245, rgba=ZMP_RGBA)
    _add_light(spec)
    spec.worldbody.add_camera(name=CAMERA, pos=_EYE, xyaxes=_facing(_TARGET - _EYE), fovy=25.5)
    return spec


def solid_spec(robot: Thormang) -> mujoco.MjSpec:
    """The robot alone, without floor and light."""
    spec = _dress(robot, is_plan=False)
    spec.delete(spec.body("floor"))
    return spec


def set_floor_and_light(spec: mujoco.MjSpec) -> None:
    """Add to a scene what lies under the robot and above it."""
    spec.worldbody.add_body(name="floor").add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.05]
    )
    _add_floor(spec)
    _add_light(spec)


@dataclass(frozen=True)
class _Shapes:
    """Adds shapes to a robot's links: solid ones, or smaller translucent ones of the plan."""

    spec: mujoco.MjSpec
    is_plan: bool

    def block(
        self, link: str, size: Sequence[float], at: Any, rgba: Rgba, roundness: float
    ) -> None:
        """Box whose edges are rounder the larger `roundness`, 0 to 1."""
        name = f"block_{len(self.spec.meshes)}"
        mesh = self.spec.add_mesh(name=name, scale=self._inset(size))
        mesh.make_supersphere(24, roundness, roundness)
        geom = self.spec.body(link).add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, pos=at, mass=0.0
        )
        geom.rgba = self._colour(rgba)

    def add(
        self, kind: str, link: str, size: Sequence[float], rgba: Rgba = _FRAME_RGBA, **place: Any
    ) -> None:
        """Sphere, cylinder, capsule or box, by default of the dark frame; place as of a geom."""
        geom = self.spec.body(link).add_geom(
            type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"),
            size=[*self._inset(size), 0, 0][:3],
            mass=0.0,
            **place,
        )
        geom.rgba = self._colour(rgba)

    def paint(self, geom: mujoco.MjsGeom, rgba: Rgba) -> None:
        """Give a box that the robot has already its colour, and its size in the plan."""
        geom.rgba = self._colour(rgba)
        geom.size = self._inset(geom.size)

    def _colour(self, rgba: Rgba) -> Rgba:
        return PLAN_RGBA if self.is_plan else rgba

    def _inset(self, lengths: Any) -> list[float]:
        if not self.is_plan:
            return list(lengths)
        return [max(length - _PLAN_INSET_M, length / 2) for length in lengths]


def _dress(robot: Thormang, is_plan: bool) -> mujoco.MjSpec:
    """The robot's links and joints with shapes; the solid one brings the floor."""
    spec = rigid_spec(robot)
    for site in list(spec.sites):
        spec.delete(site)
    if is_plan:
        spec.delete(spec.body("floor"))
    shapes = _Shapes(spec, is_plan)
    _add_trunk(shapes, robot)
    for side, mirror, rgba in zip(SIDES, (1.0, -1.0), (LEFT_RGBA, RIGHT_RGBA), strict=True):
        _add_arm(shapes, mirror, rgba)
        _add_leg(shapes, side, rgba)
        shapes.paint(spec.geom(f"{side}_sole"), rgba)
    return spec


def _add_trunk(shapes: _Shapes, robot: Thormang) -> None:
    torso = "upper_body"
    width = robot.hip_half_spacing + 0.03
    shapes.block("pelvis", (0.075, width, 0.05), (0, 0, 0.075), _FRAME_RGBA, 0.25)
    shapes.add("cylinder", "pelvis", (0.055, 0.05), pos=(0, 0, 0.15))
    shapes.block(torso, (0.095, 0.155, 0.15), (0, 0, 0.165), _SHELL_RGBA, 0.35)
    shapes.block(torso, (0.02, 0.09, 0.05), (0.085, 0, 0.2), _FRAME_RGBA, 0.3)
    shapes.add("cylinder", torso, (0.035, 0.03), pos=(0, 0, 0.325))
    shapes.block(torso, (0.07, 0.07, 0.075), (0.01, 0, 0.41), _SHELL_RGBA, 0.4)
    shapes.block(torso, (0.02, 0.052, 0.022), (0.068, 0, 0.42), _FRAME_RGBA, 0.3)


def _add_arm(shapes: _Shapes, mirror: float, rgba: Rgba) -> None:
    """A bent arm, which does not move."""
    torso = "upper_body"
    upper = (0.0, 0.215 * mirror, 0.2, -0.02, 0.235 * mirror, 0.04)
    lower = (0.03, 0.235 * mirror, -0.02, 0.15, 0.21 * mirror, -0.06)
    shapes.add("sphere", torso, (0.055,), pos=(0.0, 0.195 * mirror, 0.255))
    shapes.add("capsule", torso, (0.040,), rgba, fromto=upper)
    shapes.add("sphere", torso, (0.042,), pos=(-0.02, 0.237 * mirror, 0.0))
    shapes.add("capsule", torso, (0.034,), rgba, fromto=lower)
    shapes.add("sphere", torso, (0.035,), pos=(0.19, 0.205 * mirror, -0.073))


def _add_leg(shapes: _Shapes, side: str, rgba: Rgba) -> None:
    """Thigh, shank, and a fork between ankle and sole, through which one sees the markers."""
    thigh = f"{side}_thigh"
    shank = f"{side}_shank"
    shapes.add("sphere", f"{side}_hip_roll_link", (0.062,), pos=(0, 0, 0))
    shapes.block(thigh, (0.058, 0.052, 0.115), (0.004, 0, -LEG.thigh / 2), rgba, 0.45)
    shapes.add("cylinder", thigh, (0.05, 0.058), pos=(0, 0, -LEG.thigh), zaxis=(0, 1, 0))
    shapes.block(shank, (0.05, 0.046, 0.115), (0.004, 0, -LEG.shank / 2), rgba, 0.45)
    shapes.add("cylinder", shank, (0.036, 0.05), pos=(0, 0, -LEG.shank), zaxis=(0, 1, 0))
    for y in (-0.048, 0.048):
        shapes.add("box", f"{side}_foot", (0.022, 0.008, 0.05), pos=(0, y, -0.045))


def _add_floor(spec: mujoco.MjSpec) -> None:
    """A light floor with a grid."""
    spec.add_texture(
        name="grid",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        mark=mujoco.mjtMark.mjMARK_EDGE,
        rgb1=_FLOOR_RGB,
        rgb2=_FLOOR_RGB,
        markrgb=_GRID_RGB,
        width=128,
        height=128,
    )
    repeat = 2.0 / GRID_M  # MuJoCo lays this many textures on two meters
    floor = spec.add_material(
        name="floor", texrepeat=[repeat] * 2, texuniform=True, specular=0.0, shininess=0.0
    )
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "grid"
    spec.geom("floor").material = "floor"


def _add_marker(spec: mujoco.MjSpec, name: str, radius: float, height: float, rgba: Rgba) -> None:
    """A disc on the floor, higher than the soles, so that one sees it under a foot."""
    spec.add_material(name=name, rgba=rgba, emission=0.25, specular=0.0)
    spec.worldbody.add_body(name=name, mocap=True).add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[radius, height / 2, 0],
        pos=[0, 0, height / 2],
        material=name,
    )


def _add_light(spec: mujoco.MjSpec) -> None:
    """Light from above with a shadow, which shows where the feet leave the floor."""
    spec.stat.extent = 1.6
    spec.stat.center = _TARGET
    spec.visual.map.shadowclip = 1.0
    spec.visual.map.znear = 0.2
    spec.visual.headlight.ambient = [0.6] * 3
    spec.worldbody.add_light(
        pos=[1.2, 1.5, 3.0],
        dir=[-0.4, -0.45, -1.0],
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        diffuse=[0.35] * 3,
        specular=[0.15] * 3,
    )


def _facing(direction: Array) -> list[float]:
    """The x and y axis of a camera that looks along a direction and stands upright."""
    right = np.cross(direction, [0.0, 0.0, 1.0])
    up = np.cross(right, direction)
    return [*right / np.linalg.norm(right), *up / np.linalg.norm(up)]
