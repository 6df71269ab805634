r"""Statics of legs, compiled, row by row over a batch; `elastic_env.rigid.leg_chains` has the
formulas.

Every joint turns about a coordinate axis, so that taking a vector from link to link mixes two of
its components. A row is one robot. What is needed of its legs on the way is kept in `Leg`, one leg
after the other.

Numba keeps compiled code by the file of the function that was called. So everything that a kernel
calls stands in this file, and every size comes from a type.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from elastic_env.core.compiled import compiled
from elastic_env.core.signals import Array, IntArray


def legs_type(legs: int, joints: int) -> np.dtype[Any]:
    """Row that says what L legs of J joints are, see `elastic_env.rigid.leg_chains.LegChains`."""
    return np.dtype(
        (
            np.record,
            [
                ("axis", np.int64, (joints,)),
                ("offset", np.float64, (legs, joints, 3)),
                ("moment", np.float64, (legs, joints, 3)),
                ("last_moment", np.float64, (legs, 3)),
                ("fixed_moment", np.float64, (3,)),
                ("mass", np.float64),
            ],
        )
    )


def loads_type(legs: int) -> np.dtype[Any]:
    """Row that says what loads the legs of a robot, see `elastic_env.rigid.leg_chains.LegLoads`.

    Gravity [m/s²] in the pelvis frame, masses [kg] at points of the feet [m], forces and moments on
    the feet [N], [N·m].
    """
    return np.dtype(
        (
            np.record,
            [
                ("gravity", np.float64, (3,)),
                ("mass", np.float64, (legs,)),
                ("point", np.float64, (legs, 3)),
                ("wrench", np.float64, (legs, 2, 3)),
                ("legs_weigh", np.bool_),
            ],
        )
    )


class Leg(NamedTuple):
    """A leg under its load, to be filled: J joints.

    Attributes:
        sine, cosine: Of the joint angles, (J,).
        gravity: In the frames of the links, (J, 3) [m/s²].
        carried: By each joint in the frame of its link: first moment, force, moment, (J, 3, 3).
        changes: Of what is carried, by the joints from the present one on, (J, 3, 3).
        gradient: ∂τ/∂q, (J, J) [N·m/rad].
        x: Solution, (J,).
    """

    sine: Array
    cosine: Array
    gravity: Array
    carried: Array
    changes: Array
    gradient: Array
    x: Array


LEVER = 0
FORCE = 1
MOMENT = 2
"""What a joint carries: first moment of the masses, and a wrench."""


@compiled
def local_frames(
    legs: Any, q: Array, attitude: Array, point: Array, com: Array, feet: Array
) -> None:
    """Center of mass of the whole robot, and a point that is fixed in each foot, from the pelvis in
    a level frame.

    Args:
        legs: Row of `legs_type`, (1,).
        q: Joint angles, (rows, L, J) [rad].
        attitude: Roll and pitch of the pelvis, (rows, 2) [rad]; (0, 2) for a frame that is the
            pelvis'.
        point: From the ankle, in the frame of the foot, (3,) [m].
        com: To be filled, (rows, 3) [m].
        feet: To be filled, (rows, L, 3) [m].
    """
    chain = legs[0]
    for row in range(len(q)):
        moment = (chain.fixed_moment[0], chain.fixed_moment[1], chain.fixed_moment[2])
        for leg in range(q.shape[1]):
            own = vector(chain.last_moment[leg])
            foot = vector(point)
            for j in range(q.shape[2] - 1, -1, -1):
                axis = chain.axis[j]
                s = math.sin(q[row, leg, j])
                c = math.cos(q[row, leg, j])
                own = into_parent(axis, s, c, own)
                foot = into_parent(axis, s, c, foot)
                if j > 0:
                    own = total(own, vector(chain.moment[leg, j - 1]))
                foot = total(foot, vector(chain.offset[leg, j]))
            moment = total(moment, own)
            put(feet[row, leg], foot)
        put(com[row], (moment[0] / chain.mass, moment[1] / chain.mass, moment[2] / chain.mass))
        if len(attitude) > 0:
            R = rotation_of(attitude[row, 0], attitude[row, 1])
            put(com[row], times(R, vector(com[row])))
            for leg in range(q.shape[1]):
                put(feet[row, leg], times(R, vector(feet[row, leg])))


@compiled
def torques(legs: Any, loads: Any, q: Array, torque: Array) -> None:
    """Joint torques that hold the legs, into `torque`, (rows, L, J) [N·m]; other arguments as in
    `solutions`.
    """
    chain = legs[0]
    leg_of_row = leg_to_be_filled(q.shape[2])
    for row in range(len(q)):
        for leg in range(q.shape[1]):
            carry(chain, loads[row], q[row, leg], leg, leg_of_row)
            for j in range(q.shape[2]):
                torque[row, leg, j] = held_by(
                    chain.axis[j], leg_of_row.carried[j], leg_of_row.gravity[j]
                )


@compiled
def gradients(legs: Any, loads: Any, q: Array, gradient: Array) -> None:
    """∂τ/∂q of the legs, into `gradient`, (rows, L, J, J) [N·m/rad]; other arguments as in
    `solutions`.
    """
    chain = legs[0]
    leg_of_row = leg_to_be_filled(q.shape[2])
    for row in range(len(q)):
        for leg in range(q.shape[1]):
            carry(chain, loads[row], q[row, leg], leg, leg_of_row)
            differentiate(chain, leg, leg_of_row)
            gradient[row, leg] = leg_of_row.gradient


@compiled
def solutions(legs: Any, loads: Any, q: Array, stiffness: Array, torque: Array, x: Array) -> bool:
    """Solve (K + ∂τ/∂q) x = τ leg by leg; Gauss' elimination with the largest pivot.

    Args:
        legs: Row of `legs_type`, (1,).
        loads: Rows of `loads_type`, (rows,).
        q: Joint angles, (rows, L, J) [rad].
        stiffness: K, (L, J) [N·m/rad].
        torque: τ, (rows, L, J) [N·m]; none for the torque that holds the legs, (0, L, J).
        x: To be filled, (rows, L, J) [rad].

    Returns:
        Whether all are below half a turn; a deflection beyond is none, and the matrix may be
        singular.
    """
    chain = legs[0]
    leg_of_row = leg_to_be_filled(q.shape[2])
    is_small = True
    for row in range(len(q)):
        for leg in range(q.shape[1]):
            carry(chain, loads[row], q[row, leg], leg, leg_of_row)
            differentiate(chain, leg, leg_of_row)
            A = leg_of_row.gradient
            b = leg_of_row.x
            for i in range(len(b)):  # every row by its own stiffness
                for k in range(len(b)):
                    A[i, k] /= stiffness[leg, i]
                A[i, i] += 1.0
                if len(torque) > 0:
                    b[i] = torque[row, leg, i] / stiffness[leg, i]
                else:
                    held = held_by(chain.axis[i], leg_of_row.carried[i], leg_of_row.gravity[i])
                    b[i] = held / stiffness[leg, i]
            solve(A, b)
            for i in range(len(b)):
                x[row, leg, i] = b[i]
                is_small = is_small and abs(b[i]) < math.pi
    return is_small


@compiled
def sole_tilts(
    axis: IntArray, q: Array, attitude: Array, bending: Array, seen: Array, expected: Array
) -> None:
    """Tilt of soles, roll and pitch, as motors and IMU see it, and what the bending of the joints
    adds to it.

    Args:
        axis: Coordinate axis that each joint turns about, (J,).
        q: Joint angles, (rows, L, J) [rad].
        attitude: Roll and pitch of the pelvis, (rows, 2) [rad].
        bending: Of the joints, (rows, L, J) [rad].
        seen: To be filled, (rows, L, 2) [rad].
        expected: To be filled, (rows, L, 2) [rad].
    """
    turns = np.empty(3)
    for row in range(len(q)):
        R = rotation_of(attitude[row, 0], attitude[row, 1])
        for leg in range(q.shape[1]):
            normal = 0.0, 0.0, 1.0
            turns[:] = 0.0
            for j in range(q.shape[2] - 1, -1, -1):
                s = math.sin(q[row, leg, j])
                c = math.cos(q[row, leg, j])
                normal = into_parent(axis[j], s, c, normal)
                put(turns, into_parent(axis[j], s, c, vector(turns)))
                turns[axis[j]] += bending[row, leg, j]
            up = times(R, normal)
            turn = times(R, vector(turns))
            seen[row, leg, 0] = -up[1]
            seen[row, leg, 1] = up[0]
            expected[row, leg, 0] = turn[0]
            expected[row, leg, 1] = turn[1]


@compiled
def tilt_rotations(attitude: Array, R: Array) -> None:
    """Rotations about x by a roll, then about y by a pitch, (rows, 2) [rad]: into `R`, (rows, 3,
    3).
    """
    for row in range(len(attitude)):
        found = rotation_of(attitude[row, 0], attitude[row, 1])
        for i in range(3):
            R[row, i, 0] = found[3 * i]
            R[row, i, 1] = found[3 * i + 1]
            R[row, i, 2] = found[3 * i + 2]


@compiled
def leg_to_be_filled(joints: int) -> Leg:
    """Room for a leg."""
    return Leg(
        np.empty(joints),
        np.empty(joints),
        np.empty((joints, 3)),
        np.empty((joints, 3, 3)),
        np.empty((joints, 3, 3)),
        np.empty((joints, joints)),
        np.empty(joints),
    )


@compiled
def carry(chain: Any, load: Any, q: Array, leg: int, own: Leg) -> None:
    """Sines, gravity from the hip to the foot, and what the joints carry from the foot to the
    hip.
    """
    g = vector(load.gravity)
    for j in range(len(q)):
        own.sine[j] = math.sin(q[j])
        own.cosine[j] = math.cos(q[j])
        g = into_link(chain.axis[j], own.sine[j], own.cosine[j], g)
        put(own.gravity[j], g)
    mass = load.mass[leg]
    point = vector(load.point[leg])
    lever = mass * point[0], mass * point[1], mass * point[2]
    force = vector(load.wrench[leg, 0])
    moment = vector(load.wrench[leg, 1])
    for j in range(len(q) - 1, -1, -1):
        if load.legs_weigh:
            lever = total(lever, vector(chain.moment[leg, j]))
        put(own.carried[j, LEVER], lever)
        put(own.carried[j, FORCE], force)
        put(own.carried[j, MOMENT], moment)
        axis = chain.axis[j]
        s = own.sine[j]
        c = own.cosine[j]
        offset = vector(chain.offset[leg, j])
        lever = into_parent(axis, s, c, lever)
        force = into_parent(axis, s, c, force)
        moment = into_parent(axis, s, c, moment)
        lever = (
            lever[0] + mass * offset[0],
            lever[1] + mass * offset[1],
            lever[2] + mass * offset[2],
        )
        moment = total(moment, cross(offset, force))


@compiled
def held_by(axis: int, carried: Array, gravity: Array) -> float:
    """Torque of a joint that holds what it carries."""
    first, second = others(axis)
    lever = carried[LEVER]
    return lever[second] * gravity[first] - lever[first] * gravity[second] - carried[MOMENT, axis]


@compiled
def differentiate(chain: Any, leg: int, own: Leg) -> None:
    """Gradient of a leg that carries its load: weights keep their direction, wrenches turn with
    the foot.
    """
    changes = own.changes
    gradient = own.gradient
    n = len(own.sine)
    for j in range(n - 1, -1, -1):
        axis = chain.axis[j]
        first, second = others(axis)
        lever = own.carried[j, LEVER]
        force = own.carried[j, FORCE]
        moment = own.carried[j, MOMENT]
        g = own.gravity[j]
        changes[j, LEVER, first] = lever[first] * g[axis]
        changes[j, LEVER, second] = lever[second] * g[axis]
        changes[j, LEVER, axis] = -(lever[first] * g[first] + lever[second] * g[second])
        changes[j, FORCE, first] = -force[second]
        changes[j, FORCE, second] = force[first]
        changes[j, FORCE, axis] = 0.0
        changes[j, MOMENT, first] = -moment[second]
        changes[j, MOMENT, second] = moment[first]
        changes[j, MOMENT, axis] = 0.0
        gradient[j, j] = -changes[j, LEVER, axis]
        for k in range(j + 1, n):
            gradient[k, j] = -changes[k, LEVER, axis]
            gradient[j, k] = gradient[k, j] - changes[k, MOMENT, axis]
        if j > 0:
            s = own.sine[j]
            c = own.cosine[j]
            offset = vector(chain.offset[leg, j])
            for k in range(j, n):
                change = changes[k]
                moved = into_parent(axis, s, c, vector(change[FORCE]))
                put(change[LEVER], into_parent(axis, s, c, vector(change[LEVER])))
                put(change[FORCE], moved)
                put(
                    change[MOMENT],
                    total(into_parent(axis, s, c, vector(change[MOMENT])), cross(offset, moved)),
                )


@compiled
def solve(A: Array, b: Array) -> None:
    """Solve A x = b in place; what is singular gives no finite numbers."""
    n = len(b)
    for i in range(n):
        best = i
        for k in range(i + 1, n):
            if abs(A[k, i]) > abs(A[best, i]):
                best = k
        if best != i:
            b[i], b[best] = b[best], b[i]
            for k in range(i, n):
                A[i, k], A[best, k] = A[best, k], A[i, k]
        for k in range(i + 1, n):
            factor = A[k, i] / A[i, i]
            for m in range(i + 1, n):
                A[k, m] -= factor * A[i, m]
            b[k] -= factor * b[i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= A[i, k] * b[k]
        b[i] /= A[i, i]


@compiled
def rotation_of(
    roll: float, pitch: float
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Rotation about x by a roll, then about y by a pitch, row after row."""
    sr = math.sin(roll)
    cr = math.cos(roll)
    sp = math.sin(pitch)
    cp = math.cos(pitch)
    return cp, sp * sr, sp * cr, 0.0, cr, -sr, -sp, cp * sr, cp * cr


@compiled
def others(axis: int) -> tuple[int, int]:
    """The axes into which the others turn: a rotation about the axis turns the first towards the
    second.
    """
    return (axis + 1) % 3, (axis + 2) % 3


@compiled
def into_link(
    axis: int, s: float, c: float, v: tuple[float, float, float]
) -> tuple[float, float, float]:
    """A vector of the link before a joint in the frame of the link behind it."""
    return into_parent(axis, -s, c, v)


@compiled
def into_parent(
    axis: int, s: float, c: float, v: tuple[float, float, float]
) -> tuple[float, float, float]:
    """A vector of the link behind a joint in the frame of the link before it."""
    if axis == 0:
        return v[0], c * v[1] - s * v[2], s * v[1] + c * v[2]
    if axis == 1:
        return s * v[2] + c * v[0], v[1], c * v[2] - s * v[0]
    return c * v[0] - s * v[1], s * v[0] + c * v[1], v[2]


@compiled
def times(A: Any, v: tuple[float, float, float]) -> tuple[float, float, float]:
    """A v."""
    return (
        A[0] * v[0] + A[1] * v[1] + A[2] * v[2],
        A[3] * v[0] + A[4] * v[1] + A[5] * v[2],
        A[6] * v[0] + A[7] * v[1] + A[8] * v[2],
    )


@compiled
def cross(
    a: tuple[float, float, float], b: tuple[float, float, float]
) -> tuple[float, float, float]:
    """A × b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def total(
    a: tuple[float, float, float], b: tuple[float, float, float]
) -> tuple[float, float, float]:
    """A + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@compiled
def vector(v: Array) -> tuple[float, float, float]:
    """An array of three numbers as a vector."""
    return v[0], v[1], v[2]


@compiled
def put(out: Array, v: tuple[float, float, float]) -> None:
    """Keep a vector."""
    out[0], out[1], out[2] = v
