r"""Statics and dynamics of a tree of hinges, compiled: every row of a batch is a posture.

Each link has a frame in the anchor of its hinge, whose z axis is the hinge's axis. So a hinge turns
its frame about z, and its torque is the third component of a moment. All vectors are in the frames
of their links. The base is fixed, or the pelvis of a robot with legs, in whose frame gravity is
given.

At rest, a link and all that it carries have the first moment l about the link's anchor. With u =
−g, the torque that holds them and its derivatives are

.. math:: \tau_i = z_i \cdot (l_i \times u), \quad \partial\tau_i/\partial q_j = z_i \cdot ((z_j \times l_j) \times u)

for joints j that i carries. Gravity has a potential, so the matrix is symmetric.

Tips, the feet of a robot, bear loads. Ground that takes a weight W at a point of the sole is a mass
−W/g in that point, which makes this Eq. 4 of the paper with Jacobians from the center of mass to the
contact point. A wrench (f, n) is fixed in its tip, as a sensor there measures it. If joint j turns,
the wrench's moment about the anchors of the joints before j changes by that of (z_j × f, z_j × n);
the torque of j and of the joints after it stays.

In motion the recursive Newton-Euler algorithm [Luh1980] adds what the masses need: rates and
accelerations from the base to the tips, forces and moments back. Gravity is not part of that pass,
because `gravcomp` changes the weight of a body and not its inertia.

Rows are taken in blocks, and a loop over the rows of a block is the innermost one, so that the
compiler uses vector instructions. A row's numbers depend on that row alone. Numba keeps compiled
code by the file of the function that was called: all that a kernel calls stands here.

[Luh1980] J. Y. S. Luh, M. W. Walker, R. P. C. Paul, "On-Line Computational Scheme for Mechanical
Manipulators", J. Dyn. Sys., Meas., Control 102(2).
"""  # noqa: E501

import math
from typing import Any, TypeAlias

import numpy as np

from elastic_env.core.compiled import compiled, compiled_part, record_type
from elastic_env.core.signals import Array

Vector: TypeAlias = tuple[float, float, float]
Matrix: TypeAlias = tuple[float, float, float, float, float, float, float, float, float]
"""Row by row."""

BLOCK = 72
"""Rows that are taken together: what they need stays in the processor's fastest cache. A multiple
of nine cache lines spreads it over that cache.
"""

_VECTORS = ("up", "lever", "rate", "angular", "linear", "force", "moment")
LINK = np.dtype(
    [
        ("parent", np.int64),
        ("column", np.int64),
        ("zero", np.float64),
        ("R", np.float64, (3, 3)),
        ("anchor", np.float64, (3,)),
        ("mass", np.float64),
        ("mass_moment", np.float64, (3,)),
        ("inertia", np.float64, (3, 3)),
        ("weight", np.float64),
        ("weight_moment", np.float64, (3,)),
        ("tip", np.int64),
        ("tip_R", np.float64, (3, 3)),
        ("tip_place", np.float64, (3,)),
        *((name, np.float64, (BLOCK,)) for name in ("carried", "cosine", "sine")),
        *((name, np.float64, (3, BLOCK)) for name in _VECTORS),
    ],
    align=True,
)
"""A link: its parent in the tree, the column of its joint and the angle at which it is drawn [rad].

R and anchor are the frame in that of the parent, at that angle [1], [m]. Mass, first moment and
inertia are about the anchor, in the frame of the link [kg], [kg·m], [kg·m²]. The weight is the mass
that gravity acts on. A link that bears loads has the number of its tip, others −1, and the frame in
which the loads are given. Row 0 is the base.

The rest is room for the rows of a block: the weight that the link carries, its joint's angle, u and
l as above; angular rate, angular acceleration, acceleration of the anchor; force and moment that
the link needs. At rest, rates and accelerations have the changes that a turning joint makes.
"""


def loads_type(tips: int) -> np.dtype[Any]:
    """Row of what acts on a robot.

    Gravity [m/s²] in the frame of the base, masses [kg] at points of the tips [m], forces on the
    tips and moments about their origins [N], [N·m].
    """
    return record_type(gravity=(3,), mass=(tips,), point=(tips, 3), wrench=(tips, 2, 3))


@compiled
def gravity_torques(links: Any, loads: Any, q: Array, torque: Array) -> None:
    """Torque that holds the tree at rest, into `torque`.

    Args:
        links: Rows of `LINK`, the base first and parents before their children.
        loads: Rows of `loads_type`, (rows,), or one for all.
        q: Joint angles, (rows, n) [rad].
        torque: (rows, n) [N·m].
    """
    for start in range(0, len(q), BLOCK):
        rows = q[start : start + BLOCK]
        of_rows = loads_of(loads, start, len(rows))
        has_tips = weigh(links, of_rows, rows)
        hold(links, has_tips, torque[start : start + len(rows)])


@compiled
def gravity_gradients(links: Any, loads: Any, q: Array, gradient: Array) -> None:
    """∂τ_g/∂q into `gradient`, (rows, n, n) [N·m/rad]; arguments as `gravity_torques`."""
    found = np.zeros((q.shape[1], q.shape[1], min(len(q), BLOCK)))
    for start in range(0, len(q), BLOCK):
        rows = q[start : start + BLOCK]
        of_rows = loads_of(loads, start, len(rows))
        has_tips = weigh(links, of_rows, rows)
        differentiate(links, has_tips, len(rows), found)
        for row in range(len(rows)):
            gradient[start + row] = found[:, :, row]


@compiled
def solutions(links: Any, loads: Any, q: Array, K: Array, torque: Array, x: Array) -> bool:
    """Solve (K + ∂τ_g/∂q) x = τ, leg by leg; Gauss' elimination with the largest pivot.

    Args:
        links: See `gravity_torques`; each tip is the end of a leg, and all legs have as many
            joints, whose columns follow one another.
        loads: See there.
        q: See there.
        K: Stiffness, (n,) [N·m/rad].
        torque: τ, (rows, n) [N·m]; none for τ_g, (0, n).
        x: To be filled, (rows, n) [rad].

    Returns:
        Whether all are below half a turn; a deflection beyond is none, and the matrix may be
        singular.
    """
    n = q.shape[1]
    joints = n // len(loads[0].mass)
    gradient = np.empty((n, n, min(len(q), BLOCK)))
    A = np.empty((joints, joints))
    is_small = True
    for start in range(0, len(q), BLOCK):
        rows = q[start : start + BLOCK]
        found = x[start : start + len(rows)]
        of_rows = loads_of(loads, start, len(rows))
        has_tips = weigh(links, of_rows, rows)
        differentiate(links, has_tips, len(rows), gradient)
        if len(torque) > 0:
            found[:] = torque[start : start + len(rows)]
        else:
            hold(links, has_tips, found)
        for row in range(len(rows)):
            for first in range(0, n, joints):
                b = found[row, first : first + joints]
                for i in range(joints):  # every row by its own stiffness
                    for k in range(joints):
                        A[i, k] = gradient[first + i, first + k, row] / K[first + i]
                    A[i, i] += 1.0
                    b[i] /= K[first + i]
                solve(A, b)
                for i in range(joints):
                    is_small = is_small and abs(b[i]) < math.pi
    return is_small


@compiled
def inverse_dynamics(
    links: Any, loads: Any, motion: tuple[Array, Array, Array], torque: Array
) -> None:
    """Torque of a motion without friction, into `torque`; arguments as `gravity_torques`.

    Args:
        links: See there.
        loads: One row of `loads_type(0)`.
        motion: Joint angles, rates and accelerations, (rows, n) each [rad], [rad/s], [rad/s²].
        torque: See there.
    """
    q, q_dot, q_ddot = motion
    for start in range(0, len(q), BLOCK):
        stop = min(start + BLOCK, len(q))
        turn(links, q[start:stop])
        lift(links, loads, stop - start)
        begin(links, stop - start, True)
        move(links, q_dot[start:stop], q_ddot[start:stop])
        carry(links, stop - start, True)
        hold(links, True, torque[start:stop])


@compiled
def local_frames(
    links: Any, q: Array, attitude: Array, point: Array, com: Array, tips: Array
) -> None:
    """Center of mass, and a point that is fixed in each tip, from the base in a level frame.

    Args:
        links: See `gravity_torques`.
        q: See there.
        attitude: Roll and pitch of the base, (rows, 2) [rad]; (0, 2) for the frame of the base.
        point: In the frame of the tip, (3,) [m].
        com: To be filled, (rows, 3) [m].
        tips: To be filled, (rows, tips, 3) [m].
    """
    for start in range(0, len(q), BLOCK):
        rows = q[start : start + BLOCK]
        turn(links, rows)
        begin(links, len(rows), False)
        carry(links, len(rows), False)
        mass = links[0]["carried"]
        for row in range(len(rows)):
            x, y, z = at(links[0]["lever"], row)
            fill(com[start + row], (x / mass[row], y / mass[row], z / mass[row]))
        for i in range(1, len(links)):
            tip = links[i]["tip"]
            if tip >= 0:
                place = links[i]["force"]
                from_tip = times(matrix(links[i]["tip_R"]), vector(point))
                from_link = total(vector(links[i]["tip_place"]), from_tip)
                for row in range(len(rows)):
                    put(place, row, from_link)
                k = i
                while k != 0:
                    link = links[k]
                    R = matrix(links[k]["R"])
                    anchor = vector(links[k]["anchor"])
                    for row in range(len(rows)):
                        moved = into_parent(
                            R, link["cosine"][row], link["sine"][row], at(place, row)
                        )
                        put(place, row, total(anchor, moved))
                    k = links[k]["parent"]
                for row in range(len(rows)):
                    fill(tips[start + row, tip], at(place, row))
    for row in range(len(attitude)):
        R = rotation_of(attitude[row, 0], attitude[row, 1])
        fill(com[row], times(R, vector(com[row])))
        for tip in range(tips.shape[1]):
            fill(tips[row, tip], times(R, vector(tips[row, tip])))


@compiled
def tip_tilts(
    links: Any, q: Array, attitude: Array, bending: Array, seen: Array, expected: Array
) -> None:
    """Tilt of the tips by motors and IMU, and the share of it that the joints' bending makes.

    Args:
        links: See `gravity_torques`.
        q: See there.
        attitude: Roll and pitch of the base, (rows, 2) [rad].
        bending: Of the joints, (rows, n) [rad].
        seen: To be filled, (rows, tips, 2) [rad].
        expected: To be filled, (rows, tips, 2) [rad].
    """
    for start in range(0, len(q), BLOCK):
        rows = q[start : start + BLOCK]
        turn(links, rows)
        for i in range(1, len(links)):
            tip = links[i]["tip"]
            if tip >= 0:
                normal = links[i]["force"]
                up = times(matrix(links[i]["tip_R"]), (0.0, 0.0, 1.0))
                turned = links[i]["moment"]
                for row in range(len(rows)):
                    put(normal, row, up)
                    put(turned, row, (0.0, 0.0, 0.0))
                k = i
                while k != 0:
                    link = links[k]
                    R = matrix(links[k]["R"])
                    column = links[k]["column"]
                    for row in range(len(rows)):
                        c = link["cosine"][row]
                        s = link["sine"][row]
                        x, y, z = at(turned, row)
                        bent = (x, y, z + bending[start + row, column])
                        put(turned, row, into_parent(R, c, s, bent))
                        put(normal, row, into_parent(R, c, s, at(normal, row)))
                    k = links[k]["parent"]
                for row in range(len(rows)):
                    R = rotation_of(attitude[start + row, 0], attitude[start + row, 1])
                    x, y, _ = times(R, at(normal, row))
                    seen[start + row, tip, 0] = -y
                    seen[start + row, tip, 1] = x
                    x, y, _ = times(R, at(turned, row))
                    expected[start + row, tip, 0] = x
                    expected[start + row, tip, 1] = y


@compiled
def poses(links: Any, q: Array, place: Array, R: Array, axes: Array, anchors: Array) -> None:
    """Poses of a chain of hinges, a row after the other.

    Args:
        links: Rows of `LINK`, each in the frame of the one before it; the last has no hinge.
        q: Joint angles, (rows, n) [rad].
        place: Of the last link, to be filled, (rows, 3) [m].
        R: Of the last link, to be filled, (rows, 3, 3).
        axes: Of the hinges, to be filled, (rows, len(links) - 1, 3).
        anchors: Points on these axes, to be filled, (rows, len(links) - 1, 3) [m].
    """
    for row in range(len(q)):
        turned = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
        moved = (0.0, 0.0, 0.0)
        for i in range(len(links)):
            link = links[i]
            moved = total(moved, times(turned, vector(link["anchor"])))
            turned = product(turned, matrix(link["R"]))
            if i < len(links) - 1:
                angle = q[row, link["column"]] - link["zero"]
                c = math.cos(angle)
                s = math.sin(angle)
                xx, xy, xz, yx, yy, yz, zx, zy, zz = turned
                x = (c * xx + s * xy, c * xy - s * xx, xz)
                y = (c * yx + s * yy, c * yy - s * yx, yz)
                z = (c * zx + s * zy, c * zy - s * zx, zz)
                turned = x + y + z
                fill(axes[row, i], (xz, yz, zz))
                fill(anchors[row, i], moved)
        fill(place[row], moved)
        fill_matrix(R[row], turned)


@compiled
def tilt_rotations(attitude: Array, R: Array) -> None:
    """Rotations about x by a roll, then about y by a pitch, (rows, 2) [rad] to (rows, 3, 3)."""
    for row in range(len(attitude)):
        fill_matrix(R[row], rotation_of(attitude[row, 0], attitude[row, 1]))


@compiled_part
def loads_of(loads: Any, start: int, count: int) -> Any:
    """Loads of a block of rows; one load serves all."""
    return loads[start : start + count] if len(loads) > 1 else loads


@compiled_part
def weigh(links: Any, loads: Any, q: Array) -> bool:
    """All that acts on the links at rest, and whether tips bear loads."""
    turn(links, q)
    lift(links, loads, len(q))
    has_tips = len(loads[0].mass) > 0
    begin(links, len(q), has_tips)
    for i in range(1, len(links)):
        if has_tips and links[i]["tip"] >= 0:
            load_tip(links[i], loads, len(q))
    carry(links, len(q), has_tips)
    return has_tips


@compiled_part
def lift(links: Any, loads: Any, rows: int) -> None:
    """The vertical u, from the base to the tips."""
    for row in range(rows):
        x, y, z = vector(loads[min(row, len(loads) - 1)].gravity)
        put(links[0]["up"], row, (-x, -y, -z))
    for i in range(1, len(links)):
        link = links[i]
        above = links[link["parent"]]
        R = matrix(link["R"])
        for row in range(rows):
            c = link["cosine"][row]
            s = link["sine"][row]
            put(link["up"], row, into_link(R, c, s, at(above["up"], row)))


@compiled_part
def begin(links: Any, rows: int, has_wrenches: bool) -> None:
    """Every link carries itself."""
    for i in range(len(links)):
        link = links[i]
        weight = link["weight"]
        moment = vector(link["weight_moment"])
        for row in range(rows):
            link["carried"][row] = weight
            put(link["lever"], row, moment)
            if has_wrenches:
                put(link["force"], row, (0.0, 0.0, 0.0))
                put(link["moment"], row, (0.0, 0.0, 0.0))


@compiled_part
def carry(links: Any, rows: int, has_wrenches: bool) -> None:
    """Weights, their first moments l, and forces and moments, from the tips to the base."""
    for i in range(len(links) - 1, 0, -1):
        link = links[i]
        above = links[link["parent"]]
        R = matrix(link["R"])
        anchor = vector(link["anchor"])
        for row in range(rows):
            c = link["cosine"][row]
            s = link["sine"][row]
            carried = link["carried"][row]
            lever = into_parent(R, c, s, at(link["lever"], row))
            lever = total(lever, scale(carried, anchor))
            put(above["lever"], row, total(at(above["lever"], row), lever))
            above["carried"][row] += carried
            if has_wrenches:
                force = into_parent(R, c, s, at(link["force"], row))
                moment = into_parent(R, c, s, at(link["moment"], row))
                moment = total(moment, cross(anchor, force))
                put(above["force"], row, total(at(above["force"], row), force))
                put(above["moment"], row, total(at(above["moment"], row), moment))


@compiled_part
def load_tip(link: Any, loads: Any, rows: int) -> None:
    """Add what a tip bears to what its link carries."""
    tip = link["tip"]
    R = matrix(link["tip_R"])
    place = vector(link["tip_place"])
    for row in range(rows):
        load = loads[min(row, len(loads) - 1)]
        mass = load.mass[tip]
        point = total(place, times(R, vector(load.point[tip])))
        force = times(R, vector(load.wrench[tip, 0]))
        moment = total(times(R, vector(load.wrench[tip, 1])), cross(place, force))
        link["carried"][row] += mass
        put(link["lever"], row, total(at(link["lever"], row), scale(mass, point)))
        put(link["force"], row, scale(-1.0, force))
        put(link["moment"], row, scale(-1.0, moment))


@compiled_part
def turn(links: Any, q: Array) -> None:
    """Cosines and sines of the joint angles."""
    for i in range(1, len(links)):
        column = links[i]["column"]
        zero = links[i]["zero"]
        cosine = links[i]["cosine"]
        sine = links[i]["sine"]
        for row in range(len(q)):
            angle = q[row, column] - zero
            c = math.cos(angle)
            s = math.sin(angle)
            cosine[row] = c
            sine[row] = s


@compiled_part
def hold(links: Any, has_wrenches: bool, torque: Array) -> None:
    """Torques of what the links carry."""
    for i in range(1, len(links)):
        link = links[i]
        column = link["column"]
        for row in range(len(torque)):
            needed = cross(at(link["lever"], row), at(link["up"], row))[2]
            if has_wrenches:
                needed += link["moment"][2, row]
            torque[row, column] = needed


@compiled_part
def differentiate(links: Any, has_wrenches: bool, rows: int, gradient: Array) -> None:
    """Gradient of what the links carry, of every joint along all that carry it, (n, n, BLOCK)."""
    for j in range(1, len(links)):
        turned = links[j]
        column = links[j]["column"]
        change = turned["linear"]
        force = turned["angular"]
        moment = turned["rate"]
        for row in range(rows):
            x, y, _ = at(turned["lever"], row)
            put(change, row, cross((-y, x, 0.0), at(turned["up"], row)))
            gradient[column, column, row] = change[2, row]
            if has_wrenches:
                x, y, _ = at(turned["force"], row)
                put(force, row, (-y, x, 0.0))
                x, y, _ = at(turned["moment"], row)
                put(moment, row, (-y, x, 0.0))
        i = j
        while links[i]["parent"] != 0:
            link = links[i]
            R = matrix(links[i]["R"])
            anchor = vector(links[i]["anchor"])
            i = links[i]["parent"]
            before = links[i]["column"]
            for row in range(rows):
                c = link["cosine"][row]
                s = link["sine"][row]
                put(change, row, into_parent(R, c, s, at(change, row)))
                gradient[column, before, row] = change[2, row]
                gradient[before, column, row] = change[2, row]
                if has_wrenches:
                    moved = into_parent(R, c, s, at(force, row))
                    put(force, row, moved)
                    lever = cross(anchor, moved)
                    moved = total(into_parent(R, c, s, at(moment, row)), lever)
                    put(moment, row, moved)
                    gradient[before, column, row] += moved[2]


@compiled_part
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


@compiled_part
def move(links: Any, q_dot: Array, q_ddot: Array) -> None:
    """Rates and accelerations from the base to the tips, and what every link needs for itself."""
    for row in range(len(q_dot)):
        put(links[0]["rate"], row, (0.0, 0.0, 0.0))
        put(links[0]["angular"], row, (0.0, 0.0, 0.0))
        put(links[0]["linear"], row, (0.0, 0.0, 0.0))
    for i in range(1, len(links)):
        link = links[i]
        above = links[link["parent"]]
        column = link["column"]
        R = matrix(link["R"])
        inertia = matrix(link["inertia"])
        mass = link["mass"]
        anchor = vector(link["anchor"])
        moment = vector(link["mass_moment"])
        for row in range(len(q_dot)):
            c = link["cosine"][row]
            s = link["sine"][row]
            turn = q_dot[row, column]
            rate = at(above["rate"], row)
            angular = at(above["angular"], row)
            linear = acceleration_of(anchor, rate, angular)
            linear = into_link(R, c, s, total(at(above["linear"], row), linear))
            x, y, z = into_link(R, c, s, rate)
            own = (y * turn, -x * turn, q_ddot[row, column])
            angular = total(into_link(R, c, s, angular), own)
            rate = (x, y, z + turn)
            put(link["rate"], row, rate)
            put(link["angular"], row, angular)
            put(link["linear"], row, linear)
            spun = acceleration_of(moment, rate, angular)
            put(link["force"], row, total(scale(mass, linear), spun))
            needed = total(times(inertia, angular), cross(rate, times(inertia, rate)))
            put(link["moment"], row, total(needed, cross(moment, linear)))


@compiled_part
def acceleration_of(arm: Vector, rate: Vector, angular: Vector) -> Vector:
    """α × r + ω × (ω × r): acceleration of a point of a frame, without that of the origin."""
    return total(cross(angular, arm), cross(rate, cross(rate, arm)))


@compiled_part
def rotation_of(roll: float, pitch: float) -> Matrix:
    """Rotation about x by a roll, then about y by a pitch."""
    sr = math.sin(roll)
    cr = math.cos(roll)
    sp = math.sin(pitch)
    cp = math.cos(pitch)
    return cp, sp * sr, sp * cr, 0.0, cr, -sr, -sp, cp * sr, cp * cr


@compiled_part
def into_link(R: Matrix, c: float, s: float, v: Vector) -> Vector:
    """A vector of the parent in the frame of a link whose joint has turned."""
    x = R[0] * v[0] + R[3] * v[1] + R[6] * v[2]
    y = R[1] * v[0] + R[4] * v[1] + R[7] * v[2]
    z = R[2] * v[0] + R[5] * v[1] + R[8] * v[2]
    return c * x + s * y, c * y - s * x, z


@compiled_part
def into_parent(R: Matrix, c: float, s: float, v: Vector) -> Vector:
    """The other way round."""
    return times(R, (c * v[0] - s * v[1], s * v[0] + c * v[1], v[2]))


@compiled_part
def times(A: Matrix, v: Vector) -> Vector:
    """A v."""
    x = A[0] * v[0] + A[1] * v[1] + A[2] * v[2]
    y = A[3] * v[0] + A[4] * v[1] + A[5] * v[2]
    return x, y, A[6] * v[0] + A[7] * v[1] + A[8] * v[2]


@compiled_part
def product(A: Matrix, B: Matrix) -> Matrix:
    """A B."""
    x = times(A, (B[0], B[3], B[6]))
    y = times(A, (B[1], B[4], B[7]))
    z = times(A, (B[2], B[5], B[8]))
    return x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2]


@compiled_part
def cross(a: Vector, b: Vector) -> Vector:
    """A × b."""
    x = a[1] * b[2] - a[2] * b[1]
    y = a[2] * b[0] - a[0] * b[2]
    return x, y, a[0] * b[1] - a[1] * b[0]


@compiled_part
def total(a: Vector, b: Vector) -> Vector:
    """A + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@compiled_part
def scale(factor: float, v: Vector) -> Vector:
    """A multiple of a vector."""
    return factor * v[0], factor * v[1], factor * v[2]


@compiled_part
def vector(v: Array) -> Vector:
    """An array of three numbers as a vector."""
    return v[0], v[1], v[2]


@compiled_part
def matrix(R: Array) -> Matrix:
    """A matrix out of its array, which leaves the compiler sure that nothing changes it."""
    x = R[0, 0], R[0, 1], R[0, 2]
    y = R[1, 0], R[1, 1], R[1, 2]
    return x + y + (R[2, 0], R[2, 1], R[2, 2])


@compiled_part
def at(field: Array, row: int) -> Vector:
    """The vector of a row."""
    return field[0, row], field[1, row], field[2, row]


@compiled_part
def put(field: Array, row: int, v: Vector) -> None:
    """Keep the vector of a row."""
    field[0, row], field[1, row], field[2, row] = v


@compiled_part
def fill(out: Array, v: Vector) -> None:
    """Write a vector into an array of three numbers."""
    out[0], out[1], out[2] = v


@compiled_part
def fill_matrix(out: Array, A: Matrix) -> None:
    """Write a matrix into its array."""
    fill(out[0], (A[0], A[1], A[2]))
    fill(out[1], (A[3], A[4], A[5]))
    fill(out[2], (A[6], A[7], A[8]))
