"""ZMP by the foot sensors, as if the feet lay flat where the plan has them.

It is known against the feet alone: feet that have drifted from their footholds are not seen.
"""

import numpy as np

from elastic_env.core.signals import Array
from elastic_env.rigid.leg_kinematics import rotation_z
from elastic_env.world.ground_contact import FootSensors, zero_moment_point
from elastic_env.world.robot_model import WalkerModel


class FlatFeet:
    """Feet that lie flat on their footholds, see the module.

    Args:
        model: Assumed walker.
        least_n: Vertical force below which there is no ZMP [N].
    """

    def __init__(self, model: WalkerModel, least_n: float) -> None:
        table = model.observation_table
        plan = model.plan
        self._sensors = FootSensors.of_biped(model.biped)
        self._least_n = least_n
        self._period_s = model.control_period_s
        self._clock = table.group("clock").start
        self._zmp = table.group("zmp_reference")
        ankles = plan.ankles.copy()
        ankles[..., 2] = model.biped.ankle_height
        heading = np.stack([np.cos(plan.heading), np.sin(plan.heading)], axis=-1)
        self._tables = (rotation_z(plan.foot_yaw), ankles, heading)  # a row per control step

    def zmp_error(self, rows: Array, wrench: Array) -> Array:
        """ZMP of wrenches less the planned one, in the plan's local frame, (num_worlds, 2) [m].

        Args:
            rows: Observations whose reference is meant, (num_worlds, m).
            wrench: Force and moment at the ankles in the frames of the feet, (num_worlds, 12) [N],
                [N·m].

        Returns:
            nan where the feet carry too little.
        """
        return self.ground(rows, wrench)[1]

    def ground(self, rows: Array, wrench: Array) -> tuple[Array, Array]:
        """Force of the ground on the feet in the world, (num_worlds, 2, 3) [N], and `zmp_error`."""
        row = np.rint(rows[:, self._clock] / self._period_s).astype(np.int64)
        foot_R, ankles, heading = (table.take(row, 0, mode="clip") for table in self._tables)
        seen = wrench.reshape(-1, 2, 2, 3)
        force, moment = self._sensors.ground_wrench(seen, foot_R)
        zmp = zero_moment_point(force, moment, ankles, self._least_n)
        x, y = (zmp - rows[:, self._zmp]).T
        cosine, sine = heading.T
        error = np.empty(zmp.shape)
        error[:, 0] = cosine * x + sine * y
        error[:, 1] = cosine * y - sine * x
        return force, error
