r"""Compensators of joint elasticity: input (Eq. 9), output (Eqs. 10 to 12), and from the full joint torque.

An input compensator says by how much the motor side has to lead so that the link is where it should be; an output
compensator says where the link is when the motor encoder shows θ. All work on (..., n) arrays.

[Dahl1968] P. R. Dahl, "A Solid Friction Model", The Aerospace Corporation, TOR-0158(3107-18)-1.
"""

from typing import Any, Literal, NamedTuple, Protocol, TypeVar, get_args

import numpy as np

from baselines.compensation.compensation_kernels import DRIVE, lead
from baselines.compensation.contact_torque import LegTorque
from baselines.compensation.gravity_torque import GravityMethod, GravityModel, make_dynamics, make_gravity, make_load
from elastic_env.core.errors import require_known
from elastic_env.core.signals import Array, Parameter
from elastic_env.joint.elasticity import solve_stiffness, static_deflection, static_link_angle
from elastic_env.runtime.robot_model import RobotModel

OutputMethod = Literal["taylor", "newton", "wrench", "none"]


class Motion(NamedTuple):
    """Desired motion of the links, (..., n) each [rad], [rad/s], [rad/s²]."""

    q: Array
    q_dot: Array
    q_ddot: Array

    def shifted(self, offset: Array) -> "Motion":
        """The motion with its angles moved by an offset [rad]."""
        return Motion(self.q + offset, self.q_dot, self.q_ddot)


def input_offset(q_desired: Array, stiffness: Array, gravity: GravityModel, servo_compliance: Parameter = 0.0) -> Array:
    r"""Eq. 9, θ_cmd − θ_d = K⁻¹ τ_g(θ_d), and what the servo itself gives way: the offset that brings the link to θ_d.

    .. math:: u - q = \left(K^{-1} + k_p^{-1}\right) \tau_g(q)

    Args:
        q_desired: Link angle to reach, θ_d, (..., n) [rad].
        stiffness: K, (n,) [N·m/rad].
        gravity: τ_g of the assumed model.
        servo_compliance: 1/k_p of servos without an integrator, 0 of servos that hold their angle [rad/(N·m)].

    Returns:
        (..., n) [rad].
    """
    torque = gravity.gravity_torque(q_desired)
    return static_deflection(torque, stiffness) + servo_compliance * torque


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
        return theta - gravity.solved(theta, stiffness)
    return theta - _solve(gravity, theta, stiffness, gravity.gravity_torque(theta))


def newton_link_angle(theta: Array, stiffness: Array, gravity: GravityModel) -> Array:
    """Eq. 10 solved by Newton-Raphson from q = θ; arguments and errors as `taylor_link_angle`, residual below 1e-12."""
    return static_link_angle(theta, stiffness, gravity.gravity_torque, gravity.gravity_gradient)


class Compensator(Protocol):
    """What `baselines.Compensated` needs: an input offset for a motion, and a link angle for an encoder angle.

    `memory` has one row per world and `memory_width` columns; a compensator without memory has none.
    """

    model: RobotModel
    memory_width: int

    @property
    def modelled(self) -> float | Array:
        """1 where its link angles follow from the model, 0 where sensors show them; a number, or (n,) [1]."""
        ...

    def at(self, rows: Array) -> "Compensator":
        """The compensator for the loads at the control steps of observations, (num_worlds, m)."""
        ...

    def begin(self, motion: Motion) -> Array:
        """Memory at rest at the start of an episode, (num_worlds, memory_width)."""
        ...

    def offset(self, motion: Motion, memory: Array) -> tuple[Array, Array]:
        """Command offset for the coming control period, (num_worlds, n) [rad], and the new memory."""
        ...

    def deflection(self, offset: Array, memory: Array) -> Array:
        """The deflection δ that an offset leads by, of what `offset` returned, (num_worlds, n) [rad]."""
        ...

    def link_angle(self, theta: Array, memory: Array) -> Array:
        """Estimate of q from the encoders, (num_worlds, n) [rad]."""
        ...

    def link_rate(self, theta: Array, theta_dot: Array) -> Array:
        """Estimate of q̇ from the encoders, (num_worlds, n) [rad/s]."""
        ...


class GravityCompensator:
    """The paper's compensator: Eq. 9 on the input, Eq. 12 (or Newton on Eq. 10) on the output.

    Args:
        model: Assumed robot.
        output: "taylor" for Eq. 12, "newton" for Eq. 10, "wrench" for Eq. 12 with the torque of the measured foot
            wrenches (walker), "none" to leave the encoder as it is.
        method: How the gravity torque is computed; None for the robot's default.

    Raises:
        ConfigurationError: Unknown output method or gravity method, or one that the robot does not have.
    """

    memory_width = 0
    modelled: float | Array = 1.0

    def __init__(self, model: RobotModel, output: OutputMethod = "taylor", method: GravityMethod | None = None) -> None:
        require_known("output compensator", [output], get_args(OutputMethod))
        self.model = model
        self.stiffness, self._servo_compliance = model.stiffness, model.servo_compliance
        self._per_deflection = 1.0 + self.stiffness * self._servo_compliance
        self.gravity = self._load = make_gravity(model, method)
        """τ_g of the desired posture and of the measured one."""
        self._source, self._load_source = self.gravity, make_load(model, output, self.gravity)
        self._loads_alike = self._load_source is self._source
        self._output = output

    def at(self, rows: Array) -> "GravityCompensator":
        """See `Compensator`."""
        bound = alike(self)
        if self._loads_alike:
            bound.gravity, bound._load = self._source.level_and_tilted(rows)
        else:
            bound.gravity, bound._load = self._source.at(rows), self._load_source.at(rows, level=False)
        return bound

    def begin(self, motion: Motion) -> Array:
        """See `Compensator`."""
        return np.zeros((*motion.q.shape[:-1], 0))

    def offset(self, motion: Motion, memory: Array) -> tuple[Array, Array]:
        """See `Compensator`."""
        return input_offset(motion.q, self.stiffness, self.gravity, self._servo_compliance), memory

    def deflection(self, offset: Array, memory: Array) -> Array:  # noqa: ARG002  the interface's
        """See `Compensator`: all of the offset but what the servo itself gives way."""
        return offset / self._per_deflection

    def link_angle(self, theta: Array, memory: Array) -> Array:  # noqa: ARG002  the interface's
        """See `Compensator`."""
        if self._output == "none":
            return theta
        solve = newton_link_angle if self._output == "newton" else taylor_link_angle
        return solve(theta, self.stiffness, self._load)

    def link_rate(self, theta: Array, theta_dot: Array) -> Array:
        """See `Compensator`: the derivative of Eq. 10, (K + ∂τ_g/∂q) q̇ = K θ̇ at the estimated link angle."""
        if self._output == "none":
            return theta_dot
        q = self.link_angle(theta, theta)
        return _solve(self._load, q, self.stiffness, self.stiffness * theta_dot)


class DynamicCompensator:
    r"""Deflection from the full joint torque of the motion, and the inverse of the servo.

    The link's inverse dynamics give τ_J; the transmission with its damping, K δ + D δ̇ = τ_J, gives δ; the rotor and the
    servo, B θ̈ + τ_J = k_p e − k_v θ̇ + k_i ∫e, give the servo error e that the motion θ = q + δ needs. The command is
    θ + e, taken at the middle of the control period over which it is held.

    Memory per joint: δ, δ̇, ∫e, friction torque.

    Args:
        model: Assumed robot, with a servo on every joint.
        output: Method for the rate estimate and for the start, as in `GravityCompensator`.
        method: How the static torque is computed; None for the robot's default.
        friction: Whether the model's Coulomb friction is part of the joint torque.
    """

    modelled: float | Array = 1.0

    def __init__(
        self,
        model: RobotModel,
        output: OutputMethod = "taylor",
        method: GravityMethod | None = None,
        friction: bool = False,
    ) -> None:
        self.model = model
        self._static = GravityCompensator(model, output, method)
        self._body = self._source = make_dynamics(model, self._static.gravity)
        self._measures = output == "wrench"
        self._n, self._dt = len(model.joint_names), model.control_period_s
        self._K = model.stiffness[None]
        self._backlash: Parameter = model.backlash if model.backlash.any() else 0.0
        self._viscous, self._coulomb = model.viscous_friction, model.coulomb_friction if friction else None
        self._drives: Any = np.zeros(self._n, DRIVE)
        self._drives["damping"], self._drives["rotor_inertia"] = model.damping, model.rotor_inertia
        for name in ("position_gain", "velocity_gain", "integral_gain"):
            self._drives[name] = [getattr(servo, name) for servo in model.servos]
        self.memory_width = 4 * self._n

    def at(self, rows: Array) -> "DynamicCompensator":
        """See `Compensator`."""
        bound = alike(self)
        bound._static = self._static.at(rows)
        bound._body = self._source.at(rows, bound._static.gravity)
        return bound

    def with_stiffness(self, stiffness: Array) -> "DynamicCompensator":
        """The compensator with another K, also one for every world, (..., n) [N·m/rad]."""
        stiffer = alike(self)
        stiffer._K = np.ascontiguousarray(stiffness).reshape(-1, self._n)
        return stiffer

    def begin(self, motion: Motion) -> Array:
        """See `Compensator`."""
        torque = self._static.gravity.gravity_torque(motion.q)
        integral_gain = self._drives["integral_gain"]
        windup = np.divide(torque, integral_gain, out=np.zeros_like(torque), where=integral_gain > 0.0)
        deflection = static_deflection(torque, self._K, self._backlash)
        zero = np.zeros_like(torque)
        return np.concatenate([deflection, zero, windup, zero], axis=-1)

    def offset(self, motion: Motion, memory: Array) -> tuple[Array, Array]:
        """See `Compensator`."""
        offset, kept, friction = np.empty(motion.q.shape), np.empty(memory.shape), memory[:, 3 * self._n :]
        torque = self._body.inverse_dynamics(motion.q, motion.q_dot, motion.q_ddot) + self._viscous * motion.q_dot
        if self._coulomb is not None:
            friction = presliding_friction(friction, motion.q_dot * self._dt, self._coulomb)
            torque = torque + friction
        kept[:, 3 * self._n :] = friction
        settled = static_deflection(torque, self._K, self._backlash)
        moving = np.ascontiguousarray(motion.q_dot), np.ascontiguousarray(motion.q_ddot)
        before = np.ascontiguousarray(memory)
        lead(self._drives, self._dt, self._K, moving, (torque, settled), (before, kept), offset)
        return offset, kept

    def deflection(self, offset: Array, memory: Array) -> Array:  # noqa: ARG002  the interface's
        """See `Compensator`: the offset less what the servo needs."""
        return memory[..., : self._n]

    def link_angle(self, theta: Array, memory: Array) -> Array:
        """See `Compensator`: the deflection of the desired motion, or of the measured wrenches, off the encoder."""
        if self._measures:
            return self._static.link_angle(theta, memory)
        return theta - memory[..., : self._n]

    def link_rate(self, theta: Array, theta_dot: Array) -> Array:
        """See `Compensator`."""
        return self._static.link_rate(theta, theta_dot)


PRESLIDING_RAD = 1e-3
"""Displacement over which Coulomb friction turns round [rad]."""


def presliding_friction(friction: Array, displacement: Array, coulomb: Array) -> Array:
    r"""Coulomb friction with presliding: it turns round over a displacement, and stays at rest [Dahl1968].

    .. math:: f_{k+1} = F s + (f_k - F s) e^{-|\Delta q| / x_0}, \quad s = \mathrm{sign}(\Delta q)

    Args:
        friction: f, that holds the link back, before the displacement, (..., n) [N·m].
        displacement: Δq, (..., n) [rad].
        coulomb: F, (n,) [N·m].
    """
    full = coulomb * np.sign(displacement)
    return full + (friction - full) * np.exp(-np.abs(displacement) / PRESLIDING_RAD)


def _solve(gravity: GravityModel, q: Array, stiffness: Array, torque: Array) -> Array:
    """(K + ∂τ_g/∂q)⁻¹ τ, leg by leg where the legs do not couple, (..., n) [rad]."""
    if isinstance(gravity, LegTorque):
        return gravity.solved(q, stiffness, torque)
    return solve_stiffness(np.broadcast_to(stiffness, q.shape), gravity.gravity_gradient(q), torque)


_T = TypeVar("_T")


def alike(compensator: _T) -> _T:
    """A shallow copy, as `copy.copy` makes it, in a fraction of its time."""
    other = object.__new__(type(compensator))
    other.__dict__.update(compensator.__dict__)
    return other
