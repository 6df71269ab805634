"""Products of vectors in the last axis of arrays, (..., 3), faster than NumPy's own for many short ones."""

import numpy as np

from elastic_env.signals import Array


def cross(a: Array, b: Array) -> Array:
    """Vector product, (..., 3) and (..., 3) to (..., 3)."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    x = ay * bz - az * by
    product = np.empty((*x.shape, 3))
    product[..., 0], product[..., 1], product[..., 2] = x, az * bx - ax * bz, ax * by - ay * bx
    return product


def rotated(R: Array, v: Array) -> Array:
    """R v, (..., 3, 3) and (..., 3) to (..., 3)."""
    return R[..., 0] * v[..., 0, None] + R[..., 1] * v[..., 1, None] + R[..., 2] * v[..., 2, None]
