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
from typing import Any

import numpy as np

from baselines.compensation.inputs import PolicyInputs, shifted_share
from baselines.compensation.policy import Action, ObservationView, PolicyWithInputs, taken_up
from baselines.walking.posture import hip_offsets
from baselines.walking.zmp_shift import center_of_mass_following, center_of_mass_per_pelvis, pelvis_shift_offsets
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, IntArray
from elastic_env.dynamics.biped import Biped
from elastic_env.dynamics.contact_force import shares
from elastic_env.dynamics.leg_kinematics import rotation_of_tilt
from elastic_env.motion.gait import LEFT, RIGHT
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
    """Time constant with which the weight is measured that the force difference is a share of [s]; None takes the
    assumed weight, with which a load on the robot shortens the leg that carries it."""


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
    com, soles = biped.chains.com_and_feet(q.reshape(len(q), 2, -1), (0.0, 0.0, -biped.ankle_height))
    R = rotation_of_tilt(attitude)
    return LocalFrame((R @ com[..., None])[..., 0], soles @ R.swapaxes(-1, -2))


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
        self._model, self._biped, self._plan = model, model.biped, model.plan
        self._com_feedback, self._gains = com_feedback, gains or WalkingGains()
        table = model.observation_table
        self._view = ObservationView(table, model.control_period_s)
        self._attitude, self._wrench = table.group("imu_attitude"), table.group("wrench")
        self._clock, self._share = table.group("clock"), table.group("load_share")
        self._dt = model.control_period_s
        self._ramp_steps = max(round(ramp_s / self._dt), 1)
        stiffness = model.stiffness.reshape(2, 6)
        self._ankle_stiffness = stiffness[:, 4:]
        self._weight_of_feet = self._biped.weight - self._biped.chains_above_feet.mass * self._biped.gravity
        self._per_pelvis = center_of_mass_per_pelvis(model)
        self._friction_deflection = model.coulomb_friction / model.stiffness

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
        frame = local_frame(self._biped, self._view.theta(rows), rows[:, self._attitude])
        memory, _ = taken_up(state, episode_start, rows, self._view, lambda: self._begin(frame))
        steps, z, last, velocity, shift, planned, weight = np.split(memory, [1, 2, 6, 8, 10, 14], axis=1)
        steps = steps + 1.0
        share = np.ones_like(steps) if (steps >= self._ramp_steps).all() else minimum_jerk(steps / self._ramp_steps)
        row = np.clip(np.round(rows[:, self._clock][:, 0] / self._dt).astype(np.int64) - 1, 0, self._plan.num_steps)
        if self._gains.weight_filter_s is not None:
            load = self._vertical_forces(rows).sum(axis=1, keepdims=True) + self._weight_of_feet
            weight = weight + _share(self._dt, self._gains.weight_filter_s) * (load - weight)
        z = self._leg_difference(rows, row, z, weight, inputs)
        coms, before = frame.com_from_soles[..., :2], planned[:, 2:]
        planned = self._planned_shift(inputs, planned, share)
        if self._com_feedback:
            seen = coms - planned[:, None, 2:], last.reshape(coms.shape) - before[:, None]
            velocity, shift = self._zmp_shift(rows, row, seen, (velocity, shift), inputs.balance_gain)
        at_ankles, against_friction = self._ankle_offsets(rows, shift), self._friction_offsets(rows)
        if inputs.deflection is not None:
            wound = 1.0 + inputs.deflection
            at_ankles, against_friction = wound * at_ankles, wound * against_friction
        lengthened = z if inputs.leg_length is None else z + inputs.leg_length
        moved = self._leg_offsets(rows, lengthened) + at_ankles
        if inputs.hip is not None:
            moved = moved + hip_offsets(inputs.hip)
        action = share * moved + against_friction
        if planned.any():
            coming = np.minimum(row + 1, self._plan.num_steps)
            action = action + pelvis_shift_offsets(self._model, coming, planned[:, 2:] / self._per_pelvis)
        kept = np.hstack([steps, z, coms.reshape(len(rows), 4), velocity, shift, planned, weight])
        action = action.astype(np.float32)
        return action.reshape((*observation.shape[:-1], action.shape[-1])), (kept, None)

    def link_estimate(self, observation: Array, state: Any) -> Array:  # noqa: ARG002
        """The encoder angles, (..., 12) [rad]: without an output compensator it takes motors for links."""
        rows = self._view.rows(observation)
        return self._view.theta(rows).reshape((*observation.shape[:-1], -1))

    def _begin(self, frame: LocalFrame) -> Array:
        coms = frame.com_from_soles[..., :2].reshape(len(frame.com), 4)
        weight = np.full((len(coms), 1), self._biped.weight)
        return np.hstack([np.zeros((len(coms), 2)), coms, np.zeros((len(coms), 8)), weight])

    def _planned_shift(self, inputs: PolicyInputs, planned: Array, share: Array) -> Array:
        """Shift of the planned center of mass for the input `zmp`, and in all on the ramp, (num_worlds, 4) [m]."""
        following = planned[:, :2]
        if inputs.zmp is not None:
            following = center_of_mass_following(following, inputs.zmp, self._plan.omega, self._dt)
        return np.hstack([following, share * (following if inputs.com is None else following + inputs.com)])

    def _leg_difference(self, rows: Array, row: IntArray, z: Array, weight: Array, inputs: PolicyInputs) -> Array:
        """Left minus right leg length: what the force difference lacks, integrated with a leak [m]."""
        gains, share, gain = self._gains, self._plan.share[row, None], self._gains.force_difference
        if inputs.zmp_shift is not None:
            share = shifted_share(share, inputs.zmp_shift[:, 1:], self._biped.foot_spacing)
        if inputs.balance_gain is not None:
            gain = (1.0 + inputs.balance_gain) * gain
        vertical = self._vertical_forces(rows)
        desired = (1.0 - 2.0 * share) * weight
        missing = desired - (vertical[:, [LEFT]] - vertical[:, [RIGHT]])
        z = z + self._dt * (gain * missing - z / gains.force_difference_decay_s)
        return np.clip(z, -gains.force_difference_limit_m, gains.force_difference_limit_m)

    def _vertical_forces(self, rows: Array) -> Array:
        """Along the normals of the soles, which are nearly vertical, (num_worlds, 2) [N]."""
        return rows[:, self._wrench].reshape(-1, 2, 2, 3)[:, :, 0, 2]

    def _zmp_shift(
        self, rows: Array, row: IntArray, coms: tuple[Array, Array], kept: tuple[Array, Array], change: Array | None
    ) -> tuple[Array, Array]:
        """Filtered deviation of the COM velocity from the plan, and ZMP shift, (num_worlds, 2) each [m/s], [m].

        Args:
            rows: Observations.
            row: Row of the plan.
            coms: COM from both soles less the shift of the plan, now and a period ago, (num_worlds, 2, 2) each [m].
            kept: What this returned a period ago.
            change: Relative change of the gain, (num_worlds, 1) [1].
        """
        gains, plan, (now, last), (velocity, shift) = self._gains, self._plan, coms, kept
        worlds, support = np.arange(len(rows)), rows[:, self._clock][:, 2].astype(np.int64)
        deviation = now[worlds, support] + self._biped.footholds[support] - plan.com[row]
        deviating = (now - last)[worlds, support] / self._dt - plan.com_dot[row]
        velocity = velocity + _share(self._dt, gains.velocity_filter_s) * (deviating - velocity)
        error, dcm = deviation + velocity / plan.omega, gains.dcm
        if change is not None:
            dcm = (1.0 + change) * dcm
        wanted = np.clip(dcm * error, -gains.zmp_limit_m, gains.zmp_limit_m)
        return velocity, shift + _share(self._dt, gains.zmp_filter_s) * (wanted - shift)

    def _leg_offsets(self, rows: Array, z: Array) -> Array:
        """Offsets that lengthen the left leg by z/2 and shorten the right one, (num_worlds, 12) [rad]."""
        leg = self._biped.leg
        knee = self._view.motion(rows).q.reshape(-1, 2, 6)[..., 3]
        distance = np.sqrt(leg.thigh**2 + leg.shank**2 + 2.0 * leg.thigh * leg.shank * np.cos(knee))
        bend = -distance / (leg.thigh * leg.shank * np.sin(knee)) * (0.5 * np.array([1.0, -1.0]) * z)
        # the ankle stays on the line from the hip, and the sole keeps its attitude
        at_hip = -bend * leg.shank * (leg.shank + leg.thigh * np.cos(knee)) / distance**2
        offsets = np.zeros((len(rows), 2, 6))
        offsets[..., 3] = bend
        offsets[..., 2] = at_hip
        offsets[..., 4] = -bend - at_hip
        return offsets.reshape(len(rows), 12)

    def _friction_offsets(self, rows: Array) -> Array:
        """Offsets that wind the springs against the friction of joints that the plan moves, (num_worlds, 12) [rad]."""
        return self._friction_deflection * np.tanh(self._view.motion(rows).q_dot / self._gains.friction_rate_rad_s)

    def _ankle_offsets(self, rows: Array, shift: Array) -> Array:
        """Offsets that wind the ankle springs by the torque of a ZMP shift, (num_worlds, 12) [rad]."""
        carried = shares(rows[:, self._share][:, 0]) * self._biped.weight
        offsets = np.zeros((len(rows), 2, 6))
        offsets[..., 4] = carried * shift[:, [0]] / self._ankle_stiffness[:, 0]
        offsets[..., 5] = -carried * shift[:, [1]] / self._ankle_stiffness[:, 1]
        return offsets.reshape(len(rows), 12)


def _share(period_s: float, time_constant_s: float) -> float:
    """Share of a step that a first-order filter makes in one period."""
    return 1.0 - float(np.exp(-period_s / time_constant_s))
