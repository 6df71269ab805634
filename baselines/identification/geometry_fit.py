r"""Geometry, encoders and compliance of an arm from positions of markers, by least squares.

The parameters x minimise

.. math:: \sum_i \|y_i - p_i(x)\|^2 / \sigma^2 + \sum_j (x_j - \mu_j)^2 / s_j^2

with the noise σ of the residuals, estimated with x, and Gaussian priors in the units of
manufacture. A prior is the knowledge before the poses: lengths to millimetres, angles to a fraction
of a degree. A parameter that the poses do not determine keeps its prior, and is named. Intervals
are those of the posterior at the solution: ±1.96 standard deviations.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from baselines.identification.geometry_model import ArmParameters
from baselines.identification.geometry_problem import GeometryProblem
from baselines.identification.prior_least_squares import solve_with_prior
from elastic_env.core.config import Model
from elastic_env.core.errors import ConfigurationError, ElasticError
from elastic_env.core.signals import Array

_MOST_EVALUATIONS = 400
_IMPOSSIBLE_ERROR_M = 10.0
"""Error of a marker where there is no posture at rest [m]."""
_TOLERANCE = 1e-6
"""Relative change of the sum of squares at which the solver stops."""
_FIRST_NOISE_M = 3e-3
_NOISE_ROUNDS = 3
"""Fits, each with the noise of the residuals of the one before."""
_LEAST_NOISE_M = 1e-5
_LARGEST_RATIO = 0.5
"""Posterior over prior deviation from which on the poses do not determine a parameter."""
_FEWEST_POSES = 2
QUANTILE = 1.96
"""Half-width of a 95 % interval in standard deviations."""


_UNITS = {
    "translation": "m",
    "rotation": "rad",
    "marker": "m",
    "offset": "rad",
    "length": "m",
    "angle": "rad",
    "compliance": "rad/(N·m)",
    "friction": "N·m",
}
"""Units of the kinds of parameters."""


class GeometryEstimate(Model):
    """One parameter and its 95 % interval."""

    kind: str
    """Field of `ArmParameters`: translation and rotation of the tracker, marker, offset,
    length, angle, compliance, friction.
    """
    name: str
    """Joint or marker, with the axis of the joint's frame where it has several."""
    value: float
    half_width: float
    """Half of the 95 % interval."""
    unit: str
    is_told: bool
    """True if the poses narrow it to less than half of its prior's deviation."""


@dataclass(frozen=True, eq=False)
class GeometryFit:
    """Parameters that fit, with their uncertainty.

    Attributes:
        problem: The poses.
        x: Estimates of the unknowns, (p,).
        covariance: Covariance of the estimates, (p, p).
        noise_m: Standard deviation of a coordinate of a marker [m].
    """

    problem: GeometryProblem
    x: Array
    covariance: Array
    noise_m: float

    @property
    def parameters(self) -> ArmParameters:
        """All parameters."""
        return self.problem.parameters(self.x)

    @cached_property
    def estimates(self) -> tuple[GeometryEstimate, ...]:
        """The unknowns with their intervals."""
        unknowns = self.problem.unknowns
        deviation = np.sqrt(np.diag(self.covariance))
        return tuple(
            GeometryEstimate(
                kind=unknowns.kinds[i],
                name=unknowns.names[i],
                value=self.x[i],
                half_width=QUANTILE * deviation[i],
                unit=_UNITS[unknowns.kinds[i]],
                is_told=bool(deviation[i] < _LARGEST_RATIO * unknowns.prior[i]),
            )
            for i in range(len(self.x))
        )

    def prediction_error(self, problem: GeometryProblem) -> Array:
        """Measured less predicted places of the markers, (N, k, 3) [m]."""
        predict = self.problem.model.predict_markers
        return problem.measured - predict(self.parameters, problem.theta, problem.axial)


def fit_geometry(problem: GeometryProblem) -> GeometryFit:
    """Fit the unknowns of poses.

    Args:
        problem: The poses and the unknowns.

    Raises:
        ConfigurationError: Fewer than two poses.
        ElasticError: The poses do not fit the arm, or the fit does not converge.
    """
    if len(problem.theta) < _FEWEST_POSES:
        raise ConfigurationError(
            f"a fit of the geometry needs at least {_FEWEST_POSES} poses, got {len(problem.theta)}"
        )
    x = np.zeros(len(problem.unknowns.prior))
    noise = _FIRST_NOISE_M
    for _ in range(_NOISE_ROUNDS):
        x = _solve(problem, x, noise)
        residual, _ = problem.linearise(x)
        used = len(x) - float(np.trace(_covariance(problem, x, noise)))
        spread = np.sqrt(residual @ residual / max(len(residual) - used, 1.0))
        noise = max(float(spread), _LEAST_NOISE_M)
    prior = problem.unknowns.prior
    covariance = _covariance(problem, x, noise) * np.outer(prior, prior)
    return GeometryFit(problem, x, covariance, noise)


def _covariance(problem: GeometryProblem, x: Array, noise: float) -> Array:
    """Covariance of the unknowns in units of their priors, (p, p)."""
    _, gradient = problem.linearise(x)
    rows = gradient * problem.unknowns.prior / noise
    return np.linalg.inv(rows.T @ rows + np.eye(len(x)))


def _solve(problem: GeometryProblem, x: Array, noise: float) -> Array:
    """Unknowns with the least sum of squares, from a first x.

    Raises:
        ElasticError: The solver does not find them.
    """
    prior = problem.unknowns.prior

    def residual(z: Array) -> Array:
        try:
            return problem.residual(prior * z) / noise
        except ElasticError:  # no spring holds it: the solver takes a shorter step
            return np.full(problem.measured.size, _IMPOSSIBLE_ERROR_M / noise)

    def jacobian(z: Array) -> Array:
        return problem.linearise(prior * z)[1] * prior / noise

    solution = solve_with_prior(residual, jacobian, x / prior, _MOST_EVALUATIONS, ftol=_TOLERANCE)
    if not solution.success:
        raise ElasticError(
            f"the fit of the geometry did not converge in {_MOST_EVALUATIONS} steps; check the"
            " units of the log's columns and the model"
        )
    return prior * solution.x
