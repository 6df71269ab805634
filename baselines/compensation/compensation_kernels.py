"""What compensators compute in a control step, compiled, row by row.

Loads of the legs: see `baselines.compensation.contact_torque`. Lead of the motors: see `DynamicCompensator`.

Numba keeps compiled code by the file of the function that was called. So everything that a kernel calls stands in this
file, and every size comes from a type.
"""

import math
from typing import Any

import numpy as np

from elastic_env.core.compiled import compiled
from elastic_env.core.signals import Array

CONTACT = np.dtype(
    (
        np.record,
        [
            ("gravity", np.float64),  # [m/s²]
            ("mass", np.float64),  # of the robot [kg]
            ("footholds", np.float64, (2, 2)),  # middles of the soles [m]
            ("ankle_height", np.float64),  # [m]
            ("is_at_zmp", np.bool_),  # or at the ankle axes
            ("legs_weigh", np.bool_),
        ],
    )
)
"""How the ground carries the robot."""

DRIVE = np.dtype(
    (
        np.record,
        [
            ("damping", np.float64),  # D [N·m·s/rad]
            ("rotor_inertia", np.float64),  # B [kg·m²]
            ("position_gain", np.float64),  # [N·m/rad]
            ("velocity_gain", np.float64),  # [N·m·s/rad]
            ("integral_gain", np.float64),  # [N·m/(rad·s)]
        ],
    )
)
"""Rotor, damper and servo of a joint."""


@compiled
def planned_loads(observed: Any, contact: Any, level: Any, tilted: Any) -> None:
    """Loads under the planned load share.

    Args:
        observed: Observations, rows with fields.
        contact: Row of `CONTACT`, (1,).
        level: Loads of a pelvis that is level, to be filled, rows of `elastic_env.dynamics.leg_kernels.loads_type`.
        tilted: The same of one that is tilted as the IMU says.
    """
    ground = contact[0]
    for world in range(len(level)):
        load, plan = level[world], observed[world]
        fill_gravity(plan, ground.gravity, True, load)
        load.legs_weigh = ground.legs_weigh
        share = plan.load_share
        for foot in range(2):
            weight = share if foot == 1 else 1.0 - share
            load.mass[foot] = -ground.mass * weight  # what the ground carries is a negative mass where it does
            for i in range(2):
                middle = (1.0 - share) * ground.footholds[0, i] + share * ground.footholds[1, i]
                load.point[foot, i] = plan.zmp_reference[i] - middle if ground.is_at_zmp else 0.0
            load.point[foot, 2] = -ground.ankle_height if ground.is_at_zmp else 0.0
            for i in range(3):
                load.wrench[foot, 0, i] = load.wrench[foot, 1, i] = 0.0
        tilted[world] = load
        fill_gravity(plan, ground.gravity, False, tilted[world])


@compiled
def shift_seen(observed: Any, shift: Array, spacing: float) -> None:
    """Shift the plan's ZMP in observations, in place, and its load share with it.

    Args:
        observed: Observations, rows with fields, (n,).
        shift: Of the ZMP, x forward and y left, (n, 2) [m].
        spacing: Distance of the feet [m].
    """
    for world in range(len(observed)):
        shown = observed[world]
        for i in range(2):
            shown.zmp_reference[i] += shift[world, i]
        shown.load_share = shifted_share(shown.load_share, shift[world, 1], spacing)


@compiled
def shifted_shares(observed: Any, planned: Array, period_s: float, shift: Array, spacing: float, found: Array) -> None:
    """Load shares of the right foot at the end of the last control period, under a ZMP that is shifted.

    Args:
        observed: Observations, rows with fields, (n,).
        planned: Shares of the plan, one per control step.
        period_s: Control period [s].
        shift: Of the ZMP, x forward and y left, (n, 2) [m].
        spacing: Distance of the feet [m].
        found: To be filled, (n,).
    """
    for world in range(len(found)):
        row = int(min(max(np.rint(observed[world].clock[0] / period_s) - 1.0, 0.0), len(planned) - 1.0))
        found[world] = shifted_share(planned[row], shift[world, 1], spacing)


@compiled
def shifted_share(share: float, shift_y: float, spacing: float) -> float:
    """Load share of the right foot under a ZMP that is shifted to the left.

    On two feet the feet share the weight by the lever, −p/w of it. Towards single support the foot that stands takes
    over, whose ankle carries the shift, so that the change fades with 4 μ (1 − μ).

    Args:
        share: Planned share μ.
        shift_y: Shift p [m].
        spacing: Distance w of the feet [m].
    """
    shifted = share - 4.0 * share * (1.0 - share) * shift_y / spacing
    if shifted > 1.0:
        return 1.0
    return 0.0 if shifted < 0.0 else shifted


@compiled
def measured_loads(observed: Any, gravity: float, is_level: bool, loads: Any) -> None:
    """Loads by the foot wrenches.

    Args:
        observed: Observations, rows with fields.
        gravity: Its acceleration [m/s²].
        is_level: Whether the pelvis is level, or tilted as the IMU says.
        loads: To be filled, rows of `elastic_env.dynamics.leg_kernels.loads_type`.
    """
    for world in range(len(loads)):
        load, shown = loads[world], observed[world]
        fill_gravity(shown, gravity, is_level, load)
        load.legs_weigh = True
        for foot in range(2):
            load.mass[foot] = 0.0
            for i in range(3):
                load.point[foot, i] = 0.0
                load.wrench[foot, 0, i], load.wrench[foot, 1, i] = shown.wrench[foot, 0, i], shown.wrench[foot, 1, i]


@compiled
def gravities(attitude: Array, gravity: float, found: Array) -> None:
    """Gravity in the frames of pelvises with roll and pitch, (rows, 2) [rad]: into `found`, (rows, 3) [m/s²]."""
    for row in range(len(attitude)):
        found[row, 0], found[row, 1], found[row, 2] = gravity_of(attitude[row, 0], attitude[row, 1], gravity)


@compiled
def fill_gravity(shown: Any, gravity: float, is_level: bool, load: Any) -> None:
    """Gravity in the frame of a pelvis that is level or tilted."""
    load.gravity[0], load.gravity[1], load.gravity[2] = 0.0, 0.0, -gravity
    if not is_level:
        tilted = gravity_of(shown.imu_attitude[0], shown.imu_attitude[1], gravity)
        load.gravity[0], load.gravity[1], load.gravity[2] = tilted


@compiled
def gravity_of(roll: float, pitch: float, gravity: float) -> tuple[float, float, float]:
    """Gravity in the frame of a tilted pelvis [m/s²]."""
    cosine = math.cos(pitch)
    return gravity * math.sin(pitch), -gravity * (cosine * math.sin(roll)), -gravity * (cosine * math.cos(roll))


@compiled
def lead(drives: Any, period_s: float, stiffness: Array, motion: Any, loads: Any, memory: Any, offset: Array) -> None:
    """By how much motors lead under their loads, and the memory after a control period.

    Args:
        drives: Rows of `DRIVE`, one per joint, (n,).
        period_s: Control period [s].
        stiffness: K of the worlds, (worlds, n), or of all, (1, n) [N·m/rad].
        motion: Rates and accelerations of the links, (worlds, n) each [rad/s], [rad/s²].
        loads: Joint torque [N·m], and the deflection at rest under it [rad], (worlds, n) each.
        memory: Deflections, their rates and integrals of the servo errors, (worlds, at least 3 n), before and to be
            filled.
        offset: To be filled, (worlds, n) [rad].
    """
    (q_dot, q_ddot), (torque, settled), (before, now), n = motion, loads, memory, len(drives)
    for world in range(len(offset)):
        K = stiffness[min(world, len(stiffness) - 1)]
        for i in range(n):
            drive, last, load = drives[i], before[world, i], torque[world, i]
            deflection = lagging(last, settled[world, i], drive.damping / K[i], period_s)
            rate = (deflection - last) / period_s
            acceleration = (rate - before[world, n + i]) / period_s
            theta_dot, theta_ddot = q_dot[world, i] + rate, q_ddot[world, i] + acceleration
            effort = drive.rotor_inertia * theta_ddot + load + drive.velocity_gain * theta_dot
            windup, error = 0.0, effort / drive.position_gain
            if drive.integral_gain > 0.0:  # k_p e + k_i ∫e = effort
                time_s = drive.position_gain / drive.integral_gain
                windup = lagging(before[world, 2 * n + i], effort / drive.integral_gain, time_s, period_s)
                error = (effort - drive.integral_gain * windup) / drive.position_gain
            offset[world, i] = deflection + error - 0.5 * period_s * theta_dot  # it is held too early
            now[world, i], now[world, n + i], now[world, 2 * n + i] = deflection, rate, windup


@compiled
def lagging(state: float, target: float, time_constant_s: float, period_s: float) -> float:
    """State of a first-order lag after one period towards a constant target; no lag for a time constant of zero."""
    return target + math.exp(-period_s / time_constant_s) * (state - target)
