"""Bodies to look at for a robot without shapes: a rod from each joint to the next."""

import mujoco
import numpy as np

_RADIUS = 0.02
"""Of a rod, over the size of the robot."""
_RGBA = (0.75, 0.76, 0.78, 1.0)


def add_simple_bodies(spec: mujoco.MjSpec) -> None:
    """Draw every link that has a link at some distance as a rod. Rods have no mass and touch nothing.

    Args:
        spec: It is changed. Links that have shapes get a rod too.
    """
    lengths = [float(np.linalg.norm(body.pos)) for body in spec.bodies]
    radius = _RADIUS * sum(lengths)
    for body, length in zip(spec.bodies, lengths, strict=True):
        if length > radius:
            body.parent.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0.0, 0.0, 0.0, *body.pos], size=[radius, 0.0, 0.0],
                mass=0.0, contype=0, conaffinity=0, rgba=_RGBA,
            )  # fmt: skip
