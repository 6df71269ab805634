r"""Errors of an identification at poses that it did not see, beside rivals that need no physics.

A rival learns the error of the rigid model at some poses from the joint angles, and predicts it at
others. Anybody who has a log can try these in an hour. So a model of springs is worth its
assumptions only where it is ahead of them at poses that none of them saw.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from baselines.identification.arm_fit import needed_poses, solve_unknowns
from baselines.identification.geometry_fit import GeometryProblem, fit_geometry
from baselines.identification.pose_log import Kind
from baselines.identification.pose_model import PoseModel
from elastic_env.core.config import Model
from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array, IntArray

Rival = Callable[[Array, Array, Array], Array]
"""Of angles (N, n), errors (N, m) and other angles (M, n): errors there, (M, m)."""

_FOLDS = 5
_WIDTHS = (0.3, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Widths of the kernel, in standard deviations of the angles times √n."""
_RIDGES = tuple(10.0**power for power in range(-6, 3))
"""Weights of the ridge."""


def predict_constant(angles: Array, errors: Array, others: Array) -> Array:
    """The mean error everywhere."""
    del angles
    return np.broadcast_to(errors.mean(axis=0), (len(others), errors.shape[1]))


def predict_linear(angles: Array, errors: Array, others: Array) -> Array:
    """A constant and a share of each angle, by least squares."""
    rows, new = (np.column_stack([np.ones(len(part)), part]) for part in (angles, others))
    return new @ np.linalg.lstsq(rows, errors, rcond=None)[0]


def predict_by_kernel(angles: Array, errors: Array, others: Array) -> Array:
    """Kernel ridge regression with a Gaussian kernel, about the mean error.

    Width and ridge are those of the least error in a cross-validation over these poses.
    """
    spread = np.where(angles.std(axis=0) > 0.0, angles.std(axis=0), 1.0)
    own, new = ((part - angles.mean(axis=0)) / spread for part in (angles, others))
    mean = errors.mean(axis=0)
    fold = np.arange(len(own)) % _FOLDS
    between = _squared_distances(own, own)
    chosen = (np.inf, _WIDTHS[0], _RIDGES[0])
    for width in _WIDTHS:
        kernel = np.exp(-between / (2.0 * width**2 * own.shape[1]))
        for ridge in _RIDGES:
            missed = 0.0
            for k in range(_FOLDS):
                inner = fold != k
                matrix = kernel[np.ix_(inner, inner)] + ridge * np.eye(int(inner.sum()))
                weights = np.linalg.solve(matrix, errors[inner] - mean)
                found = kernel[np.ix_(~inner, inner)] @ weights
                missed += float(np.sum((errors[~inner] - mean - found) ** 2))
            chosen = min(chosen, (missed, width, ridge))
    _, width, ridge = chosen
    scale = 2.0 * width**2 * own.shape[1]
    matrix = np.exp(-between / scale) + ridge * np.eye(len(own))
    weights = np.linalg.solve(matrix, errors - mean)
    return mean + np.exp(-_squared_distances(new, own) / scale) @ weights


RIVALS: dict[str, Rival] = {
    "constant": predict_constant,
    "linear in the angles": predict_linear,
    "kernel regression": predict_by_kernel,
}
"""Rivals by the names that tables have."""


def _squared_distances(a: Array, b: Array) -> Array:
    """Between rows, (N, n) and (M, n) to (N, M)."""
    return np.sum((a[:, None] - b[None]) ** 2, axis=-1)


RIGID = "rigid, as given"
FITTED = "identified"
FEWEST_POSES = 10
"""Poses on either side of a split, at least."""
Missed = Callable[[IntArray], Array]
"""Measured less predicted at chosen poses: vectors of k places, (N, k, d), in SI units."""
ErrorUnit = Literal["mm", "mrad", "N·m"]


class HeldOutError(Model):
    """Distances of a measurement from its prediction at poses that were held out."""

    name: str
    """The prediction."""
    rms: float
    """Root mean square over poses, and over markers or joints."""
    mean: float
    """Mean over the same."""
    worst: float
    """Largest."""


class CurvePoint(Model):
    """Held-out error of an identification from fewer poses."""

    poses: int
    rms: float
    mean: float


class HeldOut(Model):
    """Held-out errors; a part of `identification.json`."""

    of: str
    """What was predicted."""
    unit: ErrorUnit
    """Unit of all errors."""
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
        return min(self.errors[:-1], key=lambda error: error.rms)

    @property
    def is_ahead(self) -> bool:
        """Whether the identification has less error than every rival."""
        return self.errors[-1].rms < self.best_rival.rms


@dataclass(frozen=True)
class Judged:
    """Poses, and two ways to predict them from some of them.

    Attributes:
        theta: Motor encoders, (N, n) [rad].
        of: What is predicted.
        unit: Unit that errors are shown in.
        fewest: Poses that an identification needs.
        rigid: Fits the frame of the measurement alone to chosen poses.
        identified: Fits all that is sought to chosen poses.
    """

    theta: Array
    of: str
    unit: ErrorUnit
    fewest: int
    rigid: Callable[[IntArray], Missed]
    identified: Callable[[IntArray], Missed]

    @classmethod
    def of_geometry(cls, problem: GeometryProblem) -> "Judged":
        """Markers of an arm whose geometry is sought too."""

        def fit(inner: GeometryProblem) -> Missed:
            found = fit_geometry(inner)
            return lambda poses: found.prediction_error(problem.of_poses(poses))

        return cls(
            theta=problem.theta,
            of="markers",
            unit="mm",
            fewest=FEWEST_POSES,
            rigid=lambda poses: fit(problem.of_poses(poses).align().as_rigid()),
            identified=lambda poses: fit(problem.of_poses(poses).align()),
        )

    @classmethod
    def of_poses(cls, model: PoseModel) -> "Judged":
        """A measurement of an arm whose stiffness is sought."""
        rigid = replace(model, unknowns=model.unknowns.of_frame())

        def fit(inner: PoseModel) -> Missed:
            found = solve_unknowns(inner)
            return lambda poses: inner.at(model.log.part(poses)).prediction_error(found)

        of, unit = _SHOWN[model.log.kind]
        return cls(
            theta=model.log.theta,
            of=of,
            unit=unit,
            fewest=max(needed_poses(model), FEWEST_POSES),
            rigid=lambda poses: fit(replace(rigid, log=model.log.part(poses))),
            identified=lambda poses: fit(replace(model, log=model.log.part(poses))),
        )

    def too_few(self, parts: list[IntArray]) -> str:
        """Why a split leaves too few poses, with a cure; empty where it leaves enough."""
        count = len(self.theta)
        fitted = min(count - len(part) for part in parts)
        held_out = sum(len(part) for part in parts)
        if fitted >= self.fewest and held_out >= FEWEST_POSES:
            return ""
        return (
            f"{count} poses leave {fitted} to fit and {held_out} to hold out, {self.fewest} and"
            f" {FEWEST_POSES} are needed; log more poses, or choose --holdout or --folds"
        )

    def counts(self, parts: list[IntArray]) -> list[int]:
        """Numbers of poses of the curve: halved down to the fewest, which come first."""
        counts = []
        count = len(self.theta) - len(parts[0])
        while count >= self.fewest:
            counts.append(count)
            count //= 2
        return counts[::-1]


_SHOWN: dict[Kind, tuple[str, ErrorUnit]] = {
    "end_effector": ("the end effector", "mm"),
    "markers": ("markers", "mm"),
    "imu": ("the IMU's vertical", "mrad"),
    "link_encoders": ("link encoders", "mrad"),
    "torques": ("joint torques", "N·m"),
}
"""What errors are of, and their unit."""


def split(count: int, share: float, folds: int, seed: int) -> list[IntArray]:
    """Poses to hold out, fold by fold; one fold holds out a share.

    Args:
        count: Poses of the log.
        share: Share that is held out, if there is one fold.
        folds: Folds that hold out each pose once; 1 for a single split.
        seed: Seed of the draw.
    """
    order = np.random.default_rng(seed).permutation(count)
    if folds > 1:
        return [np.sort(order[k::folds]) for k in range(min(folds, count))]
    return [np.sort(order[: round(share * count)])]


def judge(
    judged: Judged, parts: list[IntArray], seed: int, progress: Callable[[int], None]
) -> HeldOut:
    """Fit without the poses of each part, and predict them.

    Args:
        judged: All poses.
        parts: Poses that are held out, fold by fold.
        seed: Seed of the poses of the curve.
        progress: Called with the number of fits so far; `num_fits` says how many there are.

    Raises:
        ElasticError: A fit does not converge.
    """
    everything = np.arange(len(judged.theta))
    found: dict[str, list[Array]] = {}
    done = 0
    for part in parts:
        rest = np.setdiff1d(everything, part)
        rigid = judged.rigid(rest)
        inner = judged.theta[rest], rigid(rest)
        errors = {
            RIGID: _distances(rigid(part)),
            **rival_errors(*inner, judged.theta[part], rigid(part)),
            FITTED: _distances(judged.identified(rest)(part)),
        }
        for name, own in errors.items():
            found.setdefault(name, []).append(own)
        done += 1
        progress(done)
    rest = np.setdiff1d(everything, parts[0])
    order = np.random.default_rng(seed).permutation(rest)
    curve = []
    for count in judged.counts(parts):
        try:
            missed = judged.identified(np.sort(order[:count]))(parts[0])
        except ElasticError:
            continue  # so few poses need not tell springs that hold the arm
        own = _summary("", [_distances(missed)], judged.unit)
        curve.append(CurvePoint(poses=count, rms=own.rms, mean=own.mean))
        done += 1
        progress(done)
    return HeldOut(
        of=judged.of,
        unit=judged.unit,
        poses=len(rest),
        held_out=sum(len(part) for part in parts),
        errors=tuple(_summary(name, own, judged.unit) for name, own in found.items()),
        curve=tuple(curve),
    )


def rival_errors(
    angles: Array, missed: Array, others: Array, missed_there: Array
) -> dict[str, Array]:
    """Distances from what each rival predicts on top of a rigid fit, (M, k), in SI units.

    Args:
        angles: Poses that a rival learns from, (N, n) [rad].
        missed: Measured less predicted by the rigid fit at these poses, (N, k, d).
        others: Poses that it predicts, (M, n) [rad].
        missed_there: Measured less predicted by the rigid fit at those, (M, k, d).
    """
    flat = missed.reshape(len(missed), -1)
    return {
        name: _distances(missed_there - predict(angles, flat, others).reshape(missed_there.shape))
        for name, predict in RIVALS.items()
    }


def num_fits(judged: Judged, parts: list[IntArray]) -> int:
    """Steps of progress of `judge`."""
    return len(parts) + len(judged.counts(parts))


def _distances(missed: Array) -> Array:
    return np.linalg.norm(missed, axis=-1)


def _summary(name: str, distances: list[Array], unit: ErrorUnit) -> HeldOutError:
    own = np.concatenate(distances) * (1.0 if unit == "N·m" else 1e3)
    return HeldOutError(
        name=name,
        rms=float(np.sqrt(np.mean(own**2))),
        mean=float(own.mean()),
        worst=float(own.max()),
    )
