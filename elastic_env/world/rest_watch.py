"""Warning for joints that move while they are scored at rest."""

import warnings
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from elastic_env.core.signals import Array, BoolArray, IntArray
from elastic_env.world.records import Records

_MOTION_PER_SAG = 0.004
"""Smallest motion within a window that causes a warning, over the sag [1].

An error of 2 % of the sag that decays at 1/s moves by as much.
"""
_SMALLEST_RAD = 1e-5
"""Smallest motion that causes a warning where a robot does not sag [rad]."""
_SLOW_LAG_S = 0.15
"""Lag of a servo that does not come to rest within the usual 1.5 s [s]."""
_LAGS = 8.0
"""Lags after which a servo has 0.03 % of its way left [1]."""


class RestWatch:
    """Warn once if links still move in a window at rest, and no policy moves them.

    Attributes:
        has_warned: True after the warning.

    Args:
        static_torque: τ_g that holds the links, from (..., n) [rad] to (..., n) [N·m].
        stiffness: Stiffness of spring and servo in series, (n,) [N·m/rad].
        joints: Names of the joints.
        servo_lag: k_v/k_p of the servos, the time in which a damped servo creeps to its command,
            (n,) [s].
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
        self.has_warned = False
        self._window: IntArray = np.empty(0, dtype=np.int64)
        self._least: Array = np.empty(0)
        self._most: Array = np.empty(0)

    def restart(self, worlds: BoolArray) -> None:
        """Begin new episodes in some worlds, a (num_worlds,) mask."""
        if self._window.shape == worlds.shape:
            self._window[worlds] = -1

    def update(self, rest: IntArray, is_last: BoolArray, joints: Records) -> None:
        """Check control steps; the result does not depend on how they are divided into calls.

        Args:
            rest: Number of the window at rest, −1 elsewhere, (steps, num_worlds).
            is_last: True where the window ends with a step, (steps, num_worlds).
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
            angles = np.stack([within["q"], within["offset"]])
            least = angles.min(axis=1)
            most = angles.max(axis=1)
            is_fresh = (window != self._window)[:, None]
            self._least = np.where(is_fresh, least, np.minimum(self._least, least))
            self._most = np.where(is_fresh, most, np.maximum(self._most, most))
            is_over = (window >= 0) & is_last[end - 1]
            self._window = np.where(is_over, -1, window)
            if is_over.any():
                motion = (self._most - self._least)[:, is_over]
                q_ref = within[-1]["q_ref"][is_over]
                self._check_windows(q_ref, motion, window[is_over])

    def _check_windows(self, q_ref: Array, motion: Array, window: IntArray) -> None:
        """Warn if links moved within windows that are over.

        Args:
            q_ref: Reference of the windows, (windows, n) [rad].
            motion: Extent of the motion of links and of commands, (2, windows, n) [rad].
            window: Numbers of the windows, (windows,).
        """
        sag = np.abs(self._static_torque(q_ref) / self._stiffness).max(axis=-1)
        links, commands = motion.max(axis=-1)
        least = np.maximum(_MOTION_PER_SAG * sag, _SMALLEST_RAD)
        moves = (links > least) & (commands < links / 2.0)
        if not moves.any():
            return
        self.has_warned = True
        worst = int(np.argmax(np.where(moves, links, 0.0)))
        joint = int(motion[0, worst].argmax())
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
        """Advice for a joint that does not rest; damping makes a slow servo slower."""
        lag_s = float(self._servo_lag[joint])
        if lag_s < _SLOW_LAG_S:
            return "Give the reference a longer settle_s, or joints and servos more damping"
        return (
            f"Its servo takes velocity_gain / position_gain = {lag_s:.2g} s to come near: give the"
            f" reference a settle_s of {np.ceil(_LAGS * lag_s):g} s, or the servo less damping"
        )
