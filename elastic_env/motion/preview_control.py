r"""Preview control of the center of mass on the cart-table model [Kajita2003].

The cart of mass M at height z_c has the ZMP p = x − (z_c/g) ẍ. The jerk of the cart is chosen by an
optimal servo with preview of the ZMP reference: integral of the ZMP error, state feedback, and the
reference of the next seconds.

[Kajita2003] S. Kajita et al., "Biped Walking Pattern Generation by using Preview Control of
Zero-Moment Point", ICRA. [Katayama1985] T. Katayama et al., "Design of an optimal controller for a
discrete-time system subject to previewable demand", Int. J. Control 41(3).
"""

from dataclasses import dataclass

import numpy as np

from elastic_env.core.config import Model, quantity
from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array


class PreviewConfig(Model):
    """Cart-table model and weights of the preview servo."""

    com_height_m: float = quantity("m", gt=0)
    """z_c, height of the center of mass over the ground [m]."""
    period_s: float = quantity("s", 0.004, gt=0)
    """Control period [s]."""
    preview_s: float = quantity("s", 1.6, gt=0)
    """Time over which the reference is known [s]."""
    error_weight: float = quantity("1/m²", 1.0, gt=0)
    """Weight of the ZMP error [1/m²]."""
    jerk_weight: float = quantity("s⁶/m²", 1e-6, gt=0)
    """Weight of the jerk [s⁶/m²]."""
    gravity: float = quantity("m/s²", 9.81, gt=0)
    """Acceleration of gravity [m/s²]."""


@dataclass(frozen=True)
class PreviewGains:
    """Gains on the integrated ZMP error, the state (x, ẋ, ẍ), and the reference in preview."""

    integral: float
    state: Array
    preview: Array


@dataclass(frozen=True)
class ComMotion:
    """Motion of the center of mass and its ZMP on the cart-table, time first [m], [m/s], [m/s²]."""

    com: Array
    com_dot: Array
    com_ddot: Array
    zmp: Array


def cart_table(config: PreviewConfig) -> tuple[Array, Array, Array]:
    """Discrete cart-table: x_{k+1} = A x_k + b u_k with the jerk u, p = c·x; (3, 3), (3,), (3,)."""
    T = config.period_s
    A = np.array([[1.0, T, T**2 / 2.0], [0.0, 1.0, T], [0.0, 0.0, 1.0]])
    b = np.array([T**3 / 6.0, T**2 / 2.0, T])
    c = np.array([1.0, 0.0, -config.com_height_m / config.gravity])
    return A, b, c


def preview_gains(config: PreviewConfig) -> PreviewGains:
    """Compute optimal gains by the Riccati equation of the incremental system [Katayama1985]."""
    # imported late: it takes a tenth of a second, and only walks need it
    from scipy import linalg

    A, b, c = cart_table(config)
    Phi = np.block([[np.ones((1, 1)), (c @ A)[None]], [np.zeros((3, 1)), A]])
    G = np.concatenate([[c @ b], b])[:, None]
    Q = np.diag([config.error_weight, 0.0, 0.0, 0.0])
    P = linalg.solve_discrete_are(Phi, G, Q, np.array([[config.jerk_weight]]))
    denominator = config.jerk_weight + (G.T @ P @ G).item()
    K = (G.T @ P @ Phi / denominator)[0]
    closed_loop = Phi - G @ K[None]
    steps = round(config.preview_s / config.period_s)
    preview = np.empty(steps)
    X = -closed_loop.T @ P[:, 0]
    preview[0] = -K[0]
    for i in range(1, steps):
        preview[i] = (G[:, 0] @ X) / denominator
        X = closed_loop.T @ X
    return PreviewGains(integral=float(K[0]), state=K[1:], preview=preview)


def follow_zmp(config: PreviewConfig, zmp_ref: Array, start: Array) -> ComMotion:
    """Compute the motion of the center of mass whose ZMP follows a reference, from rest.

    Args:
        config: Model and weights.
        zmp_ref: Reference at the control rate, (T, d) [m]; its last row continues beyond the end.
        start: Position of the center of mass at rest, (d,) [m].

    Returns:
        Motion at the times of the reference, (T, d) each.

    Raises:
        ElasticError: Shapes that do not fit.
    """
    if zmp_ref.ndim != 2 or start.shape != zmp_ref.shape[1:]:
        got = f"got {zmp_ref.shape} and {start.shape}"
        raise ElasticError(f"zmp_ref must be (T, d) and start (d,), {got}")
    A, b, c = cart_table(config)
    gains = preview_gains(config)
    steps, dimensions = zmp_ref.shape
    reach = len(gains.preview)
    continuation = np.repeat(zmp_ref[-1:], reach + 1, axis=0)
    # increments[k] = r_{k+1} − r_k
    increments = np.diff(np.concatenate([zmp_ref, continuation]), axis=0)
    state = np.zeros((3, dimensions))
    state[0] = start
    last = state
    jerk = np.zeros(dimensions)
    states = np.empty((steps, 3, dimensions))
    for k in range(steps):
        states[k] = state
        error = c @ state - zmp_ref[k]
        # in increments, for which the servo is optimal: it knows the preview from the first step on
        jerk = (
            jerk
            - gains.integral * error
            - gains.state @ (state - last)
            - gains.preview @ increments[k : k + reach]
        )
        last = state
        state = A @ state + b[:, None] * jerk
    zmp = np.einsum("i,kid->kd", c, states)
    return ComMotion(states[:, 0], states[:, 1], states[:, 2], zmp)
