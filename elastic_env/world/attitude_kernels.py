"""Compiled attitude: rotations of quaternions, and the filter of an inertial IMU."""

import math

import numpy as np

from elastic_env.core.compiled import compiled, compiled_part
from elastic_env.core.signals import Array


@compiled_part
def attitude_from_vertical(up_x: float, up_y: float, up_z: float) -> tuple[float, float, float]:
    """Roll and pitch (of yaw, pitch, roll), and the angle between z axis and vertical [rad].

    The argument is the vertical in the tilted frame, a unit vector [1].
    """
    pitch = math.asin(min(max(-up_x, -1.0), 1.0))
    return math.atan2(up_y, up_z), pitch, math.atan2(math.hypot(up_x, up_y), up_z)


@compiled
def complementary_filter(up: Array, turned: Array, force: Array, gain: float) -> None:
    r"""Take one step of the explicit complementary filter of the vertical [Mahony2008].

    The filter does not estimate the gyroscope's bias.

    .. math:: \dot u = u \times (\omega + \tfrac{1}{\tau} \, f / |f| \times u)

    Args:
        up: Vertical in the frame of the sensor, a unit vector, updated in place, (3,) [1].
        turned: Rotation vector of the sensor by its gyroscope, in its frame, (3,) [rad].
        force: Specific force by its accelerometer, in the frame after the rotation, (3,) [m/s²].
        gain: 1 − exp(−period/τ) [1].
    """
    angle = math.sqrt(turned[0] ** 2 + turned[1] ** 2 + turned[2] ** 2)
    # a direction at rest in the world turns backwards in the frame of the sensor
    sine = math.sin(angle) / angle if angle > 0.0 else 1.0
    cosine = (1.0 - math.cos(angle)) / (angle * angle) if angle > 0.0 else 0.5
    x = up[0]
    y = up[1]
    z = up[2]
    p, q, r = cross(x, y, z, turned)
    s, t, u = cross(p, q, r, turned)
    x = x + sine * p + cosine * s
    y = y + sine * q + cosine * t
    z = z + sine * r + cosine * u
    size = math.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
    if size > 0.0:
        a = force[0] / size
        b = force[1] / size
        c = force[2] / size
        along = a * x + b * y + c * z
        x = x + gain * (a - along * x)
        y = y + gain * (b - along * y)
        z = z + gain * (c - along * z)
    size = math.sqrt(x * x + y * y + z * z)
    up[0] = x / size
    up[1] = y / size
    up[2] = z / size


@compiled
def settled_vertical(up: Array, force: Array, gyro: Array, delay_s: float) -> None:
    """Compute the vertical at which the filter comes to rest: into `up`, (3,) [1].

    Args:
        up: Output.
        force: Constant specific force, (3,) [m/s²].
        gyro: Small bias of the gyroscope, (3,) [rad/s].
        delay_s: Time constant of the filter [s].
    """
    size = math.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
    x = force[0] / size
    y = force[1] / size
    z = force[2] / size
    p, q, r = cross(x, y, z, gyro)
    x = x + delay_s * p
    y = y + delay_s * q
    z = z + delay_s * r
    size = math.sqrt(x * x + y * y + z * z)
    up[0] = x / size
    up[1] = y / size
    up[2] = z / size


@compiled_part
def rotation_of(quaternion: Array, R: Array) -> None:
    """Compute the rotation matrix of a unit quaternion w, x, y, z: into `R`, (3, 3)."""
    w = quaternion[0]
    x = quaternion[1]
    y = quaternion[2]
    z = quaternion[3]
    R[0, 0] = 1 - 2 * (y * y + z * z)
    R[0, 1] = 2 * (x * y - w * z)
    R[0, 2] = 2 * (x * z + w * y)
    R[1, 0] = 2 * (x * y + w * z)
    R[1, 1] = 1 - 2 * (x * x + z * z)
    R[1, 2] = 2 * (y * z - w * x)
    R[2, 0] = 2 * (x * z - w * y)
    R[2, 1] = 2 * (y * z + w * x)
    R[2, 2] = 1 - 2 * (x * x + y * y)


@compiled
def rotations_of(quaternions: Array) -> Array:
    """Rotation matrices of unit quaternions, (n, 4) to (n, 3, 3)."""
    R = np.empty((len(quaternions), 3, 3))
    for row in range(len(quaternions)):
        rotation_of(quaternions[row], R[row])
    return R


@compiled_part
def rotation_between(before: Array, after: Array, turned: Array) -> None:
    """Compute the rotation vector between two unit quaternions: into `turned`, (3,) [rad].

    Its coordinates are those of the rotating frame.
    """
    a = before
    b = after
    w = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    turned[0] = a[0] * b[1] - a[1] * b[0] - a[2] * b[3] + a[3] * b[2]
    turned[1] = a[0] * b[2] + a[1] * b[3] - a[2] * b[0] - a[3] * b[1]
    turned[2] = a[0] * b[3] - a[1] * b[2] + a[2] * b[1] - a[3] * b[0]
    sine = math.sqrt(turned[0] ** 2 + turned[1] ** 2 + turned[2] ** 2)
    # q and −q are the same rotation: take the shorter way
    scale = 2.0 * math.atan2(sine, abs(w)) / sine if sine > 0.0 else 2.0
    for i in range(3):
        turned[i] *= math.copysign(scale, w)


@compiled_part
def cross(x: float, y: float, z: float, other: Array) -> tuple[float, float, float]:
    """Cross product of (x, y, z) with another vector."""
    a = y * other[2] - z * other[1]
    b = z * other[0] - x * other[2]
    return a, b, x * other[1] - y * other[0]
