"""A warning where joints move while they are scored at rest."""

import warnings
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from elastic_env.core.signals import Array, BoolArray, IntArray
from elastic_env.world.rows import Records

_SHARE = 0.004
"""Motion within a window that is worth a word, over the sag.

An error of 2 % that fades by 1/s moves by as much.
"""
_SMALLEST_RAD = 1e-5
"""Motion that is worth no word, even where a robot does not sag."""
_SLOW_S = 0.15
"""Lag of a servo with which it does not rest within the usual 1.5 s [s]."""
_LAGS = 8.0
"""Lags after which a servo is as near as 0.03 % of its way."""


class RestWatch:
    """Warns once where links still move in a window at rest, and no policy moves them.

    Attributes:
        is_said: Whether it has warned.

    Args:
        static_torque: τ_g that holds the links, from (..., n) [rad] to (..., n) [N·m].
        stiffness: Of spring and servo together, (n,) [N·m/rad].
        joints: Names of the joints.
        servo_lag: k_v/k_p of their servos, with which a damped one creeps to its command, (n,) [s].
    """

    def __init__(
        self,
        static_torque: Callable[[Array], Array],
        stiffness: Array,
        joints: Sequence[str],
        servo_lag: Array,
    ) -> None:
        self._static_torque = static_torque
        self._stiffness = stiffness
        self._joints = list(joints)
        self._servo_lag = servo_lag
        self.is_said = False
        self._window: IntArray = np.empty(0, dtype=np.int64)
        self._least: Array = np.empty(0)
        self._most: Array = np.empty(0)

    def restart(self, worlds: BoolArray) -> None:
        """Begin new episodes in some worlds, a (num_worlds,) mask."""
        if self._window.shape == worlds.shape:
            self._window[worlds] = -1

    def see(self, rest: IntArray, is_last: BoolArray, joints: Records) -> None:
        """Look at control steps; how many are seen at once makes no difference.

        Args:
            rest: Number of the window at rest, −1 elsewhere, (steps, num_worlds).
            is_last: Whether the window ends with a step, (steps, num_worlds).
            joints: Truth of the joints, (steps, num_worlds, n).
        """
        if self._window.shape != rest.shape[1:]:
            self._window = np.full(rest.shape[1:], -1)
            self._least = self._most = np.zeros((2, *joints.shape[1:]))
        is_cut = ((rest[1:] != rest[:-1]) | is_last[:-1]).any(axis=1)
        cuts = (1 + np.flatnonzero(is_cut)).tolist()
        for begin, end in pairwise([0, *cuts, len(rest)]):
            window = rest[begin]
            if (window < 0).all():
                self._window = window.copy()
                continue
            within = joints[begin:end]
            seen = np.stack([within["q"], within["offset"]])
            least = seen.min(axis=1)
            most = seen.max(axis=1)
            is_fresh = (window != self._window)[:, None]
            self._least = np.where(is_fresh, least, np.minimum(self._least, least))
            self._most = np.where(is_fresh, most, np.maximum(self._most, most))
            ended = (window >= 0) & is_last[end - 1]
            self._window = np.where(ended, -1, window)
            if ended.any():
                moved = (self._most - self._least)[:, ended]
                self._judge(within[-1]["q_ref"][ended], moved, window[ended])

    def _judge(self, q_ref: Array, moved: Array, window: IntArray) -> None:
        """Warn of windows that end.

        `moved` says by how much links and commands moved within them, (2, ended, n).
        """
        sag = np.abs(self._static_torque(q_ref) / self._stiffness).max(axis=-1)
        links, commands = moved.max(axis=-1)
        least = np.maximum(_SHARE * sag, _SMALLEST_RAD)
        restless = (links > least) & (commands < links / 2.0)
        if not restless.any():
            return
        self.is_said = True
        worst = int(np.argmax(np.where(restless, links, 0.0)))
        joint = int(moved[0, worst].argmax())
        weight = f"and the weight bends the joints by {1e3 * sag[worst]:.3g} mrad"
        if sag[worst] < _SMALLEST_RAD:
            nothing = "so that nothing is there to compensate"
            weight = f"and no weight bends the joints, {nothing}"
        warnings.warn(
            f"joint {self._joints[joint]!r} does not rest where it is scored at rest: at position"
            f" {window[worst] + 1} its link moves by {1e3 * links[worst]:.3g} mrad while it is"
            f" measured, {weight}. The score holds this motion. {self._cure(joint)}",
            stacklevel=6,
        )

    def _cure(self, joint: int) -> str:
        """Advice for a joint that does not rest: damping makes a slow servo slower."""
        lag_s = float(self._servo_lag[joint])
        if lag_s < _SLOW_S:
            return "Give the reference a longer settle_s, or joints and servos more damping"
        return (
            f"Its servo takes velocity_gain / position_gain = {lag_s:.2g} s to come near: give the"
            f" reference a settle_s of {np.ceil(_LAGS * lag_s):g} s, or the servo less damping"
        )
