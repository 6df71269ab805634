"""Errors of an identification at poses that it did not see, beside rivals that need no physics."""

from collections.abc import Callable, Iterator

import numpy as np

from baselines.identification.geometry_fit import GeometryFit, GeometryProblem, fit_geometry
from baselines.identification.rivals import RIVALS
from elastic_env.core.config import Model
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, IntArray

RIGID = "rigid, as given"
FITTED = "identified"
_FEWEST_IN_CURVE = 10


class HeldOutError(Model):
    """Distances of markers from their prediction at poses that were held out."""

    name: str
    """The prediction."""
    rms_mm: float
    """Root mean square over poses and markers."""
    mean_mm: float
    """Mean over poses and markers."""
    worst_mm: float
    """Largest."""


class CurvePoint(Model):
    """Held-out error of an identification from fewer poses."""

    poses: int
    rms_mm: float
    mean_mm: float


class HeldOut(Model):
    """Held-out errors; a part of `identification.json`."""

    poses: int
    """Poses that were fitted, in each fold."""
    held_out: int
    """Poses that were not, over all folds."""
    errors: tuple[HeldOutError, ...]
    """Of the rigid model, the rivals, and the identification last."""
    curve: tuple[CurvePoint, ...]

    @property
    def best_rival(self) -> HeldOutError:
        """The best prediction but the identification."""
        return min(self.errors[:-1], key=lambda error: error.rms_mm)

    @property
    def is_ahead(self) -> bool:
        """Whether the identification has less error than every rival."""
        return self.errors[-1].rms_mm < self.best_rival.rms_mm


def split(count: int, share: float, folds: int, seed: int) -> list[IntArray]:
    """Poses to hold out, fold by fold; one fold holds out a share.

    Args:
        count: Poses of the log.
        share: Share that is held out, if there is one fold.
        folds: Folds that hold out each pose once; 1 for a single split.
        seed: Seed of the draw.

    Raises:
        ConfigurationError: Too few poses are left.
    """
    order = np.random.default_rng(seed).permutation(count)
    if folds > 1:
        parts = [np.sort(order[k::folds]) for k in range(folds)]
    else:
        parts = [np.sort(order[: round(share * count)])]
    least = min(min(len(part), count - len(part)) for part in parts)
    if least < _FEWEST_IN_CURVE:
        raise ConfigurationError(
            f"{count} poses leave {least} on one side of the split, {_FEWEST_IN_CURVE} are needed:"
            " log more poses, or turn the split off by --holdout 0"
        )
    return parts


def judge(
    problem: GeometryProblem, parts: list[IntArray], seed: int, progress: Callable[[int], None]
) -> HeldOut:
    """Fit without the poses of each part, and predict them.

    Args:
        problem: All poses.
        parts: Poses that are held out, fold by fold.
        seed: Seed of the poses of the curve.
        progress: Called with the number of fits so far; `num_fits` says how many there are.

    Raises:
        ElasticError: A fit does not converge.
    """
    errors: dict[str, list[Array]] = {name: [] for name in (RIGID, *RIVALS, FITTED)}
    done = 0
    for part in parts:
        rest = np.setdiff1d(np.arange(len(problem.theta)), part)
        inner = problem.of_poses(rest).align()
        outer = problem.of_poses(part)
        rigid = fit_geometry(inner.as_rigid())
        errors[RIGID].append(rigid.errors(outer))
        for name, left in rival_errors(rigid, inner, outer).items():
            errors[name].append(left)
        errors[FITTED].append(fit_geometry(inner).errors(outer))
        done += 1
        progress(done)
    rest = np.setdiff1d(np.arange(len(problem.theta)), parts[0])
    outer = problem.of_poses(parts[0])
    curve = []
    for chosen in curve_poses(rest, seed):
        own = 1e3 * fit_geometry(problem.of_poses(chosen).align()).errors(outer)
        curve.append(CurvePoint(poses=len(chosen), rms_mm=_rms(own), mean_mm=float(own.mean())))
        done += 1
        progress(done)
    return HeldOut(
        poses=len(rest),
        held_out=sum(len(part) for part in parts),
        errors=tuple(_summary(name, np.concatenate(found)) for name, found in errors.items()),
        curve=tuple(curve),
    )


def rival_errors(
    rigid: GeometryFit, inner: GeometryProblem, outer: GeometryProblem
) -> dict[str, Array]:
    """Distances of the markers from what each rival predicts on top of a rigid fit, (N, k) [m].

    Args:
        rigid: Fit of the rigid model to the inner poses.
        inner: Poses that a rival learns from.
        outer: Poses that it predicts.
    """
    missed = rigid.missed(inner)
    flat = missed.reshape(len(missed), -1)
    left = {}
    for name, predict in RIVALS.items():
        predicted = predict(inner.theta, flat, outer.theta).reshape(-1, *missed.shape[1:])
        left[name] = np.linalg.norm(rigid.missed(outer) - predicted, axis=-1)
    return left


def num_fits(problem: GeometryProblem, parts: list[IntArray]) -> int:
    """Steps of progress of `judge`."""
    rest = np.setdiff1d(np.arange(len(problem.theta)), parts[0])
    return len(parts) + len(list(curve_poses(rest, 0)))


def curve_poses(rest: IntArray, seed: int) -> Iterator[IntArray]:
    """Fewer and fewer of the poses, halved down to some ten, the fewest first."""
    order = np.random.default_rng(seed).permutation(rest)
    counts = []
    count = len(rest)
    while count >= _FEWEST_IN_CURVE:
        counts.append(count)
        count //= 2
    for count in reversed(counts):
        yield np.sort(order[:count])


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _summary(name: str, distances_m: Array) -> HeldOutError:
    own = 1e3 * distances_m
    return HeldOutError(
        name=name, rms_mm=_rms(own), mean_mm=float(own.mean()), worst_mm=float(own.max())
    )
