"""Plans: sampled trajectories, their building blocks, and tables of them for many worlds."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, BoolArray, IntArray

STAND_S = 1.0
"""Time at the first position in which policies ramp in; not scored."""
LONGEST_S = 7200.0
"""Longest motion after the standing [s]: tables hold every control step."""

QUINTIC_PEAK_RATE = 15.0 / 8.0
QUINTIC_PEAK_ACCELERATION = 10.0 / np.sqrt(3.0)


@dataclass(frozen=True)
class Plan:
    """Samples of a reference at the control rate.

    Row k is the target at the end of control period k, row 0 the start.

    Attributes:
        q, q_dot, q_ddot: Angle, rate, acceleration of the link, (T,), or of all links, (T, n)
            [rad], [rad/s], [rad/s²].
        scored: Rows that count in metrics, (T,).
        rest: Number of the rest of `Hold` or `Poses` that is measured, −1 elsewhere, (T,).
    """

    q: Array
    q_dot: Array
    q_ddot: Array
    scored: BoolArray
    rest: IntArray

    @property
    def num_steps(self) -> int:
        """Control steps of an episode."""
        return len(self.q) - 1


@dataclass(frozen=True)
class Extent:
    """Bounds over all plans: range of q [rad], largest |q̇| [rad/s], largest |q̈| [rad/s²]."""

    lowest: float
    highest: float
    q_dot: float
    q_ddot: float

    @property
    def q(self) -> float:
        """Largest |q| [rad]."""
        return max(-self.lowest, self.highest)


def minimum_jerk(s: Array) -> Array:
    """Return the minimum-jerk blend 10s³ − 15s⁴ + 6s⁵ from 0 to 1, s clipped to [0, 1]."""
    s = np.clip(s, 0.0, 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


def quintic(s: Array) -> tuple[Array, Array, Array]:
    """Return `minimum_jerk` and its first two derivatives by s, s clipped to [0, 1]."""
    blend = minimum_jerk(s)
    s = np.clip(s, 0.0, 1.0)
    rate = 30.0 * s**2 * (1.0 - s) ** 2
    return blend, rate, 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s)


def quintic_moves(
    t: Array, start: float, moves: list[tuple[float, float, float]]
) -> tuple[Array, Array, Array]:
    """Return angle, rate, acceleration of moves in a row: begin [s], duration [s], target [rad]."""
    q = np.full_like(t, start)
    q_dot = np.zeros_like(t)
    q_ddot = np.zeros_like(t)
    position = start
    for begin, duration, target in moves:
        # a move changes only the rows within it; after it the whole move is added
        last = int(np.searchsorted(t, begin + duration)) + 1
        within = slice(int(np.searchsorted(t, begin)), last)
        blend, blend_dot, blend_ddot = quintic((t[within] - begin) / duration)
        q[within] += (target - position) * blend
        q[last:] += target - position
        q_dot[within] += (target - position) * blend_dot / duration
        q_ddot[within] += (target - position) * blend_ddot / duration**2
        position = target
    return q, q_dot, q_ddot


def control_times(duration_s: float, control_period_s: float) -> Array:
    """Return the ends of the control periods within a duration, from 0 [s].

    Raises:
        ConfigurationError: The duration is longer than `LONGEST_S` after the standing.
    """
    if duration_s > STAND_S + LONGEST_S:
        raise ConfigurationError(
            f"a motion must last at most {LONGEST_S:g} s, got"
            f" {duration_s - STAND_S:.6g} s; take fewer or quicker moves"
        )
    return np.arange(round(duration_s / control_period_s) + 1) * control_period_s


def derivatives(samples: Array, period_s: float) -> tuple[Array, Array]:
    """Return first and second derivative by central differences, time first; zero at the ends."""
    first = np.zeros_like(samples)
    second = np.zeros_like(samples)
    first[1:-1] = (samples[2:] - samples[:-2]) / (2.0 * period_s)
    second[1:-1] = (samples[2:] - 2.0 * samples[1:-1] + samples[:-2]) / period_s**2
    return first, second


@dataclass(frozen=True)
class Motion:
    """A reference for all joints of a robot. All its plans have the same length.

    Attributes:
        plan: Makes a plan of all joints, (T, n), from a generator and the control period [s].
        is_random: True if every episode has its own plan; else plans do not depend on the
            generator.
    """

    plan: Callable[[np.random.Generator, float], Plan]
    is_random: bool = False


LARGEST_TABLE = 500_000_000
"""Largest memory of all plans [B]: 64 worlds of six joints for 100 s take half of it."""


class PlanTable:
    """Plans of all worlds as tables, one row per control step; a repeated plan is stored once.

    Args:
        motion: Motion of all joints.
        period_s: Time between commands [s].
        num_worlds: Number of worlds.

    Raises:
        ConfigurationError: No step is scored, or the tables would take more than `LARGEST_TABLE`.

    Attributes:
        motion: Angle, rate and acceleration of all joints, (plans, T, 3, n).
        plan_of_world: Number of the plan of each world, (num_worlds,).
        scored, rest: As in a `Plan`, the same for all, (T,).
    """

    def __init__(self, motion: Motion, period_s: float, num_worlds: int) -> None:
        self._motion = motion
        self._period = period_s
        probe = motion.plan(np.random.default_rng(0), period_s)
        self.num_steps = probe.num_steps
        if not probe.scored.any():
            raise ConfigurationError(
                "the reference has no scored control step: its scored time is below the"
                f" control period of {period_s} s; lengthen it"
            )
        plans = num_worlds if motion.is_random else 1
        rows = _motion_rows(probe)
        size = plans * rows.nbytes
        if size > LARGEST_TABLE:
            raise ConfigurationError(
                f"{plans} motions of {self.num_steps} control steps take {size / 1e6:.0f} MB,"
                f" at most {LARGEST_TABLE / 1e6:.0f} MB; take a shorter motion, fewer worlds or"
                " episodes, or one motion for all by `seed`"
            )
        self.plan_of_world = np.arange(num_worlds) % plans
        self.motion = np.tile(rows, (plans, 1, 1, 1))
        self.scored = probe.scored
        self.rest = probe.rest

    def draw(self, world: int, generator: np.random.Generator) -> None:
        """Draw a new plan for one world."""
        if self._motion.is_random:
            plan = self._motion.plan(generator, self._period)
            self.motion[world] = _motion_rows(plan)


def _motion_rows(plan: Plan) -> Array:
    """Return angle, rate and acceleration of a plan, (T, 3, n)."""
    return np.stack([plan.q, plan.q_dot, plan.q_ddot], axis=1)
