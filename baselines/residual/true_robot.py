"""Parameters of the true robot, in simulation only: further features of a teacher or a critic.

No robot knows them. The gain of a teacher is a bound on the gain by estimates of the robot. A
critic that knows the robot does not confuse an easy robot with a good action: an IMU that is
mounted askew costs the same for every action.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from baselines.residual.correction import Corrected, Truth
from baselines.residual.mirror import Mirror
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, Mirrored, Signal
from elastic_env.world.robot_model import RobotModel, WalkerModel

_COLUMNS: dict[str, tuple[str, dict[str, Mirrored]]] = {
    "load": ("kg", {"mass": "same", "forward": "same", "left": "opposite"}),
    "slope": ("rad", {"forward": "same", "left": "opposite"}),
    "friction": ("1", {"factor": "same"}),
    "mounting": ("rad", {"roll": "opposite", "pitch": "same"}),
}

_JOINT_UNITS = {"stiffness": "1", "backlash": "rad"}


def truth_of(env: Any) -> Truth | None:
    """Truth of the worlds of an environment, or of the environments of a mixture; None if unknown.

    Args:
        env: An environment of ours, wrapped or not.
    """
    envs = getattr(env.unwrapped, "envs", [env.unwrapped])
    if not all(hasattr(part, "truth") for part in envs):
        return None
    return lambda: [part.truth() for part in envs]


def true_robot(
    names: Sequence[str], model: RobotModel, truth: Truth | None
) -> tuple[tuple[Signal, ...], Callable[[], Array]]:
    """Truth as signals, and a function that reads it in all worlds, (num_worlds, columns).

    Args:
        names: Names from `baselines.residual.settings.TRUE_QUANTITIES`.
        model: Assumed robot.
        truth: Result of `truth_of`.

    Raises:
        ConfigurationError: There is no truth to see, or the robot is no walker.
    """
    if truth is None or not isinstance(model, WalkerModel):
        raise ConfigurationError(
            f"a teacher sees the true {', '.join(names)}, which only the simulation of"
            " a walker knows: it is no residual for a robot; train one with"
            " privileged: [], and critic_sees: [] where there is no such truth"
        )
    signals: list[Signal] = []
    for name in names:
        joints: dict[str, Mirrored] = dict.fromkeys(model.joint_names, "same")
        unit, parts = _COLUMNS.get(name) or (_JOINT_UNITS[name], joints)
        signals += [
            Signal(f"true_{name}.{part}", unit, f"true {name}, {part}", mirrored=mirrored)
            for part, mirrored in parts.items()
        ]

    def read_truth() -> Array:
        parts = []
        for robots in truth():
            values = {
                "stiffness": robots.stiffness / model.stiffness - 1.0,
                "backlash": robots.backlash,
                "load": robots.load,
                "slope": robots.slope,
                "friction": robots.friction[:, None],
                "mounting": robots.mounting,
            }
            parts.append(np.hstack([values[name] for name in names]))
        return np.concatenate(parts)

    return tuple(signals), read_truth


class CriticView:
    """Truth that a critic sees while it learns, mirrored where the actor is.

    Args:
        names: Names from `baselines.residual.settings.TRUE_QUANTITIES`.
        corrected: The base and its correction.

    Raises:
        ConfigurationError: There is no truth to see, or the robot is no walker.
    """

    def __init__(self, names: Sequence[str], corrected: Corrected) -> None:
        model = corrected.model
        signals, self._read_truth = true_robot(names, model, corrected.truth)
        self._mirror = Mirror(signals) if corrected.settings.mirror else None
        self._support = model.observation_table.columns("clock.support")
        self.width = len(signals)

    def at(self, rows: Array) -> Array:
        """Truth at a decision, (num_worlds, width), for observations, (num_worlds, m)."""
        values = self._read_truth()
        if self._mirror is None:
            return values
        return np.where(rows[:, self._support] == 1.0, self._mirror(values), values)
