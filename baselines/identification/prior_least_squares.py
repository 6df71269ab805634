r"""Least squares with a Gaussian prior, shared by the fits of arm and geometry.

All unknowns are in units of the prior's standard deviations, so that the sum

.. math:: \|r(x)\|^2 + \|x\|^2

is least at the most probable x. The residuals r are in units of the noise.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from elastic_env.core.signals import Array


def solve_with_prior(
    residual: Callable[[Array], Array],
    jacobian: Callable[[Array], Array],
    start: Array,
    max_evaluations: int,
    *,
    x_scale: float | str = 1.0,
    ftol: float = 1e-8,
) -> Any:
    """Minimise the sum of the module by trust regions.

    Args:
        residual: r at x, (p,) to (N,); infinite or large where x is impossible.
        jacobian: Derivatives of r, (p,) to (N, p). The solver asks for the residual there first.
        start: First x, (p,).
        max_evaluations: Limit of the calls of `residual`.
        x_scale: Scale of the steps, as of `scipy.optimize.least_squares`.
        ftol: Relative change of the sum at which the solver stops.

    Returns:
        Result of `scipy.optimize.least_squares`.
    """

    def extended_jacobian(x: Array) -> Array:
        return np.concatenate([jacobian(x), np.eye(len(x))])

    return least_squares(
        lambda x: np.concatenate([residual(x), x]),
        start,
        jac=extended_jacobian,  # pyright: ignore[reportArgumentType]
        method="trf",
        ftol=ftol,
        max_nfev=max_evaluations,
        x_scale=x_scale,
    )
