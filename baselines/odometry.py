"""Where a walker's feet stand, reckoned from step to step by its legs.

A foot lands beside its foothold where the leg that carries the robot bends more or less than expected, and the next
step starts from there: the walk drifts, and the ZMP with it. While both feet are loaded, the link angles say where one
sole is relative to the other; a foot that has landed is as far off as the one that carried, plus what the two are too
far apart.
"""

import numpy as np

from baselines.bending import BendingObserver
from baselines.ground_level import GroundLevel
from baselines.walking_controller import local_frame
from elastic_env.robots.robot_model import WalkerModel
from elastic_env.robots.thormang import SIDES
from elastic_env.signals import Array, BoolArray
from elastic_env.walking.gait import LEFT, RIGHT

LANDED_SHARE, LIFTED_SHARE = 0.3, 0.02
"""Shares of the weight from which both feet count as standing, and below which one has left the ground."""

_DISPLACEMENTS = 4  # of two feet in x and y


class LegOdometry:
    """Displacement of the feet from their footholds, from the observations of a walker.

    Memory per world: that of the observers of the bending and of the ground's tilt, displacements, which feet stand.

    Args:
        model: Assumed walker.
        period_s: Time between measurements [s].
    """

    names = tuple(f"foot_displacement.{side}_{axis}" for side in SIDES for axis in "xy")
    """What `observe` returns [m]."""

    def __init__(self, model: WalkerModel, period_s: float) -> None:
        self._biped, self._wrench = model.biped, model.observation_table.group("wrench")
        self._bending, self._level = BendingObserver(model), GroundLevel(model, period_s)
        widths = [self._bending.memory_width, self._level.memory_width, _DISPLACEMENTS, len(SIDES)]
        self.memory_width, self._ends = sum(widths), np.cumsum(widths)[:-1]

    def begin(self, num_worlds: int) -> Array:
        """Memory of robots that stand on their footholds, (num_worlds, memory_width)."""
        displaced, stands = np.zeros((num_worlds, _DISPLACEMENTS)), np.ones((num_worlds, len(SIDES)))
        return np.hstack([self._bending.begin(num_worlds), self._level.begin(num_worlds), displaced, stands])

    def observe(self, rows: Array, memory: Array) -> tuple[Array, Array]:
        """Displacements after a measurement, see `names`, and the new memory.

        Args:
            rows: Observations, (num_worlds, m).
            memory: (num_worlds, memory_width).
        """
        n = len(rows)
        of_bending, of_level, displaced, stands = np.split(memory, self._ends, axis=1)
        estimates, of_bending = self._bending.observe(rows, of_bending)
        level, of_level = self._level.observe(rows, of_level)
        share = rows[:, self._wrench].reshape(n, 2, 2, 3)[:, :, 0, 2] / self._biped.weight
        landed = (share >= LANDED_SHARE).all(axis=1, keepdims=True)
        too_far = self._too_far(self._bending.link_angles(rows, estimates), level[:, :2])
        displaced = reckoned(displaced.reshape(n, 2, 2), landed & (stands == 0.0), too_far).reshape(n, -1)
        stands = np.where(landed, 1.0, stands * (share >= LIFTED_SHARE))
        return displaced, np.hstack([of_bending, of_level, displaced, stands])

    def _too_far(self, q: Array, own_tilt: Array) -> Array:
        """How much too far the right sole is from the left one, over level ground, (num_worlds, 2) [m]."""
        soles = local_frame(self._biped, q, own_tilt).soles[..., :2]
        return soles[:, RIGHT] - soles[:, LEFT] - (self._biped.footholds[RIGHT] - self._biped.footholds[LEFT])


def reckoned(displaced: Array, has_landed: BoolArray, too_far: Array) -> Array:
    """Displacements with those of the feet that have landed, from the other foot's, (num_worlds, 2 legs, 2) [m].

    Args:
        displaced: Before, (num_worlds, 2 legs, 2) [m].
        has_landed: (num_worlds, 2 legs).
        too_far: How much too far the right foot is from the left one, (num_worlds, 2) [m].
    """
    landed_at = np.stack([displaced[:, RIGHT] - too_far, displaced[:, LEFT] + too_far], axis=1)
    return np.where(has_landed[..., None], landed_at, displaced)
