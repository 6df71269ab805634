r"""Statics and dynamics of a tree of hinges on a fixed base, compiled: every row of a batch is a
posture.

Each link has a frame in the anchor of its hinge, whose z axis is the hinge's axis. So a hinge turns
its frame about z, and its torque is the third component of a moment. All vectors are in the frames
of their links.

At rest, a link and all that it carries have the first moment l about the link's anchor. With u =
−g, the torque that holds them and its derivatives are

.. math:: \tau_i = z_i \cdot (l_i \times u), \quad \partial\tau_i/\partial q_j = z_i \cdot ((z_j \times l_j) \times u)

for joints j that i carries. Gravity has a potential, so the matrix is symmetric. In motion the
recursive Newton-Euler algorithm [Luh1980] adds what the masses need: rates and accelerations from
the base to the tips, forces and moments back. Gravity is not part of that pass, because `gravcomp`
changes the weight of a body and not its inertia.

Rows are taken in blocks, and a loop over the rows of a block is the innermost one, so that the
compiler uses vector instructions. A row's numbers depend on that row alone. Numba keeps compiled
code by the file of the function that was called: all that a kernel calls stands here.

[Luh1980] J. Y. S. Luh, M. W. Walker, R. P. C. Paul, "On-Line Computational Scheme for Mechanical
Manipulators", J. Dyn. Sys., Meas., Control 102(2).
"""  # noqa: E501

import math
from typing import Any, TypeAlias

import numpy as np

from elastic_env.core.compiled import compiled
from elastic_env.core.signals import Array

Vector: TypeAlias = tuple[float, float, float]
Matrix: TypeAlias = tuple[float, float, float, float, float, float, float, float, float]
"""Row by row."""

LINK = np.dtype(
    [
        ("parent", np.int64),
        ("column", np.int64),
        ("zero", np.float64),
        ("R", np.float64, (3, 3)),
        ("anchor", np.float64, (3,)),
        ("mass", np.float64),
        ("moment", np.float64, (3,)),
        ("inertia", np.float64, (3, 3)),
        ("weight", np.float64),
        ("weight_moment", np.float64, (3,)),
    ],
    align=True,
)
"""A link: its parent in the tree, the column of its joint and the angle at which it is drawn [rad].

R and anchor are the frame in that of the parent, at that angle [1], [m]. Mass, first moment and
inertia are about the anchor, in the frame of the link [kg], [kg·m], [kg·m²]. The weight is the mass
that gravity acts on. Row 0 is the base.
"""

BLOCK = 64
"""Rows that are taken together: what they need stays in the processor's fastest cache."""

LANES = np.dtype(
    [
        ("carried", np.float64),
        ("cosine", np.float64, (BLOCK,)),
        ("sine", np.float64, (BLOCK,)),
        ("up", np.float64, (3, BLOCK)),
        ("lever", np.float64, (3, BLOCK)),
        ("rate", np.float64, (3, BLOCK)),
        ("angular", np.float64, (3, BLOCK)),
        ("linear", np.float64, (3, BLOCK)),
        ("force", np.float64, (3, BLOCK)),
        ("moment", np.float64, (3, BLOCK)),
    ],
    align=True,
)
"""What the rows of a block know of a link: the weight that it carries, its joint's angle, u and l
as above.

Of the motion: angular rate, angular acceleration, acceleration of the anchor; force and moment that
the link needs.
"""


@compiled
def gravity_torques(links: Any, gravity: Array, q: Array, lanes: Any, torque: Array) -> None:
    """Torque that holds the tree at rest, into `torque`.

    Args:
        links: Rows of `LINK`, the base first and parents before their children.
        gravity: In the frame of the base, (3,) [m/s²].
        q: Joint angles, (rows, n) [rad].
        lanes: Rows of `LANES` for every link, whose contents do not matter.
        torque: (rows, n) [N·m].
    """
    for start in range(0, len(q), len(lanes[0]["cosine"])):
        rows = q[start : start + len(lanes[0]["cosine"])]
        weigh(links, gravity, rows, lanes)
        hold(links, lanes, torque[start : start + len(rows)])


@compiled
def gravity_gradients(links: Any, gravity: Array, q: Array, lanes: Any, gradient: Array) -> None:
    """∂τ_g/∂q into `gradient`, (rows, n, n) [N·m/rad], which holds zeros; arguments as
    `gravity_torques`.
    """
    for start in range(0, len(q), len(lanes[0]["cosine"])):
        rows = q[start : start + len(lanes[0]["cosine"])]
        weigh(links, gravity, rows, lanes)
        differentiate(links, lanes, gradient[start : start + len(rows)])


@compiled
def inverse_dynamics(
    links: Any, gravity: Array, motion: tuple[Array, Array, Array], lanes: Any, torque: Array
) -> None:
    """Torque of a motion without friction, into `torque`; arguments as `gravity_torques`.

    Args:
        links: See there.
        gravity: See there.
        motion: Joint angles, rates and accelerations, (rows, n) each [rad], [rad/s], [rad/s²].
        lanes: See there.
        torque: See there.
    """
    q, q_dot, q_ddot = motion
    for start in range(0, len(q), len(lanes[0]["cosine"])):
        stop = min(start + len(lanes[0]["cosine"]), len(q))
        weigh(links, gravity, q[start:stop], lanes)
        hold(links, lanes, torque[start:stop])
        move(links, q_dot[start:stop], q_ddot[start:stop], lanes)
        push(links, lanes, torque[start:stop])


@compiled
def weigh(links: Any, gravity: Array, q: Array, lanes: Any) -> None:
    """The vertical u from the base to the tips, and the first moments l back."""
    for row in range(len(q)):
        put(lanes[0]["up"], row, (-gravity[0], -gravity[1], -gravity[2]))
    for i in range(1, len(links)):
        link = links[i]
        lane = lanes[i]
        above = lanes[link["parent"]]
        R = matrix(link["R"])
        column = link["column"]
        zero = link["zero"]
        own = link["weight_moment"]
        moment = (own[0], own[1], own[2])
        cosine = lane["cosine"]
        sine = lane["sine"]
        lane["carried"] = link["weight"]
        for row in range(len(q)):  # by itself, as the compiler knows no vectors of sines
            cosine[row] = math.cos(q[row, column] - zero)
            sine[row] = math.sin(q[row, column] - zero)
        for row in range(len(q)):
            put(lane["up"], row, into_link(R, cosine[row], sine[row], at(above["up"], row)))
            put(lane["lever"], row, moment)
    for i in range(len(links) - 1, 0, -1):
        lane = lanes[i]
        above = lanes[links[i]["parent"]]
        R = matrix(links[i]["R"])
        hung = scaled(lane["carried"], links[i]["anchor"])
        above["carried"] += lane["carried"]
        for row in range(len(q)):
            lever = into_parent(R, lane["cosine"][row], lane["sine"][row], at(lane["lever"], row))
            put(above["lever"], row, total(at(above["lever"], row), total(lever, hung)))


@compiled
def hold(links: Any, lanes: Any, torque: Array) -> None:
    """Gravity torque of rows that are weighed."""
    for i in range(1, len(links)):
        lane = lanes[i]
        column = links[i]["column"]
        for row in range(len(torque)):
            torque[row, column] = cross(at(lane["lever"], row), at(lane["up"], row))[2]


@compiled
def differentiate(links: Any, lanes: Any, gradient: Array) -> None:
    """Gradient of rows that are weighed: of every joint, along all that carry it."""
    for j in range(1, len(links)):
        change = lanes[j]["moment"]
        column = links[j]["column"]
        for row in range(len(gradient)):
            x, y, _ = at(lanes[j]["lever"], row)
            put(change, row, cross((-y, x, 0.0), at(lanes[j]["up"], row)))
            gradient[row, column, column] = change[2, row]
        i = j
        while links[i]["parent"] != 0:
            lane = lanes[i]
            R = matrix(links[i]["R"])
            i = links[i]["parent"]
            for row in range(len(gradient)):
                put(
                    change,
                    row,
                    into_parent(R, lane["cosine"][row], lane["sine"][row], at(change, row)),
                )
                gradient[row, column, links[i]["column"]] = change[2, row]
                gradient[row, links[i]["column"], column] = change[2, row]


@compiled
def move(links: Any, q_dot: Array, q_ddot: Array, lanes: Any) -> None:
    """Rates and accelerations from the base to the tips, and what every link needs for itself."""
    for row in range(len(q_dot)):
        put(lanes[0]["rate"], row, (0.0, 0.0, 0.0))
        put(lanes[0]["angular"], row, (0.0, 0.0, 0.0))
        put(lanes[0]["linear"], row, (0.0, 0.0, 0.0))
    for i in range(1, len(links)):
        link = links[i]
        lane = lanes[i]
        above = lanes[links[i]["parent"]]
        column = links[i]["column"]
        R = matrix(link["R"])
        inertia = matrix(link["inertia"])
        mass = link["mass"]
        anchor = scaled(1.0, link["anchor"])
        moment = scaled(1.0, link["moment"])
        for row in range(len(q_dot)):
            c = lane["cosine"][row]
            s = lane["sine"][row]
            turn = q_dot[row, column]
            rate = at(above["rate"], row)
            angular = at(above["angular"], row)
            linear = into_link(
                R, c, s, total(at(above["linear"], row), acceleration_of(anchor, rate, angular))
            )
            x, y, z = into_link(R, c, s, rate)
            angular = total(into_link(R, c, s, angular), (y * turn, -x * turn, q_ddot[row, column]))
            rate = (x, y, z + turn)
            put(lane["rate"], row, rate)
            put(lane["angular"], row, angular)
            put(lane["linear"], row, linear)
            spun = acceleration_of(moment, rate, angular)
            put(
                lane["force"],
                row,
                (
                    mass * linear[0] + spun[0],
                    mass * linear[1] + spun[1],
                    mass * linear[2] + spun[2],
                ),
            )
            needed = total(times(inertia, angular), cross(rate, times(inertia, rate)))
            put(lane["moment"], row, total(needed, cross(moment, linear)))


@compiled
def push(links: Any, lanes: Any, torque: Array) -> None:
    """Forces and moments from the tips to the base; what moves the joints is added to their
    torque.
    """
    for i in range(len(links) - 1, 0, -1):
        lane = lanes[i]
        above = lanes[links[i]["parent"]]
        column = links[i]["column"]
        R = matrix(links[i]["R"])
        anchor = scaled(1.0, links[i]["anchor"])
        is_inner = links[i]["parent"] != 0
        for row in range(len(torque)):
            torque[row, column] += lane["moment"][2, row]
        for row in range(len(torque) if is_inner else 0):
            c = lane["cosine"][row]
            s = lane["sine"][row]
            force = into_parent(R, c, s, at(lane["force"], row))
            moment = total(into_parent(R, c, s, at(lane["moment"], row)), cross(anchor, force))
            put(above["force"], row, total(at(above["force"], row), force))
            put(above["moment"], row, total(at(above["moment"], row), moment))


@compiled
def acceleration_of(arm: Vector, rate: Vector, angular: Vector) -> Vector:
    """α × r + ω × (ω × r): of a point that turns with a frame, without that of the frame's
    origin.
    """
    return total(cross(angular, arm), cross(rate, cross(rate, arm)))


@compiled
def into_link(R: Matrix, c: float, s: float, v: Vector) -> Vector:
    """A vector of the parent's frame in that of a link, whose joint has turned by an angle of
    this cosine and sine.
    """
    x = R[0] * v[0] + R[3] * v[1] + R[6] * v[2]
    y = R[1] * v[0] + R[4] * v[1] + R[7] * v[2]
    z = R[2] * v[0] + R[5] * v[1] + R[8] * v[2]
    return c * x + s * y, c * y - s * x, z


@compiled
def into_parent(R: Matrix, c: float, s: float, v: Vector) -> Vector:
    """The other way round."""
    return times(R, (c * v[0] - s * v[1], s * v[0] + c * v[1], v[2]))


@compiled
def times(A: Matrix, v: Vector) -> Vector:
    """A v."""
    return (
        A[0] * v[0] + A[1] * v[1] + A[2] * v[2],
        A[3] * v[0] + A[4] * v[1] + A[5] * v[2],
        A[6] * v[0] + A[7] * v[1] + A[8] * v[2],
    )


@compiled
def cross(a: Vector, b: Vector) -> Vector:
    """A × b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def total(a: Vector, b: Vector) -> Vector:
    """A + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@compiled
def scaled(factor: float, v: Array) -> Vector:
    """An array of three numbers, times a factor, as a vector."""
    return factor * v[0], factor * v[1], factor * v[2]


@compiled
def matrix(R: Array) -> Matrix:
    """A matrix out of its array, which leaves the compiler sure that nothing changes it."""
    return R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2], R[2, 0], R[2, 1], R[2, 2]


@compiled
def at(field: Array, row: int) -> Vector:
    """The vector of a row."""
    return field[0, row], field[1, row], field[2, row]


@compiled
def put(field: Array, row: int, v: Vector) -> None:
    """Keep the vector of a row."""
    field[0, row], field[1, row], field[2, row] = v
