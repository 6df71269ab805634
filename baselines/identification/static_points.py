"""Static positions of one joint: averages of encoder and IMU, recorded from an environment."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from baselines.compensation.gravity_torque import GravityModel
from elastic_env.core.errors import ConfigurationError, ElasticError
from elastic_env.core.signals import Array, IntArray

_PROGRESS_STEPS = 250
"""Control steps between two reports of progress."""


@dataclass(frozen=True)
class StaticPoints:
    """Averages of the windows at rest, one entry per visit.

    Attributes:
        theta: Encoder [rad].
        q: IMU on the link [rad].
        direction: Side of approach, +1 from below, -1 from above.
        position: Number of the static position; its two visits share it.
        load: Number of the mass that was mounted, 0 or 1.
    """

    theta: Array
    q: Array
    direction: IntArray
    position: IntArray
    load: IntArray

    def __len__(self) -> int:
        return len(self.theta)

    def rows(self, chosen: IntArray) -> "StaticPoints":
        """Some of the points, in the given order."""
        columns = {field.name: getattr(self, field.name)[chosen] for field in fields(self)}
        return StaticPoints(**columns)

    @staticmethod
    def join(parts: "Sequence[StaticPoints]") -> "StaticPoints":
        """The points of several loads together, with positions numbered through."""
        first = np.cumsum([0, *(part.position.max() + 1 for part in parts)])
        numbered = [
            replace(part, position=part.position + first[load], load=np.full(len(part), load))
            for load, part in enumerate(parts)
        ]
        names = [field.name for field in fields(StaticPoints)]
        columns = {name: np.concatenate([getattr(p, name) for p in numbered]) for name in names}
        return StaticPoints(**columns)


class HoldRecorder:
    """Averages encoder and IMU over the windows at rest of a `hold` reference.

    Args:
        directions: Directions of approach of the windows, (visits,), from `Hold.visits`.
        num_worlds: Number of worlds that play the reference in step.
    """

    def __init__(self, directions: IntArray, num_worlds: int = 1) -> None:
        self._directions = directions
        self._sums = np.zeros((len(directions), num_worlds, 2))
        self._counts = np.zeros(len(directions), dtype=np.int64)

    def take(self, encoder: Array, imu: Array, rest: int) -> None:
        """Add a sample of encoder and IMU, (num_worlds,) [rad], and the window, -1 outside."""
        if rest >= 0:
            self._sums[rest] += np.stack([encoder, imu], axis=-1)
            self._counts[rest] += 1

    @property
    def is_complete(self) -> bool:
        """True if every window has a sample."""
        return bool(self._counts.all())

    def points(self) -> list[StaticPoints]:
        """The averages of every world.

        Raises:
            ElasticError: A window has no sample: the run ended early.
        """
        if not self.is_complete:
            raise ElasticError(
                f"the run ended before all {len(self._counts)} static positions were visited"
            )
        means = self._sums / self._counts[:, None, None]
        half = len(self._directions) // 2
        position = np.concatenate([np.arange(half), np.arange(half)[::-1]])
        load = np.zeros(len(position), dtype=np.int64)
        return [
            StaticPoints(means[:, world, 0], means[:, world, 1], self._directions, position, load)
            for world in range(means.shape[1])
        ]


def record_points(
    env: Any, seed: int | None = None, progress: Callable[[float], None] | None = None
) -> list[StaticPoints]:
    """Drive a testbed, simulated or real, through its `hold` reference without compensation.

    Args:
        env: Testbed environment with reference "hold", scalar or vector.
        seed: Seed of the episode, of the first world's in a vector environment.
        progress: Called about every second with the finished share of the episode.

    Returns:
        The static points of every world; one entry for a scalar environment.

    Raises:
        ConfigurationError: The environment's reference has no static positions.
        ElasticError: The episode ended early.
    """
    task = env.unwrapped.task
    if not hasattr(task.config.reference, "visits"):
        raise ConfigurationError(
            "identification needs the reference 'hold', the environment has"
            f" {task.config.reference.kind!r}"
        )
    recorder = HoldRecorder(task.config.reference.visits[1], task.num_worlds)
    encoder = task.observation_table.names.index("encoder_angle")
    zero = np.zeros(env.action_space.shape, dtype=np.float32)
    env.reset(seed=seed)
    for step in range(task.num_steps):
        observation, _, terminated, _, info = env.step(zero)
        window = int(np.max(info["rest"]))
        recorder.take(observation[..., encoder], info["link_angle_imu"], window)
        if progress is not None and (step + 1) % _PROGRESS_STEPS == 0:
            progress((step + 1) / task.num_steps)
        if np.any(terminated):
            break
    return recorder.points()


def link_torque(points: StaticPoints, gravity: Sequence[GravityModel], q: Array) -> Array:
    """Gravity torque at link angles q [rad], each under its point's load, (len(points),) [N·m]."""
    torque = np.empty(len(points))
    for load, model in enumerate(gravity):
        rows = points.load == load
        torque[rows] = model.gravity_torque(q[rows, None])[:, 0]
    return torque
