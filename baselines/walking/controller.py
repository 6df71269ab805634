r"""The walking controller: foot forces, and feedback of the center of mass from joint angles.

* Foot force difference control [Kajita2010]: the leg that carries too little grows,
  ż = k ((F_l − F_r)_ref − (F_l − F_r)) − z/T, half of z on each side.
* Feedback of the center of mass: the error of the divergent component of motion ξ = c + ċ/ω gives a
  ZMP shift Δp = k (ξ − ξ_ref). The ankles produce it by winding their springs, Δτ/K.
* Dry friction F of the joints that the plan moves winds the springs too: their motors lead by F/K
  in the direction of the planned rate. F comes from an identification.

Inputs (`baselines.compensation.inputs`) shift the plan's ZMP or center of mass
(`baselines.walking.zmp_shift`), add to the leg length difference, turn the hips, and change the
gains. Feedback then refers to the shifted plan.

All outputs are offsets of the joints around the planned walk. Joint angles come from the encoder
columns of the observation. So an output compensator around it (`baselines.Compensated`) can give it
link angles instead of motor angles.

The local frame is at the sole of the step's support foot, level, with the heading of the pelvis. It
changes at every support change. The center of mass in it follows from joint angles and the attitude
of the IMU. The sole is where the plan has it in its local frame (`elastic_env.motion.walk_plan`).

[Kajita2010] S. Kajita et al., "Biped Walking Stabilization Based on Linear Inverted Pendulum
Tracking", IROS.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from typing_extensions import override

from baselines.compensation.compiled_rows import Records, record_row, record_rows
from baselines.compensation.contact_torque import cosine_and_sine, planned_feet, shifted_shares
from baselines.compensation.filters import filter_share, within
from baselines.compensation.policy import BatchPolicy, PolicyInputs, Step, WalkView
from baselines.compensation.ramp import feedback_ramp
from baselines.walking.zmp_shift import (
    Stances,
    center_of_mass_per_pelvis,
    following_share,
    move_pelvis,
)
from elastic_env.core.compiled import compiled, compiled_part, record_type
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, IntArray
from elastic_env.motion.trajectory import STAND_S
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
    """Center of mass and feet, level and relative to the pelvis, one row per world.

    Attributes:
        com: Center of mass, (num_worlds, 3) [m].
        soles: Middles of the soles, (num_worlds, 2, 3) [m].
    """

    com: Array
    soles: Array


def local_frame(biped: Biped, q: Array, attitude: Array) -> LocalFrame:
    """Local frame from joint angles, (num_worlds, 12) [rad], and roll and pitch [rad]."""
    return LocalFrame(*biped.chains.com_and_feet(q, _sole_center(biped), attitude))


def _sole_center(biped: Biped) -> Array:
    """Middle of a sole in the frame of the ankle, (3,) [m]."""
    return np.array([0.0, 0.0, -biped.ankle_height])


_KERNEL_GAINS = [f for f in WalkingGains.model_fields if not f.endswith("filter_s")]


class WalkingController(BatchPolicy):
    """Commands a walker around its plan, see the module; its memory is rows of `MEMORY`.

    Attributes:
        constants: Assumptions of the controller, and its gains, a row, (1,).
        ramp: Share of the feedback after 0, 1, ... control steps, up to the last one [1].
        plan: The plan in its local frame, one row per control step.

    Args:
        model: Assumed walker.
        com_feedback: True to feed the COM back; force difference control always acts.
        gains: Gains.
        ramp_s: Time in which the feedback grows from zero [s].
    """

    reads_rates = False
    """False: the velocity of the center of mass is the change of its position."""

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
        self.ramp = feedback_ramp(ramp_s, model.control_period_s)
        self.constants = _constants_row(model, com_feedback, gains or WalkingGains())
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
        self._sole = _sole_center(self._biped)

    @override
    def begin(self, rows: Array) -> Records:
        memory = np.zeros(len(rows), MEMORY)
        memory["weight"] = self._biped.weight
        return memory

    @override
    def act(self, rows: Array, memory: Records, inputs: PolicyInputs) -> Step:
        """Act for a control step; an input `deflection` r winds the springs by 1 + r as much."""
        observations = self._walk_view.fields(rows)
        theta = rows[:, self._theta]
        attitude = rows[:, self._attitude]
        com, soles = self._biped.chains.com_and_feet(theta, self._sole, attitude)
        shares = _NO_SHARES
        if (shift := inputs.zmp_shift) is not None:
            shares = np.empty(len(rows))
            shift = np.ascontiguousarray(shift)
            shifted_shares(observations, shift, self._feet, self._period_s, shares)
        action = np.empty((len(rows), 12))
        after = np.empty(len(rows), MEMORY)
        plan_rows = np.empty(len(rows), dtype=np.int64)
        pelvis = np.empty((len(rows), 2))
        is_shifted = control(
            controller=self.constants,
            plan=self.plan,
            ramp=self.ramp,
            observations=observations,
            com=com,
            soles=soles,
            shares=shares,
            inputs=_input_rows(inputs, len(rows)),
            before=memory,
            after=after,
            plan_rows=plan_rows,
            pelvis=pelvis,
            action=action,
        )
        if is_shifted:
            move_pelvis(*self._stances, plan_rows, pelvis, action)
        return action.astype(np.float32), after


_NO_SHARES: Array = np.empty(0)
"""Stands for the plan's load shares where nothing shifts the plan."""


def _constants_row(model: WalkerModel, com_feedback: bool, gains: WalkingGains) -> Any:
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
        **{name: getattr(gains, name) for name in _KERNEL_GAINS},
    )


def _input_rows(inputs: PolicyInputs, num_worlds: int) -> Records:
    """Inputs as rows of `INPUTS`, (num_worlds,); zero where there are none."""
    rows = np.zeros(num_worlds, INPUTS)
    for name in INPUTS.names or ():
        values = getattr(inputs, name)
        if values is not None:
            rows[name] = values.reshape(rows[name].shape)
    return rows


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
