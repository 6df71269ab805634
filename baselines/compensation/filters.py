"""First-order filters."""

import numpy as np


def filter_share(period_s: float, time_constant_s: float) -> float:
    """Share of its remaining way that a first-order filter goes in a period [1]."""
    return 1.0 - float(np.exp(-period_s / time_constant_s))
