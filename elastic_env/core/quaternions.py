"""Rotation matrices and unit quaternions (w, x, y, z), by MuJoCo."""

import mujoco
import numpy as np

from elastic_env.core.signals import Array


def matrix_of(quaternion: Array) -> Array:
    """Return the rotation matrix (3, 3) of a unit quaternion (4,)."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def quaternion_of(matrix: Array) -> Array:
    """Return the unit quaternion (4,) of a rotation matrix (3, 3)."""
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, matrix.ravel())
    return quaternion
