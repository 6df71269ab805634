r"""Joint torques of a walker on its feet: Eqs. 4 to 6 of the paper, and from foot wrenches.

The paper takes τ_g = J_r^T F_r + J_l^T F_l with Jacobians from the center of mass to the contact
points. A name chooses the contact points, and the links that have mass:

| name | contact | masses |
|---|---|---|
| `com` | at the ZMP, each foot's share at a point of its own (`elastic_env.rigid.contact_force`) | all links |
| `ankle` | at the ankle axes, so that no ankle carries torque | all links |
| `lumped` | at the ankle axes | all in the pelvis; the legs weigh nothing, as in published code |

In single support over its foot, `com` is the exact multibody torque.
"""  # noqa: E501

import math
from typing import Any, Literal, NamedTuple

import numpy as np

from baselines.compensation.compiled_rows import record_row, record_rows
from baselines.compensation.policy import ObservationView, WalkView
from elastic_env.core.compiled import compiled, compiled_part
from elastic_env.core.signals import Array
from elastic_env.motion.walk_plan import WalkPlan
from elastic_env.rigid.leg_chains import LegTorque
from elastic_env.rigid.tree.kernels import Vector, loads_type
from elastic_env.world.robot_model import WalkerModel

ContactMethod = Literal["com", "ankle", "lumped"]


def planned_feet(plan: WalkPlan) -> Any:
    """Planned feet, one row per control step.

    The local frame is that of `elastic_env.motion.walk_plan`.
    """
    between = plan.local.ankles[:, 0, :2] - plan.local.ankles[:, 1, :2]
    spacing = np.hypot(between[:, 0], between[:, 1])
    return record_rows(
        share=plan.share,  # load share of the right foot [1]
        soles=plan.ankles[..., :2],  # their middles in the plan's world frame [m]
        yaw=cosine_and_sine(plan.foot_yaw),
        heading=cosine_and_sine(plan.heading),  # of the pelvis
        across=between / spacing[:, None],  # direction from right to left sole
        spacing=spacing,  # distance of the soles [m]
    )


def cosine_and_sine(angles: Array) -> Array:
    """Cosine and sine of angles, (...) [rad] to (..., 2) [1]."""
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1)


LOADS = loads_type(2)
"""Loads on the legs of a world."""


class ContactGravity:
    """Gravity torque of a walker under the planned load share, by one of the methods of the module.

    Attributes:
        chains: Its legs.
        contact: Weight, contact and period for the kernels, a row, (1,).

    Args:
        model: Assumed walker.
        method: "com", "ankle" or "lumped".
    """

    def __init__(self, model: WalkerModel, method: ContactMethod = "com") -> None:
        biped = model.biped
        self._view = WalkView(model.observation_table)
        self.chains = biped.weightless_chains if method == "lumped" else biped.chains
        self.contact = record_row(
            gravity=biped.gravity,  # [m/s²]
            mass=biped.chains.mass,  # of the robot [kg]
            ankle_height=biped.ankle_height,  # [m]
            period_s=model.control_period_s,
            is_at_zmp=method == "com",  # or at the ankle axes
        )
        self._feet = planned_feet(model.plan)

    def at(self, rows: Array, level: bool = True) -> LegTorque:
        """Gravity torque under the load share of observations.

        Args:
            rows: Observations, (num_worlds, m).
            level: True for a level pelvis, as commanded, False for a tilt as the IMU measures it.
        """
        return self.level_and_tilted(rows)[0 if level else 1]

    def level_and_tilted(self, rows: Array) -> tuple[LegTorque, LegTorque]:
        """Gravity torques of `at` for a level pelvis, and for a tilted one."""
        level = np.empty(len(rows), LOADS)
        tilted = np.empty(len(rows), LOADS)
        planned_loads(self._view.fields(rows), self.contact, self._feet, level, tilted)
        return LegTorque(self.chains, level), LegTorque(self.chains, tilted)


class WrenchTorque:
    """Torque of a walker's joints from foot wrenches and the weight of the legs above the sensors.

    Args:
        model: Assumed walker.
    """

    def __init__(self, model: WalkerModel) -> None:
        self._view = WalkView(model.observation_table)
        self._chains = model.biped.chains_above_feet
        self._gravity = model.biped.gravity

    def at(self, rows: Array, level: bool = False) -> LegTorque:
        """Torque under the wrenches of observations; arguments as `ContactGravity.at`."""
        loads = np.empty(len(rows), LOADS)
        measured_loads(self._view.fields(rows), self._gravity, level, loads)
        return LegTorque(self._chains, loads)


class PlannedTorque:
    """Torque of the planned motion by inverse dynamics, and the static torque of changes of it.

    Changes are offsets of the joints, and a shifted ZMP.

    Args:
        model: Assumed walker.
        gravity: Static torque.
    """

    def __init__(self, model: WalkerModel, gravity: ContactGravity) -> None:
        table = model.observation_table
        plan = model.plan
        self._gravity = gravity
        self._view = ObservationView(model)
        rows = np.zeros((len(plan.q), len(table)))
        rows[:, table.group("clock").start] = plan.timing.time
        rows[:, table.group("zmp_reference")] = plan.zmp
        rows[:, table.group("load_share")] = plan.share[:, None]
        self._dynamic = plan.torque - gravity.at(rows).gravity_torque(plan.q)

    def at(self, rows: Array, gravity: LegTorque | None = None) -> "BoundPlannedTorque":
        """Torque at the control steps of observations, (num_worlds, m).

        `gravity` is the static torque, if known.
        """
        dynamic = self._dynamic.take(self._view.plan_row(rows), axis=0, mode="clip")
        return BoundPlannedTorque(dynamic, gravity or self._gravity.at(rows))


class BoundPlannedTorque(NamedTuple):
    """Torque of a planned control step, with the `inverse_dynamics` of a `RigidBody`."""

    dynamic: Array
    """Torque of the planned motion beyond the static torque, (num_worlds, 12) [N·m]."""
    gravity: LegTorque

    def inverse_dynamics(self, q: Array, q_dot: Array, q_ddot: Array) -> Array:  # noqa: ARG002
        """Torque at joint angles near the plan's, (num_worlds, 12) [rad] to [N·m]."""
        return self.dynamic + self.gravity.gravity_torque(q)


@compiled
def planned_loads(observations: Any, contact: Any, feet: Any, level: Any, tilted: Any) -> None:
    """Fill in loads under the planned load share.

    Args:
        observations: Rows with fields.
        contact: Attribute of `ContactGravity`, a row, (1,).
        feet: Rows of `planned_feet`.
        level: Loads of a pelvis that is level, to be filled, rows of `LOADS`.
        tilted: Loads of a pelvis that is tilted as the IMU measures it, likewise.
    """
    ground = contact[0]
    for world in range(len(level)):
        load = level[world]
        obs = observations[world]
        stance = feet[plan_row(obs, ground.period_s, 0.0, len(feet))]
        fill_gravity(obs, ground.gravity, True, load)
        share = obs.load_share
        x = zmp_from_middle(obs, stance, share, 0)
        y = zmp_from_middle(obs, stance, share, 1)
        for foot in range(2):
            # the ground's force is a negative mass at the contact point
            load.mass[foot] = -ground.mass * (share if foot == 1 else 1.0 - share)
            load.point[foot] = 0.0
            load.wrench[foot] = 0.0
            if ground.is_at_zmp:
                cosine = stance.yaw[foot, 0]
                sine = stance.yaw[foot, 1]
                load.point[foot, 0] = cosine * x + sine * y
                load.point[foot, 1] = cosine * y - sine * x
                load.point[foot, 2] = -ground.ankle_height
        tilted[world] = load
        fill_gravity(obs, ground.gravity, False, tilted[world])


@compiled_part
def zmp_from_middle(obs: Any, stance: Any, share: float, axis: int) -> float:
    """Planned ZMP from the soles' middle weighted by their loads, in the world [m]."""
    left = (1.0 - share) * stance.soles[0, axis]
    middle = left + share * stance.soles[1, axis]
    return obs.zmp_reference[axis] - middle


@compiled_part
def plan_row(obs: Any, period_s: float, periods_ago: float, rows: int) -> int:
    """Row of the plan at the end of the coming control period, or some periods before it."""
    periods = np.rint(obs.clock[0] / period_s)
    return int(min(max(periods - periods_ago, 0.0), rows - 1.0))


@compiled
def measured_loads(observations: Any, gravity: float, is_level: bool, out: Any) -> None:
    """Fill in loads by the foot wrenches.

    Args:
        observations: Rows with fields.
        gravity: Acceleration of gravity [m/s²].
        is_level: True for a level pelvis, False for a tilt as the IMU measures it.
        out: To be filled, rows of `LOADS`.
    """
    for world in range(len(out)):
        load = out[world]
        obs = observations[world]
        fill_gravity(obs, gravity, is_level, load)
        for foot in range(2):
            load.mass[foot] = 0.0
            load.point[foot] = 0.0
            for i in range(3):
                load.wrench[foot, 0, i] = obs.wrench[foot, 0, i]
                load.wrench[foot, 1, i] = obs.wrench[foot, 1, i]


@compiled_part
def fill_gravity(obs: Any, gravity: float, is_level: bool, load: Any) -> None:
    """Fill in gravity in the frame of a level or tilted pelvis."""
    in_pelvis = (0.0, 0.0, -gravity)
    if not is_level:
        in_pelvis = gravity_in_pelvis(obs.imu_attitude[0], obs.imu_attitude[1], gravity)
    for i in range(3):
        load.gravity[i] = in_pelvis[i]


@compiled_part
def gravity_in_pelvis(roll: float, pitch: float, gravity: float) -> Vector:
    """Gravity in the frame of a tilted pelvis [m/s²]."""
    cosine = math.cos(pitch)
    y = -gravity * (cosine * math.sin(roll))
    return gravity * math.sin(pitch), y, -gravity * (cosine * math.cos(roll))


@compiled
def shift_plan(observations: Any, shift: Array, feet: Any, period_s: float) -> None:
    """Shift the plan's ZMP in observations, in place, and its load share with it.

    Args:
        observations: Rows with fields, (n,).
        shift: Shift of the ZMP in the local frame, x forward and y left, (n, 2) [m].
        feet: Rows of `planned_feet`.
        period_s: Control period [s].
    """
    for world in range(len(observations)):
        obs = observations[world]
        stance = feet[plan_row(obs, period_s, 0.0, len(feet))]
        cosine = stance.heading[0]
        sine = stance.heading[1]
        obs.zmp_reference[0] += cosine * shift[world, 0] - sine * shift[world, 1]
        obs.zmp_reference[1] += sine * shift[world, 0] + cosine * shift[world, 1]
        across = shift_across(shift[world], stance)
        obs.load_share = shifted_share(obs.load_share, across, stance.spacing)


@compiled
def shifted_shares(observations: Any, shift: Array, feet: Any, period_s: float, out: Array) -> None:
    """Fill in load shares of the right foot after the last control period, under a shifted ZMP.

    Args:
        observations: Rows with fields, (n,).
        shift: Shift of the ZMP in the local frame, x forward and y left, (n, 2) [m].
        feet: Rows of `planned_feet`.
        period_s: Control period [s].
        out: To be filled, (n,).
    """
    for world in range(len(out)):
        stance = feet[plan_row(observations[world], period_s, 1.0, len(feet))]
        across = shift_across(shift[world], stance)
        out[world] = shifted_share(stance.share, across, stance.spacing)


@compiled_part
def shift_across(shift: Array, stance: Any) -> float:
    """Part of a shift in the local frame from the right foot towards the left one [m]."""
    return shift[0] * stance.across[0] + shift[1] * stance.across[1]


@compiled_part
def shifted_share(share: float, shift: float, spacing: float) -> float:
    """Load share of the right foot under a ZMP that is shifted towards the left one.

    In double support the feet share the weight by their levers: the share changes by −p/w. Towards
    single support the ankle of the standing foot carries the shift, and the change fades with
    4 μ (1 − μ).

    Args:
        share: Planned share μ.
        shift: p [m].
        spacing: Distance w of the feet [m].
    """
    shifted = share - 4.0 * share * (1.0 - share) * shift / spacing
    if shifted > 1.0:
        return 1.0
    return 0.0 if shifted < 0.0 else shifted
