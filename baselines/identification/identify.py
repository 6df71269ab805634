r"""Stiffness of an elastic joint from static positions (Fig. 5 of the paper).

Deflection is regressed on gravity torque.

The joint is driven to positions from both sides and left to settle; encoder and IMU are averaged.
Of link angle q and encoder θ the regression is

.. math:: \theta_i - q_i = \frac{1}{K} (\tau_i + F d_i) + \frac{b}{2}\,\mathrm{sign}(\tau_i + F d_i) + c

with the gravity torque τ at the *link* angle, the direction of approach d = ±1 (friction F), the
dead band b and an offset c between IMU and encoder. A plain line is biased: by −2 to −3 % with 1.75
mrad of backlash, by +4 % with τ taken at the encoder angle. With two known masses, c₁ sin q
separates an IMU error of that shape from K.
"""  # noqa: E501

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from baselines.compensation.gravity_torque import GravityModel, make_gravity
from elastic_env.core.config import Model
from elastic_env.core.errors import ConfigurationError, ElasticError
from elastic_env.core.signals import Array, IntArray

_PROGRESS_STEPS = 250


@dataclass(frozen=True)
class StaticPoints:
    """Averages of the windows at rest, one entry per visit.

    Attributes:
        theta: Encoder [rad].
        q: IMU on the link [rad].
        direction: Side of approach, +1 from below, -1 from above.
        position: Number of the static position; its two visits share it.
        load: Which of the masses was mounted, 0 or 1.
    """

    theta: Array
    q: Array
    direction: IntArray
    position: IntArray
    load: IntArray

    def __len__(self) -> int:
        return len(self.theta)

    def rows(self, chosen: IntArray) -> "StaticPoints":
        """Some of the points, in the given order."""
        columns = {field.name: getattr(self, field.name)[chosen] for field in fields(self)}
        return StaticPoints(**columns)

    @staticmethod
    def join(parts: "Sequence[StaticPoints]") -> "StaticPoints":
        """The points of several loads together, positions numbered through."""
        numbered: list[StaticPoints] = []
        first = 0
        for load, part in enumerate(parts):
            own = replace(part, position=part.position + first, load=np.full(len(part), load))
            first += part.position.max() + 1
            numbered.append(own)
        names = [field.name for field in fields(StaticPoints)]
        columns = {name: [getattr(part, name) for part in numbered] for name in names}
        joined = {name: np.concatenate(own) for name, own in columns.items()}
        return StaticPoints(**joined)


class HoldRecorder:
    """Averages encoder and IMU over the windows at rest of a `hold` reference.

    Args:
        directions: Directions of approach of the windows, (visits,), as `Hold.visits` has them.
        num_worlds: Worlds that play the reference in step.
    """

    def __init__(self, directions: IntArray, num_worlds: int = 1) -> None:
        self._directions = directions
        self._sums = np.zeros((len(directions), num_worlds, 2))
        self._counts = np.zeros(len(directions), dtype=np.int64)

    def take(self, encoder: Array, imu: Array, rest: int) -> None:
        """Take in encoder and IMU, (num_worlds,) [rad], and the window, -1 outside."""
        if rest >= 0:
            self._sums[rest] += np.stack([encoder, imu], axis=-1)
            self._counts[rest] += 1

    @property
    def is_complete(self) -> bool:
        """True when every window has been visited."""
        return bool(self._counts.all())

    def points(self) -> list[StaticPoints]:
        """The averages of every world.

        Raises:
            ElasticError: A window has no sample: the run ended early.
        """
        if not self.is_complete:
            raise ElasticError(
                f"the run ended before all {len(self._counts)} static positions were visited"
            )
        means = self._sums / self._counts[:, None, None]
        half = len(self._directions) // 2
        position = np.concatenate([np.arange(half), np.arange(half)[::-1]])
        load = np.zeros(len(position), dtype=np.int64)
        return [
            StaticPoints(means[:, world, 0], means[:, world, 1], self._directions, position, load)
            for world in range(means.shape[1])
        ]


def record_points(
    env: Any, seed: int | None = None, progress: Callable[[float], None] | None = None
) -> list[StaticPoints]:
    """Drive a testbed, simulated or real, through its `hold` reference without compensation.

    Args:
        env: Testbed environment with reference "hold", scalar or vector.
        seed: Seed of the episode, of the first world's in a vector environment.
        progress: Called with the share of the episode that is done, now and then.

    Returns:
        The static points of every world; one entry for a scalar environment.

    Raises:
        ConfigurationError: The environment's reference has no static positions.
        ElasticError: The episode ended early.
    """
    task = env.unwrapped.task
    if not hasattr(task.config.reference, "visits"):
        raise ConfigurationError(
            "identification needs the reference 'hold', the environment has"
            f" {task.config.reference.kind!r}"
        )
    recorder = HoldRecorder(task.config.reference.visits[1], task.num_worlds)
    encoder = task.observation_table.names.index("encoder_angle")
    zero = np.zeros(env.action_space.shape, dtype=np.float32)
    env.reset(seed=seed)
    for step in range(task.num_steps):
        observation, _, terminated, _, info = env.step(zero)
        window = int(np.max(info["rest"]))
        recorder.take(observation[..., encoder], info["link_angle_imu"], window)
        if progress is not None and (step + 1) % _PROGRESS_STEPS == 0:
            progress((step + 1) / task.num_steps)
        if np.any(terminated):
            break
    return recorder.points()


def link_torque(points: StaticPoints, gravity: Sequence[GravityModel], q: Array) -> Array:
    """Gravity torque at link angles q [rad], each under its point's load, (len(points),) [N·m]."""
    torque = np.empty(len(points))
    for load, model in enumerate(gravity):
        rows = points.load == load
        torque[rows] = model.gravity_torque(q[rows, None])[:, 0]
    return torque


HYSTERESIS_RESOLUTION_RAD = 1e-4
"""Differences between the directions of approach below this are not called hysteresis [rad]."""

_SIGN_ITERATIONS = 5
_ANGLE_ITERATIONS = 12  # each gains a digit: the error shrinks by about τ_g′/K
_SINGULAR = 1e-2  # smallest relative singular value of unit columns that are told apart
_RESAMPLES = 999


class Identification(Model):
    """Result of an identification, in `identification.json`; env and compensator take K from it."""

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
    tell it from K.
    """
    line_stiffness_nm_per_rad: float
    """K of a plain line through all points."""
    pearson_r: float
    residual_rad: float
    """Standard deviation of the residuals."""
    hysteresis: bool
    """True if the two directions of approach differ: the 95 % interval of the friction excludes
    zero, and the difference 2 F/K exceeds `HYSTERESIS_RESOLUTION_RAD`."""
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
    """True if the points tell all coefficients apart."""

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
        with_sine_error: Whether an IMU error proportional to sin q is a regressor.
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
    """The fit with τ at the link angles that it implies itself, by iteration from the IMU's angles.

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
    """Link angles from those of an IMU that reads q − offset + sine_error · sin q [rad]."""
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
    if len(positions) < 5 or len(np.unique(points.direction)) < 2:
        raise ElasticError(
            "an identification needs at least 5 positions approached from both sides, got"
            f" {len(positions)} positions and the directions {np.unique(points.direction).tolist()}"
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
    rows = [np.flatnonzero(points.position == position) for position in positions]

    # here: most programs need none of it, and it loads for half a second
    from scipy import stats

    generator = np.random.default_rng(seed)

    def statistics(chosen: IntArray) -> tuple[float, float]:
        while True:
            visits = np.concatenate([rows[i] for i in chosen])
            resampled = fit_points(points.rows(visits), q[visits], torque[visits], with_sine_error)
            if resampled.is_determined:
                return resampled.stiffness, resampled.friction
            # one position over and over determines nothing: draw again
            chosen = generator.integers(len(rows), size=len(rows))

    interval = stats.bootstrap(
        (np.arange(len(positions)),),
        statistics,
        n_resamples=_RESAMPLES,
        vectorized=False,
        method="percentile",
        confidence_level=_expanded_level(len(positions)),
        rng=generator,
    ).confidence_interval
    line: Any = stats.linregress(torque, points.theta - points.q)
    return Identification(
        stiffness_nm_per_rad=fit.stiffness,
        stiffness_low_nm_per_rad=float(interval.low[0]),
        stiffness_high_nm_per_rad=float(interval.high[0]),
        friction_nm=fit.friction,
        friction_low_nm=float(interval.low[1]),
        friction_high_nm=float(interval.high[1]),
        dead_band_rad=float(2.0 * fit.coefficients[2]),
        offset_rad=fit.offset,
        imu_sine_error_rad=fit.imu_sine_error if with_sine_error else None,
        line_stiffness_nm_per_rad=float(1.0 / line.slope),
        pearson_r=float(line.rvalue),
        residual_rad=float(np.std(fit.residuals, ddof=len(fit.coefficients))),
        hysteresis=bool(interval.low[1] > 0.0 or interval.high[1] < 0.0)
        and 2.0 * abs(fit.coefficients[1]) > HYSTERESIS_RESOLUTION_RAD,
        points=len(points),
        positions=len(positions),
    )


def identify(
    envs: Sequence[Any], seed: int | None = None, progress: Callable[[float], None] | None = None
) -> tuple[list[Identification], list[StaticPoints]]:
    """Identify the joint of a testbed environment, or of two that differ in a known mass.

    Args:
        envs: One or two testbeds with reference "hold", scalar or vector.
        seed: Seed of the episodes, of the first world's in a vector environment, and of the
            resampling.
        progress: Called with the share of the work that is done.

    Returns:
        Result and points of every world; one entry each for scalar environments.
    """
    if len(envs) not in {1, 2}:
        raise ConfigurationError(
            f"identification takes one environment or two with different masses, got {len(envs)}"
        )
    parts = []
    for number, env in enumerate(envs):
        share = (
            None if progress is None else (lambda done, n=number: progress((n + done) / len(envs)))
        )
        parts.append(record_points(env, seed, share))
    gravity = [make_gravity(env.unwrapped.assumed_model) for env in envs]
    points = [StaticPoints.join(world) for world in zip(*parts, strict=True)]
    return [identify_points(world, gravity, seed=seed or 0) for world in points], points


def _expanded_level(positions: int, level: float = 0.95) -> float:
    """Level of a percentile interval that covers `level` with few positions.

    There the plain one is too narrow.

    The expanded percentile interval of T. Hesterberg, "What Teachers Should Know About the
    Bootstrap", The American Statistician 69(4), 2015: a t quantile and n/(n − 1) in place of the
    normal quantile.
    """
    # here: most programs need none of it, and it loads for half a second
    from scipy import stats

    t = stats.t.ppf((1.0 + level) / 2.0, positions - 1)
    quantile = np.sqrt(positions / (positions - 1)) * t
    return float(1.0 - 2.0 * stats.norm.sf(quantile))
