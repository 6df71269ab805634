r"""ZMP of a walker by its foot sensors, as if its feet lay flat where the plan has them.

The ZMP is known relative to the feet only: it does not show feet that have drifted from their
footholds.
"""

import math
from typing import Any

import numpy as np

from baselines.compensation.compiled_rows import record_row, record_rows
from baselines.compensation.policy import WalkView
from elastic_env.core.compiled import compiled
from elastic_env.core.signals import Array
from elastic_env.world.foot_sensors import FootSensors
from elastic_env.world.robot_model import WalkerModel

LEAST_LOAD = 0.05
"""Share of the weight below which a slow feedback ignores the ZMP."""


class FlatFeet:
    """ZMP of feet that lie flat on their footholds.

    Args:
        model: Assumed walker.
        least_n: Vertical force below which there is no ZMP [N].
    """

    def __init__(self, model: WalkerModel, least_n: float) -> None:
        self._view = WalkView(model.observation_table)
        self._wrench = model.observation_table.group("wrench")
        sensors = FootSensors.of_biped(model.biped)
        self._feet = record_row(
            com=sensors.com,  # of the feet from their ankles [m]
            weight=sensors.weight,  # of the feet [N]
            least_n=least_n,
            ankle_height=model.biped.ankle_height,  # of feet on the ground [m]
            period_s=model.control_period_s,
        )
        plan = model.plan
        self._plan = record_rows(
            ankles=plan.ankles[..., :2],  # [m]
            yaw=plan.foot_yaw,  # [rad]
            heading=plan.heading,  # of the pelvis [rad]
        )

    def zmp_error(self, rows: Array, wrench: Array | None = None) -> Array:
        """ZMP of wrenches less the planned one, in the plan's local frame, (num_worlds, 2) [m].

        Args:
            rows: Observations with the reference, (num_worlds, m).
            wrench: Force and moment at the ankles in the frames of the feet, (num_worlds, 12) [N],
                [N·m]; None for those of the observations.

        Returns:
            nan where the feet carry too little.
        """
        return self.ground(rows, rows[:, self._wrench] if wrench is None else wrench)[1]

    def ground(self, rows: Array, wrench: Array) -> tuple[Array, Array]:
        """Force of the ground on the feet in the world, (num_worlds, 2, 3) [N], and `zmp_error`."""
        force = np.empty((len(rows), 2, 3))
        error = np.empty((len(rows), 2))
        wrenches = np.ascontiguousarray(wrench).reshape(-1, 2, 2, 3)
        observations = self._view.fields(rows)
        ground_reaction(self._feet, self._plan, observations, wrenches, force, error)
        return force, error


@compiled
def ground_reaction(
    feet: Any, plan: Any, observations: Any, wrench: Array, force: Array, error: Array
) -> None:
    """Fill in the values of `FlatFeet.ground`, by the equation of `compute_zmp`.

    Args:
        feet: Feet of the walker, a row, (1,).
        plan: Feet where they are planned, one row per control step.
        observations: Rows with fields, (n,).
        wrench: Force and moment at the ankles, (n, 2, 2, 3) [N], [N·m].
        force: To be filled, (n, 2, 3) [N].
        error: To be filled, (n, 2) [m].
    """
    sensors = feet[0]
    for world in range(len(error)):
        obs = observations[world]
        row = int(np.rint(obs.clock[0] / sensors.period_s))
        planned = plan[min(max(row, 0), len(plan) - 1)]
        about_x = about_y = vertical = 0.0
        for foot in range(2):
            sine = math.sin(planned.yaw[foot])
            cosine = math.cos(planned.yaw[foot])
            f = wrench[world, foot, 0]
            n = wrench[world, foot, 1]
            c = sensors.com[foot]
            w = sensors.weight[foot]
            p = planned.ankles[foot]
            x = cosine * f[0] - sine * f[1] - w[0]
            y = sine * f[0] + cosine * f[1] - w[1]
            z = f[2] - w[2]
            c_x = cosine * c[0] - sine * c[1]
            c_y = sine * c[0] + cosine * c[1]
            moment_x = cosine * n[0] - sine * n[1] - (c_y * w[2] - c[2] * w[1])
            moment_y = sine * n[0] + cosine * n[1] - (c[2] * w[0] - c_x * w[2])
            about_x += p[1] * z - sensors.ankle_height * y + moment_x
            about_y += sensors.ankle_height * x - p[0] * z + moment_y
            vertical += z
            force[world, foot] = (x, y, z)
        scale = vertical if vertical >= sensors.least_n else np.nan
        x = -about_y / scale - obs.zmp_reference[0]
        y = about_x / scale - obs.zmp_reference[1]
        sine = math.sin(planned.heading)
        cosine = math.cos(planned.heading)
        error[world, 0] = cosine * x + sine * y
        error[world, 1] = cosine * y - sine * x
