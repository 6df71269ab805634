"""Sensors of a robot: motor encoders with counts, and IMUs.

An `AttitudeSensor` measures the true attitude with errors. An `InertialSensor` computes the
attitude from a gyroscope and an accelerometer, as a real device does. So the acceleration of its
carrier disturbs it, see `elastic_env.world.pendulum_imu`.
"""

import math

import numpy as np

from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, BoolArray, IntArray
from elastic_env.world.joint_kernels import measured_angle, round_to_counts


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
