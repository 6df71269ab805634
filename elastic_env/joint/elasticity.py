r"""The elastic joint: a rotor behind a spring, a damper and a dead band.

    servo → rotor (θ, B) → K, D, backlash → link (q) ← friction, gravity

The deflection is δ = θ − q (Eq. 2), the joint torque τ_J what the transmission passes to the link; at rest
τ_J equals the gravity torque τ_g up to the friction on the link. All functions work on (..., n) arrays, so that one
joint, one robot and a batch of robots are the same formula.

[Spong1987] M. W. Spong, "Modeling and Control of Elastic Joint Robots", J. Dyn. Sys., Meas., Control 109(4).
Eq. n: the paper that this project reproduces (see the README).
"""

from collections.abc import Callable
from typing import Self

import numpy as np
from pydantic import model_validator

from elastic_env.core.config import Model, quantity
from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array, Parameter

TorqueFunction = Callable[[Array], Array]


class Servo(Model):
    r"""Position servo on the rotor: PID on the motor encoder, limited in torque.

    .. math::
        \tau_m = \mathrm{clip}(k_p (u - \theta) - k_v \dot\theta + k_i \int (u - \theta) dt, \pm \tau_{max})

    A cascade of a position P loop and a velocity PI loop, as position servos have it, acts like this PID. The
    integrator lets it hold its angle without steady-state error. Against wind-up it is clamped to what it can be
    needed for: the torque limit on top of k_v θ̇ at the speed limit.
    """

    position_gain: float = quantity("N·m/rad", gt=0, description="k_p, position gain")
    velocity_gain: float = quantity("N·m·s/rad", 0.0, ge=0, description="k_v, velocity gain")
    integral_gain: float = quantity("N·m/(rad·s)", 0.0, ge=0, description="k_i, integral gain, 0 for none")
    torque_limit: float = quantity("N·m", gt=0, description="largest torque of the servo at the output")
    speed_limit: float = quantity("rad/s", gt=0, description="no-load speed of the servo at the output")

    @property
    def integral_limit(self) -> float:
        """Largest magnitude of the integral of the position error [rad·s]; 0 without an integrator."""
        if self.integral_gain == 0.0:
            return 0.0
        return (self.torque_limit + self.velocity_gain * self.speed_limit) / self.integral_gain


class ElasticJoint(Model):
    """One elastic joint: transmission, rotor, friction, servo and motor encoder.

    A rigid joint has no `ElasticJoint`; compare with one by the `rigid` form of
    `elastic_env.joint.make_elastic.make_elastic`.
    """

    stiffness: float = quantity("N·m/rad", gt=0, description="K, stiffness of the transmission")
    damping: float = quantity("N·m·s/rad", 0.0, ge=0, description="D, damping of the transmission")
    rotor_inertia: float = quantity("kg·m²", gt=0, description="B, rotor inertia reflected to the output")
    backlash: float = quantity("rad", 0.0, ge=0, description="width of the dead band of the deflection")
    coulomb_friction: float = quantity("N·m", 0.0, ge=0, description="dry friction on the link side of the spring")
    viscous_friction: float = quantity("N·m·s/rad", 0.0, ge=0, description="viscous friction on the link side")
    encoder_counts_per_turn: int | None = quantity(
        "1", None, gt=0, description="motor encoder, counts per turn of the output; None for continuous"
    )
    servo: Servo | None = quantity("1", None, description="position servo on the rotor; None to add no actuator")

    @model_validator(mode="after")
    def _backlash_is_small(self) -> Self:
        if self.backlash >= np.pi:
            raise ValueError(f"backlash must be below half a turn, {np.pi:.4f} rad, got {self.backlash}")
        return self


def joint_torque(
    deflection: Array,
    deflection_rate: Array,
    stiffness: Parameter,
    damping: Parameter = 0.0,
    backlash: Parameter = 0.0,
) -> Array:
    r"""Torque that the transmission passes from rotor to link [Spong1987], with a dead band.

    .. math:: \tau_J = K \,\mathrm{sign}(\delta) \max(|\delta| - b/2, 0) + D \dot\delta

    Args:
        deflection: δ = θ − q, (..., n) [rad].
        deflection_rate: δ̇, (..., n) [rad/s].
        stiffness: K, broadcast against (..., n) [N·m/rad].
        damping: D, likewise [N·m·s/rad]; it acts inside the dead band too.
        backlash: Width b of the dead band [rad].

    Returns:
        τ_J, (..., n) [N·m]; positive drives the link forward.
    """
    if np.any(backlash):
        deflection = np.sign(deflection) * np.maximum(np.abs(deflection) - np.asarray(backlash) / 2.0, 0.0)
    return stiffness * deflection + damping * deflection_rate


def static_deflection(torque: Array, stiffness: Parameter, backlash: Parameter = 0.0) -> Array:
    r"""Deflection at rest under a joint torque, Eqs. 2 and 3: δ = K⁻¹ τ, plus half the dead band towards the load.

    Args:
        torque: τ_J, (..., n) [N·m]; at rest the gravity torque.
        stiffness: K [N·m/rad].
        backlash: Width of the dead band [rad].

    Returns:
        δ = θ − q, (..., n) [rad]; positive where the motor side leads.
    """
    wound = torque / stiffness
    return wound if isinstance(backlash, float) and backlash == 0.0 else wound + np.sign(torque) * backlash / 2.0


def static_link_angle(
    theta: Array,
    stiffness: Parameter,
    torque: TorqueFunction,
    torque_gradient: TorqueFunction,
    tolerance: float = 1e-12,
    max_iterations: int = 50,
) -> Array:
    r"""Link angle at rest for a motor angle: Eq. 10, q = θ − K⁻¹ τ_g(q), by Newton-Raphson from q = θ.

    Args:
        theta: Motor side, (..., n) [rad].
        stiffness: K, broadcast against (..., n) [N·m/rad].
        torque: τ_g(q), from (..., n) to (..., n) [N·m].
        torque_gradient: ∂τ_g/∂q, from (..., n) to (..., n, n) [N·m/rad].
        tolerance: Largest residual of Eq. 10 that is accepted [rad].
        max_iterations: Newton steps before giving up.

    Returns:
        q, (..., n) [rad].

    Raises:
        ElasticError: No convergence, as happens where gravity overcomes the spring (K + ∂τ_g/∂q singular).
    """
    K = np.broadcast_to(np.asarray(stiffness, dtype=np.float64), theta.shape)
    q = np.array(theta, dtype=np.float64)
    residual = np.full_like(q, np.inf)
    for _ in range(max_iterations):
        residual = K * (q - theta) + torque(q)
        open_rows = np.any(np.abs(residual) > tolerance * K, axis=-1, keepdims=True)
        if not open_rows.any():
            return q
        # rows that are done stay, so that a row does not depend on the rest of its batch
        q = np.where(open_rows, q - solve_stiffness(K, torque_gradient(q), residual), q)
    raise ElasticError(
        f"Eq. 10 did not converge in {max_iterations} Newton steps: residual {np.abs(residual / K).max():.3g} rad, "
        f"required {tolerance:.3g} rad; is the stiffness (smallest {K.min():.6g} N·m/rad) too low for the load?"
    )


def solve_stiffness(stiffness: Array, torque_gradient: Array, torque: Array) -> Array:
    r"""Solve (K + ∂τ_g/∂q) x = τ, the matrix form of the quotient in Eq. 12.

    Args:
        stiffness: Diagonal of K, (..., n) [N·m/rad].
        torque_gradient: ∂τ_g/∂q, (..., n, n) [N·m/rad].
        torque: Right-hand side, (..., n) [N·m].

    Returns:
        x, (..., n) [rad].

    Raises:
        ElasticError: K + ∂τ_g/∂q is singular: gravity balances the spring and no deflection is stable.
    """
    n = stiffness.shape[-1]
    # every row by its own stiffness: the size of K says nothing about singularity
    relative = torque_gradient / stiffness[..., None] + np.eye(n)
    if n == 1:
        _require_regular(relative[..., 0, 0], stiffness)
        return torque / stiffness / relative[..., 0]
    try:
        solution = np.linalg.solve(relative, (torque / stiffness)[..., None])[..., 0]
    except np.linalg.LinAlgError:
        solution = np.full_like(torque, np.inf)
    if not (np.abs(solution) < np.pi).all():  # no deflection: worth a closer look
        _require_regular(np.linalg.det(relative), stiffness)
    return solution


def _require_regular(determinant: Array, stiffness: Array) -> None:
    if (np.abs(determinant) < np.finfo(np.float64).eps).any():
        raise ElasticError(
            "K + ∂τ_g/∂q is singular: gravity cancels the stiffness "
            f"(smallest K {stiffness.min():.6g} N·m/rad); a stiffer joint or a lighter load is needed"
        )
