"""The measured ZMP against the planned one, as if the feet lay flat on their footholds."""

import numpy as np

from elastic_env.core.signals import Array
from elastic_env.world.ground_contact import FootSensors
from elastic_env.world.robot_model import WalkerModel

LEAST_LOAD = 0.05
"""Share of the weight below which the feet show no ZMP."""


class FlatFeet:
    """Foot sensors of a walker whose feet lie flat where they are planned.

    They show the ZMP against the feet: feet that have drifted from their footholds are not seen.

    Args:
        model: Assumed walker.
        least_load: Share of the weight below which the feet show no ZMP [1].
    """

    def __init__(self, model: WalkerModel, least_load: float = LEAST_LOAD) -> None:
        table = model.observation_table
        self._ankles = model.biped.ankles
        self._sensors = FootSensors.of_biped(model.biped)
        self._wrench = table.group("wrench")
        self._zmp = table.group("zmp_reference")
        self._least_n = least_load * model.biped.weight

    def zmp(self, rows: Array) -> Array:
        """ZMP of observations, (num_worlds, 2) [m]; nan where the feet carry almost nothing."""
        wrench = rows[:, self._wrench]
        return self._sensors.zmp_of_flat_feet(wrench, self._ankles, self._least_n)

    def zmp_error(self, rows: Array) -> Array:
        """Measured less planned ZMP, (num_worlds, 2) [m]; zero where there is none."""
        return np.nan_to_num(self.zmp(rows) - rows[:, self._zmp], nan=0.0)
