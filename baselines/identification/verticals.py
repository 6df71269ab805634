"""Direction of gravity as an IMU measures it: roll and pitch, or a unit vector."""

import numpy as np

from elastic_env.core.signals import Array


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
