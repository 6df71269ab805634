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

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from baselines.compensation.gravity_torque import GravityModel, make_gravity
from baselines.identification.static_points import StaticPoints, link_torque, record_points
from elastic_env.core.config import Model
from elastic_env.core.errors import ConfigurationError, ElasticError
from elastic_env.core.signals import Array, IntArray

HYSTERESIS_RESOLUTION_RAD = 1e-4
"""Difference between the directions of approach above which they show hysteresis [rad]."""
_FEWEST_POSITIONS = 5
_RESAMPLES = 999
_SIGN_ITERATIONS = 5
_ANGLE_ITERATIONS = 12
"""Iterations of link angles. Each gains a digit: the error shrinks by about τ_g′/K."""
_SINGULAR = 1e-2
"""Smallest relative singular value at which unit columns count as independent."""


class Identification(Model):
    """Result of an identification, in `identification.json`; env and compensator read K from it."""

    stiffness_nm_per_rad: float
    stiffness_low_nm_per_rad: float
    """Lower end of the 95 % interval (expanded percentile bootstrap over positions)."""
    stiffness_high_nm_per_rad: float
    friction_nm: float
    dead_band_rad: float
    offset_rad: float
    """θ − q without torque: homing error of the encoder less that of the IMU."""
    imu_sine_error_rad: float | None
    """Amplitude of an IMU error proportional to sin q; None with a single mass, which cannot
    separate it from K.
    """
    line_stiffness_nm_per_rad: float
    """K of a plain line through all points."""
    pearson_r: float
    residual_rad: float
    """Standard deviation of the residuals."""
    hysteresis: bool
    """True if the two directions of approach differ.

    Then the 95 % interval of the friction excludes zero, and the difference 2 F/K exceeds
    `HYSTERESIS_RESOLUTION_RAD`.
    """
    friction_low_nm: float
    friction_high_nm: float
    points: int
    positions: int

    @property
    def half_width(self) -> float:
        """Half-width of the interval of K relative to K."""
        return (self.stiffness_high_nm_per_rad - self.stiffness_low_nm_per_rad) / (
            2.0 * self.stiffness_nm_per_rad
        )

    def link_angles(self, points: StaticPoints) -> Array:
        """Link angles of static points in the encoder's zero, (len(points),) [rad]."""
        sine_error = self.imu_sine_error_rad or 0.0
        return corrected_angles(points.q, self.offset_rad, sine_error)

    def save(self, path: Path) -> None:
        """Write the JSON file."""
        path.write_text(self.model_dump_json(indent=2) + "\n")

    @staticmethod
    def load(path: Path) -> "Identification":
        """Read the JSON file."""
        return Identification.model_validate_json(path.read_text())


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


def identify_points(
    points: StaticPoints, gravity: Sequence[GravityModel], seed: int = 0
) -> Identification:
    """K, friction, dead band and offset of static points, with intervals from resampled positions.

    Args:
        points: Static points of one or two loads.
        gravity: Gravity torque of the rigid model for each load.
        seed: Seed of the resampling.

    Raises:
        ElasticError: Too few positions, or the points do not determine the parameters.
    """
    positions = np.unique(points.position)
    directions = np.unique(points.direction)
    if len(positions) < _FEWEST_POSITIONS or len(directions) < 2:
        raise ElasticError(
            f"an identification needs at least {_FEWEST_POSITIONS} positions approached from both"
            f" sides, got {len(positions)} positions and the directions {directions.tolist()}"
        )
    with_sine_error = len(gravity) > 1
    fit, q, torque = fit_link_angles(points, gravity, with_sine_error)
    if not fit.is_determined:
        masses = ", and two masses that differ" if with_sine_error else ""
        raise ElasticError(
            "the points do not determine stiffness, friction, dead band and offset: positions with"
            f" torques of both signs are needed{masses}; got {torque.min():.3g} to"
            f" {torque.max():.3g} N·m"
        )
    low, high = _bootstrap_intervals(points, q, torque, with_sine_error, seed)

    # imported here: most programs do not need it, and it loads for half a second
    from scipy import stats

    line: Any = stats.linregress(torque, points.theta - points.q)
    return Identification(
        stiffness_nm_per_rad=fit.stiffness,
        stiffness_low_nm_per_rad=low[0],
        stiffness_high_nm_per_rad=high[0],
        friction_nm=fit.friction,
        friction_low_nm=low[1],
        friction_high_nm=high[1],
        dead_band_rad=float(2.0 * fit.coefficients[2]),
        offset_rad=fit.offset,
        imu_sine_error_rad=fit.imu_sine_error if with_sine_error else None,
        line_stiffness_nm_per_rad=float(1.0 / line.slope),
        pearson_r=float(line.rvalue),
        residual_rad=float(np.std(fit.residuals, ddof=len(fit.coefficients))),
        hysteresis=(low[1] > 0.0 or high[1] < 0.0)
        and 2.0 * abs(fit.coefficients[1]) > HYSTERESIS_RESOLUTION_RAD,
        points=len(points),
        positions=len(positions),
    )


def _bootstrap_intervals(
    points: StaticPoints, q: Array, torque: Array, with_sine_error: bool, seed: int
) -> tuple[list[float], list[float]]:
    """Lower and upper ends of the 95 % intervals of K and F, from resampled positions."""
    # imported here: most programs do not need it, and it loads for half a second
    from scipy import stats

    rows = [np.flatnonzero(points.position == n) for n in np.unique(points.position)]
    generator = np.random.default_rng(seed)

    def statistics(chosen: IntArray) -> tuple[float, float]:
        while True:
            visits = np.concatenate([rows[i] for i in chosen])
            resampled = fit_points(points.rows(visits), q[visits], torque[visits], with_sine_error)
            if resampled.is_determined:
                return resampled.stiffness, resampled.friction
            # the same position each time determines nothing: draw again
            chosen = generator.integers(len(rows), size=len(rows))

    interval = stats.bootstrap(
        (np.arange(len(rows)),),
        statistics,
        n_resamples=_RESAMPLES,
        vectorized=False,
        method="percentile",
        confidence_level=_expanded_level(len(rows)),
        rng=generator,
    ).confidence_interval
    return interval.low.tolist(), interval.high.tolist()


def identify(
    envs: Sequence[Any], seed: int | None = None, progress: Callable[[float], None] | None = None
) -> tuple[list[Identification], list[StaticPoints]]:
    """Identify the joint of a testbed environment, or of two that differ in a known mass.

    Args:
        envs: One or two testbeds with reference "hold", scalar or vector.
        seed: Seed of the episodes, of the first world's in a vector environment, and of the
            resampling.
        progress: Called with the finished share of the work.

    Returns:
        Result and points of every world; one entry each for scalar environments.
    """
    if len(envs) not in {1, 2}:
        raise ConfigurationError(
            f"identification takes one environment or two with different masses, got {len(envs)}"
        )
    parts = []
    for number, env in enumerate(envs):
        report = (
            None if progress is None else (lambda done, n=number: progress((n + done) / len(envs)))
        )
        parts.append(record_points(env, seed, report))
    gravity = [make_gravity(env.unwrapped.assumed_model) for env in envs]
    points = [StaticPoints.join(world) for world in zip(*parts, strict=True)]
    return [identify_points(world, gravity, seed=seed or 0) for world in points], points


def _expanded_level(positions: int, level: float = 0.95) -> float:
    """Level of a percentile interval that covers `level` also with few positions.

    With few positions the interval at `level` itself is too narrow. This is the expanded
    percentile interval of T. Hesterberg, "What Teachers Should Know About the Bootstrap", The
    American Statistician 69(4), 2015: a t quantile and n/(n − 1) instead of the normal quantile.
    """
    # imported here: most programs do not need it, and it loads for half a second
    from scipy import stats

    t = stats.t.ppf((1.0 + level) / 2.0, positions - 1)
    quantile = np.sqrt(positions / (positions - 1)) * t
    return float(1.0 - 2.0 * stats.norm.sf(quantile))
