"""What a walker's IMU and foot sensors would show if the ground were level.

The force of the ground on a robot that walks in place is vertical in the mean. Seen from feet that lie flat it leans by
as much as the ground is tilted, whatever the joints bend. The attitude less that lean is a tilt that the robot made
itself, and the foot wrenches turned by it are those of level ground.
"""

import numpy as np

from elastic_env.robots.robot_model import WalkerModel
from elastic_env.signals import Array
from elastic_env.walking.leg_kinematics import rotation_x, rotation_y

LOADED_SHARE = 0.15
"""Share of the weight from which the feet count as loaded."""


class GroundLevel:
    """Attitude and foot wrenches without the tilt of the ground, from the observations of a walker.

    Memory per world: measurements so far, mean lean of the ground's force.

    Args:
        model: Assumed walker.
        period_s: Time between measurements [s].
        mean_s: Time constant of the mean lean, after as much time [s].
    """

    names = (
        "own_tilt.roll",
        "own_tilt.pitch",
        *(f"level_wrench.{side}_{part}{axis}" for side in "lr" for part in "fm" for axis in "xyz"),
    )
    """What `observe` returns: [rad], [N] and [N·m], the wrenches in the order of the observation."""
    width = len(names)
    memory_width = 1 + 2

    def __init__(self, model: WalkerModel, period_s: float, mean_s: float = 6.0) -> None:
        table = model.observation_table
        self._attitude, self._wrench = table.group("imu_attitude"), table.group("wrench")
        self._least_n = LOADED_SHARE * model.biped.weight
        self._least_gain = 1.0 - float(np.exp(-period_s / mean_s))

    def begin(self, num_worlds: int) -> Array:
        """Memory before the first measurement, (num_worlds, memory_width)."""
        return np.zeros((num_worlds, self.memory_width))

    def observe(self, rows: Array, memory: Array) -> tuple[Array, Array]:
        """Values after a measurement, see `names`, and the new memory.

        Args:
            rows: Observations, (num_worlds, m).
            memory: (num_worlds, memory_width).
        """
        n = len(rows)
        wrench = rows[:, self._wrench].reshape(n, 4, 3)  # force and moment of the left foot, of the right one
        x, y, z = (wrench[:, 0] + wrench[:, 2]).T
        loaded = z >= self._least_n
        z = np.where(loaded, z, np.inf)
        counted = memory[:, 0] + loaded
        gain = loaded * np.maximum(1.0 / np.maximum(counted, 1.0), self._least_gain)
        lean = memory[:, 1:] + gain[:, None] * (np.stack([y / z, -x / z], axis=1) - memory[:, 1:])
        R = rotation_y(lean[:, 1]) @ rotation_x(lean[:, 0])
        leveled = wrench @ R.swapaxes(-1, -2)
        values = np.hstack([rows[:, self._attitude] - lean, leveled.reshape(n, -1)])
        return values, np.column_stack([counted, lean])
