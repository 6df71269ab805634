"""A control step of walking controller and posture feedback, compiled, row by row.

`baselines.walking.controller` and `baselines.walking.posture` have the formulas.

Numba keeps compiled code by the file of the function that was called. So everything that a kernel calls stands in this
file, and every size comes from a type. A kernel that Python calls takes plain tuples and names their parts itself.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from elastic_env.core.compiled import compiled
from elastic_env.core.signals import Array


def _row_type(*fields: tuple[Any, ...]) -> np.dtype[Any]:
    return np.dtype((np.record, list(fields)))


CONTROLLER = _row_type(
    ("period_s", np.float64), ("is_com_fed_back", np.bool_),
    ("thigh", np.float64), ("shank", np.float64), ("footholds", np.float64, (2, 2)),  # [m]
    ("weight", np.float64), ("weight_of_feet", np.float64),  # of the robot, below the sensors [N]
    ("omega", np.float64), ("following_share", np.float64),  # of the pendulum [rad/s], of its way in a period
    ("per_pelvis", np.float64, (2,)),  # motion of the center of mass per motion of the pelvis
    ("ankle_stiffness", np.float64, (2, 2)),  # pitch and roll of the legs [N·m/rad]
    ("friction_deflection", np.float64, (2, 6)), ("friction_rate_rad_s", np.float64),  # [rad], [rad/s]
    ("force_difference", np.float64), ("force_difference_decay_s", np.float64),
    ("force_difference_limit_m", np.float64),
    ("dcm", np.float64), ("zmp_limit_m", np.float64),
    ("velocity_share", np.float64), ("zmp_share", np.float64), ("weight_share", np.float64),  # of a step in a period
)  # fmt: skip
"""What the controller assumes and its gains; shares are those that first-order filters make in one period."""

LEGS = _row_type(
    ("thigh", np.float64), ("shank", np.float64), ("reach", np.float64), ("hips", np.float64, (2, 3)),  # [m]
)  # fmt: skip
"""The legs, to move the pelvis over feet that stay; the ankles come no further from the hips than the reach."""

STANCE = _row_type(
    ("pelvis", np.float64, (3,)), ("ankles", np.float64, (2, 3)), ("q", np.float64, (2, 6)),  # [m], [rad]
)  # fmt: skip
"""Where the plan has pelvis and ankles, and its joint angles, one row per control step."""

PLAN = _row_type(("share", np.float64), ("com", np.float64, (2,)), ("com_dot", np.float64, (2,)))
"""What it needs of the plan, one row per control step."""

MEMORY = _row_type(
    ("steps", np.float64), ("difference", np.float64),  # of the leg lengths [m]
    ("com", np.float64, (2, 2)),  # from both soles [m]
    ("velocity", np.float64, (2,)), ("shift", np.float64, (2,)),  # its deviation [m/s], ZMP shift [m]
    ("following", np.float64, (2,)), ("planned", np.float64, (2,)),  # shift of the planned COM for a ZMP, and in all
    ("weight", np.float64),  # as measured [N]
)  # fmt: skip
"""What the controller keeps of a world."""

INPUTS = _row_type(
    ("zmp", np.float64, (2,)), ("com", np.float64, (2,)),  # [m]
    ("leg_length", np.float64), ("hip", np.float64, (2, 2)),  # [m], roll and pitch of either leg [rad]
    ("balance_gain", np.float64), ("deflection", np.float64, (2, 6)),  # relative changes [1]
)  # fmt: skip
"""What something outside adds; zeros are as if there were none, to the last bit."""

POSTURE = _row_type(
    ("period_s", np.float64),
    ("proportional", np.float64), ("integral", np.float64), ("derivative", np.float64),  # [1], [1/s], [s]
    ("leak_s", np.float64), ("limit_rad", np.float64), ("integral_limit", np.float64),  # the last one [rad·s]
    ("filter_share", np.float64), ("swing_share", np.float64),  # of a step in a period [1]
)  # fmt: skip
"""Gains of the posture feedback."""

POSTURE_MEMORY = _row_type(
    ("steps", np.float64), ("tilt", np.float64, (2,)), ("integral", np.float64, (2,)),  # roll and pitch [rad], [rad·s]
    ("kept", np.float64, (2,)),  # hip pitch that either leg keeps [rad]
)  # fmt: skip
"""What the posture feedback keeps of a world."""


class Walk(NamedTuple):
    """What does not change: rows of `CONTROLLER`, `PLAN`, `LEGS`, `STANCE`, and the share of the feedback at first."""

    controller: Any
    plan: Any
    legs: Any
    stances: Any
    ramp: Array


class Seen(NamedTuple):
    """Observations, rows with fields; center of mass, (n, 3), and soles, (n, 2, 3), in a level frame [m].

    `shares` are the load shares of the right foot, (n,), or none to take those of the plan, (0,).
    """

    observed: Any
    com: Array
    soles: Array
    shares: Array


@compiled
def control(walk: Any, seen: Any, inputs: Any, before: Any, now: Any, action: Array) -> None:
    """Offsets of the joints, and the memory after a control step.

    Args:
        walk: `Walk`.
        seen: `Seen`.
        inputs: Rows of `INPUTS`, (n,).
        before: Rows of `MEMORY`, (n,).
        now: To be filled, (n,).
        action: To be filled, (n, 12) [rad].
    """
    walk, seen = Walk(*walk), Seen(*seen)
    controller = walk.controller[0]
    for world in range(len(now)):
        shown, own, last, given = seen.observed[world], now[world], before[world], inputs[world]
        row = int(min(max(np.rint(shown.clock[0] / controller.period_s) - 1.0, 0.0), len(walk.plan) - 1.0))
        planned = walk.plan[row]
        own.steps = last.steps + 1.0
        ramp = walk.ramp[int(min(own.steps, len(walk.ramp) - 1.0))]
        shift_plan(controller, given, ramp, last, own)
        weigh(controller, shown, last, own)
        share = planned.share if len(seen.shares) == 0 else seen.shares[world]
        balance_feet(controller, shown, share, given.balance_gain, last, own)
        for foot in range(2):
            for i in range(2):
                own.com[foot, i] = seen.com[world, i] - seen.soles[world, foot, i]
        follow_com(controller, shown, planned, given.balance_gain, last, own)
        for leg in range(2):
            offset_leg(controller, shown, given, own, leg, ramp, action[world])
        coming = walk.stances[min(row + 1, len(walk.stances) - 1)]
        x, y = own.planned[0] / controller.per_pelvis[0], own.planned[1] / controller.per_pelvis[1]
        move_pelvis(walk.legs[0], coming, x, y, action[world])


@compiled
def shift_plan(controller: Any, given: Any, ramp: float, last: Any, own: Any) -> None:
    """Shift of the planned center of mass for the input `zmp`, and in all on the ramp [m]."""
    for i in range(2):
        own.following[i] = followed(last.following[i], given.zmp[i], controller.following_share)
        own.planned[i] = ramp * (own.following[i] + given.com[i])


@compiled
def followed(center: float, zmp: float, share: float) -> float:
    """The center of mass a period later, under a ZMP shift that stays as it is; see `baselines.walking.zmp_shift`."""
    return center + share * (zmp - center)


@compiled
def move_pelvis_in_rows(legs: Any, stances: Any, shift: Array, offset: Array) -> None:
    """`move_pelvis` in every row of a plan: `LEGS`, (1,), rows of `STANCE`, (n,), shift, (n, 2), offset, (n, 12)."""
    for row in range(len(shift)):
        move_pelvis(legs[0], stances[row], shift[row, 0], shift[row, 1], offset[row])


@compiled
def move_pelvis(legs: Any, stance: Any, x: float, y: float, offset: Array) -> None:
    """Add the offsets that move the planned pelvis over feet that stay, (12,) [rad]; no shift changes no bit.

    Where a foot would be out of reach, the leg is as long as it can be.

    Args:
        legs: Row of `LEGS`.
        stance: Row of `STANCE`.
        x: Shift forward [m].
        y: Shift to the left [m].
        offset: To be added to.
    """
    if x == 0.0 and y == 0.0:
        return
    for leg in range(2):
        ankle_x = stance.ankles[leg, 0] - (stance.pelvis[0] + x) - legs.hips[leg, 0]
        ankle_y = stance.ankles[leg, 1] - (stance.pelvis[1] + y) - legs.hips[leg, 1]
        ankle_z = stance.ankles[leg, 2] - stance.pelvis[2] - legs.hips[leg, 2]
        distance = math.sqrt(ankle_x**2 + ankle_y**2 + ankle_z**2)
        drawn_in = min(1.0, legs.reach / distance)
        roll, pitch, knee = level_leg(legs, drawn_in * ankle_x, drawn_in * ankle_y, drawn_in * ankle_z)
        first, q = 6 * leg, stance.q[leg]
        offset[first] -= q[0]
        offset[first + 1] += roll - q[1]
        offset[first + 2] += pitch - q[2]
        offset[first + 3] += knee - q[3]
        offset[first + 4] += -(pitch + knee) - q[4]
        offset[first + 5] += -roll - q[5]


@compiled
def level_leg(legs: Any, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Hip roll, hip pitch and knee [rad] of a leg whose sole is parallel to the pelvis, from ankle less hip [m].

    `elastic_env.dynamics.leg_kinematics.leg_angles` has soles of every attitude.
    """
    distance = math.sqrt(x**2 + y**2 + z**2)
    thigh, shank = legs.thigh, legs.shank
    cosine = (distance**2 - thigh**2 - shank**2) / (2.0 * thigh * shank)
    knee = math.acos(min(max(cosine, -1.0), 1.0))
    of_shank = math.atan2(thigh * math.sin(knee), shank + thigh * math.cos(knee))  # from the line of hip and ankle
    return math.atan2(y, -z), of_shank + math.atan2(-x, math.hypot(y, z)) - knee, knee


@compiled
def weigh(controller: Any, shown: Any, last: Any, own: Any) -> None:
    """The weight as the feet show it, filtered; a share of zero keeps it."""
    load = (vertical_force(shown, 0) + vertical_force(shown, 1)) + controller.weight_of_feet
    own.weight = last.weight
    if controller.weight_share > 0.0:
        own.weight = last.weight + controller.weight_share * (load - last.weight)


@compiled
def vertical_force(shown: Any, foot: int) -> float:
    """Along the normal of a sole, which is nearly vertical [N]."""
    return shown.wrench[foot, 0, 2]


@compiled
def balance_feet(controller: Any, shown: Any, share: float, change: float, last: Any, own: Any) -> None:
    """Left minus right leg length: what the force difference lacks, integrated with a leak [m]."""
    gain = (1.0 + change) * controller.force_difference
    desired = (1.0 - 2.0 * share) * own.weight
    missing = desired - (vertical_force(shown, 0) - vertical_force(shown, 1))
    decay = last.difference / controller.force_difference_decay_s
    difference = last.difference + controller.period_s * (gain * missing - decay)
    own.difference = within(difference, controller.force_difference_limit_m)


@compiled
def follow_com(controller: Any, shown: Any, planned: Any, change: float, last: Any, own: Any) -> None:
    """Filtered deviation of the COM velocity from the plan [m/s], and ZMP shift [m]."""
    support = int(shown.clock[2])
    for i in range(2):
        own.velocity[i], own.shift[i] = last.velocity[i], last.shift[i]
        if controller.is_com_fed_back:
            now, before = own.com[support, i] - own.planned[i], last.com[support, i] - last.planned[i]
            deviation = now + controller.footholds[support, i] - planned.com[i]
            deviating = (now - before) / controller.period_s - planned.com_dot[i]
            own.velocity[i] = last.velocity[i] + controller.velocity_share * (deviating - last.velocity[i])
            error = deviation + own.velocity[i] / controller.omega
            wanted = within((1.0 + change) * controller.dcm * error, controller.zmp_limit_m)
            own.shift[i] = last.shift[i] + controller.zmp_share * (wanted - last.shift[i])


@compiled
def offset_leg(controller: Any, shown: Any, given: Any, own: Any, leg: int, ramp: float, action: Array) -> None:
    """Offsets of the joints of a leg: its length, the torque of the ZMP shift, what is added, and friction [rad]."""
    first, sign = 6 * leg, 1.0 - 2.0 * leg
    difference = own.difference + given.leg_length
    hip, knee, ankle = lengthening(controller, shown.reference_angle[first + 3], difference, sign)
    share = shown.load_share if leg == 1 else 1.0 - shown.load_share
    carried = share * controller.weight
    pitch = carried * own.shift[0] / controller.ankle_stiffness[leg, 0]
    roll = -carried * own.shift[1] / controller.ankle_stiffness[leg, 1]
    for i in range(6):
        wound = 1.0 + given.deflection[leg, i]
        moved = 0.0
        if i == 1:
            moved = given.hip[leg, 0]
        elif i == 2:
            moved = hip + given.hip[leg, 1]
        elif i == 3:
            moved = knee
        elif i == 4:
            moved = ankle + wound * pitch
        elif i == 5:
            moved = wound * roll
        rate = shown.reference_rate[first + i] / controller.friction_rate_rad_s
        against_friction = wound * (controller.friction_deflection[leg, i] * math.tanh(rate))
        action[first + i] = ramp * moved + against_friction


@compiled
def lengthening(controller: Any, knee: float, difference: float, sign: float) -> tuple[float, float, float]:
    """Offsets of hip pitch, knee and ankle pitch that lengthen a leg by half of a difference, or shorten it [rad].

    The ankle stays on the line from the hip, and the sole keeps its attitude.
    """
    thigh, shank = controller.thigh, controller.shank
    distance = math.sqrt(thigh**2 + shank**2 + 2.0 * thigh * shank * math.cos(knee))
    bend = -distance / (thigh * shank * math.sin(knee)) * (0.5 * sign * difference)
    at_hip = -bend * shank * (shank + thigh * math.cos(knee)) / distance**2
    return at_hip, bend, -bend - at_hip


@compiled
def within(value: float, limit: float) -> float:
    """A value within ±limit; what is no number stays so."""
    if value > limit:
        return limit
    return -limit if value < -limit else value


@compiled
def hold_posture(gains: Any, observed: Any, ramp: Array, change: Array, memory: Any, action: Array) -> None:
    """Add the turn of the hips against the pelvis' tilt, and keep the memory after a control step.

    Args:
        gains: Row of `POSTURE`, (1,).
        observed: Observations, rows with fields.
        ramp: Share of the feedback after 0, 1, ... control steps, up to the last one [1].
        change: Relative change of all gains, (n, 1) [1], or none, (0, 1); the integral itself goes on as it is.
        memory: Rows of `POSTURE_MEMORY` before, and to be filled, (n,).
        action: Offsets of the joints, (n, 12) [rad].
    """
    before, now = memory
    own = gains[0]
    for world in range(len(action)):
        shown, last, kept = observed[world], before[world], now[world]
        kept.steps = last.steps + 1.0
        share = ramp[int(min(kept.steps, len(ramp) - 1.0))]
        further = change[world, 0] if len(change) > 0 else 0.0
        for i in range(2):
            tilt = last.tilt[i] + own.filter_share * (shown.imu_attitude[i] - last.tilt[i])
            integral = last.integral[i] + own.period_s * (tilt - last.integral[i] / own.leak_s)
            kept.tilt[i], kept.integral[i] = tilt, within(integral, own.integral_limit)
            turn = own.proportional * tilt + own.integral * kept.integral[i] + own.derivative * shown.imu_rate[i]
            turn = share * within((1.0 + further) * turn, own.limit_rad)
            for leg in range(2):
                if i == 0:
                    action[world, 6 * leg + 1] += turn
                else:
                    action[world, 6 * leg + 2] += pitch_of_leg(own, shown.load_share, leg, turn, last, kept)


@compiled
def pitch_of_leg(own: Any, share_right: float, leg: int, turn: float, last: Any, kept: Any) -> float:
    """Hip pitch of a leg [rad]: one that carries half of the weight stands and turns, one in the air follows slowly."""
    share = share_right if leg == 1 else 1.0 - share_right
    standing = min(2.0 * share, 1.0)
    following = own.swing_share if standing < 1.0 else 1.0
    kept.kept[leg] = last.kept[leg] + following * (turn - last.kept[leg])
    return last.kept[leg] + standing * (turn - last.kept[leg])
