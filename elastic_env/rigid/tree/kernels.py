r"""Statics and dynamics of a tree of hinges, compiled: every row of a batch is a posture.

Each link has a frame in the anchor of its hinge, whose z axis is the hinge's axis. So a hinge turns
its frame about z, and its torque is the third component of a moment. All vectors are in the frames
of their links. The base is fixed, or the pelvis of a robot with legs, in whose frame gravity is
given.

At rest, a link and all that it carries have the first moment l about the link's anchor. With u =
−g, the torque that holds them and its derivatives are

.. math:: \tau_i = z_i \cdot (l_i \times u), \quad \partial\tau_i/\partial q_j = z_i \cdot ((z_j \times l_j) \times u)

for joints j that i carries. Gravity has a potential, so the matrix is symmetric.

Tips, the feet of a robot, have loads. Ground that takes a weight W at a point of the sole is a mass
−W/g at that point, which makes this Eq. 4 of the paper with Jacobians from the center of mass to the
contact point. A wrench (f, n) is fixed in its tip, as a sensor there measures it. If joint j turns,
the wrench's moment about the anchors of the joints before j changes by that of (z_j × f, z_j × n);
the torque of j and of the joints after it stays.

In motion the recursive Newton-Euler algorithm [Luh1980] adds what the masses need: rates and
accelerations from the base to the tips, forces and moments back. Gravity is not part of that pass,
because `gravcomp` changes the weight of a body and not its inertia.

Rows are computed in blocks. The loop over the rows of a block is the innermost one, so that the
compiler uses vector instructions. The numbers of a row depend on that row alone. Numba caches
compiled code by the file of the called function: so this file has all that a kernel calls.

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
"""Entries row by row."""

BLOCK = 72
"""Rows of a block: their data fit the processor's fastest cache. A multiple of nine cache lines
spreads them over that cache.
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
that gravity acts on. A link with loads has the number of its tip, others −1, and the frame of the
loads. Row 0 is the base.

The other fields are work space for the rows of a block: the weight that the link carries, cosine
and sine of its joint's angle, u and l as above; angular rate, angular acceleration, acceleration of
the anchor; force and moment that the link needs. For gradients at rest, the fields of rates and
accelerations hold the changes by a turning joint.
"""


def loads_type(tips: int) -> np.dtype[Any]:
    """Return the type of a row of loads on a robot.

    Gravity [m/s²] in the frame of the base, masses [kg] at points of the tips [m], forces on the
    tips and moments about their origins [N], [N·m].
    """
    return record_type(gravity=(3,), mass=(tips,), point=(tips, 3), wrench=(tips, 2, 3))


@compiled
def gravity_torques(links: Any, loads: Any, q: Array, torque: Array) -> None:
    """Write the torque that holds the tree at rest to `torque`.

    Args:
        links: Rows of `LINK`, the base first and parents before their children.
        loads: Rows of `loads_type`, (rows,), or one for all.
        q: Joint angles, (rows, n) [rad].
        torque: (rows, n) [N·m].
    """
    for start in range(0, len(q), BLOCK):
        rows = q[start : start + BLOCK]
        has_tips = load_links(links, block_loads(loads, start, len(rows)), rows)
        hold_loads(links, has_tips, torque[start : start + len(rows)])


@compiled
def gravity_gradients(links: Any, loads: Any, q: Array, gradient: Array) -> None:
    """Write ∂τ_g/∂q to `gradient`, (rows, n, n) [N·m/rad]; arguments as in `gravity_torques`."""
    block = np.zeros((q.shape[1], q.shape[1], min(len(q), BLOCK)))
    for start in range(0, len(q), BLOCK):
        rows = q[start : start + BLOCK]
        has_tips = load_links(links, block_loads(loads, start, len(rows)), rows)
        differentiate(links, has_tips, len(rows), block)
        for row in range(len(rows)):
            gradient[start + row] = block[:, :, row]


@compiled
def solve_legs(links: Any, loads: Any, q: Array, K: Array, torque: Array, x: Array) -> bool:
    """Solve (K + ∂τ_g/∂q) x = τ leg by leg, by Gaussian elimination with partial pivoting.

    Args:
        links: See `gravity_torques`; each tip is the end of a leg. All legs have equally many
            joints, in neighbouring columns.
        loads: See there.
        q: See there.
        K: Stiffness, (n,) [N·m/rad].
        torque: τ, (rows, n) [N·m]; no rows, (0, n), for τ_g.
        x: Output, (rows, n) [rad].

    Returns:
        True if all solutions are below half a turn. A larger one is no deflection, and the matrix
        may be singular.
    """
    n = q.shape[1]
    joints = n // len(loads[0].mass)
    gradient = np.empty((n, n, min(len(q), BLOCK)))
    A = np.empty((joints, joints))
    is_small = True
    for start in range(0, len(q), BLOCK):
        rows = q[start : start + BLOCK]
        solution = x[start : start + len(rows)]
        has_tips = load_links(links, block_loads(loads, start, len(rows)), rows)
        differentiate(links, has_tips, len(rows), gradient)
        if len(torque) > 0:
            solution[:] = torque[start : start + len(rows)]
        else:
            hold_loads(links, has_tips, solution)
        for row in range(len(rows)):
            for first in range(0, n, joints):
                b = solution[row, first : first + joints]
                for i in range(joints):  # scaled by the stiffness of each joint
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
    """Write the torque of a motion without friction to `torque`, see `gravity_torques`.

    Args:
        links: See there.
        loads: One row of `loads_type(0)`.
        motion: Joint angles, rates and accelerations, (rows, n) each [rad], [rad/s], [rad/s²].
        torque: See there.
    """
    q, q_dot, q_ddot = motion
    for start in range(0, len(q), BLOCK):
        stop = min(start + BLOCK, len(q))
        set_angles(links, q[start:stop])
        turn_vertical(links, loads, stop - start)
        reset_loads(links, stop - start, True)
        move_links(links, q_dot[start:stop], q_ddot[start:stop])
        sum_loads(links, stop - start, True)
        hold_loads(links, True, torque[start:stop])


@compiled
def com_and_tips(
    links: Any, q: Array, attitude: Array, point: Array, com: Array, tips: Array
) -> None:
    """Compute the center of mass, and a point fixed in each tip, from the base in a level frame.

    Args:
        links: See `gravity_torques`.
        q: See there.
        attitude: Roll and pitch of the base, (rows, 2) [rad]; (0, 2) for the frame of the base.
        point: In the frame of the tip, (3,) [m].
        com: Output, (rows, 3) [m].
        tips: Output, (rows, tips, 3) [m].
    """
    for start in range(0, len(q), BLOCK):
        rows = q[start : start + BLOCK]
        set_angles(links, rows)
        reset_loads(links, len(rows), False)
        sum_loads(links, len(rows), False)
        mass = links[0]["carried"]
        for row in range(len(rows)):
            x, y, z = get_row(links[0]["lever"], row)
            m = mass[row]
            write_vector(com[start + row], (x / m, y / m, z / m))
        for i in range(1, len(links)):
            tip = links[i]["tip"]
            if tip >= 0:
                place = links[i]["force"]
                from_tip = matvec(as_matrix(links[i]["tip_R"]), as_vector(point))
                from_link = add(as_vector(links[i]["tip_place"]), from_tip)
                for row in range(len(rows)):
                    set_row(place, row, from_link)
                k = i
                while k != 0:
                    link = links[k]
                    R = as_matrix(links[k]["R"])
                    anchor = as_vector(links[k]["anchor"])
                    for row in range(len(rows)):
                        c = link["cosine"][row]
                        s = link["sine"][row]
                        moved = to_parent(R, c, s, get_row(place, row))
                        set_row(place, row, add(anchor, moved))
                    k = links[k]["parent"]
                for row in range(len(rows)):
                    write_vector(tips[start + row, tip], get_row(place, row))
    for row in range(len(attitude)):
        R = tilt_rotation(attitude[row, 0], attitude[row, 1])
        write_vector(com[row], matvec(R, as_vector(com[row])))
        for tip in range(tips.shape[1]):
            write_vector(tips[row, tip], matvec(R, as_vector(tips[row, tip])))


@compiled
def tip_tilts(
    links: Any, q: Array, attitude: Array, bending: Array, measured: Array, expected: Array
) -> None:
    """Compute the tilt of the tips by motors and IMU, and its share by the deflection of joints.

    Args:
        links: See `gravity_torques`.
        q: See there.
        attitude: Roll and pitch of the base, (rows, 2) [rad].
        bending: Deflection of the joints, (rows, n) [rad].
        measured: Output, (rows, tips, 2) [rad].
        expected: Output, (rows, tips, 2) [rad].
    """
    for start in range(0, len(q), BLOCK):
        rows = q[start : start + BLOCK]
        set_angles(links, rows)
        for i in range(1, len(links)):
            tip = links[i]["tip"]
            if tip >= 0:
                normal = links[i]["force"]
                up = matvec(as_matrix(links[i]["tip_R"]), (0.0, 0.0, 1.0))
                turned = links[i]["moment"]
                for row in range(len(rows)):
                    set_row(normal, row, up)
                    set_row(turned, row, (0.0, 0.0, 0.0))
                k = i
                while k != 0:
                    link = links[k]
                    R = as_matrix(links[k]["R"])
                    column = links[k]["column"]
                    for row in range(len(rows)):
                        c = link["cosine"][row]
                        s = link["sine"][row]
                        x, y, z = get_row(turned, row)
                        bent = (x, y, z + bending[start + row, column])
                        set_row(turned, row, to_parent(R, c, s, bent))
                        set_row(normal, row, to_parent(R, c, s, get_row(normal, row)))
                    k = links[k]["parent"]
                for row in range(len(rows)):
                    R = tilt_rotation(attitude[start + row, 0], attitude[start + row, 1])
                    x, y, _ = matvec(R, get_row(normal, row))
                    measured[start + row, tip, 0] = -y
                    measured[start + row, tip, 1] = x
                    x, y, _ = matvec(R, get_row(turned, row))
                    expected[start + row, tip, 0] = x
                    expected[start + row, tip, 1] = y


@compiled
def chain_poses(links: Any, q: Array, place: Array, R: Array, axes: Array, anchors: Array) -> None:
    """Compute the poses of a chain of hinges.

    Args:
        links: Rows of `LINK`, each in the frame of the one before it; the last has no hinge.
        q: Joint angles, (rows, n) [rad].
        place: Output, position of the last link, (rows, 3) [m].
        R: Output, orientation of the last link, (rows, 3, 3).
        axes: Output, axes of the hinges, (rows, len(links) - 1, 3).
        anchors: Output, points on these axes, (rows, len(links) - 1, 3) [m].
    """
    for row in range(len(q)):
        rotation = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
        position = (0.0, 0.0, 0.0)
        for i in range(len(links)):
            link = links[i]
            position = add(position, matvec(rotation, as_vector(link["anchor"])))
            rotation = matmul(rotation, as_matrix(link["R"]))
            if i < len(links) - 1:
                angle = q[row, link["column"]] - link["zero"]
                c = math.cos(angle)
                s = math.sin(angle)
                xx, xy, xz, yx, yy, yz, zx, zy, zz = rotation
                x = (c * xx + s * xy, c * xy - s * xx, xz)
                y = (c * yx + s * yy, c * yy - s * yx, yz)
                z = (c * zx + s * zy, c * zy - s * zx, zz)
                rotation = x + y + z
                write_vector(axes[row, i], (xz, yz, zz))
                write_vector(anchors[row, i], position)
        write_vector(place[row], position)
        write_matrix(R[row], rotation)


@compiled
def tilt_rotations(attitude: Array, R: Array) -> None:
    """Compute rotations about x by a roll, then y by a pitch, (rows, 2) [rad] to (rows, 3, 3)."""
    for row in range(len(attitude)):
        write_matrix(R[row], tilt_rotation(attitude[row, 0], attitude[row, 1]))


@compiled_part
def block_loads(loads: Any, start: int, count: int) -> Any:
    """Return the loads of a block of rows; a single load acts on all rows."""
    return loads[start : start + count] if len(loads) > 1 else loads


@compiled_part
def load_links(links: Any, loads: Any, q: Array) -> bool:
    """Compute all loads on the links at rest; True if tips have loads."""
    set_angles(links, q)
    turn_vertical(links, loads, len(q))
    has_tips = len(loads[0].mass) > 0
    reset_loads(links, len(q), has_tips)
    for i in range(1, len(links)):
        if has_tips and links[i]["tip"] >= 0:
            load_tip(links[i], loads, len(q))
    sum_loads(links, len(q), has_tips)
    return has_tips


@compiled_part
def turn_vertical(links: Any, loads: Any, rows: int) -> None:
    """Compute the vertical u in each link, from the base to the tips."""
    for row in range(rows):
        x, y, z = as_vector(loads[min(row, len(loads) - 1)].gravity)
        set_row(links[0]["up"], row, (-x, -y, -z))
    for i in range(1, len(links)):
        link = links[i]
        above = links[link["parent"]]
        R = as_matrix(link["R"])
        for row in range(rows):
            c = link["cosine"][row]
            s = link["sine"][row]
            set_row(link["up"], row, to_link(R, c, s, get_row(above["up"], row)))


@compiled_part
def reset_loads(links: Any, rows: int, has_wrenches: bool) -> None:
    """Set the loads of each link to its own weight."""
    for i in range(len(links)):
        link = links[i]
        weight = link["weight"]
        moment = as_vector(link["weight_moment"])
        for row in range(rows):
            link["carried"][row] = weight
            set_row(link["lever"], row, moment)
            if has_wrenches:
                set_row(link["force"], row, (0.0, 0.0, 0.0))
                set_row(link["moment"], row, (0.0, 0.0, 0.0))


@compiled_part
def sum_loads(links: Any, rows: int, has_wrenches: bool) -> None:
    """Add weights, first moments l, forces and moments of the links, from tips to base."""
    for i in range(len(links) - 1, 0, -1):
        link = links[i]
        above = links[link["parent"]]
        R = as_matrix(link["R"])
        anchor = as_vector(link["anchor"])
        for row in range(rows):
            c = link["cosine"][row]
            s = link["sine"][row]
            carried = link["carried"][row]
            lever = to_parent(R, c, s, get_row(link["lever"], row))
            lever = add(lever, scale(carried, anchor))
            set_row(above["lever"], row, add(get_row(above["lever"], row), lever))
            above["carried"][row] += carried
            if has_wrenches:
                force = to_parent(R, c, s, get_row(link["force"], row))
                moment = to_parent(R, c, s, get_row(link["moment"], row))
                moment = add(moment, cross(anchor, force))
                set_row(above["force"], row, add(get_row(above["force"], row), force))
                set_row(above["moment"], row, add(get_row(above["moment"], row), moment))


@compiled_part
def load_tip(link: Any, loads: Any, rows: int) -> None:
    """Add the loads of a tip to those of its link."""
    tip = link["tip"]
    R = as_matrix(link["tip_R"])
    place = as_vector(link["tip_place"])
    for row in range(rows):
        load = loads[min(row, len(loads) - 1)]
        mass = load.mass[tip]
        point = add(place, matvec(R, as_vector(load.point[tip])))
        force = matvec(R, as_vector(load.wrench[tip, 0]))
        moment = add(matvec(R, as_vector(load.wrench[tip, 1])), cross(place, force))
        link["carried"][row] += mass
        set_row(link["lever"], row, add(get_row(link["lever"], row), scale(mass, point)))
        set_row(link["force"], row, scale(-1.0, force))
        set_row(link["moment"], row, scale(-1.0, moment))


@compiled_part
def set_angles(links: Any, q: Array) -> None:
    """Compute cosines and sines of the joint angles."""
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
def hold_loads(links: Any, has_wrenches: bool, torque: Array) -> None:
    """Write the joint torques that hold the loads of the links."""
    for i in range(1, len(links)):
        link = links[i]
        column = link["column"]
        for row in range(len(torque)):
            needed = cross(get_row(link["lever"], row), get_row(link["up"], row))[2]
            if has_wrenches:
                needed += link["moment"][2, row]
            torque[row, column] = needed


@compiled_part
def differentiate(links: Any, has_wrenches: bool, rows: int, gradient: Array) -> None:
    """Write the gradient of the torques, joint by joint along all that carry it, (n, n, BLOCK)."""
    for j in range(1, len(links)):
        turned = links[j]
        column = links[j]["column"]
        change = turned["linear"]
        force = turned["angular"]
        moment = turned["rate"]
        for row in range(rows):
            x, y, _ = get_row(turned["lever"], row)
            set_row(change, row, cross((-y, x, 0.0), get_row(turned["up"], row)))
            gradient[column, column, row] = change[2, row]
            if has_wrenches:
                x, y, _ = get_row(turned["force"], row)
                set_row(force, row, (-y, x, 0.0))
                x, y, _ = get_row(turned["moment"], row)
                set_row(moment, row, (-y, x, 0.0))
        i = j
        while links[i]["parent"] != 0:
            link = links[i]
            R = as_matrix(links[i]["R"])
            anchor = as_vector(links[i]["anchor"])
            i = links[i]["parent"]
            before = links[i]["column"]
            for row in range(rows):
                c = link["cosine"][row]
                s = link["sine"][row]
                set_row(change, row, to_parent(R, c, s, get_row(change, row)))
                gradient[column, before, row] = change[2, row]
                gradient[before, column, row] = change[2, row]
                if has_wrenches:
                    moved = to_parent(R, c, s, get_row(force, row))
                    set_row(force, row, moved)
                    lever = cross(anchor, moved)
                    moved = add(to_parent(R, c, s, get_row(moment, row)), lever)
                    set_row(moment, row, moved)
                    gradient[before, column, row] += moved[2]


@compiled_part
def solve(A: Array, b: Array) -> None:
    """Solve A x = b in place; a singular matrix gives no finite numbers."""
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
def move_links(links: Any, q_dot: Array, q_ddot: Array) -> None:
    """Compute rates and accelerations from base to tips, and the force and moment of each link."""
    for row in range(len(q_dot)):
        set_row(links[0]["rate"], row, (0.0, 0.0, 0.0))
        set_row(links[0]["angular"], row, (0.0, 0.0, 0.0))
        set_row(links[0]["linear"], row, (0.0, 0.0, 0.0))
    for i in range(1, len(links)):
        link = links[i]
        above = links[link["parent"]]
        column = link["column"]
        R = as_matrix(link["R"])
        inertia = as_matrix(link["inertia"])
        mass = link["mass"]
        anchor = as_vector(link["anchor"])
        moment = as_vector(link["mass_moment"])
        for row in range(len(q_dot)):
            c = link["cosine"][row]
            s = link["sine"][row]
            joint_rate = q_dot[row, column]
            rate = get_row(above["rate"], row)
            angular = get_row(above["angular"], row)
            linear = relative_acceleration(anchor, rate, angular)
            linear = to_link(R, c, s, add(get_row(above["linear"], row), linear))
            x, y, z = to_link(R, c, s, rate)
            relative = (y * joint_rate, -x * joint_rate, q_ddot[row, column])
            angular = add(to_link(R, c, s, angular), relative)
            rate = (x, y, z + joint_rate)
            set_row(link["rate"], row, rate)
            set_row(link["angular"], row, angular)
            set_row(link["linear"], row, linear)
            about_anchor = relative_acceleration(moment, rate, angular)
            set_row(link["force"], row, add(scale(mass, linear), about_anchor))
            needed = add(matvec(inertia, angular), cross(rate, matvec(inertia, rate)))
            set_row(link["moment"], row, add(needed, cross(moment, linear)))


@compiled_part
def relative_acceleration(arm: Vector, rate: Vector, angular: Vector) -> Vector:
    """Acceleration α × r + ω × (ω × r) of a point of a frame, without that of the origin."""
    return add(cross(angular, arm), cross(rate, cross(rate, arm)))


@compiled_part
def tilt_rotation(roll: float, pitch: float) -> Matrix:
    """Rotation about x by a roll, then about y by a pitch."""
    sr = math.sin(roll)
    cr = math.cos(roll)
    sp = math.sin(pitch)
    cp = math.cos(pitch)
    return cp, sp * sr, sp * cr, 0.0, cr, -sr, -sp, cp * sr, cp * cr


@compiled_part
def to_link(R: Matrix, c: float, s: float, v: Vector) -> Vector:
    """Transform a vector of the parent to the frame of a link, with its joint angle."""
    x = R[0] * v[0] + R[3] * v[1] + R[6] * v[2]
    y = R[1] * v[0] + R[4] * v[1] + R[7] * v[2]
    z = R[2] * v[0] + R[5] * v[1] + R[8] * v[2]
    return c * x + s * y, c * y - s * x, z


@compiled_part
def to_parent(R: Matrix, c: float, s: float, v: Vector) -> Vector:
    """Transform a vector of a link to the frame of its parent."""
    return matvec(R, (c * v[0] - s * v[1], s * v[0] + c * v[1], v[2]))


@compiled_part
def matvec(A: Matrix, v: Vector) -> Vector:
    """Product A v."""
    x = A[0] * v[0] + A[1] * v[1] + A[2] * v[2]
    y = A[3] * v[0] + A[4] * v[1] + A[5] * v[2]
    return x, y, A[6] * v[0] + A[7] * v[1] + A[8] * v[2]


@compiled_part
def matmul(A: Matrix, B: Matrix) -> Matrix:
    """Product A B."""
    x = matvec(A, (B[0], B[3], B[6]))
    y = matvec(A, (B[1], B[4], B[7]))
    z = matvec(A, (B[2], B[5], B[8]))
    return x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2]


@compiled_part
def cross(a: Vector, b: Vector) -> Vector:
    """Cross product a × b."""
    x = a[1] * b[2] - a[2] * b[1]
    y = a[2] * b[0] - a[0] * b[2]
    return x, y, a[0] * b[1] - a[1] * b[0]


@compiled_part
def add(a: Vector, b: Vector) -> Vector:
    """Sum a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@compiled_part
def scale(factor: float, v: Vector) -> Vector:
    """Multiple of a vector."""
    return factor * v[0], factor * v[1], factor * v[2]


@compiled_part
def as_vector(v: Array) -> Vector:
    """Convert an array of three numbers to a vector."""
    return v[0], v[1], v[2]


@compiled_part
def as_matrix(R: Array) -> Matrix:
    """Convert an array to a matrix: the compiler then knows that nothing changes it."""
    x = R[0, 0], R[0, 1], R[0, 2]
    y = R[1, 0], R[1, 1], R[1, 2]
    return x + y + (R[2, 0], R[2, 1], R[2, 2])


@compiled_part
def get_row(field: Array, row: int) -> Vector:
    """Return the vector of a row."""
    return field[0, row], field[1, row], field[2, row]


@compiled_part
def set_row(field: Array, row: int, v: Vector) -> None:
    """Set the vector of a row."""
    field[0, row], field[1, row], field[2, row] = v


@compiled_part
def write_vector(out: Array, v: Vector) -> None:
    """Write a vector to an array of three numbers."""
    out[0], out[1], out[2] = v


@compiled_part
def write_matrix(out: Array, A: Matrix) -> None:
    """Write a matrix to its array."""
    write_vector(out[0], (A[0], A[1], A[2]))
    write_vector(out[1], (A[3], A[4], A[5]))
    write_vector(out[2], (A[6], A[7], A[8]))
