"""Sensors of a robot: motor encoders with counts, and IMUs.

An `AttitudeSensor` shows the true attitude with errors. An `InertialSensor` computes it from a
gyroscope and an accelerometer, as a device does, so that the acceleration of what carries it
disturbs it. `PendulumImu` plays one on a link that hangs from a horizontal axis.
"""

import math
from typing import Any

import numpy as np
from numpy.random import Generator

from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, BoolArray, IntArray
from elastic_env.world import control_kernels as kernels
from elastic_env.world.control_kernels import in_whole_counts, shown_angle


class AttitudeSensor(Model):
    """IMU attitude of one axis: bias, white noise, and a sample rate up to the control rate."""

    noise_rad: float = quantity("rad", 0.0, ge=0)
    """Standard deviation of the white noise [rad]."""
    bias_rad: float = quantity("rad", 0.0)
    """Constant offset [rad]."""
    sine_error_rad: float = quantity("rad", 0.0)
    """Amplitude of an error proportional to sin(angle) [rad]."""
    rate_hz: float = quantity("Hz", 100.0, gt=0)
    """Sample rate; the value is held in between [Hz]."""


_G = 9.80665
"""Standard gravity [m/s²]."""


class InertialSensor(Model):
    r"""IMU that computes its attitude from gyroscope and accelerometer; by default the 3DM-GX4-25.

    Its filter is the explicit complementary filter of [Mahony2008] for the vertical u, without
    estimation of the bias: it integrates the gyroscope's rate ω, and turns towards the
    accelerometer's specific force f with a time constant τ. A bias b of the gyroscope tilts it by b
    τ, an acceleration a by atan(a/g), both as a first-order lag.

    .. math:: \dot u = u \times (\omega + \tfrac{1}{\tau} \, f / |f| \times u)

    The device reports this filter's attitude beside that of a Kalman filter whose model is not
    published. Its time constant for the vertical is a setting of 1 to 1000 s, 10 s by default (LORD
    3DM-GX5-35 DCP manual, 4.2.21, command 0x0C 0x51, of which it says that it is the same algorithm
    in this family of devices).

    Figures of the data sheet with ± are typical ones: they are taken as standard deviations of a
    normal distribution. Noise and in-run bias of the gyroscope are 0.005 °/s/√Hz and ±10 °/h, noise
    and initial bias of the accelerometer 100 µg/√Hz and ±0.002 g, attitude ±0.25° at rest and ±0.5°
    in motion (LORD 3DM-GX4-25 data sheet; the noises and the bias of the accelerometer also in
    thormang3_imu_3dm_gx4, calib). The initial bias of the gyroscope is left out: the device takes
    it away by a capture at rest (command 0x0C 0x39).

    What the bias of both sensors leaves of the error at rest is drawn as an offset: alignment,
    scale and mounting.
    """

    gyro_noise_density: float = quantity("rad/s/√Hz", math.radians(0.005), ge=0)
    """Noise density of the gyroscope [rad/s/√Hz]."""
    gyro_bias_rad_s: float = quantity("rad/s", math.radians(10.0) / 3600.0, ge=0)
    """Standard deviation of the gyroscope's bias [rad/s]."""
    accelerometer_noise_density: float = quantity("m/s²/√Hz", 100e-6 * _G, ge=0)
    """Noise density of the accelerometer [m/s²/√Hz]."""
    accelerometer_bias_m_s2: float = quantity("m/s²", 0.002 * _G, ge=0)
    """Standard deviation of the accelerometer's bias [m/s²]."""
    static_error_rad: float = quantity("rad", math.radians(0.25), ge=0)
    """Standard deviation of roll's and pitch's error at rest [rad]."""
    time_constant_s: float = quantity("s", 10.0, gt=0)
    """Time constant of the complementary filter [s]."""
    bandwidth_hz: float = quantity("Hz", 125.0, gt=0)
    """Of the noise: half the control rate of 250 Hz [Hz]."""

    def _check(self) -> None:
        if self.static_error_rad < self._error_by_bias_rad:
            raise ValueError(
                "static_error_rad must be at least what the biases make of it,"
                f" {self._error_by_bias_rad:.3g} rad, got {self.static_error_rad:g}; lower"
                " accelerometer_bias_m_s2, gyro_bias_rad_s or time_constant_s"
            )

    @property
    def gyro_noise_rad_s(self) -> float:
        """Standard deviation of the gyroscope's mean over a control period [rad/s]."""
        return self.gyro_noise_density * math.sqrt(self.bandwidth_hz)

    @property
    def accelerometer_noise_rad(self) -> float:
        """Standard deviation of roll and pitch by the accelerometer's mean over a period [rad].

        Only noise across the vertical tilts the attitude, that along it has no effect to first
        order.
        """
        return self.accelerometer_noise_density * math.sqrt(self.bandwidth_hz) / _G

    @property
    def offset_rad(self) -> float:
        """Standard deviation of the offset of roll and pitch [rad]."""
        rest = self.static_error_rad**2 - self._error_by_bias_rad**2
        return math.sqrt(max(rest, 0.0))

    @property
    def _error_by_bias_rad(self) -> float:
        by_accelerometer = self.accelerometer_bias_m_s2 / _G
        return math.hypot(by_accelerometer, self.gyro_bias_rad_s * self.time_constant_s)


def quantise(angle: Array, count_rad: Array | float) -> Array:
    """Angle of an encoder in whole counts.

    Args:
        angle: (...) [rad].
        count_rad: Angle of a count, one for all or what goes with the shape of `angle` [rad]; 0 for
            none.

    Returns:
        (...) [rad].
    """
    has_counts = np.asarray(count_rad) > 0.0
    counted = in_whole_counts(angle, np.where(has_counts, count_rad, 1.0))
    return np.where(has_counts, counted, angle)


def angle_of_count(counts_per_turn: int | None) -> float:
    """One count of an encoder [rad]; 0 for one without counts."""
    return 0.0 if counts_per_turn is None else 2.0 * np.pi / counts_per_turn


def attitude(sensor: AttitudeSensor, angle: Array, drawn_bias: Array, noise: Array) -> Array:
    """Measured angle of the attitude sensor.

    Args:
        sensor: Its parameters.
        angle: True angle, (...) [rad].
        drawn_bias: Further offset of this episode, (...) [rad].
        noise: Standard normal samples, (...) [1].

    Returns:
        (...) [rad].
    """
    added = sensor.noise_rad * noise
    return shown_angle(angle, drawn_bias, added, sensor.bias_rad, sensor.sine_error_rad)


def is_due(step: IntArray, rate_hz: float, control_period_s: float) -> BoolArray:
    """True at the control steps at which a sensor of its own rate delivers a sample, (n,).

    Step 0, the start of an episode, always does; a sensor faster than the control loop does at
    every step.
    """
    samples_per_step = rate_hz * control_period_s
    # the small shift keeps a rate that divides the control rate exact in floating point
    now = np.floor(step * samples_per_step + 1e-9)
    return (step == 0) | (now > np.floor((step - 1) * samples_per_step + 1e-9))


class NoiseStream:
    """Standard normal samples, one independent stream per world, drawn in blocks.

    World i's samples depend on its generator and on how many it has used, never on the other
    worlds.

    Args:
        num_worlds: How many.
        kind: Structured type of a sample, of real numbers alone.
        block: Samples that are drawn at once.

    Attributes:
        samples: Those ahead and those used, (block, num_worlds).
        used: How many of each world's are used, (num_worlds,): its next one has that number.
    """

    def __init__(self, num_worlds: int, kind: np.dtype[Any], block: int = 250) -> None:
        # samples of a time are neighbours in memory: worlds mostly use theirs together
        self.samples = np.zeros((block, num_worlds), kind)
        self.used = np.zeros(num_worlds, dtype=np.int64)
        self._world = np.arange(num_worlds)
        self._most_used = 0
        self._generators = [np.random.default_rng(0) for _ in range(num_worlds)]

    def restart(self, world: int, generator: Generator) -> None:
        """Begin a new stream for one world."""
        self._generators[world] = generator
        self._refill(world)

    def next(self, worlds: BoolArray) -> Any:
        """The next sample of some worlds, (num_worlds,).

        The rows of the others are not to be used.
        """
        self.make_ready()
        sample = self.samples[np.minimum(self.used, len(self.samples) - 1), self._world]
        self.used += worlds
        return sample

    def make_ready(self) -> None:
        """Have at least one sample of each world ahead, for one step; who takes it counts it."""
        block = len(self.samples)
        if self._most_used >= block:
            for world in np.flatnonzero(self.used == block):
                self._refill(int(world))
            self._most_used = int(self.used.max())
        self._most_used += 1

    def _refill(self, world: int) -> None:
        kind = self.samples.dtype
        shape = (len(self.samples), kind.itemsize // 8)
        drawn = self._generators[world].standard_normal(shape)
        self.samples[:, world] = drawn.view(kind)[:, 0]
        self.used[world] = 0


_PENDULUM_NOISE = np.dtype([("rate", np.float64), ("force", np.float64, (2,))])
"""A sample of noise: of the gyroscope, and of the accelerometer along both axes in the plane of
the motion [1].
"""


class PendulumImu:
    r"""An `InertialSensor` on a link that hangs from a horizontal axis at q = 0, and turns with it.

    In the frame of the link, x along its motion and z towards the axis, the vertical is (sin q, 0,
    cos q). The specific force at a distance r from the axis is

    .. math:: f = (r \ddot q + g \sin q, \; 0, \; r \dot q^2 + g \cos q)

    The gyroscope shows the mean rate over a control period, the accelerometer the mean tangential
    acceleration.

    Args:
        sensor: Its errors and its filter.
        arm_m: r [m].
        gravity_m_s2: g [m/s²].
        period_s: Control period [s].
        num_worlds: How many.
    """

    def __init__(
        self,
        sensor: InertialSensor,
        arm_m: float,
        gravity_m_s2: float,
        period_s: float,
        num_worlds: int,
    ) -> None:
        self._sensor = sensor
        self._arm_m = arm_m
        self._gravity = gravity_m_s2
        self._period_s = period_s
        self._gain = 1.0 - math.exp(-period_s / sensor.time_constant_s)
        self._up = np.zeros((num_worlds, 3))
        self._last = np.zeros((num_worlds, 2))
        # of the gyroscope, then of the accelerometer along x and z
        self._bias = np.zeros((num_worlds, 3))
        self._noise = NoiseStream(num_worlds, _PENDULUM_NOISE)

    def draw(self, world: int, generator: Generator, noise: Generator) -> float:
        """Draw the errors of an episode; the caller adds the returned offset [rad]."""
        sensor = self._sensor
        gyro, x, z, offset = generator.standard_normal(4)
        force = sensor.accelerometer_bias_m_s2
        self._bias[world] = sensor.gyro_bias_rad_s * gyro, force * x, force * z
        self._noise.restart(world, noise)
        return float(sensor.offset_rad * offset)

    def settle(self, worlds: BoolArray, q: Array) -> None:
        """The links of some worlds have been at rest at q, (num_worlds,) [rad], for long."""
        at_rest = np.zeros_like(q)
        self._last[worlds] = np.stack([q, at_rest], axis=1)[worlds]
        for world in np.flatnonzero(worlds):
            force = self._force(q, at_rest, at_rest)[world]
            gyro = np.array([0.0, -self._bias[world, 0], 0.0])
            delay_s = self._sensor.time_constant_s
            kernels.settled_vertical(self._up[world], force, gyro, delay_s)

    def advance(self, worlds: BoolArray, q: Array, q_dot: Array) -> None:
        """Advance by a control period to angles q [rad] and rates q̇ [rad/s], (num_worlds,)."""
        drawn = self._noise.next(worlds)
        last = self._last
        sensor = self._sensor
        force = self._force(q, q_dot, (q_dot - last[:, 1]) / self._period_s)
        force[:, ::2] += sensor.accelerometer_noise_rad * self._gravity * drawn["force"]
        error = self._bias[:, 0] + sensor.gyro_noise_rad_s * drawn["rate"]
        turned = q - last[:, 0] + self._period_s * error
        for world in np.flatnonzero(worlds):
            about_y = np.array([0.0, -turned[world], 0.0])
            seen = (about_y, force[world], self._gain)
            kernels.complementary_filter(self._up[world], *seen)
        self._last[worlds] = np.stack([q, q_dot], axis=1)[worlds]

    @property
    def angle(self) -> Array:
        """Link angle by the filter, (num_worlds,) [rad]."""
        return np.arctan2(self._up[:, 0], self._up[:, 2])

    def _force(self, q: Array, q_dot: Array, q_ddot: Array) -> Array:
        """Specific force with its bias in the frame of the link, (num_worlds, 3) [m/s²]."""
        r = self._arm_m
        g = self._gravity
        tangential = r * q_ddot + g * np.sin(q) + self._bias[:, 1]
        radial = r * np.square(q_dot) + g * np.cos(q) + self._bias[:, 2]
        return np.stack([tangential, np.zeros_like(q), radial], axis=1)
