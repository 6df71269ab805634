"""Errors of an identification at poses that it did not use, compared with those of rivals."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from baselines.identification.arm_fit import solve_unknowns
from baselines.identification.geometry_fit import fit_geometry
from baselines.identification.geometry_problem import GeometryProblem
from baselines.identification.pose_checks import needed_poses
from baselines.identification.pose_log import Kind
from baselines.identification.pose_model import PoseModel
from baselines.identification.rivals import RIVALS
from elastic_env.core.config import Model
from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array, IntArray

RIGID = "rigid, as given"
FITTED = "identified"
FEWEST_POSES = 10
"""Poses on either side of a split, at least."""
PredictionError = Callable[[IntArray], Array]
"""Measured less predicted at given poses: vectors of k places, (N, k, d), in SI units."""
Folds = list[IntArray]
"""Poses that each fold holds out."""
ErrorUnit = Literal["mm", "mrad", "N·m"]


class HeldOutError(Model):
    """Distances of a measurement from its prediction at poses that were held out."""

    name: str
    """Name of the prediction."""
    rms: float
    """Root mean square over poses, and over markers or joints."""
    mean: float
    """Mean over poses, and over markers or joints."""
    worst: float
    """Largest distance."""


class CurvePoint(Model):
    """Held-out error of an identification from fewer poses."""

    poses: int
    rms: float
    mean: float


class HeldOut(Model):
    """Held-out errors; a part of `identification.json`."""

    of: str
    """Measurement that was predicted."""
    unit: ErrorUnit
    """Unit of all errors."""
    poses: int
    """Poses that were fitted, in each fold."""
    held_out: int
    """Poses that were not fitted, over all folds."""
    errors: tuple[HeldOutError, ...]
    """Errors of the rigid model, the rivals, and the identification last."""
    curve: tuple[CurvePoint, ...]

    @property
    def best_rival(self) -> HeldOutError:
        """The best prediction except the identification."""
        return min(self.errors[:-1], key=lambda error: error.rms)

    @property
    def is_ahead(self) -> bool:
        """True if the identification has less error than every rival."""
        return self.errors[-1].rms < self.best_rival.rms


@dataclass(frozen=True)
class HoldoutProblem:
    """Poses, and two fits to some of them that predict the others.

    Attributes:
        theta: Motor encoders, (N, n) [rad].
        of: Measurement that is predicted.
        unit: Unit of the errors in tables.
        fewest: Number of poses that an identification needs.
        fit_rigid: Fits the frame of the measurement alone to given poses.
        fit_elastic: Fits all unknowns to given poses.
    """

    theta: Array
    of: str
    unit: ErrorUnit
    fewest: int
    fit_rigid: Callable[[IntArray], PredictionError]
    fit_elastic: Callable[[IntArray], PredictionError]

    @classmethod
    def from_geometry(cls, problem: GeometryProblem) -> "HoldoutProblem":
        """Problem of an arm with markers whose geometry is unknown too."""

        def fit(inner: GeometryProblem) -> PredictionError:
            result = fit_geometry(inner)
            return lambda poses: result.prediction_error(problem.part(poses))

        return cls(
            theta=problem.theta,
            of="markers",
            unit="mm",
            fewest=FEWEST_POSES,
            fit_rigid=lambda poses: fit(problem.part(poses).align().as_rigid()),
            fit_elastic=lambda poses: fit(problem.part(poses).align()),
        )

    @classmethod
    def from_poses(cls, model: PoseModel) -> "HoldoutProblem":
        """Problem of a measurement of an arm whose stiffness is unknown."""
        rigid = replace(model, unknowns=model.unknowns.frame_alone())
        part = model.log.part

        def fit(inner: PoseModel) -> PredictionError:
            unknowns = solve_unknowns(inner)
            return lambda poses: inner.with_log(part(poses)).prediction_error(unknowns)

        of, unit = _MEASUREMENTS[model.log.kind]
        return cls(
            theta=model.log.theta,
            of=of,
            unit=unit,
            fewest=max(needed_poses(model), FEWEST_POSES),
            fit_rigid=lambda poses: fit(replace(rigid, log=part(poses))),
            fit_elastic=lambda poses: fit(replace(model, log=part(poses))),
        )

    def shortage(self, parts: Folds) -> str:
        """Message that a split leaves too few poses, with a cure; empty where it leaves enough."""
        count = len(self.theta)
        fitted = min(count - len(part) for part in parts)
        held_out = sum(len(part) for part in parts)
        if fitted >= self.fewest and held_out >= FEWEST_POSES:
            return ""
        return (
            f"{count} poses leave {fitted} to fit and {held_out} to hold out, {self.fewest} and"
            f" {FEWEST_POSES} are needed; log more poses, or choose --holdout or --folds"
        )

    def curve_counts(self, parts: Folds) -> list[int]:
        """Numbers of poses of the curve in ascending order: halved down to the fewest."""
        counts = []
        count = len(self.theta) - len(parts[0])
        while count >= self.fewest:
            counts.append(count)
            count //= 2
        return counts[::-1]


_MEASUREMENTS: dict[Kind, tuple[str, ErrorUnit]] = {
    "end_effector": ("the end effector", "mm"),
    "markers": ("markers", "mm"),
    "imu": ("the IMU's vertical", "mrad"),
    "link_encoders": ("link encoders", "mrad"),
    "torques": ("joint torques", "N·m"),
}
"""Names of the measurements, and the units of their errors."""


def split(count: int, share: float, folds: int, seed: int) -> Folds:
    """Poses to hold out, fold by fold; a single fold holds out a share.

    Args:
        count: Number of poses of the log.
        share: Share that a single fold holds out.
        folds: Folds that hold out each pose once; 1 for a single split.
        seed: Seed of the draw.
    """
    order = np.random.default_rng(seed).permutation(count)
    if folds > 1:
        return [np.sort(order[k::folds]) for k in range(min(folds, count))]
    return [np.sort(order[: round(share * count)])]


def judge(
    problem: HoldoutProblem, parts: Folds, seed: int, progress: Callable[[int], None]
) -> HeldOut:
    """Fit without the poses of each part, and predict them.

    Args:
        problem: All poses.
        parts: Poses that are held out, fold by fold.
        seed: Seed of the poses of the curve.
        progress: Called with the number of fits so far; `num_fits` returns their total.

    Raises:
        ElasticError: A fit does not converge.
    """
    theta = problem.theta
    all_poses = np.arange(len(theta))
    distances: dict[str, list[Array]] = {}
    done = 0
    for part in parts:
        rest = np.setdiff1d(all_poses, part)
        rigid_error = problem.fit_rigid(rest)
        fold = {
            RIGID: _distances(rigid_error(part)),
            **rival_errors(theta[rest], rigid_error(rest), theta[part], rigid_error(part)),
            FITTED: _distances(problem.fit_elastic(rest)(part)),
        }
        for name, values in fold.items():
            distances.setdefault(name, []).append(values)
        done += 1
        progress(done)
    rest = np.setdiff1d(all_poses, parts[0])
    order = np.random.default_rng(seed).permutation(rest)
    curve = []
    for count in problem.curve_counts(parts):
        try:
            error = problem.fit_elastic(np.sort(order[:count]))(parts[0])
        except ElasticError:
            continue  # so few poses may give springs that do not hold the arm
        summary = _summary("", [_distances(error)], problem.unit)
        curve.append(CurvePoint(poses=count, rms=summary.rms, mean=summary.mean))
        done += 1
        progress(done)
    return HeldOut(
        of=problem.of,
        unit=problem.unit,
        poses=len(rest),
        held_out=sum(len(part) for part in parts),
        errors=tuple(_summary(*item, problem.unit) for item in distances.items()),
        curve=tuple(curve),
    )


def rival_errors(
    angles: Array, errors: Array, others: Array, other_errors: Array
) -> dict[str, Array]:
    """Distances between measurement and the prediction of each rival, (M, k), in SI units.

    A rival predicts the error of the rigid fit.

    Args:
        angles: Poses that a rival learns from, (N, n) [rad].
        errors: Measured less predicted by the rigid fit at these poses, (N, k, d).
        others: Poses that it predicts, (M, n) [rad].
        other_errors: Measured less predicted by the rigid fit at the others, (M, k, d).
    """
    flat = errors.reshape(len(errors), -1)
    shape = other_errors.shape
    return {
        name: _distances(other_errors - predict(angles, flat, others).reshape(shape))
        for name, predict in RIVALS.items()
    }


def num_fits(problem: HoldoutProblem, parts: Folds) -> int:
    """Number of fits of `judge`."""
    return len(parts) + len(problem.curve_counts(parts))


def _distances(errors: Array) -> Array:
    return np.linalg.norm(errors, axis=-1)


def _summary(name: str, distances: list[Array], unit: ErrorUnit) -> HeldOutError:
    values = np.concatenate(distances) * (1.0 if unit == "N·m" else 1e3)
    return HeldOutError(
        name=name,
        rms=float(np.sqrt(np.mean(values**2))),
        mean=float(values.mean()),
        worst=float(values.max()),
    )
