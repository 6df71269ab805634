r"""Rivals of an identification, which need no physics.

A rival learns the error of the rigid model at some poses from the joint angles, and predicts it at
others. Anybody who has a log can try these in an hour. So a model of springs is worth its
assumptions only where it is ahead of them at poses that none of them used.
"""

from collections.abc import Callable

import numpy as np

from elastic_env.core.signals import Array

Rival = Callable[[Array, Array, Array], Array]
"""Function of angles (N, n), errors there (N, m) and other angles (M, n): errors there, (M, m)."""

_FOLDS = 5
"""Folds of the cross-validation that chooses width and ridge."""
_WIDTHS = (0.3, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Widths of the kernel, in standard deviations of the angles times √n."""
_RIDGES = tuple(10.0**power for power in range(-6, 3))
"""Weights of the ridge."""


def predict_constant(angles: Array, errors: Array, others: Array) -> Array:
    """The mean error everywhere."""
    del angles
    return np.broadcast_to(errors.mean(axis=0), (len(others), errors.shape[1]))


def predict_linear(angles: Array, errors: Array, others: Array) -> Array:
    """A constant and a share of each angle, by least squares."""
    rows, new = (np.column_stack([np.ones(len(part)), part]) for part in (angles, others))
    return new @ np.linalg.lstsq(rows, errors, rcond=None)[0]


def predict_by_kernel(angles: Array, errors: Array, others: Array) -> Array:
    """Kernel ridge regression with a Gaussian kernel, about the mean error.

    Width and ridge are those of the least error in a cross-validation over these poses.
    """
    spread = np.where(angles.std(axis=0) > 0.0, angles.std(axis=0), 1.0)
    scaled, new = ((part - angles.mean(axis=0)) / spread for part in (angles, others))
    mean = errors.mean(axis=0)
    squared = _squared_distances(scaled, scaled)
    width, ridge = _best_kernel(squared, errors - mean, scaled.shape[1])
    scale = 2.0 * width**2 * scaled.shape[1]
    matrix = np.exp(-squared / scale) + ridge * np.eye(len(scaled))
    weights = np.linalg.solve(matrix, errors - mean)
    return mean + np.exp(-_squared_distances(new, scaled) / scale) @ weights


RIVALS: dict[str, Rival] = {
    "constant": predict_constant,
    "linear in the angles": predict_linear,
    "kernel regression": predict_by_kernel,
}
"""Rivals by their names in tables."""


def _best_kernel(squared: Array, errors: Array, num_angles: int) -> tuple[float, float]:
    """Width and ridge of the least error in a cross-validation.

    Args:
        squared: Squared distances between poses, (N, N).
        errors: Errors about their mean, (N, m).
        num_angles: Number of angles n.
    """
    fold = np.arange(len(errors)) % _FOLDS
    best = (np.inf, _WIDTHS[0], _RIDGES[0])
    for width in _WIDTHS:
        kernel = np.exp(-squared / (2.0 * width**2 * num_angles))
        for ridge in _RIDGES:
            total = 0.0
            for k in range(_FOLDS):
                inner = fold != k
                matrix = kernel[np.ix_(inner, inner)] + ridge * np.eye(int(inner.sum()))
                weights = np.linalg.solve(matrix, errors[inner])
                predicted = kernel[np.ix_(~inner, inner)] @ weights
                total += float(np.sum((errors[~inner] - predicted) ** 2))
            best = min(best, (total, width, ridge))
    return best[1:]


def _squared_distances(a: Array, b: Array) -> Array:
    """Squared distances between rows, (N, n) and (M, n) to (N, M)."""
    return np.sum((a[:, None] - b[None]) ** 2, axis=-1)
