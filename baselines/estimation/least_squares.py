r"""Recursive least squares for how wrong a model is: excess = ρ · expected + c [Kalman1960, without drift].

[Kalman1960] R. E. Kalman, "A New Approach to Linear Filtering and Prediction Problems", J. Basic Eng. 82.
"""

import numpy as np

from elastic_env.core.signals import Array, BoolArray

MODEL_ERROR, DISAGREEMENT_RAD = 0.3, 0.002
"""Standard deviations of ρ before the first measurement, and of a measurement."""
UNKNOWNS = 2
"""ρ and c."""

_VARIANCES = 3


def prior(offset_rad: float) -> Array:
    """Covariance before the first measurement, upper triangle, (3,)."""
    return np.diag([MODEL_ERROR, offset_rad])[np.triu_indices(UNKNOWNS)] ** 2


def symmetric(upper: Array) -> Array:
    """Covariances from their upper triangles, (..., 3) to (..., 2, 2)."""
    first, mixed, second = np.moveaxis(upper, -1, 0)
    return np.stack([np.stack([first, mixed], axis=-1), np.stack([mixed, second], axis=-1)], axis=-2)


def least_squares(x: Array, P: Array, expected: Array, excess: Array, valid: BoolArray) -> tuple[Array, Array]:
    """One measurement, where it is valid.

    Args:
        x: Estimates of ρ and c, (..., 2).
        P: Their covariance, (..., 2, 2).
        expected: What the model says, (...) [rad].
        excess: What is measured beyond it, (...) [rad].
        valid: (...).

    Returns:
        New estimates and covariance.
    """
    h = np.stack([expected, np.ones_like(expected)], axis=-1)
    Ph = (P @ h[..., None])[..., 0]
    gain = Ph / ((h * Ph).sum(axis=-1) + DISAGREEMENT_RAD**2)[..., None] * valid[..., None]
    x = x + gain * (excess - (h * x).sum(axis=-1))[..., None]
    return x, P - gain[..., :, None] * Ph[..., None, :]


class RatioFilter:
    """ρ of several values at once, each with its own c.

    Memory per world: estimates and upper triangles of covariances.

    Args:
        num: How many values.
        offset_rad: Standard deviation of c before the first measurement [rad].
    """

    def __init__(self, num: int, offset_rad: float = 0.005) -> None:
        self._num, self._prior = num, prior(offset_rad)
        self.memory_width = num * (UNKNOWNS + _VARIANCES)

    def begin(self, num_worlds: int) -> Array:
        """Memory before the first measurement, (num_worlds, memory_width)."""
        one = np.hstack([np.zeros(UNKNOWNS), self._prior])
        return np.tile(one, (num_worlds, self._num))

    def update(self, memory: Array, expected: Array, excess: Array) -> tuple[Array, Array]:
        """ρ after a measurement, (num_worlds, num), and the new memory; arguments as in `least_squares`."""
        kept = memory.reshape(len(memory), self._num, UNKNOWNS + _VARIANCES)
        valid = np.ones_like(expected, dtype=np.bool_)
        x, P = least_squares(kept[..., :UNKNOWNS], symmetric(kept[..., UNKNOWNS:]), expected, excess, valid)
        new = np.concatenate([x, P[..., *np.triu_indices(UNKNOWNS)]], axis=-1)
        return x[..., 0], new.reshape(memory.shape)
