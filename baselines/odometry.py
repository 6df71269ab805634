"""Where a walker's feet stand, reckoned from step to step by its legs, and the ZMP that the ground's forces have there.

A foot lands beside its foothold where the leg that carries the robot bends more or less than expected, and the next
step starts from there: the walk drifts, and the ZMP with it. While both feet are loaded, the link angles say where
one sole is relative to the other; a foot that has landed is as far off as the one that carried, plus what the two are
too far apart.
"""

import numpy as np

from baselines.bending import BendingObserver
from baselines.walking_controller import local_frame
from elastic_env.robots.robot_model import WalkerModel
from elastic_env.robots.thormang import SIDES
from elastic_env.signals import Array
from elastic_env.walking.gait import LEFT, RIGHT
from elastic_env.walking.ground_contact import FootSensors, zero_moment_point

LANDED_SHARE, LIFTED_SHARE = 0.3, 0.02
"""Shares of the weight from which both feet count as standing, and below which one has left the ground."""

_DISPLACEMENTS = 4  # of two feet in x and y
_LEAST_N = 50.0  # below that there is no ZMP


class LegOdometry:
    """Displacement of the feet from their footholds and errors of ZMP and load share, from a walker's observations.

    Memory per world: that of the observer of the bending, displacements, which feet stand.

    Args:
        model: Assumed walker.
        period_s: Time between measurements [s].
    """

    names = (
        *(f"foot_displacement.{side}_{axis}" for side in "lr" for axis in "xy"),
        "zmp_error.x",
        "zmp_error.y",
        "load_share_error",
    )
    """What `observe` returns: displacements [m], ZMP less the planned one [m], load share less the planned one [1]."""
    width = len(names)

    def __init__(self, model: WalkerModel, period_s: float) -> None:
        self._biped, self._bending = model.biped, BendingObserver(model, period_s)
        table, rigid = model.observation_table, model.biped.rigid
        self._wrench, self._share, self._zmp = (table.group(n) for n in ("wrench", "load_share", "zmp_reference"))
        feet = [rigid.body(f"{side}_foot").id for side in SIDES]
        self._sensors = FootSensors(rigid.body_mass[feet], rigid.body_ipos[feet], rigid.opt.gravity)
        self.memory_width = self._bending.memory_width + _DISPLACEMENTS + len(SIDES)

    def begin(self, num_worlds: int) -> Array:
        """Memory of robots that stand on their footholds, (num_worlds, memory_width)."""
        displaced, stands = np.zeros((num_worlds, _DISPLACEMENTS)), np.ones((num_worlds, len(SIDES)))
        return np.hstack([self._bending.begin(num_worlds), displaced, stands])

    def observe(self, rows: Array, memory: Array) -> tuple[Array, Array]:
        """Estimates after a measurement, see `names`, and the new memory; arguments as of `BendingObserver.observe`."""
        n = len(rows)
        own, flat, stands = np.split(memory, [self._bending.memory_width, -len(SIDES)], axis=1)
        estimates, own = self._bending.observe(rows, own)
        wrench = rows[:, self._wrench].reshape(n, 2, 2, 3)
        force, moment = self._sensors.ground_wrench(wrench, np.broadcast_to(np.eye(3), (n, 2, 3, 3)))
        share = force[..., 2] / self._biped.weight
        landed = (share >= LANDED_SHARE).all(axis=1, keepdims=True)
        displaced = self._reckoned(flat.reshape(n, 2, 2), landed & (stands == 0.0), self._too_far(rows, estimates))
        stands = np.where(landed, 1.0, stands * (share >= LIFTED_SHARE))
        ankles = self._biped.ankles + np.pad(displaced, ((0, 0), (0, 0), (0, 1)))
        zmp = zero_moment_point(force, moment, ankles, _LEAST_N) - rows[:, self._zmp]
        vertical = force[..., 2].sum(axis=1)
        right = force[:, RIGHT, 2] / np.where(vertical >= _LEAST_N, vertical, np.nan) - rows[:, self._share][:, 0]
        flat = displaced.reshape(n, -1)
        errors = np.nan_to_num(np.column_stack([zmp, right]), nan=0.0)
        return np.hstack([flat, errors]), np.hstack([own, flat, stands])

    def _too_far(self, rows: Array, estimates: Array) -> Array:
        """How much too far the right sole is from the left one, over level ground, (num_worlds, 2) [m]."""
        own_tilt = estimates[:, [BendingObserver.names.index(f"own_tilt.{axis}") for axis in ("roll", "pitch")]]
        soles = local_frame(self._biped, self._bending.link_angles(rows, estimates), own_tilt).soles[..., :2]
        return soles[:, RIGHT] - soles[:, LEFT] - (self._biped.footholds[RIGHT] - self._biped.footholds[LEFT])

    @staticmethod
    def _reckoned(displaced: Array, has_landed: Array, too_far: Array) -> Array:
        """Displacements with those of the feet that have landed, (num_worlds, 2, 2) [m]."""
        landed_at = np.stack([displaced[:, RIGHT] - too_far, displaced[:, LEFT] + too_far], axis=1)
        return np.where(has_landed[..., None], landed_at, displaced)
