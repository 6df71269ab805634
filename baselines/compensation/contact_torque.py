r"""Joint torques of a walker on its feet: Eqs. 4 to 6 of the paper, and from foot wrenches.

The paper takes τ_g = J_r^T F_r + J_l^T F_l with Jacobians from the center of mass to the contact
points. Where the contact point is, and what of the robot has mass, is chosen by name:

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

from baselines.compensation.policy import ObservationView, WalkView, record_row, record_rows
from elastic_env.core.compiled import compiled, compiled_part
from elastic_env.core.signals import Array
from elastic_env.motion.walk_plan import WalkPlan
from elastic_env.rigid.leg_chains import LegTorque
from elastic_env.rigid.tree.kernels import Vector, loads_type
from elastic_env.world.robot_model import WalkerModel

ContactMethod = Literal["com", "ankle", "lumped"]


def planned_feet(plan: WalkPlan) -> Any:
    """The feet where a plan has them, one row per control step.

    The local frame is that of `elastic_env.motion.walk_plan`.
    """
    between = plan.local.ankles[:, 0, :2] - plan.local.ankles[:, 1, :2]
    spacing = np.hypot(between[:, 0], between[:, 1])
    return record_rows(
        share=plan.share,  # load share of the right foot [1]
        soles=plan.ankles[..., :2],  # their middles in the plan's world frame [m]
        yaw=cosine_and_sine(plan.foot_yaw),
        heading=cosine_and_sine(plan.heading),  # of the pelvis
        across=between / spacing[:, None],  # direction from the right sole to the left one
        spacing=spacing,  # distance of the soles [m]
    )


def cosine_and_sine(angles: Array) -> Array:
    """Both of angles, (...) [rad] to (..., 2) [1]."""
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1)


LOADS = loads_type(2)
"""Loads on the legs of a world."""


class ContactGravity:
    """Gravity torque of a walker under the planned load share, by one of the methods of the module.

    Attributes:
        chains: Its legs.
        contact: How the ground carries the robot, a row, (1,).

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
        """The gravity torque under the load share of observations, (num_worlds, m).

        Args:
            rows: Observations.
            level: Whether the pelvis is level, as commanded, or tilted as the IMU says.
        """
        return self.level_and_tilted(rows)[0 if level else 1]

    def level_and_tilted(self, rows: Array) -> tuple[LegTorque, LegTorque]:
        """The gravity torques of `at` for a level pelvis, and for one tilted as the IMU says."""
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
        """The torque under the wrenches of observations, (num_worlds, m).

        `level` is that of `ContactGravity.at`.
        """
        loads = np.empty(len(rows), LOADS)
        measured_loads(self._view.fields(rows), self._gravity, level, loads)
        return LegTorque(self._chains, loads)


class PlannedTorque:
    """Torque of the planned motion by inverse dynamics, and the static torque of changes of it.

    Changes are offsets of the joints, and a ZMP that is shifted.

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
        self._of_motion = plan.torque - gravity.at(rows).gravity_torque(plan.q)

    def at(self, rows: Array, gravity: LegTorque | None = None) -> "BoundPlannedTorque":
        """The torque at the control steps of observations, (num_worlds, m).

        `gravity` is the static one, if known.
        """
        of_motion = self._of_motion.take(self._view.plan_row(rows), axis=0, mode="clip")
        return BoundPlannedTorque(of_motion, gravity or self._gravity.at(rows))


class BoundPlannedTorque(NamedTuple):
    """Torque of a planned control step; `inverse_dynamics` as that of a `RigidBody`."""

    of_motion: Array
    """What the planned motion adds to the static torque, (num_worlds, 12) [N·m]."""
    gravity: LegTorque

    def inverse_dynamics(self, q: Array, q_dot: Array, q_ddot: Array) -> Array:  # noqa: ARG002
        """Torque at joint angles near the plan's, (num_worlds, 12) [rad] to [N·m]."""
        return self.of_motion + self.gravity.gravity_torque(q)


@compiled
def planned_loads(observed: Any, contact: Any, feet: Any, level: Any, tilted: Any) -> None:
    """Loads under the planned load share.

    Args:
        observed: Observations, rows with fields.
        contact: How the ground carries the robot, a row, (1,).
        feet: Rows of `planned_feet`.
        level: Loads of a pelvis that is level, to be filled, rows of `LOADS`.
        tilted: The same of one that is tilted as the IMU says.
    """
    ground = contact[0]
    for world in range(len(level)):
        load = level[world]
        plan = observed[world]
        stance = feet[row_of_plan(plan, ground.period_s, 0.0, len(feet))]
        fill_gravity(plan, ground.gravity, True, load)
        share = plan.load_share
        x = from_middle(plan, stance, share, 0)
        y = from_middle(plan, stance, share, 1)
        for foot in range(2):
            weight = share if foot == 1 else 1.0 - share
            # what the ground carries is a negative mass where it does
            load.mass[foot] = -ground.mass * weight
            load.point[foot] = 0.0
            load.wrench[foot] = 0.0
            if ground.is_at_zmp:
                cosine = stance.yaw[foot, 0]
                sine = stance.yaw[foot, 1]
                load.point[foot, 0] = cosine * x + sine * y
                load.point[foot, 1] = cosine * y - sine * x
                load.point[foot, 2] = -ground.ankle_height
        tilted[world] = load
        fill_gravity(plan, ground.gravity, False, tilted[world])


@compiled_part
def from_middle(plan: Any, stance: Any, share: float, axis: int) -> float:
    """The planned ZMP from the soles' middle weighted by their loads, in the world [m]."""
    left = (1.0 - share) * stance.soles[0, axis]
    middle = left + share * stance.soles[1, axis]
    return plan.zmp_reference[axis] - middle


@compiled_part
def row_of_plan(observed: Any, period_s: float, periods_ago: float, rows: int) -> int:
    """Row of the plan at the end of the coming control period, or some periods before it."""
    periods = np.rint(observed.clock[0] / period_s)
    return int(min(max(periods - periods_ago, 0.0), rows - 1.0))


@compiled
def measured_loads(observed: Any, gravity: float, is_level: bool, loads: Any) -> None:
    """Loads by the foot wrenches.

    Args:
        observed: Observations, rows with fields.
        gravity: Its acceleration [m/s²].
        is_level: Whether the pelvis is level, or tilted as the IMU says.
        loads: To be filled, rows of `LOADS`.
    """
    for world in range(len(loads)):
        load = loads[world]
        shown = observed[world]
        fill_gravity(shown, gravity, is_level, load)
        for foot in range(2):
            load.mass[foot] = 0.0
            load.point[foot] = 0.0
            for i in range(3):
                load.wrench[foot, 0, i] = shown.wrench[foot, 0, i]
                load.wrench[foot, 1, i] = shown.wrench[foot, 1, i]


@compiled_part
def fill_gravity(shown: Any, gravity: float, is_level: bool, load: Any) -> None:
    """Gravity in the frame of a pelvis that is level or tilted."""
    turned = (0.0, 0.0, -gravity)
    if not is_level:
        roll = shown.imu_attitude[0]
        turned = gravity_in_pelvis(roll, shown.imu_attitude[1], gravity)
    for i in range(3):
        load.gravity[i] = turned[i]


@compiled_part
def gravity_in_pelvis(roll: float, pitch: float, gravity: float) -> Vector:
    """Gravity in the frame of a tilted pelvis [m/s²]."""
    cosine = math.cos(pitch)
    y = -gravity * (cosine * math.sin(roll))
    return gravity * math.sin(pitch), y, -gravity * (cosine * math.cos(roll))


@compiled
def shift_plan(observed: Any, shift: Array, feet: Any, period_s: float) -> None:
    """Shift the plan's ZMP in observations, in place, and its load share with it.

    Args:
        observed: Observations, rows with fields, (n,).
        shift: Of the ZMP in the local frame, x forward and y left, (n, 2) [m].
        feet: Rows of `planned_feet`.
        period_s: Control period [s].
    """
    for world in range(len(observed)):
        shown = observed[world]
        stance = feet[row_of_plan(shown, period_s, 0.0, len(feet))]
        cosine = stance.heading[0]
        sine = stance.heading[1]
        shown.zmp_reference[0] += cosine * shift[world, 0] - sine * shift[world, 1]
        shown.zmp_reference[1] += sine * shift[world, 0] + cosine * shift[world, 1]
        across = shift_across(shift[world], stance)
        shown.load_share = shifted_share(shown.load_share, across, stance.spacing)


@compiled
def shifted_shares(observed: Any, shift: Array, feet: Any, period_s: float, found: Array) -> None:
    """Load shares of the right foot after the last control period, under a shifted ZMP.

    Args:
        observed: Observations, rows with fields, (n,).
        shift: Of the ZMP in the local frame, x forward and y left, (n, 2) [m].
        feet: Rows of `planned_feet`.
        period_s: Control period [s].
        found: To be filled, (n,).
    """
    for world in range(len(found)):
        stance = feet[row_of_plan(observed[world], period_s, 1.0, len(feet))]
        across = shift_across(shift[world], stance)
        found[world] = shifted_share(stance.share, across, stance.spacing)


@compiled_part
def shift_across(shift: Array, stance: Any) -> float:
    """The part of a shift in the local frame from the right foot towards the left one [m]."""
    return shift[0] * stance.across[0] + shift[1] * stance.across[1]


@compiled_part
def shifted_share(share: float, shift: float, spacing: float) -> float:
    """Load share of the right foot under a ZMP that is shifted towards the left one.

    On two feet the feet share the weight by the lever, −p/w of it. Towards single support the foot
    that stands takes over, whose ankle carries the shift, so that the change fades with 4 μ (1 −
    μ).

    Args:
        share: Planned share μ.
        shift: p [m].
        spacing: Distance w of the feet [m].
    """
    shifted = share - 4.0 * share * (1.0 - share) * shift / spacing
    if shifted > 1.0:
        return 1.0
    return 0.0 if shifted < 0.0 else shifted
