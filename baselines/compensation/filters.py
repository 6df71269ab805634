"""First-order filters and limits."""

import numpy as np

from elastic_env.core.compiled import compiled_part


def filter_share(period_s: float, time_constant_s: float) -> float:
    """Share of its remaining way that a first-order filter goes in a period [1]."""
    return 1.0 - float(np.exp(-period_s / time_constant_s))


@compiled_part
def within(value: float, limit: float) -> float:
    """Value within ±limit; nan stays nan."""
    if value > limit:
        return limit
    return -limit if value < -limit else value
