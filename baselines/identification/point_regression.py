r"""Stiffness of an elastic joint from static positions (Fig. 5 of the paper).

Deflection is regressed on gravity torque.

The joint is driven to positions from both sides and left to settle; encoder and IMU are averaged.
With link angle q and encoder θ the regression is

.. math:: \theta_i - q_i = \frac{1}{K} (\tau_i + F d_i) + \frac{b}{2}\,\mathrm{sign}(\tau_i + F d_i) + c

with the gravity torque τ at the *link* angle, the direction of approach d = ±1 (friction F), the
dead band b and an offset c between IMU and encoder. A plain line is biased: by −2 to −3 % with 1.75
mrad of backlash, by +4 % with τ taken at the encoder angle. With two known masses, c₁ sin q
separates an IMU error of that shape from K.
"""  # noqa: E501

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from baselines.compensation.gravity_torque import GravityModel
from baselines.identification.static_points import StaticPoints, link_torque
from elastic_env.core.signals import Array

_SIGN_ITERATIONS = 5
_ANGLE_ITERATIONS = 12
"""Iterations of link angles. Each gains a digit: the error shrinks by about τ_g′/K."""
_SINGULAR = 1e-2
"""Smallest relative singular value at which unit columns count as independent."""


@dataclass(frozen=True)
class Fit:
    """Coefficients of the regression: 1/K, F/K, b/2, c, and with two loads the sine error."""

    coefficients: Array
    residuals: Array
    is_determined: bool
    """True if the points determine all coefficients."""

    @property
    def offset(self) -> float:
        """θ − q without torque [rad]."""
        return float(self.coefficients[3])

    @property
    def imu_sine_error(self) -> float:
        """Amplitude of an IMU error proportional to sin q [rad]; 0 where it was no regressor."""
        return -float(self.coefficients[4]) if len(self.coefficients) > 4 else 0.0

    @property
    def stiffness(self) -> float:
        """K [N·m/rad]."""
        return float(1.0 / self.coefficients[0])

    @property
    def friction(self) -> float:
        """F [N·m]."""
        return float(self.coefficients[1] / self.coefficients[0])


def fit_points(points: StaticPoints, q: Array, torque: Array, with_sine_error: bool) -> Fit:
    """Least squares of the deflections.

    The sign of the load depends on the friction, and is found by iteration.

    Args:
        points: Static points.
        q: Link angles, (len(points),) [rad].
        torque: Gravity torque at these, (len(points),) [N·m].
        with_sine_error: True if an IMU error proportional to sin q is a regressor.
    """
    deflection = points.theta - points.q
    direction = points.direction.astype(np.float64)
    constant = [np.ones(len(points)), *([np.sin(q)] if with_sine_error else [])]
    design = np.zeros((len(points), 4))
    coefficients = np.zeros(4)
    friction = 0.0
    rank = 0
    for _ in range(_SIGN_ITERATIONS):
        design = np.stack(
            [torque, direction, np.sign(torque + friction * direction), *constant], axis=1
        )
        scale = np.linalg.norm(design, axis=0)
        scaled, _, rank, _ = np.linalg.lstsq(design / scale, deflection, rcond=_SINGULAR)
        coefficients = scaled / scale
        friction = coefficients[1] / coefficients[0]
    residuals = deflection - design @ coefficients
    return Fit(coefficients, residuals, is_determined=rank == design.shape[1])


def fit_link_angles(
    points: StaticPoints, gravity: Sequence[GravityModel], with_sine_error: bool
) -> tuple[Fit, Array, Array]:
    """Fit with τ at the link angles that the fit itself gives, by iteration from the IMU's angles.

    Returns:
        The fit, the link angles in the encoder's zero [rad], and the gravity torque at these [N·m].
    """
    q = points.q
    for _ in range(_ANGLE_ITERATIONS):
        torque = link_torque(points, gravity, q)
        fit = fit_points(points, q, torque, with_sine_error)
        q = corrected_angles(points.q, fit.offset, fit.imu_sine_error)
    torque = link_torque(points, gravity, q)
    return fit_points(points, q, torque, with_sine_error), q, torque


def corrected_angles(imu: Array, offset: float, sine_error: float) -> Array:
    """Link angles q from an IMU that measures q − offset + sine_error · sin q [rad]."""
    q = imu
    for _ in range(_ANGLE_ITERATIONS):
        q = imu + offset - sine_error * np.sin(q)
    return q
