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

from elastic_env.core.config import Model, quantity
from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array, BoolArray, Parameter
from elastic_env.joint.load_continuation import TorqueFunction, follow_load
from elastic_env.joint.motor import Motor

_SINGULAR = float(np.finfo(np.float64).eps)
"""Determinant below which a matrix counts as singular."""
_SAME_RAD = 1e-6
"""Largest distance of two results that count as one equilibrium."""
_FAR_RAD = 0.5
"""Deflection beyond which there may be other equilibria."""
_LARGEST_STEP_RAD = 1e6
"""Newton steps beyond this lead nowhere."""


class Servo(Model):
    r"""Position servo on the rotor: PID on the motor encoder, limited in torque.

    .. math::
        \tau_m = \mathrm{clip}(k_p (u - \theta) - k_v \dot\theta + k_i \int (u - \theta) dt, \pm \tau_{max})

    A cascade of a position P loop and a velocity PI loop, as position servos have it, acts like
    this PID. The integrator lets it hold its angle without steady-state error. Against wind-up it
    is clamped to what it can be needed for: the torque limit on top of k_v θ̇ at the speed limit.

    With a `motor` the PID sets the duty cycle of the pulse-width modulation. The gains are those at
    rest, where the duty cycle u gives the torque k_t V u / R. The back-EMF takes from it:

    .. math::
        \tau_m = \mathrm{clip}(\mathrm{clip}(\tau_{PID}, \pm k_t V u_{max} / R)
        - k_t k_e \dot\theta / R, \pm \tau_{max})

    The torque limit is that of the current, k_t i_max; give the stall torque where there is none.
    """  # noqa: E501

    position_gain: float = quantity("N·m/rad", gt=0)
    """k_p, position gain [N·m/rad]."""
    velocity_gain: float = quantity("N·m·s/rad", 0.0, ge=0)
    """k_v, velocity gain [N·m·s/rad]."""
    integral_gain: float = quantity("N·m/(rad·s)", 0.0, ge=0)
    """k_i, integral gain, 0 for none [N·m/(rad·s)]."""
    torque_limit: float = quantity("N·m", gt=0)
    """Largest torque of the servo at the output [N·m]."""
    speed_limit: float = quantity("rad/s", gt=0)
    """No-load speed of the servo at the output [rad/s]."""
    motor: Motor | None = quantity("1", None)
    """DC motor with back-EMF and PWM limit; None for a torque that does not depend on speed [1]."""

    @property
    def braking(self) -> float:
        """k_v and what the back-EMF adds to it [N·m·s/rad]."""
        return self.velocity_gain + (0.0 if self.motor is None else self.motor.damping)

    @property
    def integral_limit(self) -> float:
        """Largest magnitude of the position error's integral [rad·s]; 0 without one."""
        if self.integral_gain == 0.0:
            return 0.0
        most = self.torque_limit + self.braking * self.speed_limit
        return most / self.integral_gain

    def largest_torque(self, speed: Parameter = 0.0) -> Array:
        """Torque that the servo has at a speed, broadcast from (..., n) [rad/s] to [N·m].

        The motor's torque falls with the speed; without a motor it is the limit throughout.
        """
        limit = np.full(np.shape(speed), self.torque_limit)
        if self.motor is None:
            return limit
        left = self.motor.stall_torque - self.motor.damping * np.abs(speed)
        return np.minimum(limit, left.clip(min=0.0))


class FrictionTerms(Model):
    """Terms of `elastic_env.joint.friction.dry_friction` that change with load or speed."""

    load_friction: float = quantity("1", 0.0, ge=0, lt=1)
    """c, share of the torque passed that is lost to dry friction, see `dry_friction` [1]."""
    static_friction: float = quantity("N·m", 0.0, ge=0)
    """F_s, excess of dry friction at rest over that in motion [N·m]."""
    stribeck_speed: float = quantity("rad/s", 0.0, ge=0)
    """ω_s, speed at which that excess is down to 37 %; required with `static_friction` [rad/s]."""

    def _check(self) -> None:
        if self.static_friction > 0.0 and self.stribeck_speed == 0.0:
            raise ValueError(
                f"static_friction = {self.static_friction:g} N·m needs a stribeck_speed above 0"
                " [rad/s], by which it falls to 37 %; 0.05 rad/s is usual for gears"
            )


class ElasticJoint(FrictionTerms):
    """One elastic joint: transmission, rotor, friction, servo and motor encoder.

    A rigid joint has no `ElasticJoint`; compare with one by the `rigid` form of
    `elastic_env.joint.make_elastic.make_elastic`.
    """

    stiffness: float = quantity("N·m/rad", gt=0)
    """K, stiffness of the transmission [N·m/rad]."""
    damping: float = quantity("N·m·s/rad", 0.0, ge=0)
    """D, damping of the transmission [N·m·s/rad]."""
    rotor_inertia: float = quantity("kg·m²", gt=0)
    """B, rotor inertia reflected to the output [kg·m²]."""
    backlash: float = quantity("rad", 0.0, ge=0, lt=np.pi)
    """Width of the dead band of the deflection [rad]."""
    coulomb_friction: float = quantity("N·m", 0.0, ge=0)
    """Dry friction on the link side of the spring [N·m]."""
    viscous_friction: float = quantity("N·m·s/rad", 0.0, ge=0)
    """Viscous friction on the link side [N·m·s/rad]."""
    encoder_counts_per_turn: int | None = quantity("1", None, gt=0)
    """Motor encoder, counts per turn of the output; None for continuous [1]."""
    servo: Servo | None = quantity("1", None)
    """Position servo on the rotor; None to add no actuator [1]."""


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
        wound = np.maximum(np.abs(deflection) - np.asarray(backlash) / 2.0, 0.0)
        deflection = np.sign(deflection) * wound
    return stiffness * deflection + damping * deflection_rate


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
