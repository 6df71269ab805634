"""The link angle at rest, where spring and load balance (Eq. 10)."""

import numpy as np

from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array, BoolArray, Parameter
from elastic_env.joint.elasticity import solve_relative
from elastic_env.joint.load_continuation import TorqueFunction, follow_load

_SAME_RAD = 1e-6
"""Largest distance of two results that count as one equilibrium."""
_FAR_RAD = 0.5
"""Deflection beyond which there may be other equilibria."""
_LARGEST_STEP_RAD = 1e6
"""Newton steps beyond this lead nowhere."""


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
        step, is_singular = solve_relative(gradient, residual / K)
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


def _may_fold(relative_gradient: Array) -> BoolArray:
    """Rows whose load may overcome a spring: K⁻¹ ∂τ_g/∂q is not smaller than 1, (..., 1)."""
    row_sums = np.abs(relative_gradient).sum(axis=-1)
    return np.asarray(row_sums.max(axis=-1, keepdims=True) >= 1.0)
