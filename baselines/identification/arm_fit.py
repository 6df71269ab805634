r"""Stiffness of every joint of an arm by least squares over static poses, with 95 % intervals.

The unknowns x of `PoseModel` minimise the squared residuals of the measurement. A weak prior,
Gaussian with the scales of the model, keeps unknowns near zero that the poses do not determine; on
the others it has no visible effect.

The intervals do not assume equal noise: friction without known direction acts on all measurements
of a pose at once, and more in one pose than in another. The covariance of x is the cluster-robust
one in its jackknife form (CR3), a cluster per pose, with Student's t:

.. math:: V = M^{-1} \Big( \tfrac{N-1}{N} \sum_i J_i^T e^*_i e^{*T}_i J_i + \Lambda \Big) M^{-1}, \quad
    e^*_i = (1 - J_i M^{-1} J_i^T)^{-1} e_i, \quad M = J^T J + \Lambda

(R. M. Bell and D. F. McCaffrey, "Bias Reduction in Standard Errors for Linear Regression with
Multi-Stage Samples", Survey Methodology 28(2), 2002.) Λ is the precision of the prior.
"""  # noqa: E501

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import stats

from baselines.identification.pose_checks import (
    require_deflections_with_load,
    require_equal_signs,
    require_poses,
    require_signs,
)
from baselines.identification.pose_log import MEASUREMENT_UNITS, Kind
from baselines.identification.pose_model import PoseModel
from baselines.identification.prior_least_squares import solve_with_prior
from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array, IntArray

USUAL_NOISE: dict[Kind, float] = {
    "end_effector": 3e-4,
    "imu": 1e-3,
    "link_encoders": 1e-4,
    "torques": 0.1,
}
"""Noise of usual sensors [m], [rad], [N·m]."""
LARGE_RESIDUAL_RATIO = 10.0
"""Ratio of residuals and usual noise from which on the log does not fit the arm."""
USUAL_EVALUATIONS = 12
"""Evaluations of a usual fit, at most."""
_LEAST_NOISE: dict[Kind, float] = {
    "end_effector": 1e-4,
    "imu": 1e-4,
    "link_encoders": 1e-5,
    "torques": 1e-2,
}
"""Noise against which the prior is weighed [m], [rad], [N·m]: about that of good sensors."""
_MOST_EVALUATIONS = 100
"""Evaluations after which a fit continues with steps in units of the derivatives."""
_FURTHER_EVALUATIONS = 150
_FIRST_DEFLECTION_RAD = 0.01
"""Deflection to begin with. It is not zero, as a rigid joint shows nothing of its friction."""
_OUTLIER_RATIO = 5.0
"""Size of an outlier's residual in standard deviations."""


@dataclass(frozen=True)
class ArmFit:
    """Unknowns that fit a log, with their uncertainty.

    Attributes:
        model: The poses.
        unknowns: Estimates, (p,).
        covariance: Covariance of the estimates, (p, p).
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
        part = self.model.unknowns.slices[name]
        deviation = np.sqrt(np.diag(self.covariance)[part])
        return self.unknowns[part], self.quantile * deviation

    @property
    def outliers(self) -> IntArray:
        """Poses whose residual is far beyond the spread."""
        size = np.sqrt(np.mean(self.residual**2, axis=1))
        usual = 1.4826 * np.median(size) if len(size) else 0.0
        return np.flatnonzero(size > _OUTLIER_RATIO * max(float(usual), 1e-12))


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
    require_equal_signs(model.log)
    if _linearised_spread(model) > LARGE_RESIDUAL_RATIO * USUAL_NOISE[model.log.kind]:
        require_signs(model, _linearised_spread)
    fit = _fit_at(model, solve_unknowns(model, progress))
    require_deflections_with_load(model, fit.unknowns, fit.estimate("compliance")[1])
    return fit


def solve_unknowns(model: PoseModel, progress: Callable[[int], None] | None = None) -> Array:
    """Unknowns that fit, (p,). The log is not checked.

    Raises:
        ElasticError: No springs explain the log, or the solver does not find them.
    """
    if not model.unknowns.size:
        return np.zeros(0)
    noise = _LEAST_NOISE[model.log.kind]
    count = 0
    point = gradient = np.empty(0)

    def residual(x: Array) -> Array:
        """Predicted less measured in units of noise, (N m,).

        Infinite where a load overcomes a spring: the solver takes a shorter step.
        """
        nonlocal count, point, gradient
        count += 1
        if progress is not None:
            progress(count)
        try:
            predicted, gradient = model.predict(model.scale * x)
        except ElasticError:
            if not len(point):  # at the start
                raise
            return np.full(model.target.size, np.inf)
        point = x.copy()
        return (predicted - model.target).ravel() / noise

    def jacobian(x: Array) -> Array:
        """Derivatives of the residual, (N m, p)."""
        if not np.array_equal(x, point):
            residual(x)
        return gradient.reshape(-1, len(x)) * model.scale / noise

    start = model.start_with(_FIRST_DEFLECTION_RAD) / model.scale
    solution = solve_with_prior(residual, jacobian, start, _MOST_EVALUATIONS)
    if not solution.success:  # ill-conditioned: steps in units of the derivatives help
        solution = solve_with_prior(
            residual, jacobian, solution.x, _FURTHER_EVALUATIONS, x_scale="jac"
        )
    if not solution.success:
        raise ElasticError(
            f"the fit did not converge in {_MOST_EVALUATIONS + _FURTHER_EVALUATIONS} steps; check"
            " zeros and units of the log's columns and the masses of the model, or seek fewer"
            " joints by --joints"
        )
    return model.scale * solution.x


def _linearised_spread(model: PoseModel) -> float:
    """Spread of the residuals to first order about small deflections, in the measurement's unit."""
    start = model.start_with(_FIRST_DEFLECTION_RAD)
    predicted, gradient = model.predict(start)
    noise = _LEAST_NOISE[model.log.kind]
    rows = gradient.reshape(-1, len(start)) * model.scale / noise
    residual = (model.target - predicted).ravel() / noise
    step = np.linalg.solve(rows.T @ rows + np.eye(len(start)), rows.T @ residual)
    return noise * float(np.std(residual - rows @ step))


def information_of(model: PoseModel, unknowns: Array, spread: float) -> tuple[Array, Array]:
    """Scaled derivatives per unit of noise, (N, m, p), and their JᵀJ + Λ, (p, p)."""
    _, gradient = model.predict(unknowns)
    rows = gradient * model.scale / spread
    return rows, add_information(np.eye(len(unknowns)), rows)


def add_information(information: Array, rows: Array) -> Array:
    """Information together with that of further poses with derivatives (N, m, p), (p, p)."""
    return information + np.tensordot(rows, rows, axes=([0, 1], [0, 1]))


def deviations(model: PoseModel, information: Array, name: str) -> Array:
    """Standard deviations of one kind of unknown by an information in units of the scales."""
    part = model.unknowns.slices[name]
    return np.sqrt(np.diag(np.linalg.inv(information))[part]) * model.scale[part]


def _fit_at(model: PoseModel, unknowns: Array) -> ArmFit:
    """The fit with spread and covariance at the estimates."""
    noise = _LEAST_NOISE[model.log.kind]
    predicted, _ = model.predict(unknowns)
    residual = model.target - predicted
    rows, information = information_of(model, unknowns, noise)
    inverse = np.linalg.inv(information)
    used = float(np.trace(inverse @ (information - np.eye(len(unknowns)))))
    spread = float(np.sqrt(np.sum(residual**2) / max(residual.size - used, 1.0)))
    covariance = _cluster_robust_covariance(rows, residual / noise, inverse)
    spread = max(spread, 1e-3 * noise)  # simulated logs without noise
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


def _cluster_robust_covariance(rows: Array, residual: Array, inverse: Array) -> Array:
    """Covariance V of the module, a cluster per pose, in units of the scales."""
    num_poses, size = residual.shape
    leverage = rows @ inverse @ rows.transpose(0, 2, 1)
    corrected = np.linalg.solve(np.eye(size) - leverage, residual[..., None])
    score = (rows.transpose(0, 2, 1) @ corrected)[..., 0]
    middle = (num_poses - 1) / num_poses * score.T @ score + np.eye(len(inverse))
    return inverse @ middle @ inverse


def noise_text(noise: float, kind: Kind) -> str:
    """Noise of a measurement with its unit, as tables show it."""
    unit = MEASUREMENT_UNITS[kind]
    return f"{noise:.3g} {unit}" if unit == "N·m" else f"{1e3 * noise:.3g} m{unit}"


def residual_summary(fit: ArmFit) -> str:
    """A sentence on the residuals and on the effect of friction on the intervals."""
    friction = "friction is separated by the sides of approach"
    if fit.model.log.direction is None:
        friction = (
            "the log has no sides of approach: friction counts as noise, and the intervals"
            " contain it"
        )
    return f"residual spread {noise_text(fit.spread, fit.model.log.kind)}; {friction}"
