"""Rotation vectors and their derivatives, and the vertical by roll and pitch of an IMU."""

import numpy as np
from scipy.spatial.transform import Rotation

from elastic_env.core.signals import Array

_SMALL_RAD = 1e-6
"""Angle below which the series of `left_jacobian` is used."""


def rotation_of(vectors: Array) -> Array:
    """Rotations by rotation vectors, (..., 3) [rad] to (..., 3, 3)."""
    flat = Rotation.from_rotvec(np.reshape(vectors, (-1, 3))).as_matrix()
    return flat.reshape(*np.shape(vectors)[:-1], 3, 3)


def left_jacobian(vectors: Array) -> Array:
    """Angular velocity by the rate of a rotation vector, (..., 3) to (..., 3, 3)."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    safe = np.where(angle < _SMALL_RAD, 1.0, angle)
    W = cross_matrix(vectors)
    first = np.where(angle < _SMALL_RAD, 0.5, (1.0 - np.cos(safe)) / safe**2)
    second = np.where(angle < _SMALL_RAD, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    return np.eye(3) + first * W + second * (W @ W)


def cross_matrix(vectors: Array) -> Array:
    """Matrices of the cross product with vectors from the left, (..., 3) to (..., 3, 3)."""
    return np.cross(np.eye(3), np.expand_dims(vectors, -2))


def vertical(attitude: Array) -> Array:
    """Unit vector against gravity in an IMU's frame from roll and pitch, (N, 2) [rad] to (N, 3).

    It is the last row of R = R_z(yaw) R_y(pitch) R_x(roll), from the IMU's to the world's frame.
    """
    roll = attitude[..., 0]
    pitch = attitude[..., 1]
    return np.stack(
        [-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)], axis=-1
    )


def roll_and_pitch(direction: Array) -> Array:
    """Inverse of `vertical`, (N, 3) to (N, 2) [rad]."""
    x, y, z = np.moveaxis(direction, -1, 0)
    return np.stack([np.arctan2(y, z), -np.arcsin(np.clip(x, -1.0, 1.0))], axis=-1)


def normals_of(directions: Array) -> Array:
    """Two unit vectors across each direction, (N, 3) to (N, 2, 3)."""
    least = np.eye(3)[np.abs(directions).argmin(axis=-1)]
    first = np.cross(directions, least)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(directions, first)], axis=-2)
