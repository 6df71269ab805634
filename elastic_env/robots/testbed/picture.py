"""The testbed's picture: what is drawn at angle x stands at q_ref + factor · (x − q_ref).

The translucent pendulum is the reference, the solid one the link, the blue pointer the rotor.
"""

from collections.abc import Mapping

import mujoco
import numpy as np

from elastic_env.rendering.picture import CAMERA, Picture, Rgba, set_stage
from elastic_env.rendering.side_by_side import Alone, Sides
from elastic_env.robots import deviations
from elastic_env.robots.deviations import REFERENCE_RGBA, enlarge_deviation
from elastic_env.robots.testbed.model import Pendulum

_LINK_RGBA = (0.85, 0.45, 0.15, 1.0)
_STEEL_RGBA = (0.42, 0.44, 0.48, 1.0)
_HOUSING_RGBA = (0.2, 0.22, 0.26, 1.0)
_ROTOR_RGBA = (0.15, 0.4, 0.85, 1.0)
_LEGEND = (
    ("rotor", _ROTOR_RGBA),
    ("link", _LINK_RGBA),
    ("reference", deviations.REFERENCE_WORD_RGBA),
)


class TestbedPicture(Picture):
    """The testbed of Fig. 4: housing, rotor pointer, pendulum, and a translucent reference."""

    __test__ = False

    def __init__(self, pendulum: Pendulum) -> None:
        super().__init__(_display_spec(pendulum), _LEGEND)
        self._pendulum = pendulum

    def alone(self) -> Alone:
        """The robot of a side-by-side picture."""
        spec = mujoco.MjSpec()
        spec.compiler.degree = False
        reach = self._pendulum.com_distance
        _add_mount(spec.worldbody)
        _add_pendulum(spec.worldbody, "link", 0.0, reach, _STEEL_RGBA, _LINK_RGBA)
        return Alone(spec, ["link"], (1.6 * reach, 0.0, 0.0), dress=_add_light)

    def sides(self, now: Mapping[str, float], world: int = 0) -> Sides:  # noqa: ARG002
        """Reference, motor side and link side of a world."""
        link = now["link_angle"]
        angles = (now["reference_angle"], link + now["deflection"], link)
        return Sides(*(np.array([angle]) for angle in angles))

    def _pose(self, now: dict[str, float], world: int) -> None:  # noqa: ARG002
        reference = now["reference_angle"]
        link = now["link_angle"]
        rotor = link + now["deflection"]
        self._data.joint("reference").qpos = reference
        self._data.joint("link").qpos = enlarge_deviation(link, reference)
        self._data.joint("rotor").qpos = enlarge_deviation(rotor, reference)

    def _caption(self, now: dict[str, float], world: int) -> list[str]:  # noqa: ARG002
        return deviations.deviation_caption(now)


def _display_spec(pendulum: Pendulum) -> mujoco.MjSpec:
    """A model for drawing only: three independent hinges, no dynamics."""
    spec = mujoco.MjSpec()
    set_stage(spec, deviations.WIDTH, deviations.HEIGHT)
    reach = pendulum.com_distance
    world = spec.worldbody
    _add_light(spec)
    eye = [0.0, -2.25 * reach, -0.22 * reach]
    world.add_camera(name=CAMERA, pos=eye, xyaxes=[1, 0, 0, 0, 0, 1], fovy=50)
    _add_mount(world)
    _add_pendulum(world, "reference", 0.03, reach, REFERENCE_RGBA, REFERENCE_RGBA)
    _add_pendulum(world, "link", 0.0, reach, _STEEL_RGBA, _LINK_RGBA)
    rotor = _add_hinge(world, "rotor")
    half = 0.36 * reach
    pointer = ([0.005, 0.004, half], [0, -0.03, -half])
    _add_disc(rotor, "rotor_disc", [0.055, 0.01, 0], [0, -0.03, 0], _ROTOR_RGBA)
    _add_box(rotor, "rotor_pointer", *pointer, _ROTOR_RGBA)
    return spec


def _add_light(spec: mujoco.MjSpec) -> None:
    light = spec.worldbody.add_light(pos=[0.3, -2.0, 2.0], dir=[-0.1, 0.8, -0.8])
    light.castshadow = False
    light.diffuse = [0.45] * 3
    light.specular = [0.1] * 3


def _add_mount(world: mujoco.MjsBody) -> None:
    _add_box(world, "housing", [0.07, 0.06, 0.09], [0, 0.12, 0.02], _HOUSING_RGBA)
    _add_box(world, "stand", [0.03, 0.03, 0.6], [0, 0.2, -0.5], (0.72, 0.74, 0.77, 1))


def _add_pendulum(
    world: mujoco.MjsBody, name: str, y: float, reach: float, rod: Rgba, bob: Rgba
) -> None:
    body = _add_hinge(world, name)
    _add_box(body, f"{name}_rod", [0.014, 0.008, reach / 2], [0, y, -reach / 2], rod)
    _add_disc(body, f"{name}_bob", [0.09, 0.025, 0], [0, y, -reach], bob)


def _add_hinge(world: mujoco.MjsBody, name: str) -> mujoco.MjsBody:
    body = world.add_body(name=name, mass=1.0, inertia=[1.0] * 3, explicitinertial=True)
    body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0.0, -1.0, 0.0])
    return body


def _add_box(
    body: mujoco.MjsBody, name: str, size: list[float], place: list[float], rgba: Rgba
) -> None:
    box = mujoco.mjtGeom.mjGEOM_BOX
    body.add_geom(name=name, type=box, size=size, pos=place, rgba=rgba)


def _add_disc(
    body: mujoco.MjsBody, name: str, size: list[float], place: list[float], rgba: Rgba
) -> None:
    """A cylinder across the plane of the motion."""
    geom = body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_CYLINDER, zaxis=[0, 1, 0])
    geom.size = size
    geom.pos = place
    geom.rgba = rgba
