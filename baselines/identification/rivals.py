"""Predictions of measured errors that need no physics: what an identification has to beat.

Each learns the error of the rigid model at some poses from the joint angles, and predicts it at
others. Anybody who has a log can try these in an hour. So a model of springs is worth its
assumptions only where it is ahead of them at poses that none of them saw.
"""

from collections.abc import Callable

import numpy as np

from elastic_env.core.signals import Array

Rival = Callable[[Array, Array, Array], Array]
"""Of angles (N, n), errors (N, m) and other angles (M, n): errors there, (M, m)."""

_FOLDS = 5
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
    own, new = ((part - angles.mean(axis=0)) / spread for part in (angles, others))
    mean = errors.mean(axis=0)
    fold = np.arange(len(own)) % _FOLDS
    between = _squared_distances(own, own)
    chosen = (np.inf, _WIDTHS[0], _RIDGES[0])
    for width in _WIDTHS:
        kernel = np.exp(-between / (2.0 * width**2 * own.shape[1]))
        for ridge in _RIDGES:
            missed = 0.0
            for k in range(_FOLDS):
                inner = fold != k
                matrix = kernel[np.ix_(inner, inner)] + ridge * np.eye(int(inner.sum()))
                weights = np.linalg.solve(matrix, errors[inner] - mean)
                missed += float(
                    np.sum((errors[~inner] - mean - kernel[np.ix_(~inner, inner)] @ weights) ** 2)
                )
            chosen = min(chosen, (missed, width, ridge))
    _, width, ridge = chosen
    scale = 2.0 * width**2 * own.shape[1]
    weights = np.linalg.solve(np.exp(-between / scale) + ridge * np.eye(len(own)), errors - mean)
    return mean + np.exp(-_squared_distances(new, own) / scale) @ weights


RIVALS: dict[str, Rival] = {
    "constant": predict_constant,
    "linear in the angles": predict_linear,
    "kernel regression": predict_by_kernel,
}
"""Rivals by the names that tables have."""


def _squared_distances(a: Array, b: Array) -> Array:
    """Between rows, (N, n) and (M, n) to (N, M)."""
    return np.sum((a[:, None] - b[None]) ** 2, axis=-1)
