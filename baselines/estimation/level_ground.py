r"""IMU and foot sensors of a walker, corrected to level ground.

In the frame of feet that lie flat, the force of the ground f carries the mass and accelerates it.
Its direction without the acceleration of the center of mass c is the tilt of the ground λ. It does
not depend on the bending of the joints:

.. math:: \lambda = \overline{f_{xy} / f_z - \ddot c_{xy} / g}

as rotations about x and y (λ_y, −λ_x). f is in the frame of the feet and c in the one of the
pelvis, which is parallel except for the bending of the joints. The mean of the acceleration over a
time t is a difference of velocities, which the motors give with a standard deviation σ_v. With the
prior σ_λ the best estimate is λ / (1 + (σ_v / g t σ_λ)²). The weight leans too, and acts at the
center of mass, h over the ankles. Set upright, it gives the wrenches of level ground at the ankles,

.. math:: f' = R f, \qquad m' = m + h \hat z \times (f' - f)

A leaning weight bends the legs further than an upright one, s and s' by the model
(`baselines.estimation.model_error`), each leg by its share w of the load. Level ground excludes
that too, so that the robot's own tilt is

.. math:: \text{attitude} - \lambda - \sum_{legs} w (s - s')

In double support this overestimates the tilt about x, where a leaning weight changes the load
shares instead of bending the ankles.
"""

from typing import Any, NamedTuple

import numpy as np

from baselines.compensation.filters import filter_share
from baselines.estimation.model_error import LOADED_SHARE, BendingObserver
from elastic_env.core.signals import Array, rename_group
from elastic_env.rigid.leg_kinematics import rotation_of_tilt
from elastic_env.world.robot_model import WalkerModel

TILT_RAD = 0.01
VELOCITY_M_PER_S = 0.07
"""Standard deviations σ_λ of the tilt before the first measurement, and σ_v of a velocity."""

_DIFFERENCE_S = 1e-3
"""Time step of finite differences [s]."""


class GroundMemory(NamedTuple):
    """Memory of the tilt of the ground.

    Attributes:
        number: Measurements in the mean, (num_worlds,).
        mean: Mean of the tilt about x and y, (num_worlds, 2) [rad].
        velocity: Last velocity of the center of mass, (num_worlds, 2) [m/s]; nan before the first.
    """

    number: Array
    mean: Array
    velocity: Array


class LevelGround:
    """Attitude and foot wrenches without the tilt of the ground, from the observations of a walker.

    Args:
        model: Assumed walker.
        period_s: Time between measurements [s].
        mean_s: Time constant of the mean [s]; before as much time, all measurements count equally.
    """

    def __init__(self, model: WalkerModel, period_s: float, mean_s: float = 6) -> None:
        table = model.observation_table
        self._attitude = table.group("imu_attitude")
        self._wrench = table.group("wrench")
        own_tilt = rename_group(table.signals_of("imu_attitude"), "own_tilt")
        wrench = rename_group(table.signals_of("wrench"), "level_wrench")
        self.signals = (*own_tilt, *wrench)
        """Values of `observe`."""
        self._theta = table.group("encoder_angle")
        self._rate = table.group("encoder_rate")
        self._carried = model.biped.chains_above_feet
        self._bending = BendingObserver(model)
        self._least_n = LOADED_SHARE * model.biped.weight
        self._period_s = period_s
        self._gravity = model.biped.gravity
        self._least_gain = filter_share(period_s, mean_s)

    def begin(self, num_worlds: int) -> GroundMemory:
        """Memory before the first measurement."""
        mean = np.zeros((num_worlds, 2))
        return GroundMemory(np.zeros(num_worlds), mean, np.full_like(mean, np.nan))

    def observe(self, rows: Array, memory: GroundMemory) -> tuple[Array, GroundMemory]:
        """Values after a measurement, see `signals`, and the new memory.

        Args:
            rows: Observations, (num_worlds, m).
            memory: Memory of the last measurement.
        """
        tilt, wrenches, memory = self.upright(rows, memory)
        level = rows.copy()
        level[:, self._attitude] -= tilt
        level[:, self._wrench] = wrenches
        load = np.maximum(rows[:, self._wrench].reshape(-1, 2, 2, 3)[:, :, 0, 2], 0.0)
        share = load / np.maximum(load.sum(axis=1, keepdims=True), self._least_n)
        further = self._bending.expected_tilt(rows) - self._bending.expected_tilt(level)
        own_tilt = level[:, self._attitude] - (share[..., None] * further).sum(axis=1)
        return np.hstack([own_tilt, wrenches]), memory

    def upright(self, rows: Array, memory: GroundMemory) -> tuple[Array, Array, Any]:
        """Tilt of the ground [rad], level foot wrenches, (num_worlds, 12), and new memory."""
        n = len(rows)
        wrench = rows[:, self._wrench].reshape(n, 2, 2, 3)
        force = wrench[:, :, 0]
        moment = wrench[:, :, 1]
        over_ankles, velocity = self._center_of_mass(rows, force[..., 2])
        mean, number = self._mean(force.sum(axis=1), velocity, memory)
        change = self._gravity * TILT_RAD * self._period_s * number
        certainty = change**2 / (change**2 + VELOCITY_M_PER_S**2)
        tilt = mean * certainty[:, None]
        upright = force @ rotation_of_tilt(tilt).swapaxes(-1, -2)
        x, y = np.moveaxis(over_ankles * (upright - force)[..., :2], -1, 0)
        level_moment = moment + np.stack([-y, x, np.zeros_like(x)], axis=-1)
        wrenches = np.stack([upright, level_moment], axis=2).reshape(n, -1)
        return tilt, wrenches, GroundMemory(number, mean, velocity)

    def _mean(self, force: Array, velocity: Array, memory: Any) -> tuple[Array, Array]:
        """Mean after a measurement, about x and y [rad], and the number of measurements in it."""
        has_velocity = np.isfinite(memory.velocity).all(axis=1)
        is_known = (force[:, 2] >= self._least_n) & has_velocity
        accelerated = (velocity - memory.velocity) / (self._period_s * self._gravity)
        direction = force[:, :2] / np.where(is_known, force[:, 2], np.inf)[:, None]
        lean = direction - np.where(is_known[:, None], accelerated, 0.0)
        number = memory.number + is_known
        gain = is_known * np.maximum(1.0 / np.maximum(number, 1.0), self._least_gain)
        tilt = np.stack([lean[:, 1], -lean[:, 0]], axis=1)
        return memory.mean + gain[:, None] * (tilt - memory.mean), number

    def _center_of_mass(self, rows: Array, load: Array) -> tuple[Array, Array]:
        """Center of mass over the ankles: height [m], and velocity against the loaded one [m/s].

        Shapes are (n, 2, 1) and (n, 2).
        """
        theta = rows[:, self._theta]
        rate = rows[:, self._rate]
        com, ankles = self._carried.com_and_feet(
            np.concatenate([theta, theta + _DIFFERENCE_S * rate])
        )
        present, future = np.split(com[:, None] - ankles, 2)
        velocity = (future - present)[..., :2] / _DIFFERENCE_S
        return present[..., 2:], velocity[np.arange(len(rows)), np.argmax(load, axis=1)]
