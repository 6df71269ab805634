"""Limits on what is commanded and on what is measured, for the last layer before the wire."""

import math
from collections.abc import Sequence
from typing import Self

import numpy as np
import numpy.typing as npt
from pydantic import model_validator

from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, BoolArray, IntArray
from elastic_env.hardware.errors import FaultError
from elastic_env.hardware.safety.bounds import exceeds, is_outside
from elastic_env.hardware.servo_bus.bus import TEMPERATURE_CYCLES, States
from elastic_env.hardware.servo_bus.torque_line import LARGEST_TORQUE_NM, torque_of_current

_TURN = 2.0 * math.pi
_LONGEST_UNTOLD = 2 * TEMPERATURE_CYCLES + 10
"""Cycles without a servo's temperature that stop the motion; replies that are missing for longer do so before."""
_LEAST_RANGE_RAD = 0.01
_TORQUE = "torque, by the current, that stops the motion"


class SafetyLimits(Model):
    """What no command may exceed, and what stops the motion when it is measured; angles as the servo has them."""

    lowest_rad: float = quantity("rad", -1.6, ge=-_TURN, le=_TURN, description="lowest goal")
    highest_rad: float = quantity("rad", 1.6, ge=-_TURN, le=_TURN, description="highest goal")
    slew_rad_s: float = quantity("rad/s", 3.0, ge=0.01, le=10, description="fastest change of the goal")
    speed_rad_s: float = quantity("rad/s", 4.5, ge=0.01, le=10, description="measured speed that stops the motion")
    torque_nm: float = quantity("N·m", LARGEST_TORQUE_NM, ge=0.1, le=LARGEST_TORQUE_NM, description=_TORQUE)
    temperature_c: float = quantity("°C", 80.0, ge=1, le=80, description="temperature above which the motion stops")
    following_error_rad: float = quantity(
        "rad", 0.35, ge=1e-3, le=1.5, description="distance from the goal that stops it"
    )
    margin_rad: float = quantity("rad", 0.05, ge=0, le=0.5, description="how far beyond that range a position may lie")
    patience_cycles: int = quantity("1", 3, ge=1, le=10, description="cycles without a reply, or too much torque")
    hang_s: float = quantity("s", 0.05, ge=0.005, le=0.09, description="time without a command that stops the motion")

    @model_validator(mode="after")
    def _range_is_ordered(self) -> Self:
        if self.highest_rad - self.lowest_rad < _LEAST_RANGE_RAD:
            raise ValueError(
                f"lowest_rad must be below highest_rad, by at least {_LEAST_RANGE_RAD} rad, got {self.lowest_rad} and "
                f"{self.highest_rad}"
            )
        return self


class Guard:
    """Keeps commands within limits, and notices when the measured state leaves them.

    Args:
        limits: The limits, the same for all servos.
        measured: Positions where the motion begins, (n,) [rad]; the first commands can only lead away from there as
            fast as the limits allow.
        names: How messages call the servos, (n,).
        hottest: Temperatures that the servos' own settings allow, (n,) [°C]; the lower one of each and the limit holds.

    Raises:
        FaultError: A position lies outside the goals' range, or is not known.
    """

    def __init__(
        self, limits: SafetyLimits, measured: Array, names: Sequence[str], hottest: npt.ArrayLike = np.inf
    ) -> None:
        self.limits, self._names = limits, tuple(names)
        self.goals = np.array(measured, dtype=np.float64)
        self._missed: IntArray = np.zeros(len(measured), dtype=np.int64)
        self._strained: IntArray = np.zeros(len(measured), dtype=np.int64)
        self._untold: IntArray = np.zeros(len(measured), dtype=np.int64)
        self._hottest: Array = np.minimum(np.full(len(measured), limits.temperature_c), hottest)
        # the margin is for what is measured on the way; where a motion begins is its first goal
        outside = is_outside(self.goals, limits.lowest_rad, limits.highest_rad)
        if outside.any():
            raise FaultError(
                f"motion must begin between {limits.lowest_rad:.3f} and {limits.highest_rad:.3f} rad in the servos' "
                f"own angles, not where these stand: {self._which(outside, self.goals)} rad; move them by hand while "
                "torque is off, correct zero_rad and direction of the mounting, or widen the limits"
            )

    @property
    def is_holding(self) -> bool:
        """Whether a reply was missing in the last cycle: the last command is then repeated, whatever is asked for."""
        return bool(self._missed.any())

    def command(self, goals: Array, elapsed_s: float) -> tuple[Array, BoolArray]:
        """What may be commanded now.

        Args:
            goals: What is asked for, (n,) [rad].
            elapsed_s: Time since the last command [s].

        Returns:
            Goals within position and slew limits, and where they differ from what was asked for.

        Raises:
            FaultError: A goal is not a finite number, or the time is none.
        """
        asked = np.asarray(goals, dtype=np.float64)
        if asked.shape != self.goals.shape or not np.isfinite(asked).all():
            raise FaultError(f"goals must be {len(self.goals)} finite angles [rad], got {np.asarray(goals).tolist()}")
        if is_outside(elapsed_s, 0.0, np.finfo(np.float64).max):
            raise FaultError(f"the time since the last command must be at least 0 s and finite, got {elapsed_s} s")
        if self.is_holding:
            return self.goals.copy(), asked != self.goals
        limits = self.limits
        reach = limits.slew_rad_s * elapsed_s
        allowed = np.clip(np.clip(asked, limits.lowest_rad, limits.highest_rad), self.goals - reach, self.goals + reach)
        self.goals = allowed
        return allowed.copy(), allowed != asked

    def take(self, states: States) -> str:
        """Take a cycle's replies; why the motion must stop, "" if it need not."""
        limits = self.limits
        measured = np.stack([states.position, states.velocity, states.current])
        unreal = states.is_fresh & ~np.isfinite(measured).all(axis=0)
        if unreal.any():
            return f"position, velocity or current of {self._which(unreal)} is not a finite number"
        self._missed = np.where(states.is_fresh, 0, self._missed + 1)
        torque = np.abs(torque_of_current(states.current))
        strained = np.where(exceeds(torque, limits.torque_nm), self._strained + 1, 0)
        self._strained = np.where(states.is_fresh, strained, self._strained)  # a missing reply tells neither way
        if states.has_alert.any():
            return "a servo reports a hardware error"
        lost = self._missed >= limits.patience_cycles
        if lost.any():
            return (
                f"no usable reply from {self._which(lost)} in {limits.patience_cycles} cycles in a row; look at cables "
                "and power, the adapter's latency timer, and what else keeps the computer busy: elastic hardware check"
            )
        outside = states.is_fresh & self._outside(states.position)
        if outside.any():
            return (
                f"a position is outside {limits.lowest_rad:.3f} to {limits.highest_rad:.3f} rad: "
                f"{self._which(outside, states.position)} rad"
            )
        fast = states.is_fresh & exceeds(np.abs(states.velocity), limits.speed_rad_s)
        if fast.any():
            return f"a speed exceeds {limits.speed_rad_s:g} rad/s: {self._which(fast, states.velocity)} rad/s"
        behind = states.is_fresh & exceeds(np.abs(states.position - self.goals), limits.following_error_rad)
        if behind.any():
            return (
                f"a servo is further than {limits.following_error_rad:g} rad from its goal, blocked or overloaded: "
                f"{self._which(behind, states.position)}, goal {np.round(self.goals[behind], 3).tolist()} rad"
            )
        too_long = states.is_fresh & (self._strained >= limits.patience_cycles)
        if too_long.any():
            return f"the torque exceeds {limits.torque_nm:g} N·m: {self._which(too_long, torque)} N·m"
        return self._heat(states.temperature)

    def _heat(self, temperature: Array) -> str:
        """Why the motion must stop by the temperatures that were told, or have not been for long; "" if it need not."""
        untold = np.isnan(temperature)
        self._untold = np.where(untold, self._untold + 1, 0)
        hot = ~untold & exceeds(temperature, self._hottest)
        if hot.any():
            return too_hot(self._which(hot, temperature), self._hottest[hot])
        unknown = exceeds(self._untold, _LONGEST_UNTOLD)
        if unknown.any():
            return f"no temperature from {self._which(unknown)} in {_LONGEST_UNTOLD} cycles: elastic hardware check"
        return ""

    def _which(self, are: BoolArray, values: Array | None = None) -> str:
        """Names of some servos, with their values."""
        said = [""] * len(self._names) if values is None else [f": {value:.3f}" for value in values]
        return ", ".join(name + more for name, more, is_one in zip(self._names, said, are, strict=True) if is_one)

    def _outside(self, positions: Array) -> BoolArray:
        low, high = self.limits.lowest_rad - self.limits.margin_rad, self.limits.highest_rad + self.limits.margin_rad
        return is_outside(positions, low, high)


def too_hot(which: str, hottest: Array) -> str:
    """Words for servos that are too hot.

    Args:
        which: Their names with their temperatures [°C].
        hottest: What each may have, (n,) [°C].
    """
    allowed = ", ".join(f"{degrees:g}" for degrees in np.atleast_1d(hottest))
    return (
        f"too hot: {which} °C, at most {allowed} °C are allowed (temperature_c, or the servo's own temperature_limit); "
        "let it cool, and look for what it has to hold or what blocks it"
    )
