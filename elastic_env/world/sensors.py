"""Sensors of a robot: motor encoders with counts, and IMUs.

An `AttitudeSensor` measures the true attitude with errors. An `InertialSensor` computes the
attitude from a gyroscope and an accelerometer, as a real device does. So the acceleration of its
carrier disturbs it. `PendulumImu` simulates one on a link that hangs from a horizontal axis.
"""

import math
from typing import Any

import numpy as np
from numpy.random import Generator

from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, BoolArray, IntArray
from elastic_env.world import control_kernels as kernels
from elastic_env.world.control_kernels import measured_angle, round_to_counts


class AttitudeSensor(Model):
    """Attitude of one axis by an IMU: bias, white noise, sample rate up to the control rate."""

    noise_rad: float = quantity("rad", 0.0, ge=0)
    """Standard deviation of the white noise [rad]."""
    bias_rad: float = quantity("rad", 0.0)
    """Constant offset [rad]."""
    sine_error_rad: float = quantity("rad", 0.0)
    """Amplitude of an error proportional to sin(angle) [rad]."""
    rate_hz: float = quantity("Hz", 100.0, gt=0)
    """Sample rate; between samples the value is held [Hz]."""


_G = 9.80665
"""Standard gravity [m/s²]."""


class InertialSensor(Model):
    r"""IMU that computes its attitude from gyroscope and accelerometer; by default the 3DM-GX4-25.

    Its filter is the explicit complementary filter of [Mahony2008] for the vertical u, without
    estimation of the bias. It integrates the gyroscope's rate ω, and turns towards the
    accelerometer's specific force f with a time constant τ. A bias b of the gyroscope tilts it by b
    τ, an acceleration a tilts it by atan(a/g), both as a first-order lag.

    .. math:: \dot u = u \times (\omega + \tfrac{1}{\tau} \, f / |f| \times u)

    The device reports the attitude of this filter and that of a Kalman filter whose model is not
    published. The time constant for the vertical can be set from 1 to 1000 s; the default is 10 s.
    The source is the LORD 3DM-GX5-35 DCP manual, 4.2.21, command 0x0C 0x51. It says that the
    algorithm is the same in this family of devices.

    Figures with ± in the data sheet are typical values. They are used as standard deviations of a
    normal distribution. The gyroscope has a noise of 0.005 °/s/√Hz and an in-run bias of ±10 °/h.
    The accelerometer has a noise of 100 µg/√Hz and an initial bias of ±0.002 g. The attitude has an
    error of ±0.25° at rest and ±0.5° in motion (LORD 3DM-GX4-25 data sheet; the noises and the bias
    of the accelerometer are also in thormang3_imu_3dm_gx4, calib). The initial bias of the
    gyroscope is zero here, because the device removes it by a capture at rest (command 0x0C 0x39).

    The part of the error at rest that the biases do not explain is drawn as an offset: alignment,
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
    """Bandwidth of the noise: half the control rate of 250 Hz [Hz]."""

    def _check(self) -> None:
        if self.static_error_rad < self._bias_tilt_rad:
            raise ValueError(
                "static_error_rad must be at least what the biases make of it,"
                f" {self._bias_tilt_rad:.3g} rad, got {self.static_error_rad:g}; lower"
                " accelerometer_bias_m_s2, gyro_bias_rad_s or time_constant_s"
            )

    @property
    def gyro_noise_rad_s(self) -> float:
        """Standard deviation of the gyroscope's mean over a control period [rad/s]."""
        return self.gyro_noise_density * math.sqrt(self.bandwidth_hz)

    @property
    def accelerometer_noise_rad(self) -> float:
        """Standard deviation of roll and pitch by the accelerometer's mean over a period [rad].

        Only noise across the vertical tilts the attitude. Noise along the vertical has no effect to
        first order.
        """
        return self.accelerometer_noise_density * math.sqrt(self.bandwidth_hz) / _G

    @property
    def offset_rad(self) -> float:
        """Standard deviation of the offset of roll and pitch [rad]."""
        return math.sqrt(max(self.static_error_rad**2 - self._bias_tilt_rad**2, 0.0))

    @property
    def _bias_tilt_rad(self) -> float:
        by_accelerometer = self.accelerometer_bias_m_s2 / _G
        return math.hypot(by_accelerometer, self.gyro_bias_rad_s * self.time_constant_s)


def quantise(angle: Array, count_rad: Array | float) -> Array:
    """Angle of an encoder in whole counts.

    Args:
        angle: (...) [rad].
        count_rad: Angle of a count, one for all or an array that broadcasts with `angle` [rad]; 0
            for a continuous encoder.

    Returns:
        (...) [rad].
    """
    has_counts = np.asarray(count_rad) > 0.0
    counted = round_to_counts(angle, np.where(has_counts, count_rad, 1.0))
    return np.where(has_counts, counted, angle)


def angle_of_count(counts_per_turn: int | None) -> float:
    """Angle of an encoder count [rad]; 0 for a continuous encoder."""
    return 0.0 if counts_per_turn is None else 2.0 * np.pi / counts_per_turn


def attitude(sensor: AttitudeSensor, angle: Array, drawn_bias: Array, noise: Array) -> Array:
    """Angle that an attitude sensor measures.

    Args:
        sensor: Parameters of the sensor.
        angle: True angle, (...) [rad].
        drawn_bias: Further offset of this episode, (...) [rad].
        noise: Standard normal samples, (...) [1].

    Returns:
        (...) [rad].
    """
    error = sensor.noise_rad * noise
    return measured_angle(angle, drawn_bias, error, sensor.bias_rad, sensor.sine_error_rad)


def is_due(step: IntArray, rate_hz: float, control_period_s: float) -> BoolArray:
    """Return True at the control steps at which a sensor with its own rate delivers a sample, (n,).

    Step 0, the start of an episode, always has a sample. A sensor faster than the control loop
    delivers a sample at every step.
    """
    samples_per_step = rate_hz * control_period_s
    # the small shift keeps a rate that divides the control rate exact in floating point
    samples = np.floor(step * samples_per_step + 1e-9)
    return (step == 0) | (samples > np.floor((step - 1) * samples_per_step + 1e-9))


class NoiseStream:
    """Standard normal samples, one independent stream per world, drawn in blocks.

    The samples of a world depend on its generator and on how many it has used, never on the other
    worlds.

    Args:
        num_worlds: Number of worlds.
        record: Structured type of a sample, with real numbers only.
        block: Samples that are drawn at once.

    Attributes:
        samples: Samples of the present block, (block, num_worlds).
        used: Number of used samples of each world, (num_worlds,), which is the index of the next.
    """

    def __init__(self, num_worlds: int, record: np.dtype[Any], block: int = 250) -> None:
        # samples of a step are neighbours in memory: worlds mostly use theirs together
        self.samples = np.zeros((block, num_worlds), record)
        self.used = np.zeros(num_worlds, dtype=np.int64)
        self._world = np.arange(num_worlds)
        self._most_used = 0
        self._generators = [np.random.default_rng(0) for _ in range(num_worlds)]

    def restart(self, world: int, generator: Generator) -> None:
        """Begin a new stream for one world."""
        self._generators[world] = generator
        self._refill(world)

    def next(self, worlds: BoolArray) -> Any:
        """Return the next sample of some worlds, (num_worlds,).

        The rows of the other worlds are not valid.
        """
        self.prepare()
        sample = self.samples[np.minimum(self.used, len(self.samples) - 1), self._world]
        self.used += worlds
        return sample

    def prepare(self) -> None:
        """Make sure that each world has an unused sample; its user increments `used`."""
        block = len(self.samples)
        if self._most_used >= block:
            for world in np.flatnonzero(self.used == block):
                self._refill(int(world))
            self._most_used = int(self.used.max())
        self._most_used += 1

    def _refill(self, world: int) -> None:
        record = self.samples.dtype
        shape = (len(self.samples), record.itemsize // 8)
        numbers = self._generators[world].standard_normal(shape)
        self.samples[:, world] = numbers.view(record)[:, 0]
        self.used[world] = 0


_PENDULUM_NOISE = np.dtype([("rate", np.float64), ("force", np.float64, (2,))])
"""A noise sample: gyroscope, and accelerometer along both axes in the plane of the motion [1]."""


class PendulumImu:
    r"""An `InertialSensor` on a link that hangs at q = 0 from a horizontal axis.

    In the frame of the link, x along its motion and z towards the axis, the vertical is (sin q, 0,
    cos q). The specific force at a distance r from the axis is

    .. math:: f = (r \ddot q + g \sin q, \; 0, \; r \dot q^2 + g \cos q)

    The gyroscope measures the mean rate over a control period. The accelerometer measures the mean
    tangential acceleration.

    Args:
        sensor: Errors and filter of the IMU.
        arm_m: r [m].
        gravity_m_s2: g [m/s²].
        period_s: Control period [s].
        num_worlds: Number of worlds.
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
        # biases of the gyroscope, then of the accelerometer along x and z
        self._bias = np.zeros((num_worlds, 3))
        self._noise = NoiseStream(num_worlds, _PENDULUM_NOISE)

    def draw(self, world: int, generator: Generator, noise: Generator) -> float:
        """Draw the errors of an episode, and return an offset that the caller adds [rad]."""
        sensor = self._sensor
        gyro, x, z, offset = generator.standard_normal(4)
        force = sensor.accelerometer_bias_m_s2
        self._bias[world] = sensor.gyro_bias_rad_s * gyro, force * x, force * z
        self._noise.restart(world, noise)
        return float(sensor.offset_rad * offset)

    def settle(self, worlds: BoolArray, q: Array) -> None:
        """Settle the filter in some worlds, whose links rest at q, (num_worlds,) [rad]."""
        at_rest = np.zeros_like(q)
        self._last[worlds] = np.stack([q, at_rest], axis=1)[worlds]
        for world in np.flatnonzero(worlds):
            force = self._force(q, at_rest, at_rest)[world]
            gyro = np.array([0.0, -self._bias[world, 0], 0.0])
            delay_s = self._sensor.time_constant_s
            kernels.settled_vertical(self._up[world], force, gyro, delay_s)

    def advance(self, worlds: BoolArray, q: Array, q_dot: Array) -> None:
        """Advance by a control period to angles q [rad] and rates q̇ [rad/s], (num_worlds,)."""
        noise = self._noise.next(worlds)
        last = self._last
        sensor = self._sensor
        force = self._force(q, q_dot, (q_dot - last[:, 1]) / self._period_s)
        force[:, ::2] += sensor.accelerometer_noise_rad * self._gravity * noise["force"]
        error = self._bias[:, 0] + sensor.gyro_noise_rad_s * noise["rate"]
        turned = q - last[:, 0] + self._period_s * error
        for world in np.flatnonzero(worlds):
            about_y = np.array([0.0, -turned[world], 0.0])
            up = self._up[world]
            kernels.complementary_filter(up, about_y, force[world], self._gain)
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
