"""Gait of a walk: step periods, phases, a foothold per step, and the ZMP reference.

A step is double, single, double support; its support foot is fixed and the other one swings. The
first step swings the right foot, as Fig. 1 of the paper. Before and after the walk the robot
stands, its feet side by side.
"""

from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from elastic_env.core.config import Model, plain_numbers, quantity
from elastic_env.core.errors import ConfigurationError, quote
from elastic_env.core.signals import Array, BoolArray, IntArray
from elastic_env.motion.trajectory import STAND_S, control_times, minimum_jerk
from elastic_env.rigid.leg_kinematics import turn

LEFT = 0
RIGHT = 1
"""Index of a foot or leg."""

STEP_DURATIONS = {
    24.0: (7.0, 10.0, 7.0),
    3.0: (1.1, 0.8, 1.1),
    1.6: (0.5, 0.6, 0.5),
    1.1: (0.3, 0.5, 0.3),
}
"""Durations of double, single, double support by step period [s]; 24 s and 3 s are the paper's."""

TRANSITION_S = 0.2
"""Half-width of the time around a lift-off or touch-down that counts as transition [s]."""

LONGEST_WALK_S = 600.0
"""Longest walk that is planned, with standing [s]: its tables hold every control step."""

_DURATIONS = ("double_support_s", "single_support_s", "last_double_support_s")
_Shift: TypeAlias = tuple[float, float, Array, Array]
_RAMP_SHIFT_S = 0.1
_RAMP_INWARD_M = 0.02


class Gait(Model):
    """A walk: in place, or with a step length and a turn per step."""

    double_support_s: float = quantity("s", 1.1, gt=0, le=3600)
    """First double support of a step [s]."""
    single_support_s: float = quantity("s", 0.8, gt=0, le=3600)
    """Single support of a step [s]."""
    last_double_support_s: float = quantity("s", 1.1, gt=0, le=3600)
    """Last double support of a step [s]."""
    num_steps: int = quantity("1", 4, ge=1, le=1000)
    """Number of steps [1]."""
    settling_steps: int = quantity("1", 0, ge=0)
    """Number of first steps that are not scored: ramps end in them [1]."""
    step_length_m: float = quantity("m", 0.0, ge=-1, le=1)
    """Distance by which a step sets its foot ahead of the other one, negative for backwards [m]."""
    step_width_m: float | None = quantity("m", None, gt=0, le=1)
    """Distance of the feet side by side; None for that of the hips [m]."""
    turn_rad: float = quantity("rad", 0.0, ge=-1, le=1)
    """Angle by which a step turns its foot from the other one, positive to the left [rad]."""
    lift_m: float = quantity("m", 0.025, gt=0)
    """Height to which the swing foot is lifted [m]."""
    hip_height_m: float = quantity("m", 0.66, gt=0)
    """Height of the hip axes over the ground [m]."""
    transfer: Literal["smooth", "ramp"] = "smooth"
    """Transfer of the ZMP from foot to foot: over the whole double support, or within 0.1 s before
    lift-off and after touch-down, 0.02 m inward of the ankle, as in the published controller of
    this robot's group."""

    @property
    def step_period_s(self) -> float:
        """Duration of a step [s]."""
        swing_s = self.double_support_s + self.single_support_s
        return swing_s + self.last_double_support_s

    @property
    def duration_s(self) -> float:
        """Duration of the episode: the walk, and standing before and after it [s]."""
        return self.num_steps * self.step_period_s + 2.0 * STAND_S

    @property
    def is_in_place(self) -> bool:
        """True if the feet come down where they stood, side by side under the hips."""
        return not (self.step_length_m or self.turn_rad or self.step_width_m)

    def _check(self) -> None:
        if self.settling_steps >= self.num_steps:
            raise ValueError(
                f"settling_steps must be less than num_steps = {self.num_steps}, so that a step is"
                f" left to score, got {self.settling_steps}; take more steps"
            )
        shortest = min(self.double_support_s, self.last_double_support_s)
        if self.transfer == "ramp" and shortest < _RAMP_SHIFT_S:
            raise ValueError(
                f"the transfer 'ramp' shifts the ZMP in {_RAMP_SHIFT_S} s; a double"
                f" support of {shortest} s is shorter"
            )


def make_gait(
    step_period: "float | tuple[float, float, float] | list[float] | Gait", **parameters: Any
) -> Gait:
    """Make a gait from its step period, or the durations of double, single, double support [s].

    Args:
        step_period: 24, 3, 1.6 or 1.1 [s], or three durations [s], or a gait, which is returned.
        **parameters: Further parameters of `Gait`.

    Raises:
        ConfigurationError: The period has no name, or the durations are not three.
    """
    if isinstance(step_period, Gait):
        return step_period.replace(**parameters) if parameters else step_period
    period = plain_numbers(step_period)
    durations = ()
    if isinstance(period, tuple | list):
        durations = tuple(period)
    elif isinstance(period, int | float):
        durations = STEP_DURATIONS.get(period, ())
    if len(durations) != 3:
        known = ", ".join(f"{period:g}" for period in STEP_DURATIONS)
        raise ConfigurationError(
            f"step_period must be one of {known} [s], or the three durations of double, single and"
            f" double support [s] such as [0.8, 0.6, 0.8]; got {quote(step_period)}"
        )
    return Gait(**dict(zip(_DURATIONS, durations, strict=True)), **parameters)


@dataclass(frozen=True)
class Timing:
    """Phases of a walk at the ends of the control periods, (T,) each.

    Attributes:
        time: Time from the start of the episode [s].
        step: Number of the step, from 0 on; before the walk the first, after it the last.
        support: Support foot of that step, `LEFT` or `RIGHT`.
        single: True if the other foot is off the ground.
        swing: Progress of the swing, 0 to 1; 0 before it and 1 after it.
        transition: True within `TRANSITION_S` of a lift-off or touch-down.
        walking: True during the walk.
        scored: True during the walk without its settling steps.
    """

    time: Array
    step: IntArray
    support: IntArray
    single: BoolArray
    swing: Array
    transition: BoolArray
    walking: BoolArray
    scored: BoolArray


def step_timing(gait: Gait, control_period_s: float) -> Timing:
    """Return the phases of a gait.

    Raises:
        ConfigurationError: A duration is no multiple of the control period, or the walk is too
            long.
    """
    first, single, last = (
        _whole_steps(name, getattr(gait, name), control_period_s) for name in _DURATIONS
    )
    period = first + single + last
    if gait.duration_s > LONGEST_WALK_S:
        raise ConfigurationError(
            f"a walk must last at most {LONGEST_WALK_S:g} s with standing,"
            f" {gait.num_steps} steps of {gait.step_period_s:g} s last"
            f" {gait.duration_s:g} s; take fewer steps or shorter ones"
        )
    time = control_times(gait.duration_s, control_period_s)
    begin = round(STAND_S / control_period_s)
    since = np.arange(len(time)) - begin  # control steps since the walk began
    step = np.clip((since - 1) // period, 0, gait.num_steps - 1)
    within = since - step * period - first  # control steps since lift-off
    swing = np.clip(within / single, 0.0, 1.0)
    half_width = int((TRANSITION_S + 1e-9) / control_period_s)
    transition = np.zeros(len(time), dtype=np.bool_)
    for lift_off in begin + np.arange(gait.num_steps) * period + first:
        for event in (lift_off, lift_off + single):
            transition[event - half_width : event + half_width + 1] = True
    walking = (since > 0) & (since <= gait.num_steps * period)
    return Timing(
        time=time,
        step=step,
        support=step % 2,
        single=(within > 0) & (within < single),
        swing=swing,
        transition=walking & transition,
        walking=walking,
        scored=walking & (step >= gait.settling_steps),
    )


@dataclass(frozen=True, eq=False)
class Footholds:
    """Places of the feet after 0, 1, ... steps, in the plan's world frame, left foot first.

    Attributes:
        positions: Middles of the soles, (num_steps + 1, 2, 2) [m].
        yaw: Headings of the feet, positive to the left, counted over full turns, (num_steps + 1, 2)
            [rad].
    """

    positions: Array
    yaw: Array

    def paths(self, timing: Timing) -> tuple[Array, Array]:
        """Return middles of the soles, (T, 2, 2) [m], and headings, (T, 2) [rad], with swings.

        A swing is a straight line from foothold to foothold with minimum jerk.
        """
        blend = minimum_jerk(timing.swing)[:, None]
        before = timing.step
        after = before + 1
        motion = self.positions[after] - self.positions[before]
        positions = self.positions[before] + blend[..., None] * motion
        yaw = self.yaw[before] + blend * (self.yaw[after] - self.yaw[before])
        return positions, yaw


def footholds(gait: Gait, feet: Array) -> Footholds:
    """Return the footholds of a gait.

    A step sets its foot beside the support foot, turned by one turn, and ahead by the step length,
    along the heading halfway through the turn. The last step closes the feet side by side.

    Args:
        gait: Step length, width and turn.
        feet: Middles of the soles where the robot stands with its usual width, left first, (2, 2)
            [m].
    """
    standing = np.array(feet)
    if gait.step_width_m is not None:
        standing[:, 1] = feet[:, 1].mean() + np.array([0.5, -0.5]) * gait.step_width_m
    # a pair of feet for each step, closed by the last one; a step sets one foot of a pair
    turns = gait.turn_rad * np.arange(gait.num_steps)
    yaw = np.append(turns, turns[-1])
    along = np.tile([gait.step_length_m, 0.0], (gait.num_steps - 1, 1))
    advance = turn(along, yaw[1:-1] - 0.5 * gait.turn_rad)
    middle = np.zeros((gait.num_steps + 1, 2))
    middle[1:-1] = np.cumsum(advance, axis=0)
    middle[-1] = middle[-2]
    # after k steps the foot that swung last belongs to pair k, the other one to pair k - 1
    steps = np.arange(gait.num_steps + 1)
    pair = np.repeat(steps[:, None], 2, axis=1)
    pair[1:, LEFT] -= steps[1:] % 2 == 1
    pair[1:, RIGHT] -= steps[1:] % 2 == 0
    return Footholds(middle[pair] + turn(standing, yaw[pair]), yaw[pair])


def zmp_reference(gait: Gait, timing: Timing, feet: Footholds) -> Array:
    """Return the reference of the zero moment point.

    Args:
        gait: Durations and kind of transfer.
        timing: Phases at the control times.
        feet: Footholds by step.

    Returns:
        (T, 2) [m]; under the support foot in single support, halfway between the feet before and
        after the walk.
    """
    zmp = np.repeat(feet.positions[:1].mean(axis=1), len(timing.time), axis=0)
    for begin, duration, start, target in _shifts(gait, feet):
        progress = (timing.time - begin) / duration
        is_smooth = gait.transfer == "smooth"
        blend = minimum_jerk(progress) if is_smooth else np.clip(progress, 0.0, 1.0)
        zmp += blend[:, None] * (target - start)
    return zmp


def inward_offsets(gait: Gait, standing: Array) -> Array:
    """Return the ZMP on one foot from the middle of its sole, in the foot's frame, (2, 2) [m].

    Args:
        gait: Kind of transfer.
        standing: Middles of the soles side by side, left first, (2, 2) [m].
    """
    inward = 0.0 if gait.transfer == "smooth" else _RAMP_INWARD_M
    towards = standing.mean(axis=0) - standing
    return inward * towards / np.linalg.norm(towards, axis=1, keepdims=True)


def _shifts(gait: Gait, feet: Footholds) -> list[_Shift]:
    """Return the moves of the ZMP: begin [s], duration [s], from and to [m]."""
    shifts: list[_Shift] = []
    middles = feet.positions.mean(axis=1)
    supports = feet.positions + turn(inward_offsets(gait, feet.positions[0]), feet.yaw)
    last = middles[0]
    begin = STAND_S
    for step in range(gait.num_steps):
        lift_off = begin + gait.double_support_s
        touch_down = lift_off + gait.single_support_s
        end = begin + gait.step_period_s
        support = supports[step, step % 2]
        if gait.transfer == "ramp":
            shifts.append((lift_off - _RAMP_SHIFT_S, _RAMP_SHIFT_S, middles[step], support))
            shifts.append((touch_down, _RAMP_SHIFT_S, support, middles[step + 1]))
        else:
            start = begin if step == 0 else begin - gait.last_double_support_s
            shifts.append((start, lift_off - start, last, support))
            if step == gait.num_steps - 1:
                shifts.append((touch_down, end - touch_down, support, middles[-1]))
        last = support
        begin = end
    return shifts


def _whole_steps(name: str, duration_s: float, control_period_s: float) -> int:
    steps = duration_s / control_period_s
    if abs(steps - round(steps)) > 1e-6 or round(steps) < 1:
        counts = {max(int(steps), 1), max(int(np.ceil(steps)), 1)}
        nearest = [f"{count * control_period_s:.10g} s" for count in sorted(counts)]
        raise ConfigurationError(
            f"{name} must be a multiple of the control period of {control_period_s} s,"
            f" got {duration_s} s; the nearest {'is' if len(nearest) == 1 else 'are'}"
            f" {' and '.join(nearest)}"
        )
    return round(steps)
