r"""Stiffness of every joint of an arm by least squares over static poses, with 95 % intervals.

The unknowns x of `PoseModel` minimise the squared residuals of the measurement. A weak prior,
Gaussian with the scales of the model, keeps unknowns near zero that the poses say nothing about; on
the others it has no visible effect.

The intervals do not assume equal noise: friction without known direction acts on all measurements
of a pose at once, and more in one pose than in another. The covariance of x is the cluster-robust
one in its jackknife form (CR3), a cluster per pose, with Student's t:

.. math:: V = M^{-1} \Big( \tfrac{N-1}{N} \sum_i J_i^T e^*_i e^{*T}_i J_i + \Lambda \Big) M^{-1}, \quad
    e^*_i = (1 - J_i M^{-1} J_i^T)^{-1} e_i, \quad M = J^T J + \Lambda

(R. M. Bell and D. F. McCaffrey, "Bias Reduction in Standard Errors for Linear Regression with
Multi-Stage Samples", Survey Methodology 28(2), 2002.) Λ is the precision of the prior.

A log whose signs contradict the model is refused: swapped encoders, joints that turn the other way.
"""  # noqa: E501

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import stats
from scipy.optimize import least_squares

from baselines.identification.pose_log import Kind, PoseLog
from baselines.identification.pose_model import PoseModel, measurement_unit
from elastic_env.core.errors import ConfigurationError, ElasticError
from elastic_env.core.signals import Array, BoolArray, IntArray

_EXPLAINED = 0.8
"""Share of a joint's deflections that a spring of negative stiffness explains where it
contradicts the model.
"""
_MOST_CORRELATED = -0.9
_LEAST_MOTION_RAD = 0.05
_BETTER = 0.2
"""Ratio of the spreads of the residuals with a sign turned round and as logged, where the sign
is wrong.
"""
_MOST_NAMED = 4
_MOST_JOINTS = 16
"""Joints of an arm whose signs are tried."""


def require_like_encoders(log: PoseLog) -> None:
    """Refuse link encoders that run against the motor encoders.

    Raises:
        ConfigurationError: Those of a joint do.
    """
    if log.kind != "link_encoders":
        return
    wrong = []
    for column, joint in enumerate(log.columns):
        theta = log.theta[:, log.joints.index(joint)]
        q = log.measured[:, column]
        moves = min(np.ptp(theta), np.ptp(q)) > _LEAST_MOTION_RAD
        if moves and np.corrcoef(theta, q)[0, 1] < _MOST_CORRELATED:
            wrong.append(joint)
    if wrong:
        raise ConfigurationError(
            f"theta and q run against each other: a sign is wrong ({_joints(wrong)}); give both the"
            " sign of the model"
        )


def require_deflections_with_load(model: PoseModel, unknowns: Array, half_width: Array) -> None:
    """Refuse link encoders that show springs of negative stiffness.

    Args:
        model: The poses.
        unknowns: Estimates, (p,).
        half_width: Of the intervals of the compliances, (k,) [rad/(N·m)].

    Raises:
        ConfigurationError: The links of a joint deflect against their load.
    """
    if model.log.kind != "link_encoders":
        return
    compliance = unknowns[model.unknowns.slices["compliance"]]
    torque = model.torque(unknowns, model.link_angles(unknowns)[0])
    against = []
    for i, at in enumerate(model.unknowns.elastic):
        name = model.log.joints[at]
        if name in model.log.columns and compliance[i] < -half_width[i]:
            q = model.log.measured[:, model.log.columns.index(name)]
            measured = model.log.theta[:, at] - q
            missing = measured - compliance[i] * torque[:, at]
            if np.var(missing) < (1.0 - _EXPLAINED) * np.var(measured):
                against.append(name)
    if against:
        raise ConfigurationError(
            "the links deflect against their load: are theta and q swapped, or a sign wrong"
            f" ({_joints(against)})? Springs give way to the load; give theta.JOINT of the motor"
            " encoder and q.JOINT of the link encoder in the signs of the model"
        )


def require_signs(model: PoseModel, spread_of: Callable[[PoseModel], float]) -> None:
    """Refuse a log that fits the model far better with the sign of a joint turned round.

    Args:
        model: The poses.
        spread_of: Spread of the residuals, also with other poses.

    Raises:
        ConfigurationError: There is such a joint.
    """
    joints = model.log.joints
    if len(joints) > _MOST_JOINTS:
        return
    turned = {joint: replace(model, log=turn_joint(model.log, joint)) for joint in joints}
    found = {joint: spread_of(other) for joint, other in turned.items()}
    least = min(found.values())
    if least < _BETTER * spread_of(model):
        wrong = [joint for joint, own in found.items() if own < 2.0 * least]
        raise ConfigurationError(
            f"the links deflect against their load: a sign is wrong ({_joints(wrong)}). With all"
            f" columns of {' or '.join(wrong[:3])} turned round the poses fit the model; give them"
            " the sign of the model"
        )


def turn_joint(log: PoseLog, joint: str) -> PoseLog:
    """A log in which a joint turns the other way."""
    at = np.array(log.joints) == joint
    measured = log.measured
    if log.kind in ("link_encoders", "torques"):
        measured = _negative(measured, np.array(log.columns) == joint)
    return replace(
        log,
        theta=_negative(log.theta, at),
        measured=measured,
        direction=_negative(log.direction, at),
        known=_negative(log.known, at),
    )


def _negative(table: Any, columns: BoolArray) -> Any:
    return None if table is None else np.where(columns, -table, table)


def _joints(names: Sequence[str]) -> str:
    """A joint, or one of several, of which the first few are named."""
    if len(names) > _MOST_NAMED:
        names = [*names[:_MOST_NAMED], f"{len(names) - _MOST_NAMED} others"]
    return f"joint {' or '.join(names)}"


_FINEST: dict[Kind, float] = {
    "end_effector": 1e-4,
    "imu": 1e-4,
    "link_encoders": 1e-5,
    "torques": 1e-2,
}
"""Noise beside which the prior counts [m], [rad], [N·m]: about that of good sensors."""
USUAL_NOISE: dict[Kind, float] = {
    "end_effector": 3e-4,
    "imu": 1e-3,
    "link_encoders": 1e-4,
    "torques": 0.1,
}
"""Noise of usual sensors [m], [rad], [N·m]."""
FAR_BEYOND = 10.0
"""Ratio of residuals and usual noise from which on the log does not fit the arm."""
MOST_EVALUATIONS = 100
"""Steps after which a fit goes on with steps in units of the derivatives."""
_FURTHER_EVALUATIONS = 150
USUAL_EVALUATIONS = 12
"""Steps of a usual fit, at most."""

_FURTHER_POSES = 3  # beyond those that are as many numbers as unknowns
_FIRST_DEFLECTION_RAD = 0.01  # not zero: a rigid joint shows nothing of its friction
_UNLIKE = 3.0  # ratio of how far positions spread, measured and of the model
_OUTLYING = 5.0  # standard deviations


@dataclass(frozen=True)
class ArmFit:
    """Unknowns that fit a log, and how well they are known.

    Attributes:
        model: The poses.
        unknowns: Estimates, (p,).
        covariance: Of the estimates, (p, p).
        information: JᵀJ / σ² + Λ in units of the scales, with the spread σ of the residuals, (p,
            p).
        q: Link angles, (N, n) [rad].
        residual: Measured less predicted, (N, m).
        spread: Standard deviation of the residuals, in the unit of the measurement.
        freedom: Degrees of freedom of the intervals.
    """

    model: PoseModel
    unknowns: Array
    covariance: Array
    information: Array
    q: Array
    residual: Array
    spread: float
    freedom: int

    @property
    def quantile(self) -> float:
        """Half-width of a 95 % interval in standard deviations."""
        return float(stats.t.ppf(0.975, self.freedom))

    def estimate(self, name: str) -> tuple[Array, Array]:
        """Estimates of one kind of unknown and the half-widths of their 95 % intervals."""
        own = self.model.unknowns.slices[name]
        return self.unknowns[own], self.quantile * np.sqrt(np.diag(self.covariance)[own])

    @property
    def outliers(self) -> IntArray:
        """Poses whose residual is far beyond the spread."""
        size = np.sqrt(np.mean(self.residual**2, axis=1))
        usual = 1.4826 * np.median(size) if len(size) else 0.0
        return np.flatnonzero(size > _OUTLYING * max(float(usual), 1e-12))


def fit_arm(model: PoseModel, progress: Callable[[int], None] | None = None) -> ArmFit:
    """Fit the unknowns of a log.

    Args:
        model: The poses.
        progress: Called with the number of evaluations so far.

    Raises:
        ConfigurationError: Too few poses for the unknowns, or the signs of the log contradict the
            model.
        ElasticError: The log does not fit the arm.
    """
    require_poses(model)
    require_like_encoders(model.log)
    if _spread_near(model) > FAR_BEYOND * USUAL_NOISE[model.log.kind]:
        require_signs(model, _spread_near)
    fit = _described(model, solve_unknowns(model, progress), _FINEST[model.log.kind])
    require_deflections_with_load(model, fit.unknowns, fit.estimate("compliance")[1])
    return fit


def solve_unknowns(model: PoseModel, progress: Callable[[int], None] | None = None) -> Array:
    """Unknowns that fit, (p,); no check of the log.

    Raises:
        ElasticError: There are no springs that explain the log, or they are not found.
    """
    if not model.unknowns.size:
        return np.zeros(0)
    noise = _FINEST[model.log.kind]
    count = 0
    at = gradient = np.empty(0)

    def residual(x: Array) -> Array:
        """Predicted less measured in units of noise, then the prior, (N m + p,).

        Infinite where a load overcomes a spring: the solver takes a shorter step.
        """
        nonlocal count, at, gradient
        count += 1
        if progress is not None:
            progress(count)
        try:
            predicted, gradient = model.predict(model.scale * x)
        except ElasticError:
            if not len(at):  # at the start
                raise
            return np.full(model.target.size + len(x), np.inf)
        at = x.copy()
        return np.concatenate([(predicted - model.target).ravel() / noise, x])

    def jacobian(x: Array) -> Array:
        """Its derivatives, (N m + p, p); the solver has asked for the residual there."""
        if not np.array_equal(x, at):
            residual(x)
        rows = gradient.reshape(-1, len(x)) * model.scale / noise
        return np.concatenate([rows, np.eye(len(x))])

    def solve(start: Array, evaluations: int, scale: Any) -> Any:
        return least_squares(
            residual,
            start,
            jac=jacobian,  # pyright: ignore[reportArgumentType]  a callable is meant to be here
            method="trf",
            max_nfev=evaluations,
            x_scale=scale,
        )

    start = model.start_with(_FIRST_DEFLECTION_RAD) / model.scale
    found = solve(start, MOST_EVALUATIONS, 1.0)
    if not found.success:  # ill-conditioned: steps in units of the derivatives help
        found = solve(found.x, _FURTHER_EVALUATIONS, "jac")
    if not found.success:
        raise ElasticError(
            f"the fit did not converge in {MOST_EVALUATIONS + _FURTHER_EVALUATIONS} steps; check"
            " zeros and units of the log's columns and the masses of the model, or seek fewer"
            " joints by --joints"
        )
    return model.scale * found.x


def _spread_near(model: PoseModel) -> float:
    """Spread of the residuals to first order about small deflections, in the measurement's unit."""
    start = model.start_with(_FIRST_DEFLECTION_RAD)
    predicted, gradient = model.predict(start)
    noise = _FINEST[model.log.kind]
    rows = gradient.reshape(-1, len(start)) * model.scale / noise
    residual = (model.target - predicted).ravel() / noise
    step = np.linalg.solve(rows.T @ rows + np.eye(len(start)), rows.T @ residual)
    return noise * float(np.std(residual - rows @ step))


def needed_poses(model: PoseModel) -> int:
    """Poses that the unknowns need at least."""
    return -(-model.unknowns.size // model.target.shape[1]) + _FURTHER_POSES


def require_poses(model: PoseModel) -> None:
    """Refuse logs with fewer numbers than unknowns, and positions of another unit.

    Raises:
        ConfigurationError: Too few poses, or positions that the arm cannot reach.
    """
    needed = needed_poses(model)
    if len(model.log) < needed:
        raise ConfigurationError(
            f"{model.unknowns.size} unknowns need at least {needed} poses of"
            f" {model.target.shape[1]} measured numbers each, the log has {len(model.log)}; log"
            " further poses, or seek fewer joints by --joints"
        )
    if model.log.kind != "end_effector":
        return
    places = (model.arm.attitude(model.log.theta).position, model.log.measured)
    # root mean square distances from the mean, which do not depend on the frame
    own, measured = (float(np.sqrt(np.var(part, axis=0).sum())) for part in places)
    if not own / _UNLIKE < measured < own * _UNLIKE:
        raise ConfigurationError(
            f"the columns end_effector spread over {measured:.3g} m, {model.arm.end_effector!r} of"
            f" the model over {own:.3g} m: convert millimetres to metres, or name the body that was"
            " measured by --end-effector"
        )


def information_of(model: PoseModel, unknowns: Array, spread: float) -> tuple[Array, Array]:
    """Scaled derivatives of a unit of noise, (N, m, p), and JᵀJ + Λ of them, (p, p)."""
    _, gradient = model.predict(unknowns)
    rows = gradient * model.scale / spread
    return rows, np.tensordot(rows, rows, axes=([0, 1], [0, 1])) + np.eye(len(unknowns))


def _described(model: PoseModel, unknowns: Array, finest: float) -> ArmFit:
    """Spread and covariance at the estimates."""
    predicted, _ = model.predict(unknowns)
    residual = model.target - predicted
    rows, information = information_of(model, unknowns, finest)
    inverse = np.linalg.inv(information)
    used = float(np.trace(inverse @ (information - np.eye(len(unknowns)))))
    spread = float(np.sqrt(np.sum(residual**2) / max(residual.size - used, 1.0)))
    covariance = _clustered(rows, residual / finest, inverse)
    spread = max(spread, 1e-3 * finest)  # simulated logs without noise
    return ArmFit(
        model,
        unknowns,
        covariance * np.outer(model.scale, model.scale),
        information_of(model, unknowns, spread)[1],
        model.link_angles(unknowns)[0],
        residual,
        spread,
        freedom=max(len(residual) - int(np.ceil(used / residual.shape[1])), 1),
    )


def _clustered(rows: Array, residual: Array, inverse: Array) -> Array:
    """Cluster-robust covariance, a cluster per pose, see the module, in units of the scales."""
    count, each = residual.shape
    leverage = rows @ inverse @ rows.transpose(0, 2, 1)
    without = np.linalg.solve(np.eye(each) - leverage, residual[..., None])
    score = (rows.transpose(0, 2, 1) @ without)[..., 0]
    middle = (count - 1) / count * score.T @ score + np.eye(len(inverse))
    return inverse @ middle @ inverse


def in_unit(noise: float, kind: Kind) -> str:
    """Noise of a measurement with its unit, as tables show it."""
    unit = measurement_unit(kind)
    return f"{noise:.3g} {unit}" if unit == "N·m" else f"{1e3 * noise:.3g} m{unit}"


def summed_up(fit: ArmFit) -> str:
    """The residuals in a sentence, with what friction means for the intervals."""
    friction = "friction is separated by the sides of approach"
    if fit.model.log.direction is None:
        friction = (
            "the log has no sides of approach: friction counts as noise, and the intervals"
            " contain it"
        )
    return f"residual spread {in_unit(fit.spread, fit.model.log.kind)}; {friction}"
