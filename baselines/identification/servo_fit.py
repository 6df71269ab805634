"""Parameters of a servo from logs in time: a start by regression, then the motion replayed.

The fit replays every log from its first row, and takes the parameters with the least squared
deviation of the angles (output error method, [Ljung1999]). Intervals are cluster-robust: residuals
of a replay hang together for tenths of a second, so that a block of the log counts as one cluster.

[Ljung1999] L. Ljung, "System Identification: Theory for the User", 2nd ed., section 7.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import t as student

from baselines.identification.servo_log import ServoLog
from baselines.identification.servo_problem import (
    AT,
    FIRST_ROWS,
    PRIORS,
    STEP,
    VISCOUS_SHARE,
    ServoProblem,
    prepare,
    regress,
)
from baselines.identification.servo_replay import NAMES, STEP_S
from elastic_env.core.signals import Array, BoolArray, IntArray

STARTS = 3
"""Starts of a fit."""
STAGES = STARTS + 1
"""Stages of a fit, for its progress."""
_PARTS_S = (0.3, 1.0)
_BETTER = 10.0  # fall of the criterion at which an effect is taken
_BLOCKS_S = (0.25, 0.5, 1.0)
_LEAST_FREEDOM = 4
_LEAST_WEIGHT = 1e-9
_SINGULAR = 1e-10
"""Share of the largest eigenvalue below which a direction counts as free."""
_UNTOLD_PART = 1e-3
"""Part of a parameter in a free direction from which on it is not told."""
_LEAST_INFLUENCE = 1e-9
"""Influence over the largest one, below which a parameter has none."""


@dataclass(frozen=True)
class ServoFit:
    """A fit.

    Attributes:
        logs: What was fitted.
        values: Estimates, as in `NAMES`, (13,).
        half_width: Of their 95 % intervals, nan for those that were not sought, (13,).
        sought: Those that the fit moved, (13,).
        tied: Names that follow from others, with the reason.
        rms: Of the replay at the fitted logs [rad].
    """

    logs: tuple[ServoLog, ...]
    values: Array
    half_width: Array
    sought: BoolArray
    tied: dict[str, str]
    rms: float

    def value(self, name: str) -> float:
        """An estimate by its name."""
        return float(self.values[AT[name]])

    def half(self, name: str) -> float:
        """Half of its interval; nan where it was not sought."""
        return float(self.half_width[AT[name]])

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
        priors: Whether the usual loss of gears and the usual no-load speed count.

    Raises:
        ElasticError: No parameters replay the logs better than a joint that stands still.
    """
    say = progress or (lambda done: None)  # noqa: ARG005
    problem = ServoProblem.of(logs)
    z = regress(problem)
    free = problem.always_sought
    rng = np.random.default_rng(seed)
    found = []
    coarse = problem.with_steps()
    for count in range(starts):
        start = z if count == 0 else z * np.exp(0.7 * rng.normal(size=len(z)))
        for seconds in _PARTS_S:
            start, _ = problem.in_parts(seconds).solve(start, free, 12)
        found.append(coarse.solve(start, free, 25))
        say(count + 1)
    best = min(found, key=lambda pair: pair[1])
    weight = _deviation(coarse, best[0]) if priors else _LEAST_WEIGHT
    coarse = replace(coarse, weight=weight)
    found = [coarse.solve(z, free, 20) for z, _ in found]
    best = min(found, key=lambda pair: pair[1])
    for effect in problem.sought_where_shown(best[0]):
        start = best[0].copy()
        more = np.array([AT[name] for name in effect])
        start[more] = list(effect.values())
        trial = coarse.solve(start, np.append(free, more), 25)
        if _gain(coarse, best, trial) > _BETTER:
            best = trial
            free = np.append(free, more)
    problem = replace(problem, weight=weight)
    z, _ = problem.solve(best[0], free, 40)
    say(STAGES)
    return _described(problem, tuple(logs), z, np.sort(free))


def _independent(r: Array) -> float:
    """Number of independent rows, by the correlation of neighbours."""
    r = r - r.mean()
    alike = np.clip(float(r[1:] @ r[:-1]) / max(float(r @ r), 1e-30), 0.0, 0.999)
    return len(r) * (1.0 - alike) / (1.0 + alike)


def _deviation(problem: ServoProblem, z: Array) -> float:
    """Standard deviation of a residual that stands for all that hang together with it [rad]."""
    r = problem.without_priors().residual(z)
    blocks = _blocks(problem.logs, _BLOCKS_S[1])
    independent = max(_independent(r), float(blocks.max()) + 1.0 - PRIORS)
    return max(float(np.sqrt(np.mean(r**2) * len(r) / independent)), _LEAST_WEIGHT)


def _gain(problem: ServoProblem, before: tuple[Array, float], after: tuple[Array, float]) -> float:
    """N ln(S₀/S₁), with the number of independent rows in place of all."""
    independent = _independent(problem.without_priors().residual(before[0]))
    return independent * float(np.log(max(before[1], 1e-30) / max(after[1], 1e-30)))


def _described(
    problem: ServoProblem, logs: tuple[ServoLog, ...], z: Array, free: IntArray
) -> ServoFit:
    """Estimates with their intervals."""
    half = np.full(len(NAMES), np.nan)
    half[free] = _half_widths(problem, z, free) * problem.scale[free]
    sought = np.zeros(len(NAMES), dtype=np.bool_)
    sought[free] = True
    values = problem.expand(z.copy())
    tied = {}
    if problem.duty is not None:
        tied["torque_limit"] = "position_gain and the logged PWM"
        half[AT["torque_limit"]] = half[AT["position_gain"]] * problem.duty
    elif not sought[AT["torque_limit"]]:
        values[AT["torque_limit"]] = np.inf
    if not problem.split_damping:
        tied["viscous_friction"] = f"{100 * VISCOUS_SHARE:g} % of the damping, assumed"
        half[AT["motor_damping"]] *= 1.0 - VISCOUS_SHARE
    r = problem.without_priors().residual(z, thinned=False)
    return ServoFit(
        logs=logs,
        values=values,
        half_width=half,
        sought=sought,
        tied=tied,
        rms=float(np.sqrt(np.mean(r**2))),
    )


def _half_widths(problem: ServoProblem, z: Array, free: IntArray) -> Array:
    """Half-widths of 95 % intervals in the scales of the parameters, (k,).

    They hold the noise, the angle at the first row, which noise shifts too, and the error of the
    steps. That falls with their length, so that it is twice the change by halved steps.
    """
    r = problem.residual(z, thinned=False)
    logs = problem.logs
    J = _gradient(problem, z, free, r)
    finer = problem.with_steps(0.5 * STEP_S)
    by_steps = finer.residual(z, thinned=False) - r
    by_starts = []
    for i, one in enumerate(problem.replays):
        noise = float(np.std(np.diff(one.log.position, 2))) / np.sqrt(6.0)
        moved = replace(one, start=(one.start[0] + noise / np.sqrt(FIRST_ROWS), one.start[1]))
        others = (*problem.replays[:i], moved, *problem.replays[i + 1 :])
        by_starts.append(replace(problem, replays=others).residual(z, thinned=False) - r)
    at_bound = (z[free] - problem.lower[free] < 1e-3) | (problem.upper[free] - z[free] < 1e-3)
    inner = np.flatnonzero(~at_bound)
    r[len(r) - PRIORS :] = problem.weight  # what a prior is expected to be off
    half = np.zeros(len(free))
    for own in [inner, *(np.append(inner, j) for j in np.flatnonzero(at_bound))]:
        columns = J[:, own]
        blocks = [_blocks(logs, seconds) for seconds in _BLOCKS_S]
        variance = np.max([_variance(columns, r, block) for block in blocks], axis=0)
        moved = np.linalg.lstsq(columns, np.stack([by_steps, *by_starts], axis=-1), rcond=1e-8)[0]
        variance += np.sum(moved[:, 1:] ** 2, axis=1)
        clusters = len(np.unique(_blocks(logs, _BLOCKS_S[-1])))
        quantile = float(student.ppf(0.975, max(clusters - len(free), _LEAST_FREEDOM)))
        width = quantile * np.sqrt(variance) + 2.0 * np.abs(moved[:, 0])
        new = own if own is inner else own[-1:]
        half[new] = width if own is inner else width[-1:]
    return half


def _gradient(problem: ServoProblem, z: Array, free: IntArray, r: Array) -> Array:
    """Derivatives of all residuals, central where the bounds allow it, (N, k)."""
    columns = []
    for i in free:
        step = np.zeros_like(z)
        step[i] = STEP
        ahead = problem.residual(z + step, thinned=False)
        if z[i] - STEP > problem.lower[i]:
            behind = problem.residual(z - step, thinned=False)
            columns.append((ahead - behind) / (2.0 * STEP))
        else:
            columns.append((ahead - r) / STEP)
    return np.stack(columns, axis=-1)


def _blocks(logs: Sequence[ServoLog], seconds: float) -> IntArray:
    """Number of the block of each row over all logs, and one for each prior, (N,)."""
    numbers = []
    first = 0
    for log in logs:
        own = ((log.time - log.time[0]) / seconds).astype(np.int64)
        numbers.append(first + own)
        first += int(own[-1]) + 1
    return np.concatenate([*numbers, first + np.arange(PRIORS)])


def _variance(J: Array, r: Array, block: IntArray) -> Array:
    """Variances of estimates by clusters, not below those for independent rows, (p,).

    Infinite for a parameter without influence, alone or against the others.
    """
    norm = np.linalg.norm(J, axis=0)
    size = np.maximum(norm, 1e-12)
    information = (J / size).T @ (J / size)
    inverse = np.linalg.pinv(information, rcond=_SINGULAR)
    spectrum, directions = np.linalg.eigh(information)
    free = directions[:, spectrum <= _SINGULAR * spectrum[-1]]
    is_told = np.abs(free).max(axis=1, initial=0.0) < _UNTOLD_PART
    is_told &= norm > _LEAST_INFLUENCE * norm.max()
    count = int(block.max()) + 1
    score = np.zeros((count, J.shape[1]))
    np.add.at(score, block, (J / size) * r[:, None])
    p = J.shape[1]
    robust = inverse @ (score.T @ score) @ inverse * (count / max(count - p, 1))
    plain = inverse * float(r @ r) / max(len(r) - p, 1)
    return np.where(is_told, np.maximum(np.diag(robust), np.diag(plain)) / size**2, np.inf)
