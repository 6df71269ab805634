"""Control step of the walking controller, compiled: balance of the feet, feedback, leg offsets."""

import math
from typing import Any

import numpy as np

from elastic_env.core.compiled import compiled, compiled_part, record_type
from elastic_env.core.signals import Array, IntArray

MEMORY = record_type(
    steps=(),
    difference=(),  # of the leg lengths [m]
    com=(2, 2),  # from both soles [m]
    velocity=(2,),  # its deviation from the plan [m/s]
    shift=(2,),  # of the ZMP [m]
    following=(2,),  # shift of the planned center of mass for the input `zmp` [m]
    planned=(2,),  # that shift with the input `com` [m]
    weight=(),  # as measured [N]
)
"""Memory of the controller."""
INPUTS = record_type(
    zmp=(2,),  # [m]
    com=(2,),  # [m]
    leg_length=(),  # [m]
    hip=(2,),  # roll and pitch of both legs [rad]
    balance_gain=(),  # relative change [1]
    deflection=(2, 6),  # relative change [1]
)
"""Inputs from outside; zeros give the same bits as no inputs."""


@compiled
def control(
    controller: Any,
    plan: Any,
    ramp: Array,
    observations: Any,
    com: Array,
    soles: Array,
    shares: Array,
    inputs: Any,
    before: Any,
    after: Any,
    plan_rows: IntArray,
    pelvis: Array,
    action: Array,
) -> bool:
    """Fill in offsets of the joints and the memory after a control step.

    Args:
        controller: Assumptions and gains, a row, (1,).
        plan: The plan in its local frame, one row per control step.
        ramp: Share of the feedback after 0, 1, ... control steps, up to the last one [1].
        observations: Observations, rows with fields, (n,).
        com: Center of mass in a level frame, (n, 3) [m].
        soles: Middles of the soles in the same, (n, 2, 3) [m].
        shares: Load shares of the right foot, (n,), or none to take those of the plan, (0,).
        inputs: Rows of `INPUTS`, (n,).
        before: Rows of `MEMORY`, (n,).
        after: The same after the control step, to be filled.
        plan_rows: Numbers of the plan's rows at the end of the control period, to be filled, (n,).
        pelvis: Shift of the planned pelvis, to be filled, (n, 2) [m].
        action: To be filled, (n, 12) [rad].

    Returns:
        True where the pelvis of a world is shifted.
    """
    constants = controller[0]
    is_shifted = False
    for world in range(len(after)):
        obs = observations[world]
        memory = after[world]
        last = before[world]
        added = inputs[world]
        periods = np.rint(obs.clock[0] / constants.period_s)
        row = int(min(max(periods - 1.0, 0.0), len(plan) - 1.0))
        plan_rows[world] = min(row + 1, len(plan) - 1)
        planned = plan[row]
        memory.steps = last.steps + 1.0
        ramp_share = ramp[int(min(memory.steps, len(ramp) - 1.0))]
        following = constants.following_share
        for i in range(2):
            memory.following[i] = follow_zmp(last.following[i], added.zmp[i], following)
            memory.planned[i] = ramp_share * (memory.following[i] + added.com[i])
            pelvis[world, i] = memory.planned[i] / constants.per_pelvis[i]
            is_shifted = is_shifted or memory.planned[i] != 0.0
        filter_weight(constants, obs, last, memory)
        share = planned.share if len(shares) == 0 else shares[world]
        balance_feet(constants, obs, share, added.balance_gain, last, memory)
        for foot in range(2):
            for i in range(2):
                memory.com[foot, i] = com[world, i] - soles[world, foot, i]
        follow_com(constants, obs, planned, added.balance_gain, last, memory)
        for leg in range(2):
            offset_leg(constants, obs, planned, added, memory, leg, ramp_share, action[world])
    return is_shifted


@compiled_part
def follow_zmp(center: float, zmp: float, share: float) -> float:
    """Center of mass a period later, under a constant ZMP shift (`baselines.walking.zmp_shift`)."""
    return center + share * (zmp - center)


@compiled_part
def filter_weight(constants: Any, obs: Any, last: Any, memory: Any) -> None:
    """Filter the weight that the feet measure; a share of zero keeps it."""
    load = vertical_force(obs, 0) + vertical_force(obs, 1) + constants.weight_of_feet
    memory.weight = last.weight
    if constants.weight_share > 0.0:
        memory.weight = last.weight + constants.weight_share * (load - last.weight)


@compiled_part
def vertical_force(obs: Any, foot: int) -> float:
    """Force along the normal of a sole, which is nearly vertical [N]."""
    return obs.wrench[foot, 0, 2]


@compiled_part
def balance_feet(
    constants: Any, obs: Any, share: float, change: float, last: Any, memory: Any
) -> None:
    """Integrate the error of the force difference into left minus right leg length, with a leak."""
    gain = (1.0 + change) * constants.force_difference
    desired = (1.0 - 2.0 * share) * memory.weight
    missing = desired - (vertical_force(obs, 0) - vertical_force(obs, 1))
    decay = last.difference / constants.force_difference_decay_s
    difference = last.difference + constants.period_s * (gain * missing - decay)
    memory.difference = within(difference, constants.force_difference_limit_m)


@compiled_part
def follow_com(
    constants: Any, obs: Any, planned: Any, change: float, last: Any, memory: Any
) -> None:
    """Filter the deviation of the COM velocity from the plan [m/s], and set the ZMP shift [m]."""
    support = int(obs.clock[2])
    for i in range(2):
        memory.velocity[i] = last.velocity[i]
        memory.shift[i] = last.shift[i]
        if constants.is_com_fed_back:
            shifted = memory.com[support, i] - memory.planned[i]
            com = last.com[support, i] if last.steps > 0.0 else memory.com[support, i]
            before = com - last.planned[i]
            deviation = shifted + planned.soles[support, i] - planned.com[i]
            velocity = (shifted - before) / constants.period_s - planned.com_dot[i]
            velocity_step = velocity - last.velocity[i]
            memory.velocity[i] = last.velocity[i] + constants.velocity_share * velocity_step
            error = deviation + memory.velocity[i] / constants.omega
            gain = (1.0 + change) * constants.dcm
            missing = within(gain * error, constants.zmp_limit_m) - last.shift[i]
            memory.shift[i] = last.shift[i] + constants.zmp_share * missing


@compiled_part
def offset_leg(
    constants: Any,
    obs: Any,
    planned: Any,
    added: Any,
    memory: Any,
    leg: int,
    ramp: float,
    out: Array,
) -> None:
    """Write the offsets of a leg's joints [rad].

    They are the sum of leg length, torque of the ZMP shift, inputs, and friction.
    """
    first = 6 * leg
    sign = 1.0 - 2.0 * leg
    difference = memory.difference + added.leg_length
    knee_angle = obs.reference_angle[first + 3]
    hip, knee, ankle = lengthening(constants, knee_angle, difference, sign)
    share = obs.load_share if leg == 1 else 1.0 - obs.load_share
    load = share * constants.weight
    cosine = planned.foot_yaw[leg, 0]
    sine = planned.foot_yaw[leg, 1]
    forward = cosine * memory.shift[0] + sine * memory.shift[1]  # in the foot's frame
    left = cosine * memory.shift[1] - sine * memory.shift[0]
    pitch = load * forward / constants.ankle_stiffness[leg, 0]
    roll = -load * left / constants.ankle_stiffness[leg, 1]
    for i in range(6):
        winding = 1.0 + added.deflection[leg, i]
        offset = 0.0
        if i == 1:
            offset = added.hip[0]
        elif i == 2:
            offset = hip + added.hip[1]
        elif i == 3:
            offset = knee
        elif i == 4:
            offset = ankle + winding * pitch
        elif i == 5:
            offset = winding * roll
        rate = obs.reference_rate[first + i] / constants.friction_rate_rad_s
        friction = constants.friction_deflection[leg, i] * math.tanh(rate)
        out[first + i] = ramp * offset + winding * friction


@compiled_part
def lengthening(
    constants: Any, knee: float, difference: float, sign: float
) -> tuple[float, float, float]:
    """Offsets of hip pitch, knee and ankle pitch that lengthen a leg by half of a difference [rad].

    The ankle stays on the line from the hip, and the sole keeps its attitude.
    """
    thigh = constants.thigh
    shank = constants.shank
    distance = math.sqrt(thigh**2 + shank**2 + 2.0 * thigh * shank * math.cos(knee))
    bend = -distance / (thigh * shank * math.sin(knee)) * (0.5 * sign * difference)
    at_hip = -bend * shank * (shank + thigh * math.cos(knee)) / distance**2
    return at_hip, bend, -bend - at_hip


@compiled_part
def within(value: float, limit: float) -> float:
    """Value within ±limit; nan stays nan."""
    if value > limit:
        return limit
    return -limit if value < -limit else value
