r"""The elastic joint: a rotor behind a spring, a damper and a dead band.

    servo → rotor (θ, B) → K, D, backlash → link (q) ← friction, gravity

The deflection is δ = θ − q (Eq. 2), the joint torque τ_J what the transmission passes to the link;
at rest τ_J equals the gravity torque τ_g up to the friction on the link. All functions work on
(..., n) arrays, so that one joint, one robot and a batch of robots are the same formula. In
simulation `make_elastic` puts the same joint into a model of MuJoCo.

[Spong1987] M. W. Spong, "Modeling and Control of Elastic Joint Robots", J. Dyn. Sys., Meas.,
Control 109(4). Eq. n: the paper that this project reproduces (see the README).
"""

import numpy as np

from elastic_env.core.compiled import within_compiled
from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array, BoolArray, Parameter

_SINGULAR = float(np.finfo(np.float64).eps)
"""Determinant below which a matrix counts as singular."""


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
    wound = wound_deflection(deflection, backlash) if np.any(backlash) else deflection
    return stiffness * wound + damping * deflection_rate


@within_compiled
def wound_deflection(deflection: Array, backlash: Parameter) -> Array:
    """Deflection of the spring without the dead band, (..., n) [rad], see `joint_torque`."""
    return np.sign(deflection) * np.maximum(np.abs(deflection) - backlash / 2.0, 0.0)


def static_deflection(torque: Array, stiffness: Parameter, backlash: Parameter = 0.0) -> Array:
    r"""Deflection at rest, Eqs. 2 and 3: δ = K⁻¹ τ, plus half the dead band towards the load.

    Args:
        torque: τ_J, (..., n) [N·m]; at rest the gravity torque.
        stiffness: K [N·m/rad].
        backlash: Width of the dead band [rad].

    Returns:
        δ = θ − q, (..., n) [rad]; positive where the motor side leads.
    """
    wound = torque / stiffness
    if isinstance(backlash, float) and backlash == 0.0:
        return wound
    return wound + np.sign(torque) * backlash / 2.0


def solve_stiffness(stiffness: Array, torque_gradient: Array, torque: Array) -> Array:
    r"""Solve (K + ∂τ_g/∂q) x = τ, the matrix form of the quotient in Eq. 12.

    Args:
        stiffness: Diagonal of K, (..., n) [N·m/rad].
        torque_gradient: ∂τ_g/∂q, (..., n, n) [N·m/rad].
        torque: Right-hand side, (..., n) [N·m].

    Returns:
        x, (..., n) [rad].

    Raises:
        ElasticError: K + ∂τ_g/∂q is singular: gravity balances the spring and no deflection is
            stable.
    """
    # every row by its own stiffness: the size of K says nothing about singularity
    relative_gradient = torque_gradient / stiffness[..., None]
    solution, is_singular = solve_relative(relative_gradient, torque / stiffness)
    if is_singular.any():
        raise ElasticError(
            "K + ∂τ_g/∂q is singular: gravity cancels the stiffness (smallest K"
            f" {stiffness.min():.6g} N·m/rad); a stiffer joint or a lighter load is needed"
        )
    return solution


def solve_relative(relative_gradient: Array, right: Array) -> tuple[Array, BoolArray]:
    """Solve (1 + K⁻¹ ∂τ_g/∂q) x = K⁻¹ τ row by row.

    Args:
        relative_gradient: K⁻¹ ∂τ_g/∂q, (..., n, n).
        right: K⁻¹ τ, (..., n) [rad].

    Returns:
        x, (..., n) [rad], and rows whose matrix is singular, (..., 1).
    """
    n = right.shape[-1]
    matrix = relative_gradient + np.eye(n)
    if n == 1:
        is_singular = np.abs(matrix[..., 0]) < _SINGULAR
        return right / np.where(is_singular, 1.0, matrix[..., 0]), is_singular
    try:
        solution = np.linalg.solve(matrix, right[..., None])[..., 0]
    except np.linalg.LinAlgError:
        is_zero = np.linalg.det(matrix)[..., None] == 0.0
        regular = np.where(is_zero[..., None], np.eye(n), matrix)
        solution = np.linalg.solve(regular, right[..., None])[..., 0]
        solution = np.where(is_zero, np.inf, solution)
    is_large: BoolArray = ~np.all(np.abs(solution) < np.pi, axis=-1, keepdims=True)
    if not is_large.any():
        return solution, is_large
    # no deflection: worth a closer look
    determinant = np.abs(np.linalg.det(matrix))[..., None]
    return solution, is_large & (determinant < _SINGULAR)
