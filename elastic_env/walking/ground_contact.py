r"""Zero moment point from the wrenches at the ankles.

A force-torque sensor at the ankle measures what the foot passes on to the leg: the ground's force less the weight of
the foot itself, (f, n) about the ankle, in the frame of the foot. With the ground's forces on both feet,
taken about the origin on the ground, the ZMP is

.. math:: x = -M_y / F_z, \quad y = M_x / F_z
"""

import numpy as np

from elastic_env.signals import Array
from elastic_env.vectors import cross, rotated


def ground_wrench(
    force: Array, moment: Array, foot_R: Array, foot_mass: Array, foot_com: Array, gravity: Array
) -> tuple[Array, Array]:
    """Force and moment of the ground on each foot, about its ankle, of feet that hardly accelerate.

    Args:
        force: Sensor, on the leg, in the frame of the foot, (..., L, 3) [N].
        moment: Sensor, about the ankle, likewise [N·m].
        foot_R: Orientation of the feet, (..., L, 3, 3).
        foot_mass: (L,) [kg].
        foot_com: Center of mass of the feet from the ankle, in the frame of the foot, (L, 3) [m].
        gravity: Acceleration of gravity in the frame that foot_R leads to, (..., 3) [m/s²].

    Returns:
        Force and moment in that frame, (..., L, 3) each [N], [N·m].
    """
    weight = foot_mass[:, None] * gravity[..., None, :]
    f = rotated(foot_R, force) - weight
    n = rotated(foot_R, moment) - cross(rotated(foot_R, foot_com), weight)
    return f, n


def zero_moment_point(force: Array, moment: Array, ankle: Array, least_n: float) -> Array:
    """ZMP of both feet together on the ground plane z = 0.

    Args:
        force: Of the ground on each foot, (..., L, 3) [N].
        moment: About its ankle, (..., L, 3) [N·m].
        ankle: Positions of the ankles, (..., L, 3) [m].
        least_n: Vertical force below which there is no ZMP [N].

    Returns:
        (..., 2) [m]; nan where the feet are not loaded.
    """
    about_origin = _over_feet(cross(ankle, force) + moment)
    vertical = _over_feet(force)[..., 2]
    loaded = vertical >= least_n
    scale = np.where(loaded, vertical, 1.0)
    zmp = np.stack([-about_origin[..., 1], about_origin[..., 0]], axis=-1) / scale[..., None]
    return np.where(loaded[..., None], zmp, np.nan)


def _over_feet(vectors: Array) -> Array:
    """Sum over the two feet, (..., 2, 3) to (..., 3)."""
    return vectors[..., 0, :] + vectors[..., 1, :]
