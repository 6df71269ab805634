r"""The walking controller: foot force difference control, and feedback of the center of mass from joint angles.

* Foot force difference control [Kajita2010]: the leg that carries too little grows,
  ż = k ((F_l − F_r)_ref − (F_l − F_r)) − z/T, half of z on each side.
* Feedback of the center of mass: the error of the divergent component of motion ξ = c + ċ/ω asks for a ZMP shift
  Δp = k (ξ − ξ_ref), which the ankles produce by winding their springs, Δτ/K.
* Dry friction of the joints that the plan moves is wound against likewise, F/K in the direction of the planned rate;
  F is what an identification found.

Inputs (`baselines.compensation.inputs`) shift the plan's ZMP or center of mass (`baselines.walking.zmp_shift`), add to
the leg length difference, turn the hips, and change the gains. Feedback then refers to the shifted plan.

All are offsets of the joints around the planned walk. Where a joint is, it takes from the encoder columns of the
observation, so that an output compensator around it (`baselines.Compensated`) shows it links instead of motors.

Local frame: at the sole of the step's support foot, level, its place in the plan's world that of the planned foothold,
re-taken at every support change. The center of mass in it follows from joint angles and the attitude of the IMU.

[Kajita2010] S. Kajita et al., "Biped Walking Stabilization Based on Linear Inverted Pendulum Tracking", IROS.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from baselines.compensation.compensation_kernels import shifted_shares
from baselines.compensation.inputs import PolicyInputs
from baselines.compensation.observed import ObservedWalk, Records
from baselines.compensation.policy import Action, ObservationView, PolicyWithInputs, taken_up
from baselines.walking import walking_kernels as kernels
from baselines.walking.zmp_shift import Stances, center_of_mass_per_pelvis, following_share
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array
from elastic_env.dynamics.biped import Biped
from elastic_env.motion.trajectory import STAND_S, minimum_jerk
from elastic_env.runtime.robot_model import WalkerModel


class WalkingGains(Model):
    """Gains of the walking controller."""

    force_difference: float = quantity("m/(N·s)", 8e-4, ge=0, description="leg length difference per force difference")
    force_difference_decay_s: float = quantity("s", 0.5, gt=0, description="time constant of its decay")
    force_difference_limit_m: float = quantity("m", 0.04, gt=0, description="largest difference of the leg lengths")
    dcm: float = quantity("1", 0.4, ge=0, description="ZMP shift per error of the divergent component of motion")
    zmp_limit_m: float = quantity("m", 0.06, gt=0, description="largest ZMP shift")
    velocity_filter_s: float = quantity("s", 0.05, gt=0, description="time constant of the COM velocity")
    zmp_filter_s: float = quantity("s", 0.03, gt=0, description="time constant of the ZMP shift")
    friction_rate_rad_s: float = quantity("rad/s", 0.01, gt=0, description="joint rate at which friction acts in full")
    weight_filter_s: float | None = None
    """Time constant of the weight that is measured [s]. Null takes the assumed weight. A load on the robot then
    shortens the leg that carries it."""


@dataclass(frozen=True)
class LocalFrame:
    """Center of mass and feet as a controller sees them, level and relative to the pelvis, one row per world.

    Attributes:
        com: Center of mass, (num_worlds, 3) [m].
        soles: Middles of the soles, (num_worlds, 2, 3) [m].
    """

    com: Array
    soles: Array

    @property
    def com_from_soles(self) -> Array:
        """Center of mass relative to each sole, (num_worlds, 2, 3) [m]."""
        return self.com[:, None] - self.soles


def local_frame(biped: Biped, q: Array, attitude: Array) -> LocalFrame:
    """Local frame from joint angles, (num_worlds, 12) [rad], and roll and pitch, (num_worlds, 2) [rad]."""
    return LocalFrame(*biped.chains.com_and_feet(q.reshape(len(q), 2, -1), _sole(biped), attitude))


def _sole(biped: Biped) -> Array:
    """Middle of a sole from the ankle, (3,) [m]."""
    return np.array([0.0, 0.0, -biped.ankle_height])


class WalkingController(PolicyWithInputs):
    """Commands a walker around its plan, see the module.

    Memory per world: steps, leg length difference, COM from both soles, deviation of its velocity, ZMP shift,
    shift of the planned COM for the input `zmp` and in all, weight.

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
        self._biped, plan = model.biped, model.plan
        table = model.observation_table
        self._view, self._observed = ObservationView(table, model.control_period_s), ObservedWalk(table)
        self._attitude, steps = table.group("imu_attitude"), max(round(ramp_s / model.control_period_s), 1)
        self._ramp = minimum_jerk(np.arange(steps + 1) / steps)
        self._constants: Any = np.array([_constants(model, com_feedback, gains or WalkingGains())], kernels.CONTROLLER)
        self._plan_rows: Any = np.zeros(plan.num_steps + 1, kernels.PLAN)
        for name in kernels.PLAN.names or ():
            self._plan_rows[name] = getattr(plan, name)
        self._planned_shares, self._period_s = np.ascontiguousarray(plan.share), model.control_period_s
        self._stances, self._sole = Stances.of(model), _sole(self._biped)

    @property
    def inputs(self) -> tuple[str, ...]:
        """See `PolicyWithInputs`."""
        return ("zmp", "com", "leg_length", "hip", "balance_gain")

    def predict_with(
        self,
        observation: Array,
        inputs: PolicyInputs,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,  # noqa: ARG002
    ) -> tuple[Action, Any]:
        """Offsets of the twelve joints [rad], and new state.

        A `deflection` r, which a compensator may hand on, winds the springs by 1 + r times as much.
        """
        rows = self._view.rows(observation)
        n, attitude = len(rows), rows[:, self._attitude]
        com, soles = self._biped.chains.com_and_feet(self._view.theta(rows).reshape(n, 2, 6), self._sole, attitude)
        memory, _ = taken_up(state, episode_start, rows, self._view, lambda: self._begin(LocalFrame(com, soles)))
        kept, action = np.empty(memory.shape), np.empty((n, 12))
        before, now = self._fields(memory), self._fields(kept)
        observed = self._observed.fields(rows)
        seen = observed, com, soles, self._shares(observed, inputs.zmp_shift)
        walk = self._constants, self._plan_rows, *self._stances, self._ramp
        kernels.control(walk, seen, _dense(inputs, n), before, now, action)
        return action.astype(np.float32).reshape((*observation.shape[:-1], action.shape[-1])), (kept, None)

    def link_estimate(self, observation: Array, state: Any) -> Array:  # noqa: ARG002
        """The encoder angles, (..., 12) [rad]: without an output compensator it takes motors for links."""
        rows = self._view.rows(observation)
        return self._view.theta(rows).reshape((*observation.shape[:-1], -1))

    def _begin(self, frame: LocalFrame) -> Array:
        memory = np.zeros((len(frame.com), kernels.MEMORY.itemsize // 8))
        fields = self._fields(memory)
        fields["com"], fields["weight"] = frame.com_from_soles[..., :2], self._biped.weight
        return memory

    def _fields(self, memory: Array) -> Records:
        """Memory, (num_worlds, 15), as rows with fields."""
        return np.ndarray(len(memory), kernels.MEMORY, np.ascontiguousarray(memory))

    def _shares(self, observed: Records, shift: Array | None) -> Array:
        """Load shares of the plan under a ZMP that the inputs shift, (num_worlds,) [1]; (0,) for those of the plan."""
        if shift is None:
            return _NO_SHARES
        shares, spacing = np.empty(len(observed)), self._biped.foot_spacing
        shifted_shares(observed, self._planned_shares, self._period_s, np.ascontiguousarray(shift), spacing, shares)
        return shares


_NO_SHARES: Array = np.empty(0)


def _constants(model: WalkerModel, com_feedback: bool, gains: WalkingGains) -> tuple[Any, ...]:
    """What the kernel needs to know, a row of `CONTROLLER`."""
    biped, stiffness, period_s = model.biped, model.stiffness.reshape(2, 6), model.control_period_s
    values = {
        **gains.model_dump(),
        "period_s": period_s, "is_com_fed_back": com_feedback,
        "thigh": biped.leg.thigh, "shank": biped.leg.shank, "footholds": biped.footholds, "omega": model.plan.omega,
        "weight": biped.weight, "weight_of_feet": biped.weight - biped.chains_above_feet.mass * biped.gravity,
        "ankle_stiffness": stiffness[:, 4:],
        "friction_deflection": model.coulomb_friction.reshape(2, 6) / stiffness,
        "velocity_share": _share(period_s, gains.velocity_filter_s),
        "zmp_share": _share(period_s, gains.zmp_filter_s),
        "following_share": following_share(model.plan.omega, period_s),
        "per_pelvis": center_of_mass_per_pelvis(model),
        "weight_share": 0.0 if gains.weight_filter_s is None else _share(period_s, gains.weight_filter_s),
    }  # fmt: skip
    return tuple(values[name] for name in kernels.CONTROLLER.names or ())


def _dense(inputs: PolicyInputs, num_worlds: int) -> Records:
    """Inputs as rows of `INPUTS`, (num_worlds,)."""
    if inputs.is_empty:
        return _none(num_worlds)
    dense = np.zeros(num_worlds, kernels.INPUTS)
    if inputs.zmp is not None:
        dense["zmp"] = inputs.zmp
    if inputs.com is not None:
        dense["com"] = inputs.com
    if inputs.leg_length is not None:
        dense["leg_length"] = inputs.leg_length[:, 0]
    if inputs.balance_gain is not None:
        dense["balance_gain"] = inputs.balance_gain[:, 0]
    if inputs.hip is not None:
        dense["hip"] = inputs.hip if inputs.hip.ndim == 3 else inputs.hip[:, None]
    if inputs.deflection is not None:
        dense["deflection"] = inputs.deflection.reshape(-1, 2, 6)
    return dense


@lru_cache
def _none(num_worlds: int) -> Records:
    """No inputs, which kernels do not change."""
    return np.zeros(num_worlds, kernels.INPUTS)


def _share(period_s: float, time_constant_s: float) -> float:
    """Share of a step that a first-order filter makes in one period."""
    return 1.0 - float(np.exp(-period_s / time_constant_s))
