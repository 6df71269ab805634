"""Mirror images of a walker in its plane of symmetry, x and z: left and right are exchanged.

A symmetric robot needs one policy for both of its steps. A residual that always sees the step on
the left foot has half as much to learn, and learns it from twice as many steps. In the mirror left
and right are exchanged; vectors change the sign of y, axes of rotation the signs of x and z, and a
share of the load or the number of a foot, p, becomes 1 − p [Abdolhosseini2019]. A decision in the
mirror is turned back: a ZMP shift to the left becomes one to the right.

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
        source: Column of the other side for each column, (columns,).
        sign, offset: Factor of its value, and the summand, (columns,) each.

    Args:
        signals: Signals of the columns, with the sides l_ and r_ behind a dot.

    Raises:
        ConfigurationError: A signal without a sign in the mirror, or without its other side.
    """

    def __init__(self, signals: Signals) -> None:
        columns = {signal.name: column for column, signal in enumerate(signals)}
        others = [_other_side(name) for name in columns]
        if missing := [name for name in others if name not in columns]:
            raise ConfigurationError(
                "in the mirror left and right change places, but there is no"
                f" {', '.join(missing)}; observe both, or mirror: false"
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
        signals: All features, also of earlier decisions.
        corrected: The base and its correction.

    Attributes:
        of_features, of_residual: Mirrors of features and residual.

    Raises:
        ConfigurationError: The robot is no walker, a signal has no mirror image, or the correction
            of a joint differs from the other leg's.
    """

    def __init__(self, signals: Signals, corrected: Corrected) -> None:
        model = corrected.model
        if not isinstance(model, WalkerModel):
            got = f"got a {type(model).__name__}; set mirror: false"
            raise ConfigurationError(f"mirror is for a walker, with two equal legs, {got}")
        different: list[str] = []
        bounds = corrected.channels.parts(corrected.channels.bounds)
        for name, input_bounds in bounds.items():
            if INPUTS[name].axes is None:
                left, right = np.split(input_bounds, 2)
                differ = np.flatnonzero(left != right)
                different += [model.joint_names[i] for i in differ]
        if different:
            raise ConfigurationError(
                "mirror needs the same joints and bounds on both legs, which differ for"
                f" {', '.join(different)}; name joints without l_ and r_, or mirror: false"
            )
        self.of_features = Mirror(signals)
        self.of_residual = Mirror(corrected.channels.signals)
        self._support = model.observation_table.columns("clock.support")

    def __call__(self, rows: Array, features: Array) -> Array:
        """Features, mirrored in a step on the right foot.

        Args:
            rows: Observations, (num_worlds, m).
            features: Features of the same measurements, (num_worlds, width).

        Returns:
            (num_worlds, width).
        """
        return np.where(self._is_on_right(rows), self.of_features(features), features)

    def turn_back(self, rows: Array, residual: Array) -> Array:
        """Residual as it acts, (num_worlds, k): a decision in the mirror is turned back."""
        return np.where(self._is_on_right(rows), self.of_residual(residual), residual)

    def _is_on_right(self, rows: Array) -> BoolArray:
        """True where the step is on the right foot, (num_worlds, 1)."""
        return rows[:, self._support] == 1.0


def _other_side(name: str) -> str:
    """Name of the same signal on the other leg; without a side the name itself."""
    return _SIDE.sub(lambda side: "r_" if side[0] == "l_" else "l_", name)


def _sign(signal: Signal) -> float:
    if signal.mirrored is None:
        raise ConfigurationError(
            f"the sign of {signal.name!r} in the mirror is unknown; leave it out, or mirror: false"
        )
    return _SIGN[signal.mirrored]
