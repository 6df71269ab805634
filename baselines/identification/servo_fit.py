"""Parameters of a servo from logs in time: a start by regression, then the motion replayed.

The fit replays every log from its first row, and takes the parameters with the least squared
deviation of the angles (output error method, [Ljung1999]). `servo_intervals` has the intervals.

[Ljung1999] L. Ljung, "System Identification: Theory for the User", 2nd ed., section 7.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from baselines.identification.servo_intervals import (
    LEAST_WEIGHT,
    half_widths,
    independent_rows,
    residual_deviation,
)
from baselines.identification.servo_log import ServoLog
from baselines.identification.servo_problem import INDEX, VISCOUS_SHARE, ServoProblem, prepare
from baselines.identification.servo_replay import NAMES
from baselines.identification.servo_start import regress
from elastic_env.core.signals import Array, BoolArray, IntArray

STARTS = 3
"""Starts of a fit."""
STAGES = STARTS + 1
"""Stages of a fit, for its progress."""
_PARTS_S = (0.3, 1.0)
"""Lengths of the parts that are replayed first."""
_LEAST_GAIN = 10.0
"""Fall of N ln S at which an effect is estimated."""


@dataclass(frozen=True)
class ServoFit:
    """Parameters that fit logs, with their intervals.

    Attributes:
        logs: Logs that were fitted.
        values: Estimates, as in `NAMES`, (13,).
        half_width: Half-widths of their 95 % intervals, nan without an estimate, (13,).
        is_estimated: True for parameters that the fit changed, (13,).
        tied: Names of parameters that follow from others, with the reason.
        rms: Root mean square deviation of the replay from the fitted logs [rad].
    """

    logs: tuple[ServoLog, ...]
    values: Array
    half_width: Array
    is_estimated: BoolArray
    tied: dict[str, str]
    rms: float

    def value(self, name: str) -> float:
        """Estimate of a parameter by its name."""
        return float(self.values[INDEX[name]])

    def half(self, name: str) -> float:
        """Half-width of its interval; nan without an estimate."""
        return float(self.half_width[INDEX[name]])

    def replay(self, log: ServoLog) -> Array:
        """Angles at the rows of a log, played from its first row, (N,) [rad]."""
        return prepare(log).play(self.values)


def fit_servo(
    logs: Sequence[ServoLog],
    progress: Callable[[int], None] | None = None,
    seed: int = 0,
    starts: int = STARTS,
    *,
    priors: bool = True,
) -> ServoFit:
    """Estimate the parameters of a servo.

    Args:
        logs: Logs of one servo under known loads.
        progress: Called with the number of finished stages, of `STAGES`.
        seed: Seed of the further starts.
        starts: Number of starts, against local minima.
        priors: False to ignore the usual loss of gears and the usual no-load speed.

    Raises:
        ElasticError: No parameters replay the logs better than a joint that does not move.
    """
    report = progress or (lambda done: None)  # noqa: ARG005
    problem = ServoProblem.from_logs(logs)
    z = regress(problem)
    free = problem.basic_parameters
    rng = np.random.default_rng(seed)
    solutions = []
    coarse = problem.with_steps()
    for count in range(starts):
        start = z if count == 0 else z * np.exp(0.7 * rng.normal(size=len(z)))
        for seconds in _PARTS_S:
            start, _ = problem.with_parts(seconds).solve(start, free, 12)
        solutions.append(coarse.solve(start, free, 25))
        report(count + 1)
    best = min(solutions, key=lambda pair: pair[1])
    weight = residual_deviation(coarse, best[0]) if priors else LEAST_WEIGHT
    coarse = replace(coarse, weight=weight)
    solutions = [coarse.solve(z, free, 20) for z, _ in solutions]
    best = min(solutions, key=lambda pair: pair[1])
    for effect in problem.optional_effects(best[0]):
        start = best[0].copy()
        further = np.array([INDEX[name] for name in effect])
        start[further] = list(effect.values())
        trial = coarse.solve(start, np.append(free, further), 25)
        if _gain(coarse, best, trial) > _LEAST_GAIN:
            best = trial
            free = np.append(free, further)
    problem = replace(problem, weight=weight)
    z, _ = problem.solve(best[0], free, 40)
    report(STAGES)
    return _fit_at(problem, tuple(logs), z, np.sort(free))


def _gain(problem: ServoProblem, before: tuple[Array, float], after: tuple[Array, float]) -> float:
    """N ln(S₀/S₁), with the number of independent rows as N."""
    independent = independent_rows(problem.without_priors().residual(before[0]))
    return independent * float(np.log(max(before[1], 1e-30) / max(after[1], 1e-30)))


def _fit_at(
    problem: ServoProblem, logs: tuple[ServoLog, ...], z: Array, free: IntArray
) -> ServoFit:
    """The fit with intervals at estimates z."""
    half = np.full(len(NAMES), np.nan)
    half[free] = half_widths(problem, z, free) * problem.scale[free]
    is_estimated = np.zeros(len(NAMES), dtype=np.bool_)
    is_estimated[free] = True
    values = problem.expand(z.copy())
    tied = {}
    limit = INDEX["torque_limit"]
    if problem.limit_per_gain is not None:
        tied["torque_limit"] = "position_gain and the logged PWM"
        half[limit] = half[INDEX["position_gain"]] * problem.limit_per_gain
    elif not is_estimated[limit]:
        values[limit] = np.inf
    if not problem.split_damping:
        tied["viscous_friction"] = f"{100 * VISCOUS_SHARE:g} % of the damping, assumed"
        half[INDEX["motor_damping"]] *= 1.0 - VISCOUS_SHARE
    r = problem.without_priors().residual(z, thinned=False)
    return ServoFit(
        logs=logs,
        values=values,
        half_width=half,
        is_estimated=is_estimated,
        tied=tied,
        rms=float(np.sqrt(np.mean(r**2))),
    )
