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
        self._ankles = plan.ankles * [1.0, 1.0, 0.0] + [0.0, 0.0, model.biped.ankle_height]
        self._foot_R = rotation_z(plan.foot_yaw)
        self._heading = np.stack([np.cos(plan.heading), np.sin(plan.heading)], axis=-1)

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
        periods = np.rint(rows[:, self._clock] / self._period_s).astype(np.int64)
        row = np.clip(periods, 0, len(self._ankles) - 1)
        seen = wrench.reshape(-1, 2, 2, 3)
        force, moment = self._sensors.ground_wrench(seen, self._foot_R[row])
        zmp = zero_moment_point(force, moment, self._ankles[row], self._least_n)
        x, y = (zmp - rows[:, self._zmp]).T
        cosine, sine = self._heading[row].T
        return force, np.stack([cosine * x + sine * y, cosine * y - sine * x], axis=-1)
