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
from elastic_env.joint.load_continuation import TorqueFunction, follow_load

_SINGULAR = float(np.finfo(np.float64).eps)
"""Determinant below which a matrix counts as singular."""
_SAME_RAD = 1e-6
"""Largest distance of two results that count as one equilibrium."""
_FAR_RAD = 0.5
"""Deflection beyond which there may be other equilibria."""
_LARGEST_STEP_RAD = 1e6
"""Newton steps beyond this lead nowhere."""


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


def static_link_angle(
    theta: Array,
    stiffness: Parameter,
    torque: TorqueFunction,
    torque_gradient: TorqueFunction,
    tolerance: float = 1e-12,
    max_iterations: int = 50,
    unique: bool = True,
) -> Array:
    r"""Link angle at rest: Eq. 10, q = θ − K⁻¹ τ_g(q), by Newton-Raphson from q = θ.

    Where the load bends a spring far, Newton's steps may fail or end at another equilibrium. There
    the load grows from zero, see `follow_load`.

    Args:
        theta: Motor side, (..., n) [rad].
        stiffness: K, broadcast against (..., n) [N·m/rad].
        torque: τ_g(q), from (..., n) to (..., n) [N·m].
        torque_gradient: ∂τ_g/∂q, from (..., n) to (..., n, n) [N·m/rad].
        tolerance: Largest residual of Eq. 10 that is accepted [rad].
        max_iterations: Newton steps before the load is followed.
        unique: Whether an equilibrium on a soft spring must be the only one. If not, the one that a
            growing load leads to is taken.

    Returns:
        q, (..., n) [rad].

    Raises:
        ElasticError: The load overcomes a spring: there is no equilibrium that a growing load leads
            to, or there are several.
    """
    K = np.broadcast_to(np.asarray(stiffness, dtype=np.float64), theta.shape)
    q = np.array(theta, dtype=np.float64)
    is_soft = np.zeros((*theta.shape[:-1], 1), dtype=np.bool_)
    open_rows = ~is_soft
    residual = np.full_like(q, np.inf)
    for iteration in range(max_iterations):
        residual = K * (q - theta) + torque(q)
        is_off = np.abs(residual) > tolerance * K
        open_rows = open_rows & is_off.any(axis=-1, keepdims=True)
        if iteration and not open_rows.any():
            break
        # rows that are done stay, so that a row does not depend on the rest of its batch
        gradient = torque_gradient(q) / K[..., None]
        step, is_singular = _solved(gradient, residual / K)
        is_short = np.abs(step) < _LARGEST_STEP_RAD
        is_lost = is_singular | ~is_short.all(axis=-1, keepdims=True)
        may_fold = (open_rows | (iteration == 0)) & _may_fold(gradient)
        is_soft = is_soft | may_fold | (open_rows & is_lost)
        open_rows = open_rows & ~is_lost
        q = np.where(open_rows, q - step, q)
    is_far = np.abs(q - theta).max(axis=-1, keepdims=True) > _FAR_RAD
    is_soft = is_soft | open_rows | is_far
    if not is_soft.any():
        return q
    own = {"tolerance": tolerance, "rows": is_soft, "unique": unique}
    found = follow_load(theta, 1.0 / K, torque, torque_gradient, **own)
    if found.lost.any():
        problem = "the link angle at rest is not clear, Eq. 10"
        raise ElasticError(f"{problem}: {found.reason(1.0 / K)}")
    is_same = ~open_rows & (np.abs(found.q - q).max(axis=-1, keepdims=True) < _SAME_RAD)
    return np.where(is_soft & ~is_same, found.q, q)


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
    solution, is_singular = _solved(relative_gradient, torque / stiffness)
    if is_singular.any():
        raise ElasticError(
            "K + ∂τ_g/∂q is singular: gravity cancels the stiffness (smallest K"
            f" {stiffness.min():.6g} N·m/rad); a stiffer joint or a lighter load is needed"
        )
    return solution


def _solved(relative_gradient: Array, right: Array) -> tuple[Array, BoolArray]:
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


def _may_fold(relative_gradient: Array) -> BoolArray:
    """Rows whose load may overcome a spring: K⁻¹ ∂τ_g/∂q is not smaller than 1, (..., 1)."""
    row_sums = np.abs(relative_gradient).sum(axis=-1)
    return np.asarray(row_sums.max(axis=-1, keepdims=True) >= 1.0)
