r"""Compensators of joint elasticity: input (Eq. 9), output (Eqs. 10 to 12), full joint torque.

An input compensator says by how much the motor side has to lead so that the link is where it should
be; an output compensator says where the link is when the motor encoder shows θ. All work on (...,
n) arrays.
"""

import math
from abc import abstractmethod
from typing import Any, Literal, NamedTuple, Protocol, Self, TypeVar, get_args

import numpy as np
from typing_extensions import override

from baselines.compensation.contact_torque import (
    PlannedTorque,
    WrenchTorque,
    planned_feet,
    shift_plan,
)
from baselines.compensation.dry_friction import FrictionCompensation, FrictionMemory
from baselines.compensation.gravity_torque import GravityMethod, GravityModel, make_gravity
from baselines.compensation.inputs import DEFLECTION
from baselines.compensation.policy import (
    Motion,
    Policy,
    PolicyAround,
    PolicyInputs,
    Step,
    WalkView,
    put_rows,
    record_rows,
    select_rows,
)
from baselines.compensation.startup import Ramp
from elastic_env.core.compiled import compiled, compiled_part
from elastic_env.core.errors import ConfigurationError, require_known
from elastic_env.core.signals import Array, IntArray, Parameter
from elastic_env.joint import elasticity
from elastic_env.motion.trajectory import STAND_S
from elastic_env.rigid.leg_chains import LegTorque
from elastic_env.world.robot_model import RobotModel, WalkerModel

OutputMethod = Literal["taylor", "newton", "wrench", "none"]


def input_offset(
    q: Array, stiffness: Array, gravity: GravityModel, servo_compliance: Parameter = 0.0
) -> Array:
    r"""Eq. 9: the offset that brings the link to θ_d.

    It is θ_cmd − θ_d = K⁻¹ τ_g(θ_d), and what the servo itself gives way.

    .. math:: u - q = \left(K^{-1} + k_p^{-1}\right) \tau_g(q)

    Args:
        q: Link angle to reach, θ_d, (..., n) [rad].
        stiffness: K, (n,) [N·m/rad].
        gravity: τ_g of the assumed model.
        servo_compliance: 1/k_p of servos without an integrator, 0 of servos that hold their angle
            [rad/(N·m)].

    Returns:
        (..., n) [rad].
    """
    torque = gravity.gravity_torque(q)
    return elasticity.static_deflection(torque, stiffness) + servo_compliance * torque


def taylor_link_angle(theta: Array, stiffness: Array, gravity: GravityModel) -> Array:
    r"""Eq. 12: link angle from the encoder with τ_g expanded to first order about θ (Eq. 11).

    .. math:: q = \theta - (K + \partial\tau_g/\partial q|_\theta)^{-1} \tau_g(\theta)

    Args:
        theta: Encoder, θ, (..., n) [rad].
        stiffness: K, (n,) [N·m/rad].
        gravity: τ_g and its gradient.

    Returns:
        q, (..., n) [rad].

    Raises:
        ElasticError: The matrix is singular.
    """
    if isinstance(gravity, LegTorque):
        return theta - gravity.solve(theta, stiffness)
    return theta - _solve(gravity, theta, stiffness, gravity.gravity_torque(theta))


def newton_link_angle(theta: Array, stiffness: Array, gravity: GravityModel) -> Array:
    """Eq. 10 solved by Newton-Raphson from q = θ, to a residual below 1e-12.

    Arguments and errors are those of `taylor_link_angle`.
    """
    torque = gravity.gravity_torque
    gradient = gravity.gravity_gradient
    return elasticity.static_link_angle(theta, stiffness, torque, gradient)


class Compensator(Protocol):
    """An input offset for a motion, and a link angle for an encoder angle.

    `baselines.Compensated` needs both.

    `memory` has one row per world: an array, or a named tuple of arrays.
    """

    model: RobotModel
    modelled: float | Array = 1.0
    """1 where its link angles follow from the model, 0 where sensors show them; a number, or
    (n,) [1].
    """
    weighs: bool = False
    """Its link angles show a load that no model knows."""

    @abstractmethod
    def at(self, rows: Array) -> "Compensator":
        """The compensator for the loads at the control steps of observations, (num_worlds, m)."""

    @abstractmethod
    def begin(self, motion: Motion) -> Any:
        """Memory at rest at the start of an episode."""

    @abstractmethod
    def offset(self, motion: Motion, memory: Any) -> tuple[Array, Any]:
        """Command offset for the coming control period, (num_worlds, n) [rad], and new memory."""

    @abstractmethod
    def deflection(self, offset: Array, memory: Any) -> Array:
        """Deflection δ that an offset leads by, as `offset` returned it, (num_worlds, n) [rad]."""

    @abstractmethod
    def link_angle(self, theta: Array, memory: Any) -> Array:
        """Estimate of q from the encoders, (num_worlds, n) [rad]."""

    @abstractmethod
    def link_rate(self, theta: Array, theta_dot: Array) -> Array:
        """Estimate of q̇ from the encoders, (num_worlds, n) [rad/s]."""


class GravityCompensator(Compensator):
    """The paper's compensator: Eq. 9 on the input, Eq. 12 (or Newton on Eq. 10) on the output.

    Args:
        model: Assumed robot.
        output: "taylor" for Eq. 12, "newton" for Eq. 10, "wrench" for Eq. 12 with the torque of the
            measured foot wrenches (walker), "none" to leave the encoder as it is.
        method: How the gravity torque is computed; None for the robot's default.

    Raises:
        ConfigurationError: Unknown output method or gravity method, or one that the robot does not
            have.
    """

    def __init__(
        self,
        model: RobotModel,
        output: OutputMethod = "taylor",
        method: GravityMethod | None = None,
    ) -> None:
        require_known("output compensator", [output], get_args(OutputMethod))
        self.model = model
        self.stiffness = model.stiffness
        self.servo_compliance = model.servo_compliance
        self._per_deflection = 1.0 + self.stiffness * self.servo_compliance
        self.gravity = make_gravity(model, method)
        """τ_g of the desired posture."""
        self._load: Any = self.gravity  # of the measured posture
        self.output = output
        self.weighs = output == "wrench"
        if self.weighs:
            if not isinstance(model, WalkerModel):
                raise ConfigurationError(
                    "the output compensator 'wrench' needs a walker with force-torque sensors at"
                    " its feet"
                )
            self._load = WrenchTorque(model)

    @override
    def at(self, rows: Array) -> "GravityCompensator":
        if not isinstance(self.model, WalkerModel):
            return self
        bound = shallow_copy(self)
        if self._load is self.gravity:
            bound.gravity, bound._load = self.gravity.level_and_tilted(rows)
        else:
            bound.gravity = self.gravity.at(rows)
            bound._load = self._load.at(rows)
        return bound

    @override
    def begin(self, motion: Motion) -> Array:
        return np.zeros((len(motion.q), 0))

    @override
    def offset(self, motion: Motion, memory: Array) -> tuple[Array, Array]:
        compliance = self.servo_compliance
        return input_offset(motion.q, self.stiffness, self.gravity, compliance), memory

    @override
    def deflection(self, offset: Array, memory: Array) -> Array:
        """All of the offset but what the servo itself gives way, (num_worlds, n) [rad]."""
        return offset / self._per_deflection

    @override
    def link_angle(self, theta: Array, memory: Array | None = None) -> Array:
        """Estimate of q from the encoders, (num_worlds, n) [rad]; it needs no memory."""
        if self.output == "none":
            return theta
        solve = newton_link_angle if self.output == "newton" else taylor_link_angle
        return solve(theta, self.stiffness, self._load)

    def deflection_by_tilt(self, theta: Array) -> Parameter:
        """What the measured tilt of a walker's pelvis adds to Eq. 12, (num_worlds, n) [rad]."""
        if self._load is self.gravity or self.weighs:
            return 0.0
        tilted = self._load.solve(theta, self.stiffness)
        return tilted - self.gravity.solve(theta, self.stiffness)

    @override
    def link_rate(self, theta: Array, theta_dot: Array) -> Array:
        """Rate at the estimated link angle, (num_worlds, n) [rad/s].

        It is the derivative of Eq. 10, (K + ∂τ_g/∂q) q̇ = K θ̇.
        """
        if self.output == "none":
            return theta_dot
        q = self.link_angle(theta)
        return _solve(self._load, q, self.stiffness, self.stiffness * theta_dot)


class DriveMemory(NamedTuple):
    """Memory of the drives, (num_worlds, n) each.

    Attributes:
        deflection: δ, by which the motor side leads [rad].
        rate: δ̇ [rad/s].
        windup: Integral of the servo error, ∫e [rad·s].
        friction: That of the dry friction.
    """

    deflection: Array
    rate: Array
    windup: Array
    friction: FrictionMemory


class DynamicCompensator(Compensator):
    r"""Deflection from the full joint torque of the motion, and the inverse of the servo.

    The link's inverse dynamics give τ_J; the transmission with its damping, K δ + D δ̇ = τ_J, gives
    δ; the rotor and the servo, B θ̈ + τ_J = k_p e − k_v θ̇ + k_i ∫e, give the servo error e that
    the motion θ = q + δ needs. The command is θ + e, taken at the middle of the control period over
    which it is held.

    Args:
        model: Assumed robot, with a servo on every joint.
        output: Method for the rate estimate and for the start, as in `GravityCompensator`.
        method: How the static torque is computed; None for the robot's default.
        friction: Whether the model's dry friction is part of the joint torque: Coulomb friction,
            and what grows with the load or falls from rest.
    """

    def __init__(
        self,
        model: RobotModel,
        output: OutputMethod = "taylor",
        method: GravityMethod | None = None,
        friction: bool = False,
    ) -> None:
        self.model = model
        self._static = GravityCompensator(model, output, method)
        is_walker = isinstance(model, WalkerModel)  # whose planned motion alone is known
        gravity = self._static.gravity
        self._body: Any = PlannedTorque(model, gravity) if is_walker else make_gravity(model)
        self.weighs = output == "wrench"
        self._dt = model.control_period_s
        self._stiffness = model.stiffness[None]
        self._backlash: Parameter = model.backlash if model.backlash.any() else 0.0
        self._viscous = model.viscous_friction
        self._friction = FrictionCompensation(
            coulomb=model.coulomb_friction,
            load_ratio=model.load_friction,
            static=model.static_friction,
            stribeck_speed=model.stribeck_speed,
        )
        self._rubs = friction
        servos = model.servos
        self._drives = record_rows(
            damping=model.damping,  # D [N·m·s/rad]
            rotor_inertia=model.rotor_inertia,  # B [kg·m²]
            position_gain=[servo.position_gain for servo in servos],  # [N·m/rad]
            braking=[servo.braking for servo in servos],  # k_v and back-EMF [N·m·s/rad]
            integral_gain=[servo.integral_gain for servo in servos],  # [N·m/(rad·s)]
        )

    @override
    def at(self, rows: Array) -> Self:
        static = self._static.at(rows)
        if static is self._static:
            return self
        bound = shallow_copy(self)
        bound._static = static
        bound._body = self._body.at(rows, static.gravity)
        return bound

    def with_stiffness(self, stiffness: Array) -> Self:
        """The compensator with another K, also one for every world, (..., n) [N·m/rad]."""
        stiffer = shallow_copy(self)
        rows = np.ascontiguousarray(stiffness).reshape(-1, len(self._drives))
        stiffer._stiffness = rows
        return stiffer

    @override
    def begin(self, motion: Motion) -> DriveMemory:
        torque = self._static.gravity.gravity_torque(motion.q)
        k_i = self._drives["integral_gain"]
        zero = np.zeros_like(torque)
        windup = np.divide(torque, k_i, out=zero.copy(), where=k_i > 0.0)
        springs = (self._stiffness, self._backlash)
        deflection = elasticity.static_deflection(torque, *springs)
        friction = self._friction.begin(torque.shape)
        return DriveMemory(deflection, rate=zero, windup=windup, friction=friction)

    @override
    def offset(self, motion: Motion, memory: DriveMemory) -> tuple[Array, DriveMemory]:
        """Offset that moves the links along a motion, (num_worlds, n) [rad], and the new memory.

        The springs settle towards K⁻¹ τ within a control period; the servo lags by its own PID.
        """
        torque = self._body.inverse_dynamics(motion.q, motion.q_dot, motion.q_ddot)
        torque = torque + self._viscous * motion.q_dot
        friction = memory.friction
        if self._rubs:
            friction = self._friction.follow(motion.q_dot * self._dt, friction)
            torque = self._friction.joint_torque(torque, motion.q_dot, friction)
        offset, deflection, rate, windup = lead_motors(
            torque=torque,
            target=elasticity.static_deflection(torque, self._stiffness, self._backlash),
            q_dot=np.ascontiguousarray(motion.q_dot),
            q_ddot=np.ascontiguousarray(motion.q_ddot),
            before=(memory.deflection, memory.rate, memory.windup),
            stiffness=self._stiffness,
            drives=self._drives,
            period_s=self._dt,
        )
        return offset, DriveMemory(deflection, rate, windup, friction)

    @override
    def deflection(self, offset: Array, memory: DriveMemory) -> Array:
        """The offset less what the servo needs, (num_worlds, n) [rad]."""
        return memory.deflection

    @override
    def link_angle(self, theta: Array, memory: DriveMemory) -> Array:
        """Link angle by the desired motion's deflection, or by the measured wrenches [rad].

        The tilt of a walker's pelvis, which is not desired, adds what it bends at rest.
        """
        if self.weighs:
            return self._static.link_angle(theta)
        return theta - memory.deflection - self._static.deflection_by_tilt(theta)

    @override
    def link_rate(self, theta: Array, theta_dot: Array) -> Array:
        return self._static.link_rate(theta, theta_dot)


@compiled
def lead_motors(
    torque: Array,
    target: Array,
    q_dot: Array,
    q_ddot: Array,
    before: tuple[Array, Array, Array],
    stiffness: Array,
    drives: Any,
    period_s: float,
) -> Array:
    """Offsets by which motors lead along a motion, and what `DriveMemory` keeps of it.

    Args:
        torque: Joint torques τ_J, (worlds, n) [N·m].
        target: Deflections at rest under them, (worlds, n) [rad].
        q_dot: Rates of the links, (worlds, n) [rad/s].
        q_ddot: Their accelerations, (worlds, n) [rad/s²].
        before: Deflection, its rate and the integral of the servo error, (worlds, n) each.
        stiffness: K of the worlds, (worlds, n), or of all, (1, n) [N·m/rad].
        drives: Rotor, damper and servo of each joint, rows, (n,).
        period_s: Control period [s].

    Returns:
        Offset, and the three of `before` after the control period, (4, worlds, n).
    """
    deflection, rate, windup = before
    found = np.zeros((4, *torque.shape))
    for world in range(len(torque)):
        K = stiffness[min(world, len(stiffness) - 1)]
        for i in range(len(drives)):
            drive = drives[i]
            last = deflection[world, i]
            bent = follow_lag(last, target[world, i], drive.damping / K[i], period_s)
            bending = (bent - last) / period_s
            theta_dot = q_dot[world, i] + bending
            theta_ddot = q_ddot[world, i] + (bending - rate[world, i]) / period_s
            effort = drive.rotor_inertia * theta_ddot + torque[world, i]
            effort += drive.braking * theta_dot
            k_i = drive.integral_gain
            integral = 0.0
            if k_i > 0.0:  # k_p e + k_i ∫e = effort
                lag_s = drive.position_gain / k_i
                integral = follow_lag(windup[world, i], effort / k_i, lag_s, period_s)
            error = (effort - k_i * integral) / drive.position_gain
            # it is held too early
            found[0, world, i] = bent + error - 0.5 * period_s * theta_dot
            found[1, world, i] = bent
            found[2, world, i] = bending
            found[3, world, i] = integral
    return found


@compiled_part
def follow_lag(state: float, target: float, lag_s: float, period_s: float) -> float:
    """State of a first-order lag after one period towards a constant target.

    There is no lag for a time constant of zero.
    """
    return target + math.exp(-period_s / lag_s) * (state - target)


def _solve(gravity: GravityModel, q: Array, stiffness: Array, torque: Array) -> Array:
    """(K + ∂τ_g/∂q)⁻¹ τ, leg by leg where the legs do not couple, (..., n) [rad]."""
    if isinstance(gravity, LegTorque):
        return gravity.solve(q, stiffness, torque)
    K = np.broadcast_to(stiffness, q.shape)
    return elasticity.solve_stiffness(K, gravity.gravity_gradient(q), torque)


_T = TypeVar("_T")


def shallow_copy(compensator: _T) -> _T:
    """A shallow copy, as `copy.copy` makes it, in a fraction of its time."""
    other = object.__new__(type(compensator))
    other.__dict__.update(compensator.__dict__)
    return other


class CompensatedMemory(NamedTuple):
    """Memory of a compensated policy.

    Attributes:
        steps: Control steps since the start of the episode, (num_worlds, 1).
        links: Link angles that the policy saw, (num_worlds, n) [rad].
        compensator: Memory of the compensator.
        inner: Memory of the policy.
    """

    steps: IntArray
    links: Array
    compensator: Any
    inner: Any


class Compensated(PolicyAround):
    """Any policy with joint elasticity compensated around it (Fig. 2 of the paper).

    Attribute `ramp` is the share of the compensation after 0, 1, ... control steps, up to 1.

    The wrapped policy's action is the offset of the link angle it wants, q_d = q_ref + a. It sees
    the estimated link angle and rate where the observation has the encoder's; the compensator's
    offset for q_d is added to its action. The compensation grows from zero in the first `ramp_s` of
    an episode, while the reference stands.

    Args:
        policy: Anything with `predict`; its state may be anything. One that does not read joint
            rates can say so by an attribute `reads_rates = False`, which saves their estimate.
        compensator: Where the motor has to lead, and where the link is: an object with the
            attributes and methods of `baselines.compensation.compensators.Compensator`.
        ramp_s: Duration of the ramp.
        corrects_policy: Whether the input `deflection` also reaches the policy, as one that winds
            springs needs it.
    """

    def __init__(
        self,
        policy: Policy,
        compensator: Compensator,
        ramp_s: float = STAND_S,
        corrects_policy: bool = False,
    ) -> None:
        model = compensator.model
        super().__init__(policy, model)
        self.inputs = (DEFLECTION, *self.policy.inputs)
        self.compensator = compensator
        self._theta = model.observation_table.group("encoder_angle")
        self._theta_dot = model.observation_table.group("encoder_rate")
        self._corrects_policy = corrects_policy
        self.ramp = Ramp(model, ramp_s).table
        self._plan: tuple[WalkView, Any] | None = None
        if isinstance(model, WalkerModel):
            self._plan = WalkView(model.observation_table), planned_feet(model.plan)

    @override
    def begin(self, rows: Array) -> CompensatedMemory:
        motion = self.view.motion(rows)
        own = self.compensator.at(rows).begin(motion)
        steps = np.zeros((len(rows), 1), dtype=np.int64)
        return CompensatedMemory(steps, motion.q.copy(), own, self.policy.begin(rows))

    @override
    def act(self, rows: Array, memory: CompensatedMemory, inputs: PolicyInputs) -> Step:
        """It takes the input `deflection`, r: what is compensated, and seen, is (1 + r) δ.

        What torque sensors or foot wrenches show of an unknown load is not in r a second time.
        The contact forces that load the joints act where the inputs shift the ZMP.
        """
        correction = inputs.deflection
        own = memory.compensator
        if self._plan is not None and (shift := inputs.zmp_shift) is not None:
            view, feet = self._plan
            rows = rows.copy()
            shift = np.ascontiguousarray(shift)
            shift_plan(view.fields(rows), shift, feet, self.compensator.model.control_period_s)
            own = self._begin_shifted(rows, memory)
        compensator = self.compensator.at(rows)
        theta = rows[:, self._theta]
        links = compensator.link_angle(theta, own)
        if correction is not None:
            seen = correction
            if inputs.load is not None and compensator.weighs:
                seen = (1.0 + correction) / (1.0 + inputs.load) - 1.0
            links = links - compensator.modelled * seen * (theta - links)
            if not self._corrects_policy:
                inputs = inputs._replace(deflection=None)
        shown = rows.copy()
        shown[:, self._theta] = links
        if self.policy.reads_rates:
            rates = compensator.link_rate(theta, rows[:, self._theta_dot])
            shown[:, self._theta_dot] = rates
        action, inner = self.policy.act(shown, memory.inner, inputs)
        wanted = action.astype(np.float64)
        motion = self.view.motion(rows)
        desired = Motion(motion.q + wanted, motion.q_dot, motion.q_ddot)
        offset, own = compensator.offset(desired, own)
        if correction is not None:
            offset = offset + correction * compensator.deflection(offset, own)
        steps = memory.steps + 1
        total = wanted + self.ramp.take(steps, mode="clip") * offset
        memory = CompensatedMemory(steps, links.copy(), own, inner)
        return total.astype(np.float32), memory

    @override
    def link_angles(self, rows: Array, memory: CompensatedMemory) -> Array:
        return memory.links

    def _begin_shifted(self, rows: Array, memory: CompensatedMemory) -> Any:
        """Memory of the compensator, begun under the shifted plan where an episode begins."""
        if np.count_nonzero(memory.steps) == len(rows):
            return memory.compensator
        fresh = memory.steps[:, 0] == 0
        begun = self.compensator.at(rows).begin(self.view.motion(rows))
        return put_rows(memory.compensator, fresh, select_rows(begun, fresh))
