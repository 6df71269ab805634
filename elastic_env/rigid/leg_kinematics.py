r"""Closed-form kinematics of a leg with six hinges: hip yaw, roll, pitch, knee, ankle pitch, roll.

The three hip axes meet in a point, the two ankle axes in another. At zero angles all link frames
are parallel to the pelvis. The axes are +z (yaw), +x (roll), +y (pitch). So the foot's orientation
in the pelvis is

.. math:: R = R_z(q_1) R_x(q_2) R_y(q_3) R_y(q_4) R_y(q_5) R_x(q_6)

and a positive knee angle bends the shank backwards. All functions work on batches of poses, (...).
"""

from dataclasses import dataclass

import numpy as np

from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array
from elastic_env.rigid.tree import kernels

JOINTS = ("hip_yaw", "hip_roll", "hip_pitch", "knee", "ankle_pitch", "ankle_roll")
"""Joints of a leg, from the hip to the foot."""


@dataclass(frozen=True)
class LegGeometry:
    """Lengths of thigh and shank [m]."""

    thigh: float
    shank: float

    @property
    def reach(self) -> float:
        """Distance from hip to ankle of the straight leg [m]."""
        return self.thigh + self.shank


def foot_pose(leg: LegGeometry, q: Array) -> tuple[Array, Array]:
    """Forward kinematics: ankle from the hip and orientation of the foot, in the pelvis frame.

    Args:
        leg: Lengths.
        q: Joint angles in the order of `JOINTS`, (..., 6) [rad].

    Returns:
        Position of the ankle from the hip, (..., 3) [m], and R_pelvis_foot, (..., 3, 3).
    """
    yaw, roll, pitch, knee, ankle_pitch, ankle_roll = np.moveaxis(q, -1, 0)
    R_hip = rotation_z(yaw) @ rotation_x(roll) @ rotation_y(pitch)
    R_knee = R_hip @ rotation_y(knee)
    position = -leg.thigh * R_hip[..., 2] - leg.shank * R_knee[..., 2]
    return position, R_knee @ rotation_y(ankle_pitch) @ rotation_x(ankle_roll)


def leg_angles(leg: LegGeometry, position: Array, R: Array) -> Array:
    """Inverse kinematics of a leg whose knee bends backwards and whose hip is above the sole.

    Args:
        leg: Lengths.
        position: Ankle from the hip in the pelvis frame, (..., 3) [m].
        R: Orientation of the foot in the pelvis frame, (..., 3, 3).

    Returns:
        Joint angles in the order of `JOINTS`, (..., 6) [rad].

    Raises:
        ElasticError: A target is out of reach.
    """
    # the hip from the ankle, in the foot frame
    hip = -np.einsum("...ji,...j->...i", R, position)
    distance = np.linalg.norm(hip, axis=-1)
    _require_reach(leg, distance)
    A = leg.thigh
    B = leg.shank
    knee = np.arccos(np.clip((distance**2 - A**2 - B**2) / (2.0 * A * B), -1.0, 1.0))
    ankle_roll = np.arctan2(hip[..., 1], hip[..., 2])
    height = np.hypot(hip[..., 1], hip[..., 2])
    knee_part = np.arctan2(-A * np.sin(knee), B + A * np.cos(knee))
    ankle_pitch = knee_part - np.arctan2(hip[..., 0], height)
    # orientation of the thigh, Rz Rx Ry
    M = R @ rotation_x(-ankle_roll) @ rotation_y(-ankle_pitch - knee)
    yaw = np.arctan2(-M[..., 0, 1], M[..., 1, 1])
    roll = np.arctan2(M[..., 2, 1], np.hypot(M[..., 2, 0], M[..., 2, 2]))
    pitch = np.arctan2(-M[..., 2, 0], M[..., 2, 2])
    return np.stack([yaw, roll, pitch, knee, ankle_pitch, ankle_roll], axis=-1)


def rotation_x(angle: Array) -> Array:
    """Rotation about x, (...) [rad] to (..., 3, 3)."""
    return _rotation(angle, 1, 2)


def rotation_y(angle: Array) -> Array:
    """Rotation about y, (...) [rad] to (..., 3, 3)."""
    return _rotation(angle, 2, 0)


def rotation_z(angle: Array) -> Array:
    """Rotation about z, (...) [rad] to (..., 3, 3)."""
    return _rotation(angle, 0, 1)


def turn(vectors: Array, angle: Array) -> Array:
    """Turn vectors about z, (..., 2) or (..., 3), by angles (...) [rad]; both are broadcast."""
    cosine = np.cos(angle)
    sine = np.sin(angle)
    x = vectors[..., 0]
    y = vectors[..., 1]
    rotated = np.empty(np.broadcast_shapes(vectors.shape, (*np.shape(angle), 1)))
    rotated[..., 0] = cosine * x - sine * y
    rotated[..., 1] = sine * x + cosine * y
    rotated[..., 2:] = vectors[..., 2:]
    return rotated


def rotation_of_tilt(attitude: Array) -> Array:
    """Rotation about x by a roll, then about y by a pitch, (..., 2) [rad] to (..., 3, 3)."""
    R = np.empty((*attitude.shape[:-1], 3, 3))
    angles = np.ascontiguousarray(attitude, dtype=np.float64)
    kernels.tilt_rotations(angles.reshape(-1, 2), R.reshape(-1, 3, 3))
    return R


def _rotation(angle: Array, first: int, second: int) -> Array:
    """Return the rotation that turns axis `first` towards axis `second`."""
    angle = np.asarray(angle, dtype=np.float64)
    R = np.zeros((*angle.shape, 3, 3))
    third = 3 - first - second
    R[..., third, third] = 1.0
    R[..., first, first] = R[..., second, second] = np.cos(angle)
    R[..., second, first] = np.sin(angle)
    R[..., first, second] = -R[..., second, first]
    return R


def _require_reach(leg: LegGeometry, distance: Array) -> None:
    nearest = abs(leg.thigh - leg.shank)
    outside = np.flatnonzero((distance > leg.reach) | (distance < nearest))
    if outside.size:
        worst = int(outside[0])
        raise ElasticError(
            f"foot target {worst} is {distance.ravel()[worst]:.4f} m from the hip, out"
            f" of reach of a leg of {leg.thigh} m + {leg.shank} m ({nearest:.4f} to"
            f" {leg.reach:.4f} m); lower the hip or shorten the step"
        )
