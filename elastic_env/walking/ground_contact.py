r"""Zero moment point from the wrenches at the ankles.

A force-torque sensor at the ankle measures what the foot passes on to the leg: the ground's force less the weight of
the foot itself, (f, n) about the ankle, in the frame of the foot. With the ground's forces on both feet,
taken about the origin on the ground, the ZMP is

.. math:: x = -M_y / F_z, \quad y = M_x / F_z
"""

import numpy as np

from elastic_env.signals import Array


class FootSensors:
    """Force-torque sensors at the ankles of feet that hardly accelerate.

    Args:
        foot_mass: (L,) [kg].
        foot_com: Center of mass of the feet from the ankle, in the frame of the foot, (L, 3) [m].
        gravity: Acceleration of gravity in the world, (3,) [m/s²].
    """

    def __init__(self, foot_mass: Array, foot_com: Array, gravity: Array) -> None:
        self._com = foot_com
        self._weight = foot_mass[:, None] * gravity
        self._turning = np.cross(np.eye(3), self._weight[:, None])  # x @ this is x × weight

    def ground_wrench(self, sensors: Array, foot_R: Array) -> tuple[Array, Array]:
        """Force and moment of the ground on each foot, about its ankle, in the world.

        Args:
            sensors: Force and moment on the leg about the ankle, in the frame of the foot, (n, L, 2, 3) [N], [N·m].
            foot_R: Orientation of the feet, (n, L, 3, 3).

        Returns:
            (n, L, 3) each [N], [N·m].
        """
        vectors = np.empty((*foot_R.shape[:-2], 3, 3))
        vectors[..., :2, :], vectors[..., 2, :] = sensors, self._com
        seen = vectors @ foot_R.swapaxes(-1, -2)
        turned = seen[..., 2:, :] @ self._turning
        return seen[..., 0, :] - self._weight, seen[..., 1, :] - turned[..., 0, :]


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
    about_x = ankle[..., 1] * force[..., 2] - ankle[..., 2] * force[..., 1] + moment[..., 0]
    about_y = ankle[..., 2] * force[..., 0] - ankle[..., 0] * force[..., 2] + moment[..., 1]
    vertical = _over_feet(force[..., 2])
    scale = np.where(vertical >= least_n, vertical, np.nan)
    zmp = np.empty((*vertical.shape, 2))
    np.divide(-_over_feet(about_y), scale, out=zmp[..., 0])
    np.divide(_over_feet(about_x), scale, out=zmp[..., 1])
    return zmp


def _over_feet(values: Array) -> Array:
    """Sum over the two feet, (..., 2) to (...)."""
    return values[..., 0] + values[..., 1]
