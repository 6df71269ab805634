"""A walker seen in the mirror of its plane of symmetry, x and z.

What the right leg does looks as if the left did it.

A robot that is its own mirror image needs one answer for both of its steps. A residual that always
sees the step on the left foot has half as much to learn, and learns it from twice as many steps. In
the mirror left and right change places; vectors change their y, axes of rotation their x and z, and
a share of the load or the choice of a foot, p, becomes 1 − p [Abdolhosseini2019]. What is decided
in the mirror is turned back: the ZMP to the left becomes one to the right.

[Abdolhosseini2019] F. Abdolhosseini et al., "On Learning Symmetric Locomotion", Motion, Interaction
and Games.
"""

import re
from collections.abc import Sequence

import numpy as np

from baselines.compensation.inputs import INPUTS
from baselines.residual.correction import Corrected
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, BoolArray, Signal
from elastic_env.world.robot_model import WalkerModel

Signals = Sequence[Signal]
_SIGN = {"same": 1.0, "opposite": -1.0, "complement": -1.0}
_SIDE = re.compile(r"(?<=\.)[lr]_")


class Mirror:
    """Image of a walker's signals in its mirror: offset + sign · values[source].

    Attributes:
        source: Column that takes the place of each, (columns,).
        sign, offset: What it is times, and what is added to it, (columns,) each.

    Args:
        signals: What the columns hold, with the sides l_ and r_ behind a dot.

    Raises:
        ConfigurationError: A signal of which nobody has said what it is in the mirror, or one of a
            side alone.
    """

    def __init__(self, signals: Signals) -> None:
        columns = {signal.name: column for column, signal in enumerate(signals)}
        others = [_other_side(name) for name in columns]
        if lacking := [name for name in others if name not in columns]:
            raise ConfigurationError(
                f"in the mirror left and right change places, but there is no {', '.join(lacking)};"
                " observe both, or mirror: false"
            )
        self.source = np.array([columns[name] for name in others], dtype=np.int64)
        self.sign = np.array([_sign(signal) for signal in signals])
        complements = [signal.mirrored == "complement" for signal in signals]
        self.offset = np.array(complements, dtype=np.float64)

    def __call__(self, values: Array) -> Array:
        """Values in the mirror, (..., columns)."""
        return self.offset + self.sign * values[..., self.source]


class LeftFirst:
    """Shows steps on the right foot in the mirror, as steps on the left.

    Args:
        signals: All features, with those of earlier decisions.
        corrected: The base and what acts on it.

    Attributes:
        of_features, of_residual: The mirrors.

    Raises:
        ConfigurationError: No walker, a signal without a mirror image, or a joint corrected unlike
            the other leg's.
    """

    def __init__(self, signals: Signals, corrected: Corrected) -> None:
        model = corrected.model
        if not isinstance(model, WalkerModel):
            found = f"got a {type(model).__name__}; set mirror: false"
            raise ConfigurationError(f"mirror is for a walker, with legs that are alike, {found}")
        unlike: list[str] = []
        bounds = corrected.channels.parts(corrected.channels.bounds)
        for name, of_input in bounds.items():
            if INPUTS[name].axes is None:
                left, right = np.split(of_input, 2)
                differ = np.flatnonzero(left != right)
                unlike += [model.joint_names[joint] for joint in differ]
        if unlike:
            raise ConfigurationError(
                "mirror needs joints and bounds that are the same on both legs, they are not for"
                f" {', '.join(unlike)}; name joints without l_ and r_, or mirror: false"
            )
        self.of_features = Mirror(signals)
        self.of_residual = Mirror(corrected.channels.signals)
        self._support = model.observation_table.columns("clock.support")

    def __call__(self, rows: Array, features: Array) -> Array:
        """Features as they are in a step of the left foot, and mirrored in one of the right.

        Args:
            rows: Observations, (num_worlds, m).
            features: Of the same measurements, (num_worlds, width).

        Returns:
            (num_worlds, width).
        """
        return np.where(self.on_right(rows), self.of_features(features), features)

    def turn_back(self, rows: Array, residual: Array) -> Array:
        """A residual as it acts, (num_worlds, k): a decision of the mirror is turned back."""
        return np.where(self.on_right(rows), self.of_residual(residual), residual)

    def on_right(self, rows: Array) -> BoolArray:
        """Whether the step is on the right foot, (num_worlds, 1)."""
        return rows[:, self._support] == 1.0


def _other_side(name: str) -> str:
    """The name of the same on the other leg; itself where it has no side."""
    return _SIDE.sub(lambda side: "r_" if side[0] == "l_" else "l_", name)


def _sign(signal: Signal) -> float:
    if signal.mirrored is None:
        raise ConfigurationError(
            f"it is not known what {signal.name!r} is in the mirror; leave it out, or mirror: false"
        )
    return _SIGN[signal.mirrored]
