r"""Compensation of the full joint torque of a motion, with the inverse of the servo."""

import math
from typing import Any, NamedTuple, Self

import numpy as np
from typing_extensions import override

from baselines.compensation.compensator import Compensator
from baselines.compensation.compensators import GravityCompensator, OutputMethod, shallow_copy
from baselines.compensation.compiled_rows import record_rows
from baselines.compensation.contact_torque import PlannedTorque
from baselines.compensation.dry_friction import FrictionCompensation, FrictionMemory
from baselines.compensation.gravity_torque import GravityMethod, make_gravity
from baselines.compensation.policy import Motion
from elastic_env.core.compiled import compiled, compiled_part
from elastic_env.core.signals import Array, Parameter
from elastic_env.joint.elasticity import static_deflection
from elastic_env.world.robot_model import RobotModel, WalkerModel


class DriveMemory(NamedTuple):
    """Memory of the drives, (num_worlds, n) each.

    Attributes:
        deflection: δ, by which the motor side leads [rad].
        rate: δ̇ [rad/s].
        windup: Integral of the servo error, ∫e [rad·s].
        friction: Memory of the dry friction.
    """

    deflection: Array
    rate: Array
    windup: Array
    friction: FrictionMemory


class DynamicCompensator(Compensator):
    r"""Deflection from the full joint torque of the motion, and the inverse of the servo.

    The link's inverse dynamics give τ_J. The transmission with its damping, K δ + D δ̇ = τ_J, gives
    δ. The rotor and the servo, B θ̈ + τ_J = k_p e − k_v θ̇ + k_i ∫e, give the servo error e for the
    motion θ = q + δ. The command is θ + e at the middle of the control period over which it is
    held.

    Args:
        model: Assumed robot, with a servo on every joint.
        output: Method for the rate estimate and for the start, as in `GravityCompensator`.
        method: Method for the static torque; None for the robot's default.
        friction: True to include the model's dry friction in the joint torque: Coulomb friction,
            and friction that grows with the load or falls from rest.
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
        gravity = self._static.gravity
        is_walker = isinstance(model, WalkerModel)  # only its plan has inverse dynamics
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
        self._has_friction = friction
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
        compensator = shallow_copy(self)
        compensator._static = static
        compensator._body = self._body.at(rows, static.gravity)
        return compensator

    def with_stiffness(self, stiffness: Array) -> Self:
        """Compensator with another K, for all worlds or each of them, (..., n) [N·m/rad]."""
        new = shallow_copy(self)
        new._stiffness = np.ascontiguousarray(stiffness).reshape(-1, len(self._drives))
        return new

    @override
    def begin(self, motion: Motion) -> DriveMemory:
        torque = self._static.gravity.gravity_torque(motion.q)
        k_i = self._drives["integral_gain"]
        zero = np.zeros_like(torque)
        windup = np.divide(torque, k_i, out=zero.copy(), where=k_i > 0.0)
        deflection = static_deflection(torque, self._stiffness, self._backlash)
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
        if self._has_friction:
            friction = self._friction.follow(motion.q_dot * self._dt, friction)
            torque = self._friction.joint_torque(torque, motion.q_dot, friction)
        offset, deflection, rate, windup = lead_motors(
            torque=torque,
            target=static_deflection(torque, self._stiffness, self._backlash),
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
        """Offset without the error of the servo, (num_worlds, n) [rad]."""
        return memory.deflection

    @override
    def link_angle(self, theta: Array, memory: DriveMemory) -> Array:
        """Link angle by the desired motion's deflection, or by the measured wrenches [rad].

        The tilt of a walker's pelvis is not desired, and adds its bending at rest.
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
    """Offsets by which motors lead along a motion, and their new memory.

    Args:
        torque: Joint torques τ_J, (worlds, n) [N·m].
        target: Deflections at rest under them, (worlds, n) [rad].
        q_dot: Rates of the links, (worlds, n) [rad/s].
        q_ddot: Their accelerations, (worlds, n) [rad/s²].
        before: Deflection, its rate and the integral of the servo error, (worlds, n) each.
        stiffness: K of each world, (worlds, n), or of all worlds, (1, n) [N·m/rad].
        drives: Rotor, damper and servo of each joint, rows, (n,).
        period_s: Control period [s].

    Returns:
        Offset, and the three of `before` after the control period, (4, worlds, n).
    """
    deflection, rate, windup = before
    result = np.zeros((4, *torque.shape))
    for world in range(len(torque)):
        K = stiffness[min(world, len(stiffness) - 1)]
        for i in range(len(drives)):
            drive = drives[i]
            last = deflection[world, i]
            delta = follow_lag(last, target[world, i], drive.damping / K[i], period_s)
            delta_dot = (delta - last) / period_s
            theta_dot = q_dot[world, i] + delta_dot
            theta_ddot = q_ddot[world, i] + (delta_dot - rate[world, i]) / period_s
            effort = drive.rotor_inertia * theta_ddot + torque[world, i]
            effort += drive.braking * theta_dot
            k_i = drive.integral_gain
            integral = 0.0
            if k_i > 0.0:  # k_p e + k_i ∫e = effort
                lag_s = drive.position_gain / k_i
                integral = follow_lag(windup[world, i], effort / k_i, lag_s, period_s)
            error = (effort - k_i * integral) / drive.position_gain
            # at the middle of the period over which the command is held
            result[0, world, i] = delta + error - 0.5 * period_s * theta_dot
            result[1, world, i] = delta
            result[2, world, i] = delta_dot
            result[3, world, i] = integral
    return result


@compiled_part
def follow_lag(state: float, target: float, lag_s: float, period_s: float) -> float:
    """State of a first-order lag after one period towards a constant target.

    A time constant of zero means no lag.
    """
    return target + math.exp(-period_s / lag_s) * (state - target)
