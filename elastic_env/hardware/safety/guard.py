"""The last layer before the wire: limits commands, and stops a motion that leaves its limits.

A value that is not finite is beyond every bound. `nan > limit` is False, so a plain comparison
would let a motion go on without a valid measurement.
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
"""Distance outside the limits at which a motion may begin: weight presses a servo beyond its stop.
The first goal is within the limits [rad]."""
_LONGEST_WITHOUT_TEMPERATURE = 2 * TEMPERATURE_CYCLES + 10
"""Cycles without a servo's temperature that stop the motion.

Missing replies stop it earlier.
"""


def exceeds(value: npt.ArrayLike, limit: npt.ArrayLike) -> BoolArray:
    """Return True where a value is greater than its limit, or one of the two is not finite.

    Args:
        value: (...), in the unit of the limit.
        limit: (...), in the same unit.

    Returns:
        (...).
    """
    values = np.asarray(value, dtype=np.float64)
    limits = np.asarray(limit, dtype=np.float64)
    return ~(np.isfinite(values) & np.isfinite(limits) & (values <= limits))


def is_outside(value: Any, lowest: npt.ArrayLike, highest: npt.ArrayLike) -> BoolArray:
    """Return True where a value lies outside two bounds, or a number is not finite.

    Shapes as in `exceeds`.
    """
    return exceeds(value, highest) | exceeds(np.negative(value), np.negative(lowest))


class Guard:
    """Keeps commands within limits, and detects when the measured state leaves them.

    Args:
        limits: Limits of all servos; `ranges` may replace those of position.
        measured: Positions where the motion begins, (n,) [rad]; commands depart from there no
            faster than the limits allow.
        names: Names of the servos in messages, (n,).
        hottest: Temperatures that the servos' own settings allow, (n,) [°C]; the lower of this and
            the limit holds.
        strongest: Torques that the servos may give for long, (n,) [N·m]; likewise.
        ranges: Lowest and highest goal of each servo, (n, 2) [rad]; None for those of the limits.

    Raises:
        FaultError: A position lies outside the range of goals, or is not known.
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
        # consecutive cycles, (n,) each
        self._without_reply: IntArray = np.zeros(n, dtype=np.int64)
        self._without_temperature: IntArray = np.zeros(n, dtype=np.int64)
        self._strained: IntArray = np.zeros(n, dtype=np.int64)
        # the margin is for positions on the way; the first position becomes the first goal
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
        """True if a reply was missing in the last cycle; the last command is then repeated."""
        return bool(self._without_reply.any())

    def command(self, goals: Array, elapsed_s: float) -> tuple[Array, BoolArray]:
        """Limit the goals of a command.

        Args:
            goals: Desired positions, (n,) [rad].
            elapsed_s: Time since the last command [s].

        Returns:
            Goals within position and slew limits, (n,) [rad], and True where a limit changed them.

        Raises:
            FaultError: A goal or the time is not a finite number, or the time is negative.
        """
        desired = np.asarray(goals, dtype=np.float64)
        n = len(self.goals)
        if desired.shape != (n,) or not np.isfinite(desired).all():
            got = np.asarray(goals).tolist()
            raise FaultError(f"goals must be {n} finite angles [rad], got {got}")
        if is_outside(elapsed_s, 0.0, np.finfo(np.float64).max):
            needed = f"at least 0 s and finite, got {elapsed_s} s"
            raise FaultError(f"the time since the last command must be {needed}")
        if not self.is_holding:
            reach = self.limits.slew_rad_s * elapsed_s
            within = np.clip(desired, self._lowest, self._highest)
            self.goals = np.clip(within, self.goals - reach, self.goals + reach)
        return self.goals.copy(), self.goals != desired

    def check(self, states: States) -> str:
        """Check the replies of a cycle.

        Returns:
            Reason to stop the motion, "" if there is none.
        """
        limits = self.limits
        is_fresh = states.is_fresh
        motion = np.stack([states.position, states.velocity, states.torque])
        unreal = is_fresh & ~np.isfinite(motion).all(axis=0)
        if unreal.any():
            return f"position, velocity or torque of {self._list(unreal)} is not a finite number"
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
                f"a servo is further than {limits.following_error_rad:g} rad from its "
                f"goal, blocked or overloaded: {self._list(behind, states.position)}, "
                f"goal {np.round(self.goals[behind], 3).tolist()} rad"
            )
        return self._check_load(states) or self._check_heat(states.temperature)

    def _check_load(self, states: States) -> str:
        """Reason to stop by the torques, "" if there is none."""
        torque = np.abs(states.torque)
        strained = np.where(exceeds(torque, self._strongest), self._strained + 1, 0)
        # a missing reply changes no count
        self._strained = np.where(states.is_fresh, strained, self._strained)
        too_long = states.is_fresh & (self._strained >= self.limits.patience_cycles)
        if too_long.any():
            torques = self._list(too_long, torque)
            allowed = ", ".join(f"{limit:g}" for limit in self._strongest[too_long])
            return f"the torque exceeds {allowed} N·m: {torques} N·m"
        return ""

    def _check_heat(self, temperature: Array) -> str:
        """Reason to stop by the temperatures, "" if there is none."""
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

    def _ends(self, selected: BoolArray, between: str) -> str:
        """Text of the ranges of some servos' goals [rad], each once."""
        ends = zip(self._lowest[selected], self._highest[selected], strict=True)
        ranges = [f"{low:.3f}{between}{high:.3f}" for low, high in ends]
        return ", ".join(dict.fromkeys(ranges))

    def _list(self, selected: BoolArray, values: Array | None = None) -> str:
        """Text of the names of some servos, with their values."""
        indices = np.flatnonzero(selected)
        if values is None:
            return ", ".join(self._names[i] for i in indices)
        return ", ".join(f"{self._names[i]}: {values[i]:.3f}" for i in indices)


def explain_heat(which: str, hottest: Array) -> str:
    """Message about servos that are too hot.

    Args:
        which: Their names with their temperatures [°C].
        hottest: Highest allowed temperature of each, (n,) [°C].
    """
    limits = [f"{degrees:g}" for degrees in np.atleast_1d(hottest)]
    allowed = ", ".join(dict.fromkeys(limits))
    return (
        f"too hot: {which} °C, at most {allowed} °C are allowed (temperature_c, or the servo's own "
        "temperature_limit); let it cool, and look for what it has to hold or what blocks it"
    )
