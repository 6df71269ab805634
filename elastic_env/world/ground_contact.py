r"""Zero moment point from the wrenches at the ankles.

A force-torque sensor at the ankle measures what the foot passes on to the leg: the ground's force
less the weight of the foot itself, (f, n) about the ankle, in the frame of the foot. With the
ground's forces on both feet, taken about the origin on the ground, the ZMP is

.. math:: x = -M_y / F_z, \quad y = M_x / F_z
"""

import numpy as np

from elastic_env.core.signals import Array
from elastic_env.rigid.biped import Biped
from elastic_env.world.control_kernels import foot_drifts, ground_wrenches, moment_points


class FootSensors:
    """Force-torque sensors at the ankles of feet that hardly accelerate.

    Args:
        foot_mass: (L,) [kg].
        foot_com: Center of mass of the feet from the ankle, in the frame of the foot, (L, 3) [m].
        gravity: Acceleration of gravity in the world, (3,) [m/s²].

    Attributes:
        com: As `foot_com`.
        weight: Of each foot, in the world, (L, 3) [N].
    """

    def __init__(self, foot_mass: Array, foot_com: Array, gravity: Array) -> None:
        self.com = foot_com
        self.weight = foot_mass[:, None] * gravity

    @classmethod
    def of_biped(cls, biped: Biped) -> "FootSensors":
        """The force-torque sensors at the ankles of a biped."""
        model = biped.rigid
        feet = biped.feet
        return cls(model.body_mass[feet], model.body_ipos[feet], model.opt.gravity)

    def ground_wrench(self, sensors: Array, foot_R: Array) -> tuple[Array, Array]:
        """Force and moment of the ground on each foot, about its ankle, in the world.

        Args:
            sensors: Force and moment on the leg about the ankle, in the frame of the foot, (n, L,
                2, 3) [N], [N·m].
            foot_R: Orientation of the feet, (n, L, 3, 3).

        Returns:
            (n, L, 3) each [N], [N·m].
        """
        seen = _rows(sensors, (*foot_R.shape[:-2], 2, 3), 3)
        R = _rows(foot_R, foot_R.shape, 3)
        force = np.empty(R.shape[:-1])
        moment = np.empty(R.shape[:-1])
        ground_wrenches(seen, R, self.com, self.weight, force, moment)
        shape = foot_R.shape[:-1]
        return force.reshape(shape), moment.reshape(shape)


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
    shape = np.broadcast_shapes(force.shape, moment.shape, ankle.shape)
    f, n, p = (_rows(values, shape, 2) for values in (force, moment, ankle))
    zmp = np.empty((len(f), 2))
    moment_points(f, n, p, least_n, zmp)
    return zmp.reshape(*shape[:-2], 2)


def foot_drift(force: Array, ankle: Array, planned: Array) -> Array:
    r"""Displacement of the feet that stand against the plan, in the ground plane.

    .. math:: d = \sum_i w_i \, (p_i - p_{i, plan}), \quad w_i = F_{z, i} / \sum_j F_{z, j}

    It is continuous, as the weights are. The ZMP minus d is the ZMP of the same wrenches on feet
    that stand where they are planned.

    Args:
        force: Vertical force of the ground on each foot, (..., L) [N].
        ankle: Positions of the ankles, (..., L, 3) [m].
        planned: Where the plan has them, (..., L, 3) [m].

    Returns:
        d, (..., 2) [m]; nan where nothing is carried.
    """
    f = _rows(force, ankle.shape[:-1], 1)
    p, p_plan = (_rows(places, ankle.shape, 2) for places in (ankle, planned))
    drift = np.empty((len(f), 2))
    foot_drifts(f, p, p_plan, drift)
    return drift.reshape(*ankle.shape[:-2], 2)


def _rows(values: Array, shape: tuple[int, ...], axes: int) -> Array:
    """Values of a shape with one row per robot: all but the last axes in one."""
    if values.shape != shape:
        # which cannot be written to: to Numba that is another type
        values = np.broadcast_to(values, shape)
    return np.require(values, requirements=["C", "W"]).reshape(-1, *shape[-axes:])
