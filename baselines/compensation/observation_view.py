"""Columns of an observation by name, for policies and for compiled kernels."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from baselines.compensation.records import Records
from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array, BoolArray, IntArray, SignalTable
from elastic_env.world.robot_model import RobotModel


class Motion(NamedTuple):
    """Desired motion of the links, (..., n) each [rad], [rad/s], [rad/s²]."""

    q: Array
    q_dot: Array
    q_ddot: Array


class ObservationView:
    """Columns of an observation that policies need, by name."""

    def __init__(self, model: RobotModel) -> None:
        table = model.observation_table
        self._width = len(table)
        self._period_s = model.control_period_s
        self._clock: Any = table.group("clock") if "clock.time" in table.names else None
        self._theta = table.group("encoder_angle")
        self._q = table.group("reference_angle")
        self._q_dot = table.group("reference_rate")
        self._q_ddot = table.group("reference_acceleration")
        self._command = table.group("last_command")
        self.num_joints = self._theta.stop - self._theta.start

    def theta(self, rows: Array) -> Array:
        """Encoder angles, (num_worlds, n) [rad]."""
        return rows[:, self._theta]

    def plan_row(self, rows: Array) -> IntArray:
        """Row of a walk's plan at the end of the coming control period, (num_worlds,)."""
        return np.rint(rows[:, self._clock.start] / self._period_s).astype(np.int64)

    def motion(self, rows: Array) -> Motion:
        """Reference motion for the coming control period, (num_worlds, n) each."""
        return Motion(rows[:, self._q], rows[:, self._q_dot], rows[:, self._q_ddot])

    def rows(self, observation: Array) -> Array:
        """Observation with one row per world, (num_worlds, m).

        Raises:
            ElasticError: The observation does not have the columns of the table.
        """
        rows = np.asarray(observation, dtype=np.float64)
        rows = rows[None] if rows.ndim < 2 else rows
        if rows.ndim != 2 or rows.shape[1] != self._width:
            needed = f"the {self._width} columns of its table, one row per world"
            shape = np.shape(observation)
            raise ElasticError(f"an observation must have {needed}, got shape {shape}")
        return rows

    def require_start(self, rows: Array, episode_start: Any) -> None:
        """Refuse observations that are not the first of their episodes.

        Args:
            rows: Observations, (num_worlds, m).
            episode_start: Worlds whose episode begins; None to decide by the observations.

        Raises:
            ElasticError: An episode goes on.
        """
        if not np.all(self.is_start(rows) if episode_start is None else episode_start):
            at_rest = "a reference at rest, and no command yet"
            sign = at_rest if self._clock is None else "clock.time"
            raise ElasticError(
                "predict() was called without `state` in what looks like the middle of an episode"
                f" (a beginning is known by {sign}): this policy has memory; pass the state that"
                " the last call returned, and episode_start=True where an episode begins"
            )

    def is_start(self, rows: Array) -> BoolArray:
        """True for an observation that can be the first of an episode, (num_worlds,).

        The clock decides, or without one: a reference at rest and no command yet. The last command
        is then the reference, or zero, as an environment may begin.
        """
        if self._clock is not None:
            return rows[:, self._clock][:, 0] < 1.5 * self._period_s
        command = rows[:, self._command]
        is_reference = (command == rows[:, self._q]).all(axis=1)
        is_at_rest = (rows[:, self._q_dot] == 0.0).all(axis=1)
        return is_at_rest & (is_reference | (command == 0.0).all(axis=1))


_WALK_FIELDS: Mapping[str, tuple[int, ...]] = {
    "encoder_angle": (12,),
    "encoder_rate": (12,),
    "imu_attitude": (2,),
    "imu_rate": (3,),
    "wrench": (2, 2, 3),
    "reference_angle": (12,),
    "reference_rate": (12,),
    "clock": (3,),
    "load_share": (),
    "zmp_reference": (2,),
}
"""Groups of a walker's observation, and the shapes of their fields; wrench: feet, force and
moment, axes.
"""


class WalkView:
    """Observations of a walker as rows with named fields, as compiled kernels read them.

    Args:
        table: Columns of the observation.
    """

    def __init__(self, table: SignalTable) -> None:
        groups = [table.group(name) for name in _WALK_FIELDS]
        layout = {
            "names": list(_WALK_FIELDS),
            "formats": [(np.float64, shape) for shape in _WALK_FIELDS.values()],
            "offsets": [8 * group.start for group in groups],
            # without the columns behind them, so that one kernel fits all walkers
            "itemsize": 8 * max(group.stop for group in groups),
        }
        self._type = np.dtype((np.record, layout))

    def fields(self, rows: Array) -> Records:
        """Observations, (num_worlds, m), as rows with fields, (num_worlds,), in the same memory."""
        rows = np.ascontiguousarray(rows)
        return np.ndarray(len(rows), self._type, rows, 0, rows.strides[:1])
