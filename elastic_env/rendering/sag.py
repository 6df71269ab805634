"""Picture of a robot that sags, over its translucent reference, with enlarged deviations."""

from collections.abc import Sequence

import mujoco
import numpy as np

from elastic_env.core.signals import Array
from elastic_env.rendering.picture import Image, Rgba, paint, renderer, set_stage
from elastic_env.rendering.simple_bodies import add_simple_bodies

ENLARGEMENT = 8.0
"""Factor by which deviations are drawn."""
_REFERENCE = "reference_"
_REFERENCE_RGBA = (0.3, 0.7, 0.45, 0.3)
_LINK_RGBA = (1.0, 0.72, 0.42, 1.0)


class SagViews:
    """A robot and its translucent reference.

    Args:
        spec: The robot's bodies, drawn in one colour. A robot without shapes is drawn as rods
            between its joints.
        joints: Hinges, in the order of all arrays.
        pixels: Width and height of a view.
    """

    def __init__(self, spec: mujoco.MjSpec, joints: Sequence[str], pixels: int) -> None:
        scene = _one_color_copy(spec, _LINK_RGBA)
        reference = _one_color_copy(spec, _REFERENCE_RGBA)
        set_stage(scene, pixels, pixels)
        scene.visual.headlight.diffuse = [0.45] * 3
        scene.attach(reference, prefix=_REFERENCE, frame=scene.worldbody.add_frame())
        self._model = scene.compile()
        self._joints = list(joints)

    def draw(self, q_ref: Array, links: Array) -> Image:
        """Draw views in a row.

        Args:
            q_ref: Reference of each view, (views, n) [rad].
            links: Link angles, (views, n) [rad].

        Raises:
            ElasticError: The machine cannot draw.
        """
        data = mujoco.MjData(self._model)
        views = []
        with renderer(self._model) as scene_renderer:
            for references, q in zip(q_ref, links, strict=True):
                enlarged = references + ENLARGEMENT * (q - references)
                angles = zip(self._joints, enlarged, references, strict=True)
                for name, angle, reference in angles:
                    data.joint(name).qpos = angle
                    data.joint(_REFERENCE + name).qpos = reference
                mujoco.mj_forward(self._model, data)
                scene_renderer.update_scene(data, camera=_camera(self._model, data))
                views.append(scene_renderer.render().copy())
        return np.concatenate(views, axis=1)


def _one_color_copy(spec: mujoco.MjSpec, rgba: Rgba) -> mujoco.MjSpec:
    """Copy a specification in one colour, without floors."""
    copy = spec.copy()
    for geom in list(copy.geoms):
        if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
            copy.delete(geom)
    if not copy.geoms:
        add_simple_bodies(copy)
    paint(copy, rgba)
    return copy


def _camera(model: mujoco.MjModel, data: mujoco.MjData) -> mujoco.MjvCamera:
    """Return a camera at the side that sees the whole robot."""
    radius = model.geom_rbound[:, None]
    low = (data.geom_xpos - radius).min(axis=0)
    high = (data.geom_xpos + radius).max(axis=0)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = (low + high) / 2.0
    camera.distance = 1.15 * float(np.linalg.norm(high - low))
    camera.azimuth = 125.0
    camera.elevation = -15.0
    return camera
