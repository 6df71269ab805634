"""An IMU that computes its attitude, on a link that hangs from a horizontal axis."""

import math

import numpy as np
from numpy.random import Generator

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, BoolArray
from elastic_env.world import attitude_kernels as kernels
from elastic_env.world.joint_config import JointConfig
from elastic_env.world.joint_plant import JointPlant
from elastic_env.world.noise_stream import NoiseStream
from elastic_env.world.sensors import InertialSensor

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


def make_pendulum_imu(
    config: JointConfig, plant: JointPlant, num_worlds: int
) -> PendulumImu | None:
    """Make the IMU that computes its attitude; None in scenarios without one.

    Raises:
        ConfigurationError: The robot has no place for it.
    """
    scenario = config.scenario
    if all(part.inertial_share == 0.0 for part in scenario.parts):
        return None
    if any(part.inertial_share < 1.0 for part in scenario.parts):
        raise ConfigurationError(
            f"scenario {scenario.name!r} gives only some robots an IMU that computes"
            " its attitude; only the walker supports that, set inertial_share to 0 or 1"
        )
    if plant.imu_arm_m is None:
        raise ConfigurationError(
            f"scenario {scenario.name!r} is about the IMU on a link, which {plant.name}"
            " does not have; choose another one, or the testbed or the walker"
        )
    gravity = float(np.linalg.norm(plant.model.opt.gravity))
    place = (plant.imu_arm_m, gravity, config.control_period_s)
    return PendulumImu(scenario.inertial, *place, num_worlds)
