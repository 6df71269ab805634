"""Comparisons for what stops a motion: whatever is not a finite number is beyond every bound.

`nan > limit` is False, so that a plain comparison lets a motion go on whose measurement is none.
"""

import numpy as np
import numpy.typing as npt

from elastic_env.core.signals import BoolArray


def exceeds(value: npt.ArrayLike, limit: npt.ArrayLike) -> BoolArray:
    """True where a value is not known to be at most a limit: it is greater, or one of the two is nan or infinite.

    Args:
        value: (...), in the unit of the limit.
        limit: (...), likewise.

    Returns:
        (...), of one value a single one.
    """
    values = np.asarray(value, dtype=np.float64)
    most = np.asarray(limit, dtype=np.float64)
    return ~(np.isfinite(values) & np.isfinite(most) & (values <= most))


def is_outside(value: npt.ArrayLike, lowest: npt.ArrayLike, highest: npt.ArrayLike) -> BoolArray:
    """True where a value is not known to lie between two bounds, or on one of them; shapes as in `exceeds`."""
    return exceeds(value, highest) | exceeds(np.negative(value), np.negative(lowest))
