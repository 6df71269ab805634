"""Parameters of a servo from logs in time: a start by regression, then the motion replayed.

The start solves the equation of motion, which is linear in the parameters where the joint moves.
The fit replays every log from its first row, and takes the parameters with the least squared
deviation of the angles (output error method, [Ljung1999]). Intervals are cluster-robust: residuals
of a replay hang together for tenths of a second, so that a block of the log counts as one cluster.

[Bock1983] H. G. Bock, "Recent Advances in Parameter Identification Techniques for O.D.E.".
[Ljung1999] L. Ljung, "System Identification: Theory for the User", 2nd ed., section 7.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares, lsq_linear
from scipy.stats import t as student

from baselines.identification.servo_log import ServoLog
from baselines.identification.servo_replay import NAMES, STEP_S, Replay
from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array, BoolArray, IntArray

VISCOUS_SHARE = 0.2
"""Viscous friction over all damping where the torque is never off, as published models of small
servos have it: 22 % for the XL330 [Rhoban2025]."""
USUAL_LOSS = (0.25, 0.15)
"""Mean and standard deviation of c before a log is seen: gear trains pass 60 to 90 %."""
_NO_LOAD_SPEED = 8.0
_NO_LOAD_SPREAD = 0.5
"""No-load speed [rad/s] and the deviation of its logarithm: data sheets have 4 to 16 rad/s."""
SLOW = (0.02, 0.5)
"""Speeds of slow motion; below it the joint stands [rad/s]."""
_MOVING = 0.05
_BLOCKS_S = (0.25, 0.5, 1.0)
_FIRST = 5
_LEAST_FREEDOM = 4
_MOST_ROWS = 600
_STEP = 1e-3
STARTS = 3
"""Starts of a fit."""
_PARTS_S = (0.3, 1.0)
_COARSE_S = 3.4e-3
_BETTER = 10.0  # fall of the criterion at which two more parameters are taken
_AT = {name: i for i, name in enumerate(NAMES)}
_DELAY_S = 0.06
_SATURATED = 0.6


@dataclass(frozen=True)
class ServoFit:
    """A fit.

    Attributes:
        logs: What was fitted.
        values: Estimates, as in `NAMES`, (12,).
        half_width: Of their 95 % intervals, nan for those that were not sought, (12,).
        sought: Those that the fit moved, (12,).
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
        return float(self.values[_AT[name]])

    def half(self, name: str) -> float:
        """Half of its interval; nan where it was not sought."""
        return float(self.half_width[_AT[name]])

    def replay(self, log: ServoLog) -> Array:
        """Angles at the rows of a log, played from its first row, (N,) [rad]."""
        return prepare(log).play(self.values)


@dataclass(frozen=True)
class _Problem:
    """Replays and what is sought of them, in units in which all parameters are about 1."""

    replays: tuple[Replay, ...]
    scale: Array
    lower: Array
    upper: Array
    duty: float | None
    split_damping: bool
    weight: float = 0.0

    def expand(self, z: Array) -> Array:
        """Parameters of the replay."""
        p = z * self.scale
        if self.duty is not None:
            p[_AT["torque_limit"]] = p[_AT["position_gain"]] * self.duty
        if not self.split_damping:
            damping = p[_AT["motor_damping"]]
            p[_AT["motor_damping"]] = (1.0 - VISCOUS_SHARE) * damping
            p[_AT["viscous_friction"]] = VISCOUS_SHARE * damping
        return p

    def residual(self, z: Array, thinned: bool = True) -> Array:
        """Deviations at some or all rows [rad]."""
        p = self.expand(z)
        parts = []
        for one in self.replays:
            every = max(1, len(one.log) // _MOST_ROWS) if thinned else 1
            parts.append((one.play(p) - one.log.position)[::every])
        if self.weight > 0.0:
            parts.append(self.weight * self.prior(p))
        return np.nan_to_num(np.concatenate(parts), nan=10.0, posinf=10.0, neginf=-10.0)

    def prior(self, p: Array) -> Array:
        """Deviations from what servos usually have, in standard deviations, (2,)."""
        volts = max(one.log.supply for one in self.replays)
        limit = p[_AT["torque_limit"]]
        damping = p[_AT["motor_damping"]]
        speed = _NO_LOAD_SPEED
        if 0.0 < limit < 1e3 * self.scale[_AT["torque_limit"]] and damping > 0.0:
            speed = np.clip(limit * volts / damping, 0.1, 1e3)
        loss = (p[_AT["load_friction"]] - USUAL_LOSS[0]) / USUAL_LOSS[1]
        return np.array([loss, np.log(speed / _NO_LOAD_SPEED) / _NO_LOAD_SPREAD])

    def solve(self, z: Array, free: IntArray, evaluations: int) -> tuple[Array, float]:
        """Least squares over some of the parameters, from a start."""
        low = self.lower[free]
        high = self.upper[free]

        def full(part: Array) -> Array:
            whole = z.copy()
            whole[free] = part
            return whole

        def jacobian(part: Array) -> Array:
            base = self.residual(full(part))
            return np.stack(
                [
                    (self.residual(full(part + _STEP * unit)) - base) / _STEP
                    for unit in np.eye(len(part))
                ],
                axis=-1,
            )

        start = np.clip(z[free], low + 1e-6, high - 1e-6)
        found = least_squares(
            lambda part: self.residual(full(part)),
            start,
            jac=jacobian,  # pyright: ignore[reportArgumentType]
            bounds=(low, high),
            max_nfev=evaluations,
            x_scale="jac",
            xtol=1e-6,
            ftol=1e-7,
        )
        return full(found.x), 2.0 * float(found.cost)


def prepare(log: ServoLog, longest_s: float = STEP_S) -> Replay:
    """A log ready for replays; its first speed from its first rows."""
    speed, _ = log.derivatives()
    if np.abs(speed[:_FIRST]).max() > _MOVING:
        return Replay.of(log, float(speed[0]), longest_s=longest_s)
    return Replay.of(log, 0.0, float(np.mean(log.position[:_FIRST])), longest_s)


def _cut(logs: Sequence[ServoLog], seconds: float) -> list[Replay]:
    """Replays of short parts, each from the measured angle and speed at its first row.

    A short replay goes wrong little with wrong parameters, so that its least squares have hardly
    any local minima [Bock1983]; a long one then starts close to its own.
    """
    cut = []
    for log in logs:
        speed, _ = log.derivatives()
        count = max(1, round((log.time[-1] - log.time[0]) / seconds))
        edges = np.searchsorted(log.time, np.linspace(log.time[0], log.time[-1], count + 1))
        for first, last in itertools.pairwise(edges):
            if last - first >= _FEWEST_IN_PART:
                own = log.part(slice(first, last + 1))
                cut.append(Replay.of(own, float(speed[first]), longest_s=_COARSE_S))
    return cut


def duty_per_torque_gain(logs: Sequence[ServoLog]) -> float | None:
    """T/k, limit of the torque over the position gain, from logged PWM [rad]; None if unknown.

    The duty is proportional to g (goal − position) until it stays at its limit.
    """
    rows, duty, highest = [], [], 0.0
    at_limit = 0
    for log in logs:
        if log.pwm is None:
            continue
        highest = max(highest, float(np.abs(log.pwm).max()))
        at_limit += int(np.sum(np.abs(log.pwm) > 0.999 * highest))
    if highest == 0.0 or at_limit < _FEWEST_AT_LIMIT:
        return None
    for log in logs:
        if log.pwm is not None:
            inner = log.enabled & (np.abs(log.pwm) < 0.98 * highest)
            rows.append(log.gain * (log.goal - log.position)[inner])
            duty.append(log.pwm[inner])
    error, own = np.concatenate(rows), np.concatenate(duty)
    slope = float(error @ own) / float(error @ error)
    correlated = np.corrcoef(error, own)[0, 1] > _PROPORTIONAL
    return highest / slope if slope > 0.0 and correlated else None


_PRIORS = 2
_LEAST_WEIGHT = 1e-9
_FEWEST_IN_PART = 5
_FEWEST_AT_LIMIT = 20
_PROPORTIONAL = 0.98


def fit_servo(
    logs: Sequence[ServoLog],
    progress: Callable[[int], None] | None = None,
    seed: int = 0,
    starts: int = STARTS,
) -> ServoFit:
    """Estimate the parameters of a servo.

    Args:
        logs: Logs of one servo under known loads.
        progress: Called with the number of finished stages, of `STAGES`.
        seed: Seed of the further starts.
        starts: Number of starts, against local minima.

    Raises:
        ElasticError: No parameters replay the logs better than a joint that stands still.
    """
    say = progress or (lambda done: None)  # noqa: ARG005
    problem = _problem(logs)
    z = _start(problem, logs)
    base = _base(problem)
    rng = np.random.default_rng(seed)
    found = []
    coarse = replace(problem, replays=tuple(prepare(log, _COARSE_S) for log in logs))
    for count in range(starts):
        start = z if count == 0 else z * np.exp(0.7 * rng.normal(size=len(z)))
        for seconds in _PARTS_S:
            parts = replace(problem, replays=tuple(_cut(logs, seconds)))
            start, _ = parts.solve(start, base, 12)
        found.append(coarse.solve(start, base, 25))
        say(count + 1)
    best = min(found, key=lambda pair: pair[1])
    problem = replace(problem, weight=_deviation(coarse, best[0]))
    coarse = replace(coarse, weight=problem.weight)
    found = [coarse.solve(z, base, 20) for z, _ in found]
    best = min(found, key=lambda pair: pair[1])
    free = base
    for further, first in _further(problem):
        start = best[0].copy()
        more = np.array([_AT[name] for name in further])
        start[more] = first
        if "torque_limit" in further:
            start[more] = _SATURATED * largest_pull(problem, best[0])
        trial = coarse.solve(start, np.append(free, more), 25)
        if _gain(coarse, best, trial) > _BETTER:
            best = trial
            free = np.append(free, more)
    z, _ = problem.solve(best[0], free, 40)
    say(STAGES)
    return _described(problem, tuple(logs), z, np.sort(free))


STAGES = STARTS + 1
"""Stages of a fit, for its progress."""


_LEAST_TORQUE = 1e-9


def _problem(logs: Sequence[ServoLog]) -> _Problem:
    torque = max(float(np.abs(log.external_torque(log.position)).max()) for log in logs)
    if torque < _LEAST_TORQUE:
        raise ElasticError(
            "nothing loads the joint, so that no torque is known; hang a known mass on it, turn"
            " its axis out of the vertical, or log a column tau_known [N·m]"
        )
    highest = max(log.gain for log in logs)
    inertia = max(log.load.inertia or torque / 100.0 for log in logs)
    spans = [np.ptp(log.goal) for log in logs if log.enabled.any()]
    span = max(spans, default=1.0)
    gain = torque / (0.3 * span * highest)
    scale = np.array(
        [
            gain,
            torque,
            0.1 * torque,
            0.5 * inertia,
            inertia,
            0.1 * torque,
            0.3,
            0.02 * torque,
            0.1 * torque,
            0.3,
            0.02,
            0.01,
        ]
    )
    lower = np.zeros(len(NAMES))
    upper = np.full(len(NAMES), 1e3)
    upper[_AT["load_friction"]] = 0.9 / 0.3
    lower[_AT["stribeck_speed"]], upper[_AT["stribeck_speed"]] = 0.05, 10.0
    lower[_AT["zero_offset"]], upper[_AT["zero_offset"]] = -10.0, 10.0
    upper[_AT["delay"]] = _DELAY_S / 0.01
    upper[_AT["torque_limit"]] = 1e9
    off = any((~log.enabled).sum() > 0.1 * len(log) for log in logs)
    return _Problem(
        replays=tuple(prepare(log) for log in logs),
        scale=scale,
        lower=lower,
        upper=upper,
        duty=duty_per_torque_gain(logs),
        split_damping=off,
    )


def _base(problem: _Problem) -> IntArray:
    """Parameters that are always sought."""
    logs = [one.log for one in problem.replays]
    names = ["rotor_inertia", "coulomb_friction", "load_friction"]
    if any(log.load.inertia is None for log in logs):
        names = ["link_inertia", *names[1:]]
    if any(log.enabled.any() for log in logs):
        names += ["position_gain", "motor_damping", "delay"]
    if problem.split_damping:
        names.append("viscous_friction")
    if any(log.load.torque > 0.0 for log in logs):
        names.append("zero_offset")
    return np.sort([_AT[name] for name in names])


def _further(problem: _Problem) -> list[tuple[tuple[str, ...], list[float]]]:
    """Effects that are sought where they show, each with a start."""
    further: list[tuple[tuple[str, ...], list[float]]] = []
    has_torque = any(one.log.enabled.any() for one in problem.replays)
    if problem.duty is None and has_torque:
        further.append((("torque_limit",), [0.0]))
    further.append((("static_friction", "stribeck_speed"), [0.5, 1.0]))
    return further


def largest_pull(problem: _Problem, z: Array) -> float:
    """Largest torque that the servo would give without a limit, in the unit of the limit."""
    p = problem.expand(z)
    pulls = [
        p[0]
        * one.log.gain
        * one.log.supply
        * np.abs(one.log.goal - one.log.position)[one.log.enabled]
        for one in problem.replays
    ]
    return float(np.concatenate(pulls).max()) / problem.scale[_AT["torque_limit"]]


def _start(problem: _Problem, logs: Sequence[ServoLog]) -> Array:
    """Parameters that solve the equation of motion where the joint moves, in their scales.

    k g e − k c g e s σ − b w − B a − F s − d w − m g l o cos q = I a − τ(q), linear in k, k c, b,
    B, F, d and o, for the error e, the side s of motion and the side σ of the motor's torque.
    """
    rows = []
    right = []
    for log in logs:
        w, a = log.derivatives()
        error = _drive(log, problem.duty)
        moving = np.abs(w) > _MOVING
        side = np.sign(w)
        lever = log.load.torque * np.cos(log.position - log.load.rest)
        inertia = log.load.inertia
        columns = np.stack(
            [
                error,
                -error * side * np.sign(error),
                -w * log.enabled,
                -a,
                -side,
                -w * ~log.enabled,
                lever,
            ],
            axis=-1,
        )
        rows.append(columns[moving])
        right.append(((inertia or 0.0) * a - log.external_torque(log.position))[moving])
    matrix, target = np.concatenate(rows), np.concatenate(right)
    if len(target) < 2 * matrix.shape[1]:
        raise ElasticError(
            f"the joint moves in {len(target)} rows only, {2 * matrix.shape[1]} are needed: it"
            " sticks or the goal hardly moves; command a motion of some tenths of a radian"
        )
    size = np.maximum(np.abs(matrix).max(axis=0), 1e-12)
    low = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -np.inf])
    solved = lsq_linear(matrix / size, target, (low, np.full(7, np.inf))).x / size
    k, kc, b, B, F, d, offset = solved
    z = np.zeros(len(NAMES))
    z[_AT["position_gain"]] = k
    z[_AT["torque_limit"]] = np.inf
    z[_AT["motor_damping"]] = b
    z[_AT["rotor_inertia"]] = z[_AT["link_inertia"]] = B
    z[_AT["coulomb_friction"]] = F
    z[_AT["load_friction"]] = np.clip(kc / k if k > 0.0 else 0.0, 0.0, 0.7)
    z[_AT["viscous_friction"]] = d
    z[_AT["zero_offset"]] = np.clip(offset, -0.1, 0.1)
    z[_AT["stribeck_speed"]] = 0.3
    z /= problem.scale
    z[_AT["torque_limit"]] = 1e6
    if not any(log.load.inertia is None for log in logs):
        z[_AT["link_inertia"]] = 0.0
    else:
        z[_AT["rotor_inertia"]] = 0.0
    least = np.zeros(len(NAMES))
    base = _base(problem)
    least[base] = 0.05
    least[_AT["zero_offset"]] = -np.inf
    return np.maximum(z, least)


def _drive(log: ServoLog, duty: float | None) -> Array:
    """Torque of the motor at standstill over k, as `Replay` has it, (N,) [V·rad].

    The register's error is limited before the supply's voltage scales it: the limit is T/k.
    """
    error = log.gain * (log.goal - log.position)
    if duty is not None:
        error = np.clip(error, -duty, duty)
    return error * log.supply * log.enabled


def _independent(r: Array) -> float:
    """Number of independent rows, by the correlation of neighbours."""
    r = r - r.mean()
    alike = np.clip(float(r[1:] @ r[:-1]) / max(float(r @ r), 1e-30), 0.0, 0.999)
    return len(r) * (1.0 - alike) / (1.0 + alike)


def _deviation(problem: _Problem, z: Array) -> float:
    """Standard deviation of a residual that stands for all that hang together with it [rad]."""
    r = replace(problem, weight=0.0).residual(z)
    blocks = _blocks([one.log for one in problem.replays], _BLOCKS_S[1])
    independent = max(_independent(r), float(blocks.max()) + 1.0 - _PRIORS)
    return max(float(np.sqrt(np.mean(r**2) * len(r) / independent)), _LEAST_WEIGHT)


def _gain(problem: _Problem, before: tuple[Array, float], after: tuple[Array, float]) -> float:
    """N ln(S₀/S₁), with the number of independent rows in place of all."""
    independent = _independent(replace(problem, weight=0.0).residual(before[0]))
    return independent * float(np.log(max(before[1], 1e-30) / max(after[1], 1e-30)))


def _described(problem: _Problem, logs: tuple[ServoLog, ...], z: Array, free: IntArray) -> ServoFit:
    """Estimates with their intervals."""
    half = np.full(len(NAMES), np.nan)
    half[free] = _half_widths(problem, z, free) * problem.scale[free]
    sought = np.zeros(len(NAMES), dtype=np.bool_)
    sought[free] = True
    values = problem.expand(z.copy())
    tied = {}
    if problem.duty is not None:
        tied["torque_limit"] = "position_gain and the logged PWM"
        half[_AT["torque_limit"]] = half[_AT["position_gain"]] * problem.duty
    elif not sought[_AT["torque_limit"]]:
        values[_AT["torque_limit"]] = np.inf
    if not problem.split_damping:
        tied["viscous_friction"] = f"{100 * VISCOUS_SHARE:g} % of the damping, assumed"
        half[_AT["motor_damping"]] *= 1.0 - VISCOUS_SHARE
    r = replace(problem, weight=0.0).residual(z, thinned=False)
    return ServoFit(
        logs=logs,
        values=values,
        half_width=half,
        sought=sought,
        tied=tied,
        rms=float(np.sqrt(np.mean(r**2))),
    )


def _half_widths(problem: _Problem, z: Array, free: IntArray) -> Array:
    """Half-widths of 95 % intervals in the scales of the parameters, (k,).

    They hold the noise, the angle at the first row, which noise shifts too, and the error of the
    steps. That falls with their length, so that it is twice the change by halved steps.
    """
    r = problem.residual(z, thinned=False)
    logs = [one.log for one in problem.replays]
    J = _gradient(problem, z, free, r)
    finer = replace(problem, replays=tuple(prepare(log, 0.5 * STEP_S) for log in logs))
    by_steps = finer.residual(z, thinned=False) - r
    by_starts = []
    for i, one in enumerate(problem.replays):
        noise = float(np.std(np.diff(one.log.position, 2))) / np.sqrt(6.0)
        moved = replace(one, start=(one.start[0] + noise / np.sqrt(_FIRST), one.start[1]))
        others = (*problem.replays[:i], moved, *problem.replays[i + 1 :])
        by_starts.append(replace(problem, replays=others).residual(z, thinned=False) - r)
    at_bound = (z[free] - problem.lower[free] < 1e-3) | (problem.upper[free] - z[free] < 1e-3)
    inner = np.flatnonzero(~at_bound)
    r[len(r) - _PRIORS :] = problem.weight  # what a prior is expected to be off
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


def _gradient(problem: _Problem, z: Array, free: IntArray, r: Array) -> Array:
    """Derivatives of all residuals, central where the bounds allow it, (N, k)."""
    columns = []
    for i in free:
        step = np.zeros_like(z)
        step[i] = _STEP
        ahead = problem.residual(z + step, thinned=False)
        if z[i] - _STEP > problem.lower[i]:
            behind = problem.residual(z - step, thinned=False)
            columns.append((ahead - behind) / (2.0 * _STEP))
        else:
            columns.append((ahead - r) / _STEP)
    return np.stack(columns, axis=-1)


def _blocks(logs: Sequence[ServoLog], seconds: float) -> IntArray:
    """Number of the block of each row over all logs, and one for each prior, (N,)."""
    numbers = []
    first = 0
    for log in logs:
        own = ((log.time - log.time[0]) / seconds).astype(np.int64)
        numbers.append(first + own)
        first += int(own[-1]) + 1
    return np.concatenate([*numbers, first + np.arange(_PRIORS)])


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


_SINGULAR = 1e-10
"""Share of the largest eigenvalue below which a direction counts as free."""
_UNTOLD_PART = 1e-3
"""Part of a parameter in a free direction from which on it is not told."""
_LEAST_INFLUENCE = 1e-9
"""Influence over the largest one, below which a parameter has none."""


def slow_rows(log: ServoLog) -> BoolArray:
    """Rows in which the torque is on and the joint moves slowly and steadily, (N,)."""
    w, a = log.derivatives()
    inertia = log.load.inertia or 0.0
    weight = max(float(np.abs(log.external_torque(log.position)).max()), 1e-12)
    steady = np.abs(inertia * a) < 0.05 * weight
    return log.enabled & (np.abs(w) > SLOW[0]) & (np.abs(w) < SLOW[1]) & steady
