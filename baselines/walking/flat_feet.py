"""ZMP by the foot sensors, as if the feet lay flat where the plan has them.

It is known against the feet alone: feet that have drifted from their footholds are not seen.
"""

import math
from typing import Any

import numpy as np

from baselines.compensation.policy import WalkView
from elastic_env.core.compiled import compiled, record_type
from elastic_env.core.signals import Array
from elastic_env.world.foot_sensors import FootSensors
from elastic_env.world.robot_model import WalkerModel

LEAST_LOAD = 0.05
"""Share of the weight below which the feet show no ZMP to a slow feedback."""

FEET = record_type(
    com=(2, 3),  # of the feet from their ankles [m]
    weight=(2, 3),  # of the feet [N]
    least_n=(),  # vertical force below which there is no ZMP
    period_s=(),
)
"""Feet of a walker."""

FOOTPRINTS = record_type(
    ankles=(2, 3),  # of feet on the ground [m]
    yaw=(2,),  # of the feet [rad]
    heading=(),  # of the pelvis [rad]
)
"""Feet where they are planned, one row per control step."""


class FlatFeet:
    """Feet that lie flat on their footholds, see the module.

    Args:
        model: Assumed walker.
        least_n: Vertical force below which there is no ZMP [N].
    """

    def __init__(self, model: WalkerModel, least_n: float) -> None:
        self._view = WalkView(model.observation_table)
        self._wrench = model.observation_table.group("wrench")
        sensors = FootSensors.of_biped(model.biped)
        self._feet: Any = np.zeros(1, FEET)
        self._feet["com"] = sensors.com
        self._feet["weight"] = sensors.weight
        self._feet["least_n"] = least_n
        self._feet["period_s"] = model.control_period_s
        plan = model.plan
        self._plan: Any = np.zeros(len(plan.q), FOOTPRINTS)
        self._plan["ankles"] = plan.ankles
        self._plan["ankles"][..., 2] = model.biped.ankle_height
        self._plan["yaw"] = plan.foot_yaw
        self._plan["heading"] = plan.heading

    def zmp_error(self, rows: Array, wrench: Array | None = None) -> Array:
        """ZMP of wrenches less the planned one, in the plan's local frame, (num_worlds, 2) [m].

        Args:
            rows: Observations whose reference is meant, (num_worlds, m).
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
        seen = np.ascontiguousarray(wrench).reshape(-1, 2, 2, 3)
        find_ground(self._feet, self._plan, self._view.fields(rows), seen, force, error)
        return force, error


@compiled
def find_ground(
    feet: Any, plan: Any, observed: Any, wrench: Array, force: Array, error: Array
) -> None:
    """`FlatFeet.ground`, by the equation of `elastic_env.world.ground_contact`.

    Args:
        feet: Row of `FEET`, (1,).
        plan: Rows of `FOOTPRINTS`, one per control step.
        observed: Observations, rows with fields, (n,).
        wrench: Force and moment at the ankles, (n, 2, 2, 3) [N], [N·m].
        force: To be filled, (n, 2, 3) [N].
        error: To be filled, (n, 2) [m].
    """
    own = feet[0]
    for world in range(len(error)):
        shown = observed[world]
        row = int(np.rint(shown.clock[0] / own.period_s))
        planned = plan[min(max(row, 0), len(plan) - 1)]
        about_x = about_y = vertical = 0.0
        for foot in range(2):
            sine = math.sin(planned.yaw[foot])
            cosine = math.cos(planned.yaw[foot])
            f = wrench[world, foot, 0]
            n = wrench[world, foot, 1]
            c = own.com[foot]
            w = own.weight[foot]
            p = planned.ankles[foot]
            x = cosine * f[0] - sine * f[1] - w[0]
            y = sine * f[0] + cosine * f[1] - w[1]
            z = f[2] - w[2]
            c_x = cosine * c[0] - sine * c[1]
            c_y = sine * c[0] + cosine * c[1]
            moment_x = cosine * n[0] - sine * n[1] - (c_y * w[2] - c[2] * w[1])
            moment_y = sine * n[0] + cosine * n[1] - (c[2] * w[0] - c_x * w[2])
            about_x += p[1] * z - p[2] * y + moment_x
            about_y += p[2] * x - p[0] * z + moment_y
            vertical += z
            force[world, foot] = (x, y, z)
        scale = vertical if vertical >= own.least_n else np.nan
        x = -about_y / scale - shown.zmp_reference[0]
        y = about_x / scale - shown.zmp_reference[1]
        sine = math.sin(planned.heading)
        cosine = math.cos(planned.heading)
        error[world, 0] = cosine * x + sine * y
        error[world, 1] = cosine * y - sine * x
