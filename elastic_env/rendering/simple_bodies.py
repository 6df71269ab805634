"""Simple shapes for links without any: rods from joint to joint, and balls at the ends."""

from typing import Any

import mujoco
import numpy as np

_RADIUS = 0.02
"""Radius of a rod divided by the size of the robot."""
_RGBA = (0.75, 0.76, 0.78, 1.0)
_LOOK: dict[str, Any] = {"rgba": _RGBA, "mass": 0.0, "contype": 0, "conaffinity": 0}
_CAPSULE = mujoco.mjtGeom.mjGEOM_CAPSULE
_SPHERE = mujoco.mjtGeom.mjGEOM_SPHERE


def add_simple_bodies(spec: mujoco.MjSpec) -> None:
    """Draw links without a shape by rods to the next links, or a ball about the center of mass.

    Rods and balls have no mass and touch nothing.

    Args:
        spec: A specification that compiles; it is changed.
    """
    model = spec.copy().compile()
    radius = _RADIUS * float(np.linalg.norm(model.body_pos, axis=1).sum())
    for body in [body for body in spec.bodies if not body.geoms]:
        children = np.flatnonzero(model.body_parentid == body.id)
        ends = [model.body_pos[child] for child in children if child != body.id]
        rods = [end for end in ends if np.linalg.norm(end) > radius]
        for end in rods:
            _add(body, _CAPSULE, radius, fromto=np.concatenate([np.zeros(3), end]))
        if not rods and model.body_mass[body.id] > 0.0:
            _add(body, _SPHERE, radius, pos=model.body_ipos[body.id])


def _add(body: Any, kind: mujoco.mjtGeom, radius: float, **place: Any) -> None:
    body.add_geom(type=kind, size=[radius, 0.0, 0.0], **_LOOK, **place)
