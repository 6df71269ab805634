r"""By how much the joints bend more than the model says, r, from what a robot measures.

| estimator | measures | 1 + r |
|---|---|---|
| `LegEstimator` | encoders, foot sensors, IMU | (1 + ρ_roll) (1 + μ) for all joints of a leg but yaw |
| the same | also joint torques | (1 + ρ_roll) (1 + μ) for rolls, (1 + ρ_pitch) (1 + μ) for pitches |
| `EncoderEstimator` | also link encoders | (1 + r_j) (1 + μ) joint by joint |
| `LinkEncoderEstimator` | encoders on motors and links of a robot on a fixed base | 1 + r_j joint by joint |

ρ is the relative error of a leg's compliance by `BendingObserver`, μ the mean excess load of the
feet. Without torque sensors ρ of pitch is left out: friction hides the bending there. Joints
without a link encoder have r_j = 0. r_j is by the regression of
`baselines.estimation.joint_stiffness`. The expected deflection is :math:`h = K^{-1} (\tau +
\tau_F)` with the Coulomb friction, and with the torque of the measured foot wrenches, or of the
motion on a fixed base.
"""  # noqa: E501

from abc import abstractmethod
from typing import Any, NamedTuple, Protocol

import numpy as np
from typing_extensions import override

from baselines.compensation.compensators import GravityCompensator
from baselines.compensation.gravity_torque import make_dynamics
from baselines.compensation.measured import DeflectionSensors
from baselines.compensation.policy import ObservationView
from baselines.estimation.bending import BendingObserver
from baselines.estimation.joint_stiffness import (
    RegressionMemory,
    StiffnessPrior,
    StiffnessRegression,
)
from elastic_env.core.signals import Array, SignalTable
from elastic_env.world.robot_model import RobotModel, WalkerModel

_SEEN = SignalTable(BendingObserver.signals)
_ERROR = _SEEN.group("model_error")
_LOAD = _SEEN.names.index("excess_load")
_ROLL = 0
_PITCH = 1
_AXIS = np.array([_ROLL, _ROLL, _PITCH, _PITCH, _PITCH, _ROLL])  # of the joints of a leg
_BENDS = np.array([0.0, 1.0, 1.0, 1.0, 1.0, 1.0])  # the yaw hardly does
_PRIOR_LOADS = 5.0
"""Number of measurements that the assumed load counts for."""
ARM_PRIOR = StiffnessPrior(own=0.3, noise_rad=0.005)
"""Joints of an arm are less alike than those of two legs, and no foot sensors add errors of
their own.
"""


class Estimator(Protocol):
    """Estimates r from observations; its memory is an array or a named tuple, one row per world."""

    @abstractmethod
    def begin(self, num_worlds: int) -> Any:
        """Memory before the first estimate."""

    @abstractmethod
    def estimate(self, rows: Array, memory: Any) -> tuple[Array, Any]:
        """The correction r of every joint, (num_worlds, n) [1], and the new memory."""


class EstimatorMemory(NamedTuple):
    """Number and sum of the measured excess loads, (num_worlds, 2), and the observer's memory."""

    loads: Array
    observer: Any


class LegEstimator(Estimator):
    """r of each leg by motors, foot sensors and IMU, and by joint torques where there are any.

    Args:
        model: Assumed walker.
        sensors: Joint torque sensors, if it has them.
    """

    def __init__(self, model: WalkerModel, sensors: DeflectionSensors | None = None) -> None:
        self._observer = BendingObserver(model)
        self._sensors = sensors
        self._axis = np.zeros_like(_AXIS) if sensors is None else _AXIS

    @override
    def begin(self, num_worlds: int) -> EstimatorMemory:
        return EstimatorMemory(np.zeros((num_worlds, 2)), self._observer.begin(num_worlds))

    @override
    def estimate(self, rows: Array, memory: EstimatorMemory) -> tuple[Array, EstimatorMemory]:
        bending = None if self._sensors is None else self._sensors.deflection(rows)
        seen, observer = self._observer.observe(rows, memory.observer, bending)
        load, loads = mean_load(memory.loads, seen[:, [_LOAD]])
        error = seen[:, _ERROR].reshape(len(rows), 2, 2)[:, :, self._axis]
        joints = ((1.0 + error) * (1.0 + load[:, :, None]) - 1.0) * _BENDS
        return joints.reshape(len(rows), -1), EstimatorMemory(loads, observer)


class EncoderEstimator(Estimator):
    """r of each joint by link encoders; joints that have none take part in the load alone.

    See the module.

    Args:
        model: Assumed walker.
        sensors: Its link encoders.
    """

    def __init__(self, model: WalkerModel, sensors: DeflectionSensors) -> None:
        self._sensors = sensors
        self._regression = StiffnessRegression(model, StiffnessPrior())
        self._compensator = GravityCompensator(model, output="wrench")
        self._theta = model.observation_table.group("encoder_angle")
        self._stiffness = model.stiffness
        self._wrench = model.observation_table.group("wrench")
        self._carried = model.biped.chains_above_feet.mass * model.biped.gravity

    @override
    def begin(self, num_worlds: int) -> EstimatorMemory:
        return EstimatorMemory(np.zeros((num_worlds, 2)), self._regression.begin(num_worlds))

    @override
    def estimate(self, rows: Array, memory: EstimatorMemory) -> tuple[Array, EstimatorMemory]:
        has = self._sensors.has
        deflection = self._sensors.deflection(rows)
        theta = rows[:, self._theta]
        q = theta - deflection
        friction = self._regression.friction(q, memory.observer)
        modelled = theta - self._compensator.at(rows).link_angle(theta)
        h = modelled + friction / self._stiffness
        error, observer = self._regression.add(
            h, deflection, friction, q, memory.observer, measured=has
        )
        force = rows[:, self._wrench].reshape(len(rows), 2, 2, 3)[:, :, 0, 2]
        excess = force.sum(axis=1, keepdims=True) / self._carried - 1.0
        load, loads = mean_load(memory.loads, excess)
        return (1.0 + has * error) * (1.0 + load) - 1.0, EstimatorMemory(loads, observer)


class LinkEncoderEstimator(Estimator):
    """r of each joint by encoders on all links, see the module.

    Args:
        model: Assumed robot on a fixed base.
        sensors: Its link encoders.
    """

    def __init__(self, model: RobotModel, sensors: DeflectionSensors) -> None:
        self._sensors = sensors
        self._regression = StiffnessRegression(model, ARM_PRIOR)
        self._view = ObservationView(model)
        self._body = make_dynamics(model, GravityCompensator(model).gravity)
        self._stiffness = model.stiffness
        self._viscous = model.viscous_friction

    @override
    def begin(self, num_worlds: int) -> RegressionMemory:
        return self._regression.begin(num_worlds)

    @override
    def estimate(self, rows: Array, memory: RegressionMemory) -> tuple[Array, RegressionMemory]:
        deflection = self._sensors.deflection(rows)
        motion = self._view.motion(rows)
        q = self._view.theta(rows) - deflection
        friction = self._regression.friction(q, memory)
        torque = self._body.inverse_dynamics(q, motion.q_dot, motion.q_ddot)
        torque = torque + self._viscous * motion.q_dot
        h = (torque + friction) / self._stiffness
        return self._regression.add(h, deflection, friction, q, memory, measured=self._sensors.has)


def make_estimator(model: RobotModel, sensors: DeflectionSensors) -> Estimator:
    """The estimator that makes the most of a robot's sensors."""
    if not isinstance(model, WalkerModel):
        return LinkEncoderEstimator(model, sensors)
    if sensors.are_torques:
        return LegEstimator(model, sensors)
    return EncoderEstimator(model, sensors)


def mean_load(memory: Array, excess: Array, prior: float = _PRIOR_LOADS) -> tuple[Array, Array]:
    """Mean excess load of the feet, (num_worlds, 1) [1], and the new number and sum.

    Args:
        memory: Number and sum, (num_worlds, 2).
        excess: Measured over assumed load less one, (num_worlds, 1) [1].
        prior: Number of measurements that the assumed load counts for.
    """
    memory = memory + np.hstack([np.ones_like(excess), excess])
    return memory[:, 1:] / (prior + memory[:, :1]), memory
