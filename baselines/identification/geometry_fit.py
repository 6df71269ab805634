r"""Geometry, encoders and compliance of an arm from positions of markers, by least squares.

The parameters x minimise

.. math:: \sum_i \|y_i - p_i(x)\|^2 / \sigma^2 + \sum_j (x_j - \mu_j)^2 / s_j^2

with the noise σ of the residuals, estimated with x, and Gaussian priors in the units of
manufacture. A prior is what is known before the poses: lengths to millimetres, angles to a fraction
of a degree. Where the poses do not tell a parameter it keeps its prior, and is named. Intervals are
of the posterior at the solution: ±1.96 standard deviations.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from baselines.identification.geometry_model import (
    AxialTorques,
    Geometry,
    GeometryModel,
    Parameters,
)
from elastic_env.core.config import Model, quantity
from elastic_env.core.errors import ConfigurationError, ElasticError
from elastic_env.core.signals import Array, IntArray

_MOST_EVALUATIONS = 400
_LOST_M = 10.0
"""Error of a marker that counts where there is no posture at rest [m]."""
_SETTLED = 1e-6
"""Relative change of the sum of squares below which it is least."""
_FIRST_NOISE_M = 3e-3
_NOISE_ROUNDS = 3
_FINEST_M = 1e-5
_TOLD = 0.5
"""Share of its prior's deviation from which on the poses do not tell a parameter."""
_FEWEST_POSES = 2
_UNLIKE = 3.0
"""Ratio of how far markers spread, measured and of the model."""
_NOTHING = 1e-9
"""Prior of what counts as known."""
_SMALLEST_MOMENT = 0.05
"""Share of the largest moment in the arm that a joint is taken to carry at least."""
QUANTILE = 1.96
"""Half-width of a 95 % interval in standard deviations."""


class GeometryPriors(Model):
    """Standard deviations of what is known before the poses."""

    frame_m: float = quantity("m", 1.0, gt=0, le=100)
    """Place of the tracker [m]."""
    frame_rad: float = quantity("rad", 1.0, gt=0, le=10)
    """Directions of the tracker [rad]."""
    marker_m: float = quantity("m", 0.3, gt=0, le=10)
    """Place of a marker on its link [m]."""
    offset_rad: float = quantity("rad", 0.02, gt=0, le=1)
    """Offset of an encoder [rad]."""
    length_m: float = quantity("m", 0.002, gt=0, le=1)
    """Length of a link [m]."""
    angle_rad: float = quantity("rad", 0.005, gt=0, le=1)
    """Angle between axes [rad]."""
    deflection_rad: float = quantity("rad", 0.1, gt=0, le=1)
    """Deflection of a joint about its axis under its largest torque [rad]."""
    lateral_rad: float = quantity("rad", 0.02, gt=0, le=1)
    """The same across its axis [rad]."""
    friction_share: float = quantity("1", 0.3, gt=0, le=10)
    """Dry friction of a joint over its largest torque, where sides of approach are logged."""


UNITS = {
    "translation": "m",
    "rotation": "rad",
    "marker": "m",
    "offset": "rad",
    "length": "m",
    "angle": "rad",
    "compliance": "rad/(N·m)",
    "friction": "N·m",
}
"""Units of the kinds of parameters."""


class GeometryEstimate(Model):
    """One parameter and its 95 % interval."""

    kind: str
    """What it is of: tracker (translation, rotation), marker, offset, length, angle, compliance,
    friction."""
    name: str
    """Joint or marker, with the axis of the joint's frame where it has several."""
    value: float
    half_width: float
    """Half of the 95 % interval."""
    unit: str
    is_told: bool
    """Whether the poses narrow it to less than half of its prior's deviation."""


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Parameters that are sought, as one vector x.

    Attributes:
        kinds: Field of `Parameters` of each one, (p,).
        names: Joint or marker and axis of each one, such as `elbow.x`, (p,).
        basis: All parameters, flat, by x, (f, p).
        prior: Standard deviations of the priors, (p,).
    """

    kinds: tuple[str, ...]
    names: tuple[str, ...]
    basis: Array
    prior: Array


@dataclass(frozen=True, eq=False)
class GeometryProblem:
    """Poses, and what is sought.

    Attributes:
        model: Markers as a function of parameters.
        theta: Motor encoders, (N, n) [rad].
        measured: Places of the markers, (N, k, 3) [m].
        joints: Names of the joints, (n,).
        geometry: How much of the geometry is unknown.
        elastic: Joints whose stiffness is sought; none for a rigid arm.
        lateral: Whether their lateral compliance is sought too.
        priors: What is known before the poses.
        free: Joints whose frame is wholly unknown.
        axial: Sides of approach and known torques; None where the log has neither.
    """

    model: GeometryModel
    theta: Array
    measured: Array
    joints: tuple[str, ...]
    geometry: Geometry = "offsets"
    elastic: tuple[str, ...] = ()
    lateral: bool = False
    priors: GeometryPriors = field(default_factory=GeometryPriors)
    free: tuple[str, ...] = ()
    axial: AxialTorques | None = None

    def of_poses(self, chosen: IntArray) -> "GeometryProblem":
        """The problem of some of the poses, with the same unknowns and priors."""
        other = replace(
            self,
            theta=self.theta[chosen],
            measured=self.measured[chosen],
            axial=None if self.axial is None else self.axial.of_poses(chosen),
        )
        other.__dict__["unknowns"] = self.unknowns
        return other

    def align(self) -> "GeometryProblem":
        """The same problem, with the tracker rotated as fits rigid nominal poses best.

        Raises:
            ConfigurationError: The markers spread far more or less than those of the model.
        """
        nominal = self.model.nominal_parameters()
        own = self.model.predict_markers(nominal, self.theta).reshape(-1, 3)
        shown = self.measured.reshape(-1, 3)
        own_m, shown_m = (float(np.std(points, axis=0).max()) for points in (own, shown))
        if not own_m / _UNLIKE < shown_m < own_m * _UNLIKE:
            raise ConfigurationError(
                f"the markers spread over {shown_m:.3g} m, those of the model over {own_m:.3g} m:"
                " convert millimetres to metres, or name the bodies that were measured"
            )
        middle = shown.mean(axis=0)
        own_middle = own.mean(axis=0)
        R = Rotation.align_vectors(shown - middle, own - own_middle)[0].as_matrix()
        aligned = replace(self.model, alignment=R, origin=middle - R @ own_middle)
        other = replace(self, model=aligned)
        other.__dict__["unknowns"] = self.unknowns
        return other

    def as_rigid(self) -> "GeometryProblem":
        """The same poses of the rigid arm as it is given: only tracker and markers are sought."""
        priors = self.priors.replace(offset_rad=_NOTHING)
        return replace(self, geometry="offsets", elastic=(), lateral=False, priors=priors)

    @cached_property
    def largest_moment(self) -> Array:
        """Largest moments in these poses about the axes of each joint, (n, 3) [N·m]."""
        rigid = self.model.posture(self.model.nominal_parameters(), self.theta)
        loads = self.model.moments(rigid)
        if self.axial is not None:
            loads[..., 2] += self.axial.known
        moments = np.abs(loads).max(axis=0)
        return np.maximum(moments, _SMALLEST_MOMENT * max(float(moments.max()), 1e-9))

    @cached_property
    def unknowns(self) -> Unknowns:
        """Parameters that are sought, and their priors."""
        own = self.priors
        nominal = self.model.nominal_parameters()
        starts = np.cumsum([0, *(part.size for part in nominal)])
        begin = dict(zip(Parameters._fields, starts, strict=False))
        found: list[tuple[str, str, Array, float]] = []

        def seek(kind: str, name: str, first: int, direction: Array, prior: float) -> None:
            column = np.zeros(starts[-1])
            at = begin[kind] + first
            column[at : at + len(direction)] = direction
            found.append((kind, name, column, prior))

        for axis, unit in zip("xyz", np.eye(3), strict=True):
            seek("translation", axis, 0, unit, own.frame_m)
            seek("rotation", axis, 0, unit, own.frame_rad)
            for i, marker in enumerate(self.model.markers):
                seek("marker", f"{marker.name}.{axis}", 3 * i, unit, own.marker_m)
        for j, joint in enumerate(self.joints):
            is_free = joint in self.free
            one = np.ones(1)
            seek("offset", joint, j, one, own.frame_rad if is_free else own.offset_rad)
            size = {
                "length": own.frame_m if is_free else own.length_m,
                "angle": own.frame_rad if is_free else own.angle_rad,
            }
            for kind, name, direction in self._errors_of(j, is_free):
                seek(kind, f"{joint}.{name}", 3 * j, direction, size[kind])
            if joint not in self.elastic:
                continue
            moment = self.largest_moment[j]
            axis_z = np.array([0.0, 0.0, 1.0])
            seek("compliance", joint, 3 * j, axis_z, own.deflection_rad / moment[2])
            for i, name in enumerate("xy" if self.lateral else ""):
                prior = own.lateral_rad / moment[i]
                seek("compliance", f"{joint}.{name}", 3 * j, np.eye(3)[i], prior)
            if self.axial is not None and self.axial.direction[:, j].any():
                seek("friction", joint, j, one, own.friction_share * moment[2])
        kinds, names, columns, priors = zip(*found, strict=True)
        return Unknowns(kinds, names, np.stack(columns, axis=1), np.array(priors))

    def _errors_of(self, joint: int, is_free: bool) -> list[tuple[str, str, Array]]:
        """Kind, name and direction of the unknown lengths and angles of a joint's frame."""
        if self.geometry == "offsets" and not is_free:
            return []
        across, along = self.model.normals[joint]
        axis = np.array([0.0, 0.0, 1.0])
        errors = [("length", "x", across), ("length", "z", axis), ("angle", "x", across)]
        if self.geometry == "full" or is_free:
            errors += [("length", "y", along), ("angle", "y", along)]
        return errors

    def parameters(self, x: Array) -> Parameters:
        """All parameters at x."""
        flat = self.unknowns.basis @ x
        nominal = self.model.nominal_parameters()
        ends = np.cumsum([part.size for part in nominal])
        parts = np.split(flat, ends[:-1])
        pairs = zip(parts, nominal, strict=True)
        return Parameters(*(part.reshape(like.shape) for part, like in pairs))

    def residual(self, x: Array) -> Array:
        """Shown by the model less measured, (N k 3,) [m]."""
        shown = self.model.predict_markers(self.parameters(x), self.theta, self.axial)
        return (shown - self.measured).ravel()

    def linearise(self, x: Array) -> tuple[Array, Array]:
        """The residual, (N k 3,) [m], and its derivatives by x, (N k 3, p)."""
        shown, gradient = self.model.gradient(self.parameters(x), self.theta, self.axial)
        rows = shown.size
        flat = np.concatenate([part.reshape(rows, -1) for part in gradient], axis=1)
        return (shown - self.measured).ravel(), flat @ self.unknowns.basis


@dataclass(frozen=True, eq=False)
class GeometryFit:
    """Parameters that fit, and how well they are known.

    Attributes:
        problem: The poses.
        x: Estimates of the unknowns, (p,).
        covariance: Of the estimates, (p, p).
        noise_m: Standard deviation of a coordinate of a marker [m].
    """

    problem: GeometryProblem
    x: Array
    covariance: Array
    noise_m: float

    @property
    def parameters(self) -> Parameters:
        """All parameters."""
        return self.problem.parameters(self.x)

    @cached_property
    def estimates(self) -> tuple[GeometryEstimate, ...]:
        """The unknowns with their intervals."""
        own = self.problem.unknowns
        deviation = np.sqrt(np.diag(self.covariance))
        return tuple(
            GeometryEstimate(
                kind=own.kinds[i],
                name=own.names[i],
                value=self.x[i],
                half_width=QUANTILE * deviation[i],
                unit=UNITS[own.kinds[i]],
                is_told=bool(deviation[i] < _TOLD * own.prior[i]),
            )
            for i in range(len(self.x))
        )

    def prediction_error(self, problem: GeometryProblem) -> Array:
        """Places of the markers less those that this fit predicts, (N, k, 3) [m]."""
        shown = self.problem.model.predict_markers(self.parameters, problem.theta, problem.axial)
        return problem.measured - shown


def fit_geometry(problem: GeometryProblem) -> GeometryFit:
    """Fit the unknowns of poses.

    Args:
        problem: The poses and what is sought.

    Raises:
        ConfigurationError: Fewer than two poses.
        ElasticError: The poses do not fit the arm, or the fit does not converge.
    """
    if len(problem.theta) < _FEWEST_POSES:
        raise ConfigurationError(
            f"a fit of the geometry needs at least {_FEWEST_POSES} poses, got {len(problem.theta)}"
        )
    x = np.zeros(len(problem.unknowns.prior))
    noise = _FIRST_NOISE_M
    for _ in range(_NOISE_ROUNDS):
        x = _least(problem, x, noise)
        residual, _ = problem.linearise(x)
        used = len(x) - float(np.trace(_covariance(problem, x, noise)))
        spread = np.sqrt(residual @ residual / max(len(residual) - used, 1.0))
        noise = max(float(spread), _FINEST_M)
    prior = problem.unknowns.prior
    covariance = _covariance(problem, x, noise) * np.outer(prior, prior)
    return GeometryFit(problem, x, covariance, noise)


def _covariance(problem: GeometryProblem, x: Array, noise: float) -> Array:
    """Of the unknowns in units of their priors, (p, p)."""
    _, gradient = problem.linearise(x)
    rows = gradient * problem.unknowns.prior / noise
    return np.linalg.inv(rows.T @ rows + np.eye(len(x)))


def _least(problem: GeometryProblem, x: Array, noise: float) -> Array:
    """Unknowns of the least sum of squares, from x on.

    Raises:
        ElasticError: They are not found.
    """
    prior = problem.unknowns.prior

    def residual(z: Array) -> Array:
        try:
            missed = problem.residual(prior * z) / noise
        except ElasticError:  # no spring holds it: the solver takes a shorter step
            missed = np.full(problem.measured.size, _LOST_M / noise)
        return np.concatenate([missed, z])

    def jacobian(z: Array) -> Array:
        _, gradient = problem.linearise(prior * z)
        return np.concatenate([gradient * prior / noise, np.eye(len(z))])

    found = least_squares(
        residual,
        x / prior,
        jac=jacobian,  # pyright: ignore[reportArgumentType]  a callable is meant to be here
        method="trf",  # its regions of trust are in units of the priors
        ftol=_SETTLED,
        max_nfev=_MOST_EVALUATIONS,
    )
    if not found.success:
        raise ElasticError(
            f"the fit of the geometry did not converge in {_MOST_EVALUATIONS} steps; check the"
            " units of the log's columns and the model"
        )
    return prior * found.x
