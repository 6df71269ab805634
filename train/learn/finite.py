"""A training that diverges: its numbers are checked on the way."""

from typing import Any

import numpy as np

from elastic_env.core.errors import ElasticError


class DivergedError(ElasticError):
    """A quantity of a training is no longer a finite number.

    Args:
        quantity: What it is, such as the reward.
    """

    def __init__(self, quantity: str) -> None:
        super().__init__(f"{quantity} is not a finite number")
        self.quantity = quantity


def require_finite(quantity: str, values: Any) -> None:
    """Refuse nan and infinity among the numbers of a training.

    Raises:
        DivergedError: There is one.
    """
    if not np.isfinite(values).all():
        raise DivergedError(quantity)
