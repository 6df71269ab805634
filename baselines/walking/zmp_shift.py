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

from typing import Any, NamedTuple

import numpy as np
from scipy import linalg

from baselines.walking import walking_kernels as kernels
from elastic_env.core.signals import Array
from elastic_env.dynamics.leg_kinematics import LegGeometry
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


def following_share(omega: float, period_s: float) -> float:
    """Share of its way that the c of a ZMP shift goes in a period, where the shift stays as it is [1].

    Args:
        omega: Natural frequency of the pendulum [rad/s].
        period_s: The period [s].
    """
    return 1.0 - float(np.exp(-omega * period_s))


def center_of_mass_per_pelvis(model: WalkerModel) -> Array:
    """Motion of the center of mass per motion of the standing pelvis over its feet, x and y, (2,) [1].

    The legs follow the pelvis by half on average: it is the share of the weight that the pelvis carries along.
    """
    plan, biped, axes = model.plan, model.biped, np.eye(3)[:2]
    moved = plan.pelvis[0] + _PROBE_M * np.concatenate([axes, -axes])
    q = biped.joint_angles(moved, np.broadcast_to(plan.ankles[0], (4, 2, 3)))
    com = moved + biped.chains.center_of_mass(q.reshape(4, 2, -1))
    return np.diagonal((com[:2] - com[2:])[:, :2] / (2.0 * _PROBE_M)).copy()


class Stances(NamedTuple):
    """What moves the planned pelvis over feet that stay: a row of `LEGS` and rows of `STANCE` of the kernels."""

    legs: Any
    rows: Any

    @classmethod
    def of(cls, model: WalkerModel) -> "Stances":
        """Those of the assumed walker and its plan."""
        plan, leg, size = model.plan, model.biped.leg, len(model.plan.q)
        legs = np.array([(leg.thigh, leg.shank, _REACH * leg.reach, model.biped.hips)], kernels.LEGS)
        rows = np.zeros(size, kernels.STANCE)
        rows["pelvis"], rows["ankles"], rows["q"] = plan.pelvis, plan.ankles, plan.q.reshape(size, 2, -1)
        return cls(legs, rows)


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
    stances, offsets = Stances.of(model), np.zeros((len(zmp), len(model.joint_names)))
    shift = center_of_mass_shift(zmp, model.plan.omega, model.control_period_s)
    kernels.move_pelvis_in_rows(stances.legs, stances.rows, shift, offsets)
    return offsets
