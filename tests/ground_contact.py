"""Kernels of the ground contact, which take one robot, for many at once."""

from collections.abc import Callable
from typing import Any

import numpy as np

from elastic_env.core.signals import Array
from elastic_env.world import walk_kernels as kernels
from elastic_env.world.foot_sensors import FootSensors


def ground_wrench(feet: FootSensors, sensors: Array, foot_R: Array) -> tuple[Array, Array]:
    """Force and moment of the ground on each foot about its ankle, (..., L, 3) each [N], [N·m].

    Args:
        feet: Their sensors.
        sensors: Force and moment on the leg, in the frame of the foot, (..., L, 2, 3) [N], [N·m].
        foot_R: Orientation of the feet, (..., L, 3, 3).
    """
    shape = foot_R.shape[:-1]
    R = np.array(foot_R).reshape(-1, *foot_R.shape[-3:])
    shown = np.array(np.broadcast_to(sensors, (*shape[:-1], 2, 3)))
    force, moment = np.empty((2, len(R), *shape[-2:]))
    for row, own in enumerate(shown.reshape(len(R), -1, 2, 3)):
        kernels.compute_ground_wrench(own, R[row], feet.com, feet.weight, force[row], moment[row])
    return force.reshape(shape), moment.reshape(shape)


def zero_moment_point(force: Array, moment: Array, ankle: Array, least_n: float) -> Array:
    """ZMP of both feet together on z = 0, (..., 2) [m]; of (..., L, 3) [N], [N·m], [m]."""

    def of_one(zmp: Array, *own: Array) -> None:
        kernels.compute_zmp(*own, least_n, zmp)

    return _of_each(of_one, 2, force, moment, ankle)


def foot_drift(force: Array, ankle: Array, planned: Array) -> Array:
    """Displacement of the feet that stand, (..., 2) [m]; of (..., L) [N] and (..., L, 3) [m]."""

    def of_one(drift: Array, force: Array, ankle: Array, planned: Array) -> None:
        kernels.compute_foot_drift(np.array(force[:, 0]), ankle, planned, drift)

    return _of_each(of_one, 2, force[..., None], ankle, planned)


def _of_each(fill: Callable[..., Any], axes: int, *values: Array) -> Array:
    """Results of a function of one robot; it is called with a row to be filled, (2,)."""
    shape = np.broadcast_shapes(*(own.shape for own in values))
    rows = [np.array(np.broadcast_to(own, shape)).reshape(-1, *shape[-axes:]) for own in values]
    found = np.empty((len(rows[0]), 2))
    for row, *own in zip(found, *rows, strict=True):
        fill(row, *own)
    return found.reshape(*shape[:-axes], 2)
