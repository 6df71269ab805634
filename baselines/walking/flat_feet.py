"""The measured ZMP against the planned one, as if the feet lay flat on their footholds."""

from typing import Any

import numpy as np

from baselines.compensation.policy import WalkView
from elastic_env.core.compiled import compiled, record_type
from elastic_env.core.signals import Array
from elastic_env.world.ground_contact import FootSensors
from elastic_env.world.robot_model import WalkerModel

LEAST_LOAD = 0.05
"""Share of the weight below which the feet show no ZMP."""

FLAT_FEET = record_type(
    ankles=(2, 3),  # [m]
    com=(2, 3),  # of the feet from their ankles [m]
    weight=(2, 3),  # of the feet [N]
    least_n=(),  # vertical force below which there is no ZMP
)
"""Feet of a walker where they are planned."""


class FlatFeet:
    """Foot sensors of a walker whose feet lie flat where they are planned.

    They show the ZMP against the feet: feet that have drifted from their footholds are not seen.

    Args:
        model: Assumed walker.
        least_load: Share of the weight below which the feet show no ZMP [1].
    """

    def __init__(self, model: WalkerModel, least_load: float = LEAST_LOAD) -> None:
        self._view = WalkView(model.observation_table)
        self._reference = model.observation_table.group("zmp_reference")
        sensors = FootSensors.of_biped(model.biped)
        self._feet: Any = np.zeros(1, FLAT_FEET)
        self._feet["ankles"] = model.biped.ankles
        self._feet["com"] = sensors.com
        self._feet["weight"] = sensors.weight
        self._feet["least_n"] = least_load * model.biped.weight

    def zmp(self, rows: Array) -> Array:
        """ZMP of observations, (num_worlds, 2) [m]; nan where the feet carry almost nothing."""
        zmp = np.empty((len(rows), 2))
        find_zmp(self._feet, self._view.fields(rows), False, zmp)
        return zmp

    def zmp_error(self, rows: Array) -> Array:
        """Measured less planned ZMP, (num_worlds, 2) [m]; zero where there is none."""
        zmp = np.empty((len(rows), 2))
        find_zmp(self._feet, self._view.fields(rows), True, zmp)
        return zmp - rows[:, self._reference]


@compiled
def find_zmp(feet: Any, observed: Any, is_planned: bool, zmp: Array) -> None:
    """Measured ZMP by the equation of `elastic_env.world.ground_contact`.

    Args:
        feet: Row of `FLAT_FEET`, (1,).
        observed: Observations, rows with fields, (n,).
        is_planned: True for the planned ZMP where the feet carry almost nothing, else nan.
        zmp: To be filled, (n, 2) [m].
    """
    own = feet[0]
    for world in range(len(zmp)):
        shown = observed[world]
        about_x = about_y = vertical = 0.0
        for foot in range(2):
            force = shown.wrench[foot, 0]
            moment = shown.wrench[foot, 1]
            weight = own.weight[foot]
            c = own.com[foot]
            p = own.ankles[foot]
            # of the ground, about the ankle
            x = force[0] - weight[0]
            y = force[1] - weight[1]
            z = force[2] - weight[2]
            about_x += p[1] * z - p[2] * y + moment[0] - (c[1] * weight[2] - c[2] * weight[1])
            about_y += p[2] * x - p[0] * z + moment[1] - (c[2] * weight[0] - c[0] * weight[2])
            vertical += z
        for i in range(2):
            zmp[world, i] = shown.zmp_reference[i] if is_planned else np.nan
        if vertical >= own.least_n:
            zmp[world, 0] = -about_y / vertical
            zmp[world, 1] = about_x / vertical
