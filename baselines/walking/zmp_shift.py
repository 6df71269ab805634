r"""A shift of the ZMP as offsets of the joints: the pelvis moves as an inverted pendulum has to.

The ZMP p of a pendulum whose center of mass moves by c is [Kajita2003]

.. math:: p = c - \ddot c / \omega^2

A shift that is known over the whole walk has one c that stays bounded. Its Fourier transform is that of p over
1 + (ν/ω)²: a low-pass filter without phase shift, which looks as far ahead as back. The pelvis is moved by c over feet
that stay, by inverse kinematics. A learned p makes a plan of its own of the ZMP, as in [Hu2015].

A shift of which only the present is known is taken to stay as it is. Then the bounded solution is a first-order lag,

.. math:: \dot c = \omega (p - c)

and while p changes, the ZMP is shifted by p − ṗ/ω: it comes late by 1/ω, and sets out in the other direction.

[Kajita2003] S. Kajita et al., "Biped Walking Pattern Generation by using Preview Control of Zero-Moment Point", ICRA.
[Hu2015] K. Hu, C. Ott, D. Lee, "Online Iterative Learning Control of Zero-Moment Point for Biped Walking
Stabilization", ICRA.
"""

import numpy as np
from scipy import linalg

from elastic_env.core.signals import Array, IntArray
from elastic_env.dynamics.leg_kinematics import LegGeometry, leg_angles
from elastic_env.runtime.robot_model import WalkerModel

_PROBE_M = 0.005
_REACH = 0.999
"""Share of the straight leg's length to which a foot may go."""


def center_of_mass_shift(zmp: Array, omega: float, period_s: float) -> Array:
    """The bounded c of a ZMP shift, at rest before the first and after the last row.

    Args:
        zmp: Shift p over time, (T, k) [m].
        omega: Natural frequency of the pendulum [rad/s].
        period_s: Time between rows [s].

    Returns:
        (T, k) [m]; its second difference fulfils the equation of the module.
    """
    stiff = 1.0 / (omega * period_s) ** 2
    bands = np.tile([[-stiff], [1.0 + 2.0 * stiff], [-stiff]], len(zmp))
    bands[1, [0, -1]] = 1.0 + stiff
    return linalg.solve_banded((1, 1), bands, zmp)


def center_of_mass_following(center: Array, zmp: Array, omega: float, period_s: float) -> Array:
    """The c of a ZMP shift that stays as it is, a period later.

    Args:
        center: Present c, (..., k) [m].
        zmp: Shift p from now on, (..., k) [m].
        omega: Natural frequency of the pendulum [rad/s].
        period_s: The period [s].
    """
    return center + (1.0 - float(np.exp(-omega * period_s))) * (zmp - center)


def center_of_mass_per_pelvis(model: WalkerModel) -> Array:
    """Motion of the center of mass per motion of the standing pelvis over its feet, x and y, (2,) [1].

    The legs follow the pelvis by half on average: it is the share of the weight that the pelvis carries along.
    """
    plan, biped, axes = model.plan, model.biped, np.eye(3)[:2]
    moved = plan.pelvis[0] + _PROBE_M * np.concatenate([axes, -axes])
    q = biped.joint_angles(moved, np.broadcast_to(plan.ankles[0], (4, 2, 3)))
    com = moved + biped.chains.center_of_mass(q.reshape(4, 2, -1))
    return np.diagonal((com[:2] - com[2:])[:, :2] / (2.0 * _PROBE_M)).copy()


def pelvis_shift_offsets(model: WalkerModel, row: IntArray | slice, shift: Array) -> Array:
    """Offsets of the joints that move the planned pelvis over feet that stay; zero for no shift, to the last bit.

    Where a foot would be out of reach, the leg is as long as it can be.

    Args:
        model: Assumed walker.
        row: Rows of the plan.
        shift: Of the pelvis at each of them, x forward and y left, (rows, 2) [m].

    Returns:
        (rows, 12) [rad].
    """
    plan, biped = model.plan, model.biped
    pelvis = np.array(plan.pelvis[row])
    pelvis[:, :2] += shift
    target = within_reach(biped.leg, plan.ankles[row] - pelvis[:, None] - biped.hips)
    level = np.broadcast_to(np.eye(3), (*target.shape, 3))
    q = leg_angles(biped.leg, target, level).reshape(len(shift), -1)
    return np.where((shift != 0.0).any(axis=1, keepdims=True), q - plan.q[row], 0.0)


def within_reach(leg: LegGeometry, ankle: Array) -> Array:
    """Ankles from their hips, (..., 3) [m], drawn in along the leg to where it reaches."""
    distance = np.linalg.norm(ankle, axis=-1, keepdims=True)
    return ankle * np.minimum(1.0, _REACH * leg.reach / distance)


def zmp_shift_offsets(model: WalkerModel, zmp: Array) -> Array:
    """Offsets of the joints that shift the ZMP of the plan.

    Args:
        model: Assumed walker.
        zmp: Shift at every row of the plan, x forward and y left, (T, 2) [m].

    Returns:
        (T, 12) [rad].
    """
    plan = model.plan
    shift = center_of_mass_shift(zmp, plan.omega, model.control_period_s)
    return pelvis_shift_offsets(model, slice(None), shift)
