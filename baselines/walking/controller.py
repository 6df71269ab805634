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

from dataclasses import dataclass
from typing import Any

import numpy as np
from typing_extensions import override

from baselines.compensation.contact_torque import cosine_and_sine, planned_feet, shifted_shares
from baselines.compensation.filters import filter_share
from baselines.compensation.observation_view import WalkView
from baselines.compensation.policy import BatchPolicy, PolicyInputs, Step
from baselines.compensation.records import Records, record_row, record_rows
from baselines.compensation.startup import feedback_ramp
from baselines.walking.control_kernel import INPUTS, MEMORY, control
from baselines.walking.zmp_shift import (
    Stances,
    center_of_mass_per_pelvis,
    following_share,
    move_pelvis,
)
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array
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
