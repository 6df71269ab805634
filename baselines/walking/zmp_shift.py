r"""Offsets of the joints for a shift of the ZMP: the pelvis moves like an inverted pendulum.

The ZMP p of a pendulum whose center of mass moves by c is [Kajita2003]

.. math:: p = c - \ddot c / \omega^2

A shift that is known over the whole walk has exactly one bounded c. Its Fourier transform is the
one of p over 1 + (ν/ω)²: a low-pass filter without phase shift, which uses future values as far as
past ones. Inverse kinematics move the pelvis by c over feet that stay. A learned p makes a new plan
of the ZMP, as in [Hu2015].

A shift of which only the present value is known counts as constant. Then the bounded solution is a
first-order lag,

.. math:: \dot c = \omega (p - c)

and while p changes, the ZMP is shifted by p − ṗ/ω: it is late by 1/ω, and begins in the opposite
direction.

[Kajita2003] S. Kajita et al., "Biped Walking Pattern Generation by using Preview Control of
Zero-Moment Point", ICRA. [Hu2015] K. Hu, C. Ott, D. Lee, "Online Iterative Learning Control of
Zero-Moment Point for Biped Walking Stabilization", ICRA.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from baselines.compensation.compiled_rows import record_row, record_rows
from baselines.compensation.contact_torque import cosine_and_sine
from elastic_env.core.compiled import compiled, compiled_part
from elastic_env.core.signals import Array
from elastic_env.rigid.leg_kinematics import LegGeometry, turn
from elastic_env.world.robot_model import WalkerModel

_PROBE_M = 0.005
"""Displacement of the pelvis for finite differences [m]."""
_REACH = 0.999
"""Largest distance of ankle and hip, over the length of the straight leg [1]."""


def center_of_mass_shift(zmp: Array, omega: float, period_s: float) -> Array:
    """Bounded c of a ZMP shift, at rest before the first and after the last row.

    Args:
        zmp: Shift p over time, (T, k) [m].
        omega: Natural frequency of the pendulum [rad/s].
        period_s: Time between rows [s].

    Returns:
        (T, k) [m]; its second difference fulfils the equation of the module.
    """
    from scipy import linalg  # late, see `elastic_env.motion.preview_control`

    stiff = 1.0 / (omega * period_s) ** 2
    bands = np.tile([[-stiff], [1.0 + 2.0 * stiff], [-stiff]], len(zmp))
    bands[1, [0, -1]] = 1.0 + stiff
    return linalg.solve_banded((1, 1), bands, zmp)


def following_share(omega: float, period_s: float) -> float:
    """Share of the remaining way that c goes in a period, under a constant ZMP shift [1].

    Args:
        omega: Natural frequency of the pendulum [rad/s].
        period_s: The period [s].
    """
    return 1.0 - float(np.exp(-omega * period_s))


def center_of_mass_per_pelvis(model: WalkerModel) -> Array:
    """Motion of the center of mass per motion of the standing pelvis, x and y, (2,) [1].

    It is the share of the weight that the pelvis carries along: the legs follow it by half on
    average.
    """
    plan = model.plan
    biped = model.biped
    axes = np.eye(3)[:2]
    pelvis = plan.pelvis[0] + _PROBE_M * np.concatenate([axes, -axes])
    q = biped.joint_angles(pelvis, np.broadcast_to(plan.ankles[0], (4, 2, 3)))
    com = pelvis + biped.chains.center_of_mass(q)
    return np.diagonal((com[:2] - com[2:])[:, :2] / (2.0 * _PROBE_M)).copy()


class Stances(NamedTuple):
    """The legs, a row, and the planned stances in the local frame, one row per control step."""

    legs: Any
    rows: Any

    @classmethod
    def of(cls, model: WalkerModel) -> "Stances":
        """Legs of the assumed walker, and the stances of its plan."""
        leg = model.biped.leg
        local = model.plan.local
        legs = record_row(
            thigh=leg.thigh,  # [m]
            shank=leg.shank,  # [m]
            reach=_REACH * leg.reach,  # largest distance of ankle and hip [m]
            hips=model.biped.hips,  # [m]
        )
        rows = record_rows(
            pelvis=local.pelvis,  # [m]
            ankles=local.ankles,  # [m]
            foot_yaw=cosine_and_sine(local.foot_yaw),
            q=model.plan.q.reshape(-1, 2, 6),  # [rad]
        )
        return cls(legs, rows)


def within_reach(leg: LegGeometry, ankle: Array) -> Array:
    """Ankles relative to their hips, (..., 3) [m], pulled along the leg to within its reach."""
    distance = np.linalg.norm(ankle, axis=-1, keepdims=True)
    return ankle * np.minimum(1.0, _REACH * leg.reach / distance)


def zmp_shift_offsets(model: WalkerModel, zmp: Array) -> Array:
    """Offsets of the joints that shift the ZMP of the plan.

    Args:
        model: Assumed walker.
        zmp: Shift at every row of the plan in its local frame, x forward and y left, (T, 2) [m].

    Returns:
        (T, 12) [rad].
    """
    stances = Stances.of(model)
    offsets = np.zeros((len(zmp), len(model.joint_names)))
    plan = model.plan
    zmp_in_world = turn(zmp, plan.heading)
    com = center_of_mass_shift(zmp_in_world, plan.omega, model.control_period_s)
    shift = turn(com, -plan.heading)
    move_pelvis(*stances, np.arange(len(zmp)), shift, offsets)
    return offsets


@compiled
def move_pelvis(legs: Any, stances: Any, steps: Any, shift: Array, out: Array) -> None:
    """Add the offsets that move the planned pelvis over feet that stay; zero changes no bit.

    Where a foot would be out of reach, the leg is as long as it can be.

    Args:
        legs: Row of `Stances`, (1,).
        stances: Rows of `Stances`, one per control step of the plan.
        steps: Row of the plan for each of the shifts, (n,).
        shift: Shifts forward and to the left in the plan's local frame, (n, 2) [m].
        out: To be added to, (n, 12) [rad].
    """
    leg = legs[0]
    for row in range(len(shift)):
        if shift[row, 0] == 0.0 and shift[row, 1] == 0.0:
            continue
        for side in range(2):
            move_hip(leg, stances[steps[row]], side, shift[row], out[row])


@compiled
def move_feet(legs: Any, stances: Any, steps: Any, shift: Array, out: Array) -> None:
    """Add the offsets that move planned feet under a pelvis that stays, as `move_pelvis` does.

    Args:
        legs: Row of `Stances`, (1,).
        stances: Rows of `Stances`, one per control step of the plan.
        steps: Row of the plan for each of the shifts, (n,).
        shift: Shifts of the left and the right foot in the plan's local frame, (n, 2, 2) [m].
        out: To be added to, (n, 12) [rad].
    """
    for row in range(len(shift)):
        for side in range(2):
            of_foot = shift[row, side]
            if of_foot[0] != 0.0 or of_foot[1] != 0.0:
                move_hip(legs[0], stances[steps[row]], side, -of_foot, out[row])


@compiled_part
def move_hip(leg: Any, stance: Any, side: int, shift: Array, out: Array) -> None:
    """Add the offsets of one leg, (12,) [rad], whose hip moves over its foot, (2,) [m]."""
    ankle = stance.ankles[side]
    hip = leg.hips[side]
    x = ankle[0] - (stance.pelvis[0] + shift[0]) - hip[0]
    y = ankle[1] - (stance.pelvis[1] + shift[1]) - hip[1]
    z = ankle[2] - stance.pelvis[2] - hip[2]
    cosine = stance.foot_yaw[side, 0]
    sine = stance.foot_yaw[side, 1]
    # the hip yaw of the plan stays: in the frame of the sole the leg is level
    x, y = cosine * x + sine * y, cosine * y - sine * x
    scale = min(1.0, leg.reach / math.sqrt(x**2 + y**2 + z**2))
    roll, pitch, knee = level_leg(leg, scale * x, scale * y, scale * z)
    q = (stance.q[side, 0], roll, pitch, knee, -(pitch + knee), -roll)
    for i in range(6):
        out[6 * side + i] += q[i] - stance.q[side, i]


@compiled_part
def level_leg(legs: Any, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Hip roll, hip pitch and knee of a leg whose sole is parallel to the pelvis [rad].

    The arguments are the ankle less the hip [m]. `elastic_env.rigid.leg_kinematics.leg_angles` is
    for soles of any attitude.
    """
    distance = math.sqrt(x**2 + y**2 + z**2)
    thigh = legs.thigh
    shank = legs.shank
    cosine = (distance**2 - thigh**2 - shank**2) / (2.0 * thigh * shank)
    knee = math.acos(min(max(cosine, -1.0), 1.0))
    # angle of the shank against the line of hip and ankle
    angle = math.atan2(thigh * math.sin(knee), shank + thigh * math.cos(knee))
    return math.atan2(y, -z), angle + math.atan2(-x, math.hypot(y, z)) - knee, knee
