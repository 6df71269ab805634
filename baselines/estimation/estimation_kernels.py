"""Recursive least squares of how legs bend, compiled, row by row; `baselines.estimation.bending` has the formulas.

Numba keeps compiled code by the file of the function that was called. So everything that a kernel calls stands in this
file, and every size comes from a type.
"""

import math
from typing import Any

import numpy as np

from elastic_env.core.compiled import compiled
from elastic_env.core.signals import Array

ESTIMATE = np.dtype(
    (
        np.record,
        [
            ("unknowns", np.float64, (2, 2, 2)),  # legs, roll and pitch: ρ [1] and c [rad]
            ("covariance", np.float64, (2, 2, 3)),  # its upper triangle
        ],
    )
)
"""What is known of a robot's legs."""


@compiled
def regress(observed: Any, tilts: Any, least: Any, memory: Any, found: Array) -> None:
    """One step of recursive least squares for seen − expected = ρ · expected + c, of feet that are loaded.

    Args:
        observed: Observations, rows with fields.
        tilts: Of the soles as they are seen and as they are expected, (n, 2, 2) each [rad].
        least: Force that the feet carry [N], force of a loaded foot [N], standard deviation of a measurement [rad].
        memory: Rows of `ESTIMATE` before, and to be filled, (n,).
        found: To be filled, (n, 9): ρ of legs and axes, their standard deviations, measured over assumed load less one.
    """
    (seen, expected), (carried_n, loaded_n, deviation_rad), (before, now) = tilts, least, memory
    for world in range(len(found)):
        now[world] = before[world]
        load = 0.0
        for leg in range(2):
            force = observed[world].wrench[leg, 0, 2]
            load += force
            for axis in range(2):
                x, P = now[world].unknowns[leg, axis], now[world].covariance[leg, axis]
                if force >= loaded_n:
                    update(x, P, expected[world, leg, axis], seen[world, leg, axis], deviation_rad)
                found[world, 2 * leg + axis], found[world, 4 + 2 * leg + axis] = x[0], math.sqrt(P[0])
        found[world, 8] = load / carried_n - 1.0


@compiled
def update(x: Array, P: Array, expected: float, seen: float, deviation_rad: float) -> None:
    """A measurement of (expected, 1) · x = seen − expected, whose errors have a standard deviation."""
    first, second = P[0] * expected + P[1], P[1] * expected + P[2]
    variance = (expected * first + second) + deviation_rad**2
    error = (seen - expected) - (expected * x[0] + x[1])
    gain = first / variance, second / variance
    x[0] += gain[0] * error
    x[1] += gain[1] * error
    P[0] -= gain[0] * first
    P[1] -= gain[0] * second
    P[2] -= gain[1] * second
