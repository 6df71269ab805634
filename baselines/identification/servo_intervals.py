"""Intervals of a servo's parameters by cluster-robust covariance.

Residuals of a replay are correlated over tenths of a second, so that a block of the log counts as
one cluster.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import t as student

from baselines.identification.servo_log import ServoLog
from baselines.identification.servo_problem import FIRST_ROWS, PRIORS, STEP, ServoProblem
from baselines.identification.servo_replay import STEP_S
from elastic_env.core.signals import Array, IntArray

LEAST_WEIGHT = 1e-9
"""Weight of priors that have no visible effect."""
_BLOCKS_S = (0.25, 0.5, 1.0)
"""Lengths of the blocks; the largest variance counts."""
_LEAST_FREEDOM = 4
_BOUND_MARGIN = 1e-3
"""Distance from a bound up to which a parameter is at the bound, in its scale."""
_SINGULAR = 1e-10
"""Share of the largest eigenvalue below which a direction counts as free."""
_LARGEST_FREE_PART = 1e-3
"""Part of a parameter in a free direction from which on the logs do not determine it."""
_LEAST_INFLUENCE = 1e-9
"""Influence over the largest one, below which a parameter has none."""


def half_widths(problem: ServoProblem, z: Array, free: IntArray) -> Array:
    """Half-widths of 95 % intervals in the scales of the parameters, (k,).

    They include the noise, the noise of the angle at the first row, and the error of the steps.
    The latter falls with the length of the steps, so that it is twice the change by halved steps.

    Args:
        problem: Replays of the whole logs.
        z: Estimates, in their scales, (13,).
        free: Indices of the estimated parameters, (k,).
    """
    r = problem.residual(z, thinned=False)
    J = _gradient(problem, z, free, r)
    by_steps = problem.with_steps(0.5 * STEP_S).residual(z, thinned=False) - r
    changes = np.stack([by_steps, *_changes_by_starts(problem, z, r)], axis=-1)
    r[len(r) - PRIORS :] = problem.weight  # expected deviation of a prior
    margin = np.minimum(z[free] - problem.lower[free], problem.upper[free] - z[free])
    at_bound = margin < _BOUND_MARGIN
    inner = np.flatnonzero(~at_bound)
    widths = np.zeros(len(free))
    widths[inner] = _widths(problem, J[:, inner], r, changes, len(free))
    for j in np.flatnonzero(at_bound):
        columns = np.append(inner, j)
        widths[j] = _widths(problem, J[:, columns], r, changes, len(free))[-1]
    return widths


def _widths(problem: ServoProblem, J: Array, r: Array, changes: Array, k: int) -> Array:
    """Half-widths of some parameters with derivatives J, (N, p) to (p,).

    Args:
        problem: Replays.
        J: Derivatives of the residuals, (N, p).
        r: Residuals, (N,).
        changes: Changes of the residuals by steps, then by each start, (N, 1 + starts).
        k: Number of all estimated parameters.
    """
    blocks = [_blocks(problem.logs, seconds) for seconds in _BLOCKS_S]
    variance = np.max([cluster_variance(J, r, block) for block in blocks], axis=0)
    shifts = np.linalg.lstsq(J, changes, rcond=1e-8)[0]
    variance += np.sum(shifts[:, 1:] ** 2, axis=1)
    clusters = len(np.unique(blocks[-1]))
    quantile = float(student.ppf(0.975, max(clusters - k, _LEAST_FREEDOM)))
    return quantile * np.sqrt(variance) + 2.0 * np.abs(shifts[:, 0])


def _changes_by_starts(problem: ServoProblem, z: Array, r: Array) -> list[Array]:
    """Change of the residuals r by a standard deviation of each replay's first angle, (N,) each."""
    changes = []
    for i, replay in enumerate(problem.replays):
        noise = float(np.std(np.diff(replay.log.position, 2))) / np.sqrt(6.0)
        angle, speed = replay.start
        shifted = replace(replay, start=(angle + noise / np.sqrt(FIRST_ROWS), speed))
        replays = (*problem.replays[:i], shifted, *problem.replays[i + 1 :])
        changes.append(replace(problem, replays=replays).residual(z, thinned=False) - r)
    return changes


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


def residual_deviation(problem: ServoProblem, z: Array) -> float:
    """Standard deviation that a residual has if it represents all correlated with it [rad]."""
    r = problem.without_priors().residual(z)
    blocks = _blocks(problem.logs, _BLOCKS_S[1])
    independent = max(independent_rows(r), float(blocks.max()) + 1.0 - PRIORS)
    return max(float(np.sqrt(np.mean(r**2) * len(r) / independent)), LEAST_WEIGHT)


def independent_rows(r: Array) -> float:
    """Number of independent rows, by the correlation of neighbours."""
    r = r - r.mean()
    correlation = np.clip(float(r[1:] @ r[:-1]) / max(float(r @ r), 1e-30), 0.0, 0.999)
    return len(r) * (1.0 - correlation) / (1.0 + correlation)


def _blocks(logs: Sequence[ServoLog], seconds: float) -> IntArray:
    """Number of the block of each row over all logs, and one block for each prior, (N,)."""
    numbers = []
    first = 0
    for log in logs:
        blocks = ((log.time - log.time[0]) / seconds).astype(np.int64)
        numbers.append(first + blocks)
        first += int(blocks[-1]) + 1
    return np.concatenate([*numbers, first + np.arange(PRIORS)])


def cluster_variance(J: Array, r: Array, block: IntArray) -> Array:
    """Variances of estimates by clusters, not below those for independent rows, (p,).

    Infinite for a parameter without influence, alone or against the others.

    Args:
        J: Derivatives of the residuals, (N, p).
        r: Residuals, (N,).
        block: Number of the cluster of each row, (N,).
    """
    norm = np.linalg.norm(J, axis=0)
    size = np.maximum(norm, 1e-12)
    information = (J / size).T @ (J / size)
    inverse = np.linalg.pinv(information, rcond=_SINGULAR)
    spectrum, directions = np.linalg.eigh(information)
    free = directions[:, spectrum <= _SINGULAR * spectrum[-1]]
    is_determined = np.abs(free).max(axis=1, initial=0.0) < _LARGEST_FREE_PART
    is_determined &= norm > _LEAST_INFLUENCE * norm.max()
    count = int(block.max()) + 1
    score = np.zeros((count, J.shape[1]))
    np.add.at(score, block, (J / size) * r[:, None])
    p = J.shape[1]
    robust = inverse @ (score.T @ score) @ inverse * (count / max(count - p, 1))
    plain = inverse * float(r @ r) / max(len(r) - p, 1)
    variance = np.maximum(np.diag(robust), np.diag(plain)) / size**2
    return np.where(is_determined, variance, np.inf)
