r"""The walking controller: foot forces, and feedback of the center of mass from joint angles.

* Foot force difference control [Kajita2010]: the leg that carries too little grows,
  ż = k ((F_l − F_r)_ref − (F_l − F_r)) − z/T, half of z on each side.
* Feedback of the center of mass: the error of the divergent component of motion ξ = c + ċ/ω asks
  for a ZMP shift Δp = k (ξ − ξ_ref), which the ankles produce by winding their springs, Δτ/K.
* Dry friction of the joints that the plan moves is wound against likewise, F/K in the direction of
  the planned rate; F is what an identification found.

Inputs (`baselines.compensation.inputs`) shift the plan's ZMP or center of mass
(`baselines.walking.zmp_shift`), add to the leg length difference, turn the hips, and change the
gains. Feedback then refers to the shifted plan.

All are offsets of the joints around the planned walk. Where a joint is, it takes from the encoder
columns of the observation, so that an output compensator around it (`baselines.Compensated`) shows
it links instead of motors.

Local frame: at the sole of the step's support foot, level, with the heading of the pelvis, re-taken
at every support change. The center of mass in it follows from joint angles and the attitude of the
IMU. The sole stands where the plan has it in its local frame (`elastic_env.motion.walk_plan`).

[Kajita2010] S. Kajita et al., "Biped Walking Stabilization Based on Linear Inverted Pendulum
Tracking", IROS.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from typing_extensions import override

from baselines.compensation.contact_torque import cosine_and_sine, planned_feet, shifted_shares
from baselines.compensation.policy import (
    NO_INPUTS,
    ONE_WORLD,
    BatchPolicy,
    PolicyInputs,
    Records,
    Step,
    WalkView,
    filter_share,
    record_row,
    record_rows,
)
from baselines.walking.zmp_shift import (
    Stances,
    center_of_mass_per_pelvis,
    following_share,
    move_pelvis,
)
from elastic_env.core.compiled import compiled, compiled_part, record_type
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, IntArray
from elastic_env.motion.trajectory import STAND_S, minimum_jerk
from elastic_env.rigid.biped import Biped
from elastic_env.world.robot_model import WalkerModel


class WalkingGains(Model):
    """Gains of the walking controller."""

    force_difference: float = quantity("m/(N·s)", 8e-4, ge=0)
    """Leg length difference per force difference [m/(N·s)]."""
    force_difference_decay_s: float = quantity("s", 0.5, gt=0)
    """Time constant of its decay [s]."""
    force_difference_limit_m: float = quantity("m", 0.04, gt=0)
    """Largest difference of the leg lengths [m]."""
    dcm: float = quantity("1", 0.4, ge=0)
    """ZMP shift per error of the divergent component of motion [1]."""
    zmp_limit_m: float = quantity("m", 0.06, gt=0)
    """Largest ZMP shift [m]."""
    velocity_filter_s: float = quantity("s", 0.05, gt=0)
    """Time constant of the COM velocity [s]."""
    zmp_filter_s: float = quantity("s", 0.03, gt=0)
    """Time constant of the ZMP shift [s]."""
    friction_rate_rad_s: float = quantity("rad/s", 0.01, gt=0)
    """Joint rate at which friction acts in full [rad/s]."""
    weight_filter_s: float | None = quantity("s", None, gt=0)
    """Time constant of the weight that is measured [s]. Null takes the assumed weight. A load on
    the robot then shortens the leg that carries it."""


@dataclass(frozen=True)
class LocalFrame:
    """Center of mass and feet for a controller, level and relative to the pelvis, a row per world.

    Attributes:
        com: Center of mass, (num_worlds, 3) [m].
        soles: Middles of the soles, (num_worlds, 2, 3) [m].
    """

    com: Array
    soles: Array


def local_frame(biped: Biped, q: Array, attitude: Array) -> LocalFrame:
    """Local frame from joint angles, (num_worlds, 12) [rad], and roll and pitch [rad]."""
    return LocalFrame(*biped.chains.com_and_feet(q, _sole(biped), attitude))


def _sole(biped: Biped) -> Array:
    """Middle of a sole from the ankle, (3,) [m]."""
    return np.array([0.0, 0.0, -biped.ankle_height])


_GAINS = [name for name in WalkingGains.model_fields if not name.endswith("filter_s")]
MEMORY = record_type(
    steps=(),
    difference=(),  # of the leg lengths [m]
    com=(2, 2),  # from both soles [m]
    velocity=(2,),  # its deviation from the plan [m/s]
    shift=(2,),  # of the ZMP [m]
    following=(2,),  # shift of the planned center of mass for the input `zmp` [m]
    planned=(2,),  # that shift in all [m]
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
"""Inputs from outside; zeros are as if there were none, to the last bit."""


class WalkingController(BatchPolicy):
    """Commands a walker around its plan, see the module; its memory is rows of `MEMORY`.

    Attributes:
        constants: Assumptions of the controller, and its gains, a row, (1,).
        ramp: Share of the feedback after 0, 1, ... control steps, up to the last one [1].
        plan: The plan in its local frame, one row per control step.

    Args:
        model: Assumed walker.
        com_feedback: Whether the COM is fed back; force difference control always acts.
        gains: Gains.
        ramp_s: Time in which the feedback grows from zero [s].
    """

    reads_rates = False
    """It needs no joint rates: the velocity of the center of mass is the change of its position."""

    def __init__(
        self,
        model: WalkerModel,
        com_feedback: bool = True,
        gains: WalkingGains | None = None,
        ramp_s: float = STAND_S,
    ) -> None:
        super().__init__(model)
        self.inputs = ("zmp", "com", "leg_length", "hip", "balance_gain")
        table = model.observation_table
        self._biped = model.biped
        self._walk_view = WalkView(table)
        self._attitude = table.group("imu_attitude")
        self._theta = table.group("encoder_angle")
        steps = max(round(ramp_s / model.control_period_s), 1)
        self.ramp = minimum_jerk(np.arange(steps + 1) / steps)
        self.constants = _constants(model, com_feedback, gains or WalkingGains())
        plan = model.plan
        local = plan.local
        self.plan = record_rows(
            share=plan.share,  # load share of the right foot [1]
            com=local.com,  # center of mass [m]
            com_dot=local.com_dot,  # against the feet that stand [m/s]
            soles=local.ankles[..., :2],  # their middles [m]
            foot_yaw=cosine_and_sine(local.foot_yaw),
        )
        self._feet = planned_feet(plan)
        self._period_s = model.control_period_s
        self._stances = Stances.of(model)
        self._sole = _sole(self._biped)

    @override
    def begin(self, rows: Array) -> Records:
        memory = np.zeros(len(rows), MEMORY)
        memory["weight"] = self._biped.weight
        return memory

    @override
    def act(self, rows: Array, memory: Records, inputs: PolicyInputs) -> Step:
        """With a `deflection` r, handed on by a compensator, springs are wound by 1 + r as much."""
        observed = self._walk_view.fields(rows)
        theta = rows[:, self._theta]
        attitude = rows[:, self._attitude]
        com, soles = self._biped.chains.com_and_feet(theta, self._sole, attitude)
        shares = _NO_SHARES
        if (shift := inputs.zmp_shift) is not None:
            shares = np.empty(len(rows))
            shift = np.ascontiguousarray(shift)
            shifted_shares(observed, shift, self._feet, self._period_s, shares)
        action = np.empty((len(rows), 12))
        now = np.empty(len(rows), MEMORY)
        coming = np.empty(len(rows), dtype=np.int64)
        pelvis = np.empty((len(rows), 2))
        is_moved = control(
            controller=self.constants,
            plan=self.plan,
            ramp=self.ramp,
            observed=observed,
            com=com,
            soles=soles,
            shares=shares,
            inputs=_dense(inputs, len(rows)),
            before=memory,
            now=now,
            coming=coming,
            pelvis=pelvis,
            action=action,
        )
        if is_moved:
            move_pelvis(*self._stances, coming, pelvis, action)
        return action.astype(np.float32), now


_NO_SHARES: Array = np.empty(0)
"""Load shares of a plan that nothing shifts."""


def _constants(model: WalkerModel, com_feedback: bool, gains: WalkingGains) -> Any:
    """Assumptions and gains for the kernel, a row, (1,)."""
    biped = model.biped
    stiffness = model.stiffness.reshape(2, 6)
    period_s = model.control_period_s
    return record_row(
        period_s=period_s,
        is_com_fed_back=com_feedback,
        thigh=biped.leg.thigh,  # [m]
        shank=biped.leg.shank,  # [m]
        weight=biped.weight,  # of the robot [N]
        weight_of_feet=biped.weight - biped.chains_above_feet.mass * biped.gravity,  # [N]
        omega=model.plan.omega,  # of the pendulum [rad/s]
        following_share=following_share(model.plan.omega, period_s),
        per_pelvis=center_of_mass_per_pelvis(model),
        ankle_stiffness=stiffness[:, 4:],  # pitch and roll of the legs [N·m/rad]
        friction_deflection=model.coulomb_friction.reshape(2, 6) / stiffness,  # [rad]
        velocity_share=filter_share(period_s, gains.velocity_filter_s),
        zmp_share=filter_share(period_s, gains.zmp_filter_s),
        weight_share=filter_share(period_s, gains.weight_filter_s or np.inf),
        **{name: getattr(gains, name) for name in _GAINS},
    )


def _dense(inputs: PolicyInputs, num_worlds: int) -> Records:
    """Inputs as rows of `INPUTS`, (num_worlds,)."""
    dense = np.zeros(num_worlds, INPUTS)
    if inputs is NO_INPUTS or inputs is ONE_WORLD:
        return dense
    for name in INPUTS.names or ():
        values = getattr(inputs, name)
        if values is not None:
            dense[name] = values.reshape(dense[name].shape)
    return dense


@compiled
def control(
    controller: Any,
    plan: Any,
    ramp: Array,
    observed: Any,
    com: Array,
    soles: Array,
    shares: Array,
    inputs: Any,
    before: Any,
    now: Any,
    coming: IntArray,
    pelvis: Array,
    action: Array,
) -> bool:
    """Offsets of the joints, and the memory after a control step; whether the pelvis is shifted.

    Args:
        controller: Assumptions and gains, a row, (1,).
        plan: The plan in its local frame, one row per control step.
        ramp: Share of the feedback after 0, 1, ... control steps, up to the last one [1].
        observed: Observations, rows with fields, (n,).
        com: Center of mass in a level frame, (n, 3) [m].
        soles: Middles of the soles in the same, (n, 2, 3) [m].
        shares: Load shares of the right foot, (n,), or none to take those of the plan, (0,).
        inputs: Rows of `INPUTS`, (n,).
        before: Rows of `MEMORY`, (n,).
        now: The same after the control step, to be filled.
        coming: Rows of the plan at the end of the control period, to be filled, (n,).
        pelvis: Shift of the planned pelvis, to be filled, (n, 2) [m].
        action: To be filled, (n, 12) [rad].
    """
    constants = controller[0]
    is_shifted = False
    for world in range(len(now)):
        shown = observed[world]
        own = now[world]
        last = before[world]
        given = inputs[world]
        periods = np.rint(shown.clock[0] / constants.period_s)
        row = int(min(max(periods - 1.0, 0.0), len(plan) - 1.0))
        coming[world] = min(row + 1, len(plan) - 1)
        planned = plan[row]
        own.steps = last.steps + 1.0
        ramped = ramp[int(min(own.steps, len(ramp) - 1.0))]
        following = constants.following_share
        for i in range(2):
            own.following[i] = follow_zmp(last.following[i], given.zmp[i], following)
            own.planned[i] = ramped * (own.following[i] + given.com[i])
            pelvis[world, i] = own.planned[i] / constants.per_pelvis[i]
            is_shifted = is_shifted or own.planned[i] != 0.0
        weigh(constants, shown, last, own)
        share = planned.share if len(shares) == 0 else shares[world]
        balance_feet(constants, shown, share, given.balance_gain, last, own)
        for foot in range(2):
            for i in range(2):
                own.com[foot, i] = com[world, i] - soles[world, foot, i]
        follow_com(constants, shown, planned, given.balance_gain, last, own)
        for leg in range(2):
            offset_leg(constants, shown, planned, given, own, leg, ramped, action[world])
    return is_shifted


@compiled_part
def follow_zmp(center: float, zmp: float, share: float) -> float:
    """The center of mass a period later, under a ZMP shift that stays as it is.

    See `baselines.walking.zmp_shift`.
    """
    return center + share * (zmp - center)


@compiled_part
def weigh(controller: Any, shown: Any, last: Any, own: Any) -> None:
    """The weight as the feet show it, filtered; a share of zero keeps it."""
    of_soles = vertical_force(shown, 0) + vertical_force(shown, 1)
    load = of_soles + controller.weight_of_feet
    own.weight = last.weight
    if controller.weight_share > 0.0:
        own.weight = last.weight + controller.weight_share * (load - last.weight)


@compiled_part
def vertical_force(shown: Any, foot: int) -> float:
    """Along the normal of a sole, which is nearly vertical [N]."""
    return shown.wrench[foot, 0, 2]


@compiled_part
def balance_feet(
    controller: Any, shown: Any, share: float, change: float, last: Any, own: Any
) -> None:
    """Left minus right leg length: what the force difference lacks, integrated with a leak [m]."""
    gain = (1.0 + change) * controller.force_difference
    desired = (1.0 - 2.0 * share) * own.weight
    missing = desired - (vertical_force(shown, 0) - vertical_force(shown, 1))
    decay = last.difference / controller.force_difference_decay_s
    difference = last.difference + controller.period_s * (gain * missing - decay)
    own.difference = within(difference, controller.force_difference_limit_m)


@compiled_part
def follow_com(
    controller: Any, shown: Any, planned: Any, change: float, last: Any, own: Any
) -> None:
    """Filtered deviation of the COM velocity from the plan [m/s], and ZMP shift [m]."""
    support = int(shown.clock[2])
    for i in range(2):
        own.velocity[i] = last.velocity[i]
        own.shift[i] = last.shift[i]
        if controller.is_com_fed_back:
            now = own.com[support, i] - own.planned[i]
            com = last.com[support, i] if last.steps > 0.0 else own.com[support, i]
            before = com - last.planned[i]
            deviation = now + planned.soles[support, i] - planned.com[i]
            deviating = (now - before) / controller.period_s - planned.com_dot[i]
            further = deviating - last.velocity[i]
            own.velocity[i] = last.velocity[i] + controller.velocity_share * further
            error = deviation + own.velocity[i] / controller.omega
            gain = (1.0 + change) * controller.dcm
            wanted = within(gain * error, controller.zmp_limit_m)
            missing = wanted - last.shift[i]
            own.shift[i] = last.shift[i] + controller.zmp_share * missing


@compiled_part
def offset_leg(
    controller: Any,
    shown: Any,
    planned: Any,
    given: Any,
    own: Any,
    leg: int,
    ramp: float,
    out: Array,
) -> None:
    """Offsets of a leg's joints [rad].

    They hold its length, the torque of the ZMP shift, what is added, and friction.
    """
    first = 6 * leg
    sign = 1.0 - 2.0 * leg
    difference = own.difference + given.leg_length
    bent = shown.reference_angle[first + 3]
    hip, knee, ankle = lengthening(controller, bent, difference, sign)
    share = shown.load_share if leg == 1 else 1.0 - shown.load_share
    carried = share * controller.weight
    cosine = planned.foot_yaw[leg, 0]
    sine = planned.foot_yaw[leg, 1]
    ahead = cosine * own.shift[0] + sine * own.shift[1]  # in the frame of the foot
    aside = cosine * own.shift[1] - sine * own.shift[0]
    pitch = carried * ahead / controller.ankle_stiffness[leg, 0]
    roll = -carried * aside / controller.ankle_stiffness[leg, 1]
    for i in range(6):
        wound = 1.0 + given.deflection[leg, i]
        moved = 0.0
        if i == 1:
            moved = given.hip[0]
        elif i == 2:
            moved = hip + given.hip[1]
        elif i == 3:
            moved = knee
        elif i == 4:
            moved = ankle + wound * pitch
        elif i == 5:
            moved = wound * roll
        rate = shown.reference_rate[first + i] / controller.friction_rate_rad_s
        friction = controller.friction_deflection[leg, i] * math.tanh(rate)
        out[first + i] = ramp * moved + wound * friction


@compiled_part
def lengthening(
    controller: Any, knee: float, difference: float, sign: float
) -> tuple[float, float, float]:
    """Offsets of hip pitch, knee and ankle pitch that lengthen a leg by half of a difference [rad].

    The ankle stays on the line from the hip, and the sole keeps its attitude.
    """
    thigh = controller.thigh
    shank = controller.shank
    distance = math.sqrt(thigh**2 + shank**2 + 2.0 * thigh * shank * math.cos(knee))
    bend = -distance / (thigh * shank * math.sin(knee)) * (0.5 * sign * difference)
    at_hip = -bend * shank * (shank + thigh * math.cos(knee)) / distance**2
    return at_hip, bend, -bend - at_hip


@compiled_part
def within(value: float, limit: float) -> float:
    """A value within ±limit; what is no number stays so."""
    if value > limit:
        return limit
    return -limit if value < -limit else value
