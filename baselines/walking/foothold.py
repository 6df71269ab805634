r"""Feet that land as planned: a refined plan, tared foot sensors, corrected footholds.

**Refined walk**: the policy walks a plan of its own, whose ZMP is nearer to the reference.

The plan that the environment shows puts the center of mass of a cart-table under the reference p of
the ZMP. Legs that swing move the ZMP of the whole robot off it, which inverse dynamics tells. That
error passes the preview control once more [Kajita2003], and gives a plan with other joint angles
(`elastic_env.motion.walk_plan.refine_plan`),

.. math:: q_{ref}' = q_{ref} + \Delta q

The policy inside knows the refined plan alone: it sees q_ref' and its derivatives where the
observation has q_ref, and the action is Δq + a, with its own action a.

[Kajita2003] S. Kajita et al., "Biped Walking Pattern Generation by using Preview Control of
Zero-Moment Point", ICRA.

**Foot tare**: foot sensors are set to zero in every swing, as a foot in the air weighs only itself.

Six-axis sensors of feet drift by some newtons while a robot walks. Practice zeroes them where the
load is known: with the foot in the air, the sensor at the ankle carries the foot alone, f = m (g −
a) with the planned acceleration a, and its moment c × f about the ankle. The mean of what it shows
beyond that, over the middle of a swing, is taken off until the next swing of the same foot.

**Foothold correction**: feet land where the plan has them, by the forces that closed legs carry.

A robot on elastic joints puts its foot down beside its foothold: the joints of the standing leg
give way under the load. Encoders and IMU do not show by how much. Once both feet stand, the legs
and the ground close a chain, whose springs pull the feet to where the joints are commanded. The
ground holds the feet apart by friction, so that a landing error e shows as a pair of horizontal
forces,

.. math:: e = p_l - p_r - (p_l - p_r)_{plan} = C \, \tfrac12 (f_l - f_r) + o_l - o_r

with the forces f of the feet on the legs, the compliance C of the closed legs, and the offsets o of
the feet that are commanded, all in the plan's local frame. A foot lands farther forward than its
shear shows, the quicker the load comes on it: e_x has the further term −λ dμ/dt, with the planned
share μ of the load on the right foot. λ was found on robots of bank 1 at step periods of 3, 1.6 and
1.1 s; without it all feet walk forward. The error adds up to where the feet are in the plan's world
frame, from landing to landing,

.. math:: P_{landed} = P_{standing} \pm e

A constant error of e does not add up: left and right take turns, and their signs with them. The
next swing is offset by −P − b, where P is the place of the foot that stands and b the error with
which this foot landed before. The offset is gone once the foot is to carry a quarter of the load
(`return_load`).
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np
from typing_extensions import override

from baselines.compensation.policy import (
    MemoryAround,
    PassingMemory,
    PolicyAround,
    PolicyInputs,
    Step,
    WalkView,
    record_row,
    record_rows,
)
from baselines.walking.zmp_shift import Stances, move_feet
from elastic_env.core.compiled import compiled, compiled_part, record_type
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, IntArray, Mirrored, SignalGroup
from elastic_env.motion.trajectory import derivatives
from elastic_env.motion.walk_plan import refine_plan
from elastic_env.rigid.leg_kinematics import turn
from elastic_env.world.foot_sensors import FootSensors
from elastic_env.world.robot_model import WalkerModel


def refine_model(model: WalkerModel) -> WalkerModel:
    """The assumed walker with its plan refined.

    Raises:
        ElasticError: A foot is out of reach on the refined plan.
    """
    plan = refine_plan(model.plan, model.biped, model.control_period_s)
    return replace(model, plan=plan)


class RefinedWalk(PassingMemory):
    """A policy for the refined plan of a walker, on the plan that the environment shows.

    Args:
        policy: What commands the robot along the refined plan.
        model: Assumed walker, with the plan of the environment.
        further: The same with the plan that the policy knows.
    """

    def __init__(self, policy: Any, model: WalkerModel, further: WalkerModel) -> None:
        super().__init__(policy, model)
        table = model.observation_table
        # angles, rates and accelerations stand side by side
        first = table.group("reference_angle").start
        self._columns = slice(first, table.group("reference_acceleration").stop)
        motions = [np.hstack([p.q, p.q_dot, p.q_ddot]) for p in (model.plan, further.plan)]
        self._change = motions[1] - motions[0]

    @override
    def act(self, rows: Array, memory: Any, inputs: PolicyInputs) -> Step:
        """Its memory is that of the policy inside."""
        row = self.view.plan_row(rows)
        change = self._change.take(row, axis=0, mode="clip")
        seen = rows.copy()
        seen[:, self._columns] += change
        action, memory = self.policy.act(seen, memory, inputs)
        total = action + change[:, : self.view.num_joints]
        return total.astype(np.float32), memory


class FootTareGains(Model):
    """When and how far the foot sensors are set to zero."""

    begin: float = quantity("1", 0.3, gt=0, lt=0.5)
    """Progress of the swing at which the mean begins; it ends as long before landing [1]."""
    first_gain: float = quantity("1", 1.0, ge=0, le=1)
    """Share of the first mean that is taken off [1]."""
    gain: float = quantity("1", 0.5, ge=0, le=1)
    """Share of what is left in every further swing [1]."""


TARE = record_type(
    bias=(2, 2, 3),  # feet, force and moment, axes [N], [N·m]
    total=(2, 3),  # of the samples of this swing
    samples=(),
    swings=(2,),  # of both feet so far
)
"""Memory of the tare."""


class FootTare(PolicyAround):
    """A policy of a walker that sees its foot sensors set to zero, see the module.

    Args:
        policy: What commands the robot.
        model: Assumed walker.
        gains: When and how far.
    """

    memory_type = TARE

    def __init__(self, policy: Any, model: WalkerModel, gains: FootTareGains) -> None:
        super().__init__(policy, model)
        self._walk_view = WalkView(model.observation_table)
        self._gains = record_row(period_s=model.control_period_s, **gains.model_dump())
        self._unloaded = unloaded_wrench(model)

    @override
    def act(self, rows: Array, memory: MemoryAround, inputs: PolicyInputs) -> Step:
        rows = rows.copy()
        tare = memory.own.copy()
        observed = self._walk_view.fields(rows)
        tare_feet(self._gains, self._unloaded, observed, tare)
        action, inner = self.policy.act(rows, memory.inner, inputs)
        return action, MemoryAround(tare, inner)


def unloaded_wrench(model: WalkerModel) -> Array:
    """Force and moment that feet in the air leave at level ankles by plan, (T, 2, 2, 3).

    Feet, force [N] and moment [N·m], axes in the frames of the feet.
    """
    biped = model.biped
    sensors = FootSensors.of_biped(biped)
    _, acceleration = derivatives(model.plan.ankles, model.control_period_s)
    mass = biped.rigid.body_mass[biped.feet]
    in_feet = turn(acceleration, -model.plan.foot_yaw)
    force = sensors.weight - mass[:, None] * in_feet
    return np.stack([force, np.cross(sensors.com, force)], axis=2)


@compiled
def tare_feet(gains: Any, unloaded: Array, observed: Any, memory: Any) -> None:
    """Take the bias off the wrenches of observations, in place, and keep the memory.

    Args:
        gains: Gains and the control period, a row, (1,).
        unloaded: As of `unloaded_wrench`.
        observed: Observations, rows with fields, (n,).
        memory: Rows of `TARE`, brought up to date, (n,).
    """
    rules = gains[0]
    for world in range(len(memory)):
        shown = observed[world]
        own = memory[world]
        foot = 1 - int(shown.clock[2])
        progress = shown.clock[1]
        if rules.begin < progress < 1.0 - rules.begin:
            # measured at the end of the last period
            row = int(np.rint(shown.clock[0] / rules.period_s)) - 1
            expected = unloaded[min(max(row, 0), len(unloaded) - 1), foot]
            for part in range(2):
                for i in range(3):
                    beyond = shown.wrench[foot, part, i] - expected[part, i]
                    own.total[part, i] += beyond
            own.samples += 1.0
        elif own.samples > 0.0:
            share = rules.gain if own.swings[foot] > 0.0 else rules.first_gain
            own.swings[foot] += 1.0
            for part in range(2):
                for i in range(3):
                    mean = own.total[part, i] / own.samples
                    own.bias[foot, part, i] += share * (mean - own.bias[foot, part, i])
                    own.total[part, i] = 0.0
            own.samples = 0.0
        for side in range(2):
            for part in range(2):
                for i in range(3):
                    shown.wrench[side, part, i] -= own.bias[side, part, i]


class FootholdGains(Model):
    """Gains of the foothold correction."""

    compliance_m_n: float = quantity("m/N", 4.4e-4, gt=0)
    """Compliance C of the closed legs, forward and sideways [m/N]."""
    first_gain: float = quantity("1", 0.8, ge=0, le=1)
    """Share of its first landing error that a foot learns [1]."""
    gain: float = quantity("1", 0.4, ge=0, le=1)
    """Share of every further one [1]."""
    begin: float = quantity("1", 0.1, ge=0, lt=0.5)
    """Progress of the swing at which the foot begins to be moved; it ends as long before landing
    [1]."""
    limit_m: float = quantity("m", 0.04, gt=0, le=0.05)
    """Largest offset of a foot forward and sideways [m]."""
    load_rate_m_s: float = quantity("m·s", 2e-4, ge=0)
    """Forward landing error λ that the shear does not show, over the rate of the load share [m·s].
    """
    return_load: float = quantity("1", 0.25, gt=0, le=1)
    """Share of the load on a foot that has landed at which its offset is gone [1]."""


FOOTHOLDS = record_type(
    place=(2, 2),  # of the feet against the plan, in the world [m]
    bias=(2, 2),  # error with which they land [m]
    landed=(2, 2),  # error of their last landings [m]
    landings=(2,),
    target=(2, 2),  # offset with which they land [m]
    offset=(2, 2),  # commanded now [m]
    total=(2,),  # of the errors e since the last landing [m]
    samples=(),
    swing=(),  # foot in the air, -1 for none
)
"""Memory of the foothold correction."""


OF_FEET: dict[str, Mirrored | None] = {
    "l_x": "same",
    "l_y": "opposite",
    "r_x": "same",
    "r_y": "opposite",
}
"""Vectors of both feet in the plane, and what they are in the mirror."""
# the mirror changes left and right: of their difference x turns round, and y stays
_OF_BOTH: dict[str, Mirrored | None] = {"x": "opposite", "y": "same"}
_KNOWN = {
    name: SignalGroup.of(name, "m", meaning, parts, kind=None).signals
    for name, meaning, parts in (
        ("feet", "displacement {part} of a foot against the plan", OF_FEET),
        ("landing", "error {part} of a foot's last landing", OF_FEET),
        ("shear", "{part} of the landing error by the shear of both feet so far", _OF_BOTH),
    )
}
"""What the correction knows, in the plan's local frame; `shear` is zero before both feet carry."""


class FootholdCorrection(PolicyAround):
    """A policy of a walker whose feet land where they are planned, see the module.

    Args:
        policy: What commands the robot.
        model: Assumed walker.
        gains: Gains.
    """

    memory_type = FOOTHOLDS

    def __init__(self, policy: Any, model: WalkerModel, gains: FootholdGains) -> None:
        super().__init__(policy, model)
        self._walk_view = WalkView(model.observation_table)
        self._stances = Stances.of(model)
        self._gains = record_row(period_s=model.control_period_s, **gains.model_dump())
        plan = model.plan
        rate = derivatives(plan.share, model.control_period_s)[0]
        self._plan = record_rows(heading=plan.heading, foot_yaw=plan.foot_yaw, share_dot=rate)
        self.estimates = {**self.policy.estimates, **_KNOWN}

    @override
    def begin(self, rows: Array) -> MemoryAround:
        memory = super().begin(rows)
        memory.own["swing"] = -1.0
        return memory

    @override
    def estimate(self, name: str, rows: Array, memory: MemoryAround) -> Array:
        own = memory.own
        if name == "feet":
            heading = self._plan["heading"].take(self.view.plan_row(rows), mode="clip")
            return turn(own["place"], -heading[:, None]).reshape(len(rows), 4)
        if name == "landing":
            return own["landed"].reshape(len(rows), 4)
        if name == "shear":
            return own["total"] / np.maximum(own["samples"], 1.0)[:, None]
        return super().estimate(name, rows, memory)

    @override
    def act(self, rows: Array, memory: MemoryAround, inputs: PolicyInputs) -> Step:
        action, inner = self.policy.act(rows, memory.inner, inputs)
        observed = self._walk_view.fields(rows)
        now = memory.own.copy()
        coming: IntArray = np.empty(len(rows), dtype=np.int64)
        correct_footholds(self._gains, self._plan, observed, now, coming)
        total = action.astype(np.float64)
        move_feet(*self._stances, coming, np.ascontiguousarray(now["offset"]), total)
        return total.astype(np.float32), MemoryAround(now, inner)


@compiled
def correct_footholds(gains: Any, plan: Any, observed: Any, memory: Any, coming: IntArray) -> None:
    """Offsets of the feet and the memory after a control step.

    Args:
        gains: Gains and the control period, a row, (1,).
        plan: Headings of the pelvis and of the feet [rad], rate of the load share [1/s], one row
            per control step.
        observed: Observations, rows with fields, (n,).
        memory: Rows of `FOOTHOLDS`, brought up to date, (n,).
        coming: Rows of the plan at the end of the control period, to be filled, (n,).
    """
    rules = gains[0]
    for world in range(len(memory)):
        shown = observed[world]
        own = memory[world]
        row = min(int(np.rint(shown.clock[0] / rules.period_s)), len(plan) - 1)
        planned = plan[row]
        coming[world] = row
        progress = shown.clock[1]
        support = int(shown.clock[2])
        # the foot that swings, and in double support the one that has landed last
        foot = support if progress <= 0.0 else 1 - support
        if 0.0 < progress < 1.0:
            if own.swing < 0.0:
                lift(rules, planned, own, foot)
            aim(rules, planned, own, foot)
            share = blend((progress - rules.begin) / (1.0 - 2.0 * rules.begin))
        else:
            own.swing = -1.0
            feel_landing(rules, planned, shown, own)
            unloaded = shown.load_share if foot == 0 else 1.0 - shown.load_share
            share = max((unloaded - (1.0 - rules.return_load)) / rules.return_load, 0.0)
        for i in range(2):
            own.offset[1 - foot, i] = 0.0
            own.offset[foot, i] = share * own.target[foot, i]


@compiled_part
def feel_landing(rules: Any, planned: Any, shown: Any, own: Any) -> None:
    """Add the present error of the feet's distance, where both carry the robot."""
    if 0.25 < shown.load_share < 0.75:
        left = shown.wrench[0, 0]
        right = shown.wrench[1, 0]
        left_x, left_y = rotate(left[0], left[1], planned.foot_yaw[0] - planned.heading)
        right_x, right_y = rotate(right[0], right[1], planned.foot_yaw[1] - planned.heading)
        shear = (0.5 * (left_x - right_x), 0.5 * (left_y - right_y))
        own.total[0] -= rules.load_rate_m_s * planned.share_dot
        for i in range(2):
            commanded = own.offset[0, i] - own.offset[1, i]
            own.total[i] += rules.compliance_m_n * shear[i] + commanded
        own.samples += 1.0


@compiled_part
def lift(rules: Any, planned: Any, own: Any, foot: int) -> None:
    """Take the landing of the standing foot into account, as the other one lifts off."""
    standing = 1 - foot
    sign = 1.0 if standing == 0 else -1.0
    own.swing = foot
    if own.samples > 0.0 and own.landings[0] + own.landings[1] > 0.0:
        gain = rules.gain if own.landings[standing] > 1.0 else rules.first_gain
        error_x = sign * own.total[0] / own.samples
        error_y = sign * own.total[1] / own.samples
        moved = rotate(error_x, error_y, planned.heading)
        for i, error in enumerate((error_x, error_y)):
            own.place[standing, i] = own.place[foot, i] + moved[i]
            own.landed[standing, i] = error
            missed = error - own.target[standing, i] - own.bias[standing, i]
            own.bias[standing, i] += gain * missed
    own.landings[foot] += 1.0
    own.samples = 0.0
    for i in range(2):
        own.total[i] = 0.0


@compiled_part
def aim(rules: Any, planned: Any, own: Any, foot: int) -> None:
    """Offset with which the foot in the air is to land."""
    standing = own.place[1 - foot]
    back = rotate(-standing[0], -standing[1], -planned.heading)
    for i in range(2):
        wanted = back[i] - own.bias[foot, i]
        own.target[foot, i] = min(max(wanted, -rules.limit_m), rules.limit_m)


@compiled_part
def rotate(x: float, y: float, angle: float) -> tuple[float, float]:
    """A vector turned about the vertical, to the left [rad]."""
    cosine = math.cos(angle)
    sine = math.sin(angle)
    return cosine * x - sine * y, sine * x + cosine * y


@compiled_part
def blend(s: float) -> float:
    """Minimum-jerk blend from 0 to 1, s clipped to [0, 1]."""
    s = min(max(s, 0.0), 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
