"""Unknown parameters of an arm's geometry, their priors, and the residuals of markers."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from baselines.identification.geometry_gradient import marker_gradient
from baselines.identification.geometry_model import (
    ArmParameters,
    AxialTorques,
    Geometry,
    GeometryModel,
)
from elastic_env.core.config import Model, quantity
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, IntArray

_SPREAD_RATIO = 3.0
"""Ratio between measured spread of markers and the model's from which the units differ."""
_EXACT_RAD = 1e-9
"""Deviation of a prior that leaves a parameter at its nominal value [rad]."""
_SMALLEST_MOMENT = 0.05
"""Share of the largest moment in the arm that each joint is assumed to carry at least."""


class GeometryPriors(Model):
    """Standard deviations of the parameters before the poses."""

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
    """Deflection of a joint across its axis under its largest torque [rad]."""
    friction_share: float = quantity("1", 0.3, gt=0, le=10)
    """Dry friction of a joint over its largest torque, where sides of approach are logged."""


@dataclass(frozen=True, eq=False)
class GeometryUnknowns:
    """Unknown parameters as one vector x.

    Attributes:
        kinds: Field of `ArmParameters` of each unknown, (p,).
        names: Joint or marker and axis of each unknown, such as `elbow.x`, (p,).
        basis: Derivatives of all parameters, flat, by x, (f, p).
        prior: Standard deviations of the priors, (p,).
    """

    kinds: tuple[str, ...]
    names: tuple[str, ...]
    basis: Array
    prior: Array


@dataclass(frozen=True, eq=False)
class GeometryProblem:
    """Poses and the unknown parameters.

    Attributes:
        model: Markers as a function of parameters.
        theta: Motor encoders, (N, n) [rad].
        measured: Places of the markers, (N, k, 3) [m].
        geometry: Unknown part of the geometry.
        elastic: Joints whose stiffness is unknown; none for a rigid arm.
        lateral: True if their lateral compliance is unknown too.
        priors: Standard deviations before the poses.
        free: Joints whose frame is wholly unknown.
        axial: Sides of approach and known torques; None where the log has neither.
    """

    model: GeometryModel
    theta: Array
    measured: Array
    geometry: Geometry = "offsets"
    elastic: tuple[str, ...] = ()
    lateral: bool = False
    priors: GeometryPriors = field(default_factory=GeometryPriors)
    free: tuple[str, ...] = ()
    axial: AxialTorques | None = None

    def part(self, poses: IntArray) -> "GeometryProblem":
        """The problem of some of the poses, with the same unknowns and priors."""
        other = replace(
            self,
            theta=self.theta[poses],
            measured=self.measured[poses],
            axial=None if self.axial is None else self.axial.part(poses),
        )
        other.__dict__["unknowns"] = self.unknowns
        return other

    def align(self) -> "GeometryProblem":
        """The same problem with the tracker's frame that fits rigid nominal poses best.

        Raises:
            ConfigurationError: The markers spread far more or less than those of the model.
        """
        nominal = self.model.nominal_parameters()
        expected = self.model.predict_markers(nominal, self.theta).reshape(-1, 3)
        measured = self.measured.reshape(-1, 3)
        expected_m, measured_m = (
            float(np.std(part, axis=0).max()) for part in (expected, measured)
        )
        if not expected_m / _SPREAD_RATIO < measured_m < expected_m * _SPREAD_RATIO:
            raise ConfigurationError(
                f"the markers spread over {measured_m:.3g} m, those of the model over"
                f" {expected_m:.3g} m: convert millimetres to metres, or name the bodies that were"
                " measured"
            )
        centre = measured.mean(axis=0)
        model_centre = expected.mean(axis=0)
        rotation = Rotation.align_vectors(measured - centre, expected - model_centre)[0]
        R = rotation.as_matrix()
        aligned = replace(self.model, alignment=R, origin=centre - R @ model_centre)
        other = replace(self, model=aligned)
        other.__dict__["unknowns"] = self.unknowns
        return other

    def as_rigid(self) -> "GeometryProblem":
        """The same poses of the nominal rigid arm: only tracker and markers are unknown."""
        priors = self.priors.replace(offset_rad=_EXACT_RAD)
        return replace(self, geometry="offsets", elastic=(), lateral=False, priors=priors)

    @cached_property
    def largest_moment(self) -> Array:
        """Largest moments in these poses about the axes of each joint, (n, 3) [N·m]."""
        rigid = self.model.posture(self.model.nominal_parameters(), self.theta)
        loads = self.model.moments(rigid)
        if self.axial is not None:
            loads[..., 2] += self.axial.known_torque
        moments = np.abs(loads).max(axis=0)
        return np.maximum(moments, _SMALLEST_MOMENT * max(float(moments.max()), 1e-9))

    @cached_property
    def unknowns(self) -> GeometryUnknowns:
        """Unknown parameters and their priors."""
        priors = self.priors
        nominal = self.model.nominal_parameters()
        edges = np.cumsum([0, *(part.size for part in nominal)])
        starts = dict(zip(ArmParameters._fields, edges, strict=False))
        rows: list[tuple[str, str, Array, float]] = []

        def add(kind: str, name: str, first: int, values: Array, prior: float) -> None:
            column = np.zeros(edges[-1])
            start = starts[kind] + first
            column[start : start + len(values)] = values
            rows.append((kind, name, column, prior))

        for axis, unit in zip("xyz", np.eye(3), strict=True):
            add("translation", axis, 0, unit, priors.frame_m)
            add("rotation", axis, 0, unit, priors.frame_rad)
            for i, marker in enumerate(self.model.markers):
                add("marker", f"{marker.name}.{axis}", 3 * i, unit, priors.marker_m)
        for j, joint in enumerate(self.model.joints):
            is_free = joint in self.free
            scalar = np.ones(1)
            size = {
                "offset": priors.frame_rad if is_free else priors.offset_rad,
                "length": priors.frame_m if is_free else priors.length_m,
                "angle": priors.frame_rad if is_free else priors.angle_rad,
            }
            add("offset", joint, j, scalar, size["offset"])
            for kind, name, direction in self._frame_errors(j, is_free):
                add(kind, f"{joint}.{name}", 3 * j, direction, size[kind])
            if joint not in self.elastic:
                continue
            moment = self.largest_moment[j]
            axis_z = np.array([0.0, 0.0, 1.0])
            add("compliance", joint, 3 * j, axis_z, priors.deflection_rad / moment[2])
            for i, name in enumerate("xy" if self.lateral else ""):
                prior = priors.lateral_rad / moment[i]
                add("compliance", f"{joint}.{name}", 3 * j, np.eye(3)[i], prior)
            if self.axial is not None and self.axial.direction[:, j].any():
                add("friction", joint, j, scalar, priors.friction_share * moment[2])
        kinds, names, columns, deviations = zip(*rows, strict=True)
        basis = np.stack(columns, axis=1)
        return GeometryUnknowns(kinds, names, basis, np.array(deviations))

    def _frame_errors(self, joint: int, is_free: bool) -> list[tuple[str, str, Array]]:
        """Kind, name and direction of the unknown lengths and angles of a joint's frame."""
        if self.geometry == "offsets" and not is_free:
            return []
        across, along = self.model.normals[joint]
        axis = np.array([0.0, 0.0, 1.0])
        errors = [("length", "x", across), ("length", "z", axis), ("angle", "x", across)]
        if self.geometry == "full" or is_free:
            errors += [("length", "y", along), ("angle", "y", along)]
        return errors

    def parameters(self, x: Array) -> ArmParameters:
        """All parameters at x."""
        nominal = self.model.nominal_parameters()
        ends = np.cumsum([part.size for part in nominal])
        parts = np.split(self.unknowns.basis @ x, ends[:-1])
        pairs = zip(parts, nominal, strict=True)
        return ArmParameters(*(part.reshape(like.shape) for part, like in pairs))

    def residual(self, x: Array) -> Array:
        """Predicted less measured, (N k 3,) [m]."""
        places = self.model.predict_markers(self.parameters(x), self.theta, self.axial)
        return (places - self.measured).ravel()

    def linearise(self, x: Array) -> tuple[Array, Array]:
        """The residual, (N k 3,) [m], and its derivatives by x, (N k 3, p)."""
        parameters = self.parameters(x)
        places, gradient = marker_gradient(self.model, parameters, self.theta, self.axial)
        rows = places.size
        flat = np.concatenate([part.reshape(rows, -1) for part in gradient], axis=1)
        return (places - self.measured).ravel(), flat @ self.unknowns.basis
