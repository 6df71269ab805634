"""The true robot, in simulation alone: what a teacher sees beside its features, or a critic.

No robot knows it. What a teacher gains says how much there is to gain by knowing the robot, and so
bounds what estimates of it can bring. A critic that knows the robot takes no other robot's luck for
the actor's merit: an IMU that is mounted askew costs the same whatever the actor does.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from baselines.residual.correction import Corrected, Truth
from baselines.residual.mirror import Mirror
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, Mirrored, Signal
from elastic_env.world.robot_model import RobotModel, WalkerModel

_PARTS: dict[str, tuple[str, dict[str, Mirrored]]] = {
    "load": ("kg", {"mass": "same", "forward": "same", "left": "opposite"}),
    "slope": ("rad", {"forward": "same", "left": "opposite"}),
    "friction": ("1", {"factor": "same"}),
    "mounting": ("rad", {"roll": "opposite", "pitch": "same"}),
}

_UNIT_OF_JOINTS = {"stiffness": "1", "backlash": "rad"}


def truth_of(env: Any) -> Truth | None:
    """Truth of the worlds of an environment, or of the environments of a mixture; None if unknown.

    Args:
        env: An environment of ours, wrapped or not.
    """
    own = env.unwrapped
    envs = getattr(own, "envs", [own])
    if not all(hasattr(one, "truth") for one in envs):
        return None
    return lambda: [one.truth() for one in envs]


def true_robot(
    names: Sequence[str], model: RobotModel, truth: Truth | None
) -> tuple[tuple[Signal, ...], Callable[[], Array]]:
    """The truth as signals, and what shows it of all worlds, (num_worlds, columns).

    Args:
        names: Of `baselines.residual.settings.TRUE_QUANTITIES`.
        model: Assumed robot.
        truth: As of `truth_of`.

    Raises:
        ConfigurationError: There is no truth to see, or the robot is no walker.
    """
    if truth is None or not isinstance(model, WalkerModel):
        raise ConfigurationError(
            f"a teacher sees the true {', '.join(names)}, which only the simulation of a walker"
            " knows: it is no residual for a robot; train one with privileged: [], and"
            " critic_sees: [] where there is no such truth"
        )
    signals: list[Signal] = []
    for name in names:
        joints: dict[str, Mirrored] = dict.fromkeys(model.joint_names, "same")
        unit, parts = _PARTS.get(name) or (_UNIT_OF_JOINTS[name], joints)
        signals += [
            Signal(f"true_{name}.{part}", unit, f"true {name}, {part}", mirrored=mirrored)
            for part, mirrored in parts.items()
        ]

    def see() -> Array:
        parts = []
        for own in truth():
            values = {
                "stiffness": own.stiffness / model.stiffness - 1.0,
                "backlash": own.backlash,
                "load": own.load,
                "slope": own.slope,
                "friction": own.friction[:, None],
                "mounting": own.mounting,
            }
            parts.append(np.hstack([values[name] for name in names]))
        return np.concatenate(parts)

    return tuple(signals), see


class CriticView:
    """What a critic sees of the true robots while it learns, in the mirror where the actor is.

    Args:
        names: Of `baselines.residual.settings.TRUE_QUANTITIES`.
        corrected: The base and its correction.

    Raises:
        ConfigurationError: There is no truth to see, or the robot is no walker.
    """

    def __init__(self, names: Sequence[str], corrected: Corrected) -> None:
        model = corrected.model
        signals, self._see = true_robot(names, model, corrected.truth)
        self._mirror = Mirror(signals) if corrected.settings.mirror else None
        self._support = model.observation_table.columns("clock.support")
        self.width = len(signals)

    def at(self, rows: Array) -> Array:
        """Truth at a decision, (num_worlds, width), for observations, (num_worlds, m)."""
        values = self._see()
        if self._mirror is None:
            return values
        return np.where(rows[:, self._support] == 1.0, self._mirror(values), values)
