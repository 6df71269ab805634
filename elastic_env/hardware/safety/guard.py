"""The last layer before the wire: limits commands, and stops a motion that leaves its limits.

Whatever is not a finite number is beyond every bound. `nan > limit` is False, so that a plain
comparison would let a motion go on whose measurement is none.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from elastic_env.core.signals import Array, BoolArray, IntArray
from elastic_env.hardware.buses.bus import TEMPERATURE_CYCLES, States
from elastic_env.hardware.errors import FaultError
from elastic_env.hardware.settings import SafetyLimits

_START_SLACK_RAD = 0.005
"""How far outside a motion may begin: weight presses a servo that rests on a stop beyond it. The
first goal is within the limits [rad]."""
_LONGEST_WITHOUT_TEMPERATURE = 2 * TEMPERATURE_CYCLES + 10
"""Cycles without a servo's temperature that stop the motion.

Replies that are missing for longer do so before.
"""


def exceeds(value: npt.ArrayLike, limit: npt.ArrayLike) -> BoolArray:
    """True where a value is not known to be at most a limit.

    It is greater, or one of the two is nan or infinite.

    Args:
        value: (...), in the unit of the limit.
        limit: (...), likewise.

    Returns:
        (...), of one value a single one.
    """
    values = np.asarray(value, dtype=np.float64)
    most = np.asarray(limit, dtype=np.float64)
    return ~(np.isfinite(values) & np.isfinite(most) & (values <= most))


def is_outside(value: Any, lowest: npt.ArrayLike, highest: npt.ArrayLike) -> BoolArray:
    """True where a value is not known to lie between two bounds, or on one of them.

    Shapes as in `exceeds`.
    """
    return exceeds(value, highest) | exceeds(np.negative(value), np.negative(lowest))


class Guard:
    """Keeps commands within limits, and notices when the measured state leaves them.

    Args:
        limits: The limits, the same for all servos but for `ranges`.
        measured: Positions where the motion begins, (n,) [rad]; the first commands can only lead
            away from there as fast as the limits allow.
        names: The servos' names in messages, (n,).
        hottest: Temperatures that the servos' own settings allow, (n,) [°C]; the lower one of each
            and the limit holds.
        strongest: Torques that the servos may give for long, (n,) [N·m]; likewise.
        ranges: Lowest and highest goal of each servo, (n, 2) [rad]; None for those of the limits.

    Raises:
        FaultError: A position lies outside the goals' range, or is not known.
    """

    def __init__(
        self,
        limits: SafetyLimits,
        measured: Array,
        names: Sequence[str],
        hottest: npt.ArrayLike = np.inf,
        strongest: npt.ArrayLike = np.inf,
        ranges: Array | None = None,
    ) -> None:
        n = len(measured)
        self.limits = limits
        self.goals = np.array(measured, dtype=np.float64)
        self._names = tuple(names)
        ends = np.tile([limits.lowest_rad, limits.highest_rad], (n, 1))
        self._lowest, self._highest = (ends if ranges is None else ranges).T
        self._hottest: Array = np.minimum(np.full(n, limits.temperature_c), hottest)
        self._strongest: Array = np.minimum(np.full(n, limits.torque_nm), strongest)
        # cycles in a row, (n,) each
        self._without_reply: IntArray = np.zeros(n, dtype=np.int64)
        self._without_temperature: IntArray = np.zeros(n, dtype=np.int64)
        self._strained: IntArray = np.zeros(n, dtype=np.int64)
        # the margin is for what is measured on the way; where a motion begins is its first goal
        slack = _START_SLACK_RAD
        outside = is_outside(self.goals, self._lowest - slack, self._highest + slack)
        if outside.any():
            raise FaultError(
                f"motion must begin between {self._ends(outside, ' and ')} rad in the servos' own"
                f" angles, not where these stand: {self._list(outside, self.goals)} rad; move them"
                " by hand while torque is off, correct zero_rad and direction of the mounting, or"
                " widen the limits"
            )

    @property
    def is_holding(self) -> bool:
        """True if a reply was missing in the last cycle, and so the last command is repeated."""
        return bool(self._without_reply.any())

    def command(self, goals: Array, elapsed_s: float) -> tuple[Array, BoolArray]:
        """Limit what is asked for.

        Args:
            goals: Positions asked for, (n,) [rad].
            elapsed_s: Time since the last command [s].

        Returns:
            Goals within position and slew limits, and where they differ from what was asked for.

        Raises:
            FaultError: A goal is not a finite number, or the time is none.
        """
        asked = np.asarray(goals, dtype=np.float64)
        n = len(self.goals)
        if asked.shape != (n,) or not np.isfinite(asked).all():
            found = np.asarray(goals).tolist()
            raise FaultError(f"goals must be {n} finite angles [rad], got {found}")
        if is_outside(elapsed_s, 0.0, np.finfo(np.float64).max):
            needed = f"at least 0 s and finite, got {elapsed_s} s"
            raise FaultError(f"the time since the last command must be {needed}")
        if not self.is_holding:
            reach = self.limits.slew_rad_s * elapsed_s
            within = np.clip(asked, self._lowest, self._highest)
            self.goals = np.clip(within, self.goals - reach, self.goals + reach)
        return self.goals.copy(), self.goals != asked

    def check(self, states: States) -> str:
        """Take a cycle's replies.

        Returns:
            Why the motion must stop, "" if it need not.
        """
        limits = self.limits
        is_fresh = states.is_fresh
        motion = np.stack([states.position, states.velocity, states.torque])
        unreal = is_fresh & ~np.isfinite(motion).all(axis=0)
        if unreal.any():
            servos = self._list(unreal)
            return f"position, velocity or torque of {servos} is not a finite number"
        if states.has_alert.any():
            return "a servo reports a hardware error"
        self._without_reply = np.where(is_fresh, 0, self._without_reply + 1)
        lost = self._without_reply >= limits.patience_cycles
        if lost.any():
            hint = limits.patience_hint("patience_cycles")
            return (
                f"no usable reply from {self._list(lost)} in {limits.patience_cycles} cycles in a "
                "row; look at cables and power, the adapter's latency timer, and what else keeps "
                f"the computer busy: elastic hardware check{hint}"
            )
        lowest = self._lowest - limits.margin_rad
        highest = self._highest + limits.margin_rad
        outside = is_fresh & is_outside(states.position, lowest, highest)
        if outside.any():
            ends = f"{self._ends(outside, ' to ')} rad"
            servos = self._list(outside, states.position)
            return f"a position is outside {ends}: {servos} rad"
        fast = is_fresh & exceeds(np.abs(states.velocity), limits.speed_rad_s)
        if fast.any():
            speeds = self._list(fast, states.velocity)
            return f"a speed exceeds {limits.speed_rad_s:g} rad/s: {speeds} rad/s"
        distance = np.abs(states.position - self.goals)
        behind = is_fresh & exceeds(distance, limits.following_error_rad)
        if behind.any():
            return (
                f"a servo is further than {limits.following_error_rad:g} rad from its goal, "
                f"blocked or overloaded: {self._list(behind, states.position)}, goal "
                f"{np.round(self.goals[behind], 3).tolist()} rad"
            )
        return self._check_load(states) or self._check_heat(states.temperature)

    def _check_load(self, states: States) -> str:
        torque = np.abs(states.torque)
        is_strained = exceeds(torque, self._strongest)
        strained = np.where(is_strained, self._strained + 1, 0)
        # a missing reply tells neither way
        self._strained = np.where(states.is_fresh, strained, self._strained)
        too_long = states.is_fresh & (self._strained >= self.limits.patience_cycles)
        if too_long.any():
            torques = self._list(too_long, torque)
            allowed = ", ".join(f"{one:g}" for one in self._strongest[too_long])
            return f"the torque exceeds {allowed} N·m: {torques} N·m"
        return ""

    def _check_heat(self, temperature: Array) -> str:
        is_missing = np.isnan(temperature)
        missed = self._without_temperature + 1
        self._without_temperature = np.where(is_missing, missed, 0)
        hot = ~is_missing & exceeds(temperature, self._hottest)
        if hot.any():
            return explain_heat(self._list(hot, temperature), self._hottest[hot])
        longest = _LONGEST_WITHOUT_TEMPERATURE
        unknown = self._without_temperature > longest
        if unknown.any():
            servos = self._list(unknown)
            return f"no temperature from {servos} in {longest} cycles: elastic hardware check"
        return ""

    def _ends(self, are: BoolArray, between: str) -> str:
        """Ranges of the goals of some servos [rad], each once."""
        ends = zip(self._lowest[are], self._highest[are], strict=True)
        ranges = [f"{low:.3f}{between}{high:.3f}" for low, high in ends]
        return ", ".join(dict.fromkeys(ranges))

    def _list(self, are: BoolArray, values: Array | None = None) -> str:
        """Names of some servos, with their values."""
        chosen = np.flatnonzero(are)
        if values is None:
            return ", ".join(self._names[i] for i in chosen)
        return ", ".join(f"{self._names[i]}: {values[i]:.3f}" for i in chosen)


def explain_heat(which: str, hottest: Array) -> str:
    """Words for servos that are too hot.

    Args:
        which: Their names with their temperatures [°C].
        hottest: Temperature that each may have, (n,) [°C].
    """
    limits = [f"{degrees:g}" for degrees in np.atleast_1d(hottest)]
    allowed = ", ".join(dict.fromkeys(limits))
    return (
        f"too hot: {which} °C, at most {allowed} °C are allowed (temperature_c, or the servo's own "
        "temperature_limit); let it cool, and look for what it has to hold or what blocks it"
    )
