"""The first observation of an episode: its signs, and a check of calls without memory."""

from typing import Any

import numpy as np

from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array, BoolArray
from elastic_env.world.robot_model import RobotModel


def require_start(model: RobotModel, rows: Array, episode_start: Any) -> None:
    """Refuse observations that are not the first of their episodes.

    Args:
        model: Robot with the columns of the observations.
        rows: Observations, (num_worlds, m).
        episode_start: Worlds whose episode begins; None to decide by the observations.

    Raises:
        ElasticError: An episode goes on.
    """
    if not np.all(is_start(model, rows) if episode_start is None else episode_start):
        has_clock = "clock.time" in model.observation_table.names
        sign = "clock.time" if has_clock else "a reference at rest, and no command yet"
        raise ElasticError(
            "predict() was called without `state` in what looks like the middle of an episode"
            f" (a beginning is known by {sign}): this policy has memory; pass the state that"
            " the last call returned, and episode_start=True where an episode begins"
        )


def is_start(model: RobotModel, rows: Array) -> BoolArray:
    """True for an observation that can be the first of an episode, (num_worlds,).

    The clock decides, or without one: a reference at rest and no command yet. The last command is
    then the reference, or zero, as an environment may begin.
    """
    table = model.observation_table
    if "clock.time" in table.names:
        return rows[:, table.names.index("clock.time")] < 1.5 * model.control_period_s
    command = rows[:, table.group("last_command")]
    is_reference = (command == rows[:, table.group("reference_angle")]).all(axis=1)
    is_at_rest = (rows[:, table.group("reference_rate")] == 0.0).all(axis=1)
    return is_at_rest & (is_reference | (command == 0.0).all(axis=1))
