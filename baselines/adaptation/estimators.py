r"""Estimates of r, by how much the joints bend more than the model predicts, from measurements.

| estimator | measures | 1 + r |
|---|---|---|
| `LegEstimator` | encoders, foot sensors, IMU | (1 + ρ_roll) (1 + μ) for all joints of a leg but yaw |
| the same | also joint torques | (1 + ρ_roll) (1 + μ) for rolls, (1 + ρ_pitch) (1 + μ) for pitches |
| `LegEncoderEstimator` | also link encoders | (1 + r_j) (1 + μ) joint by joint |
| `EncoderEstimator` | encoders on motors and links of a robot on a fixed base | 1 + r_j joint by joint |

ρ is the relative error of a leg's compliance by `BendingObserver`, μ the mean excess load of the
feet. Without torque sensors ρ of pitch is not used: friction hides the bending there. Joints
without a link encoder have r_j = 0. The regression below estimates r_j. The expected deflection is
:math:`h = K^{-1} (\tau + \tau_F)` with the Coulomb friction, and with the torque of the measured
foot wrenches, or of the motion on a fixed base.

**Regression.** The Coulomb friction :math:`\tau_F` changes its sign over a short displacement of
the link [Dahl1968]. Sensors measure

.. math:: \delta = (1 + r) h + c

with c for homing errors. This is linear regression of δ − h on h, joint by joint, after every
measurement. By its prior the joints of a robot are alike: :math:`r \sim N(0, \sigma_c^2
\mathbf{1}\mathbf{1}^T + \sigma_i^2 I)`, so that the estimate of joints without load follows the
others [Gelman2013, chapter 15]. The normal matrix is diagonal plus a matrix of rank one. The matrix
inversion lemma gives its solution in closed form.

[Dahl1968] P. R. Dahl, "A Solid Friction Model", The Aerospace Corporation, TOR-0158(3107-18)-1.
[Gelman2013] A. Gelman et al., "Bayesian Data Analysis", 3rd edition.
"""  # noqa: E501

from abc import abstractmethod
from typing import Any, NamedTuple, Protocol

import numpy as np
from typing_extensions import override

from baselines.compensation.compensators import GravityCompensator
from baselines.compensation.dry_friction import presliding_friction
from baselines.compensation.gravity_torque import make_gravity
from baselines.compensation.measured import DeflectionSensors
from baselines.compensation.policy import ObservationView
from baselines.estimation.model_error import BendingObserver
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, SignalTable
from elastic_env.world.robot_model import RobotModel, WalkerModel


class StiffnessPrior(Model):
    """Knowledge of the joints before they are measured, as standard deviations."""

    common: float = quantity("1", 0.5, gt=0)
    """Relative error that all joints share [1]."""
    own: float = quantity("1", 0.1, gt=0)
    """Relative error of a single joint in addition [1]."""
    offset_rad: float = quantity("rad", 0.002, gt=0)
    """Offset of a measured deflection [rad]."""
    noise_rad: float = quantity("rad", 0.01, gt=0)
    """Model error of a measured deflection [rad]."""


def regress(sums: Array, prior: StiffnessPrior) -> Array:
    """Relative errors r of the joints by the regression of the module.

    Args:
        sums: Number of measurements, and sums of h, h², y = δ − h, and h y of each joint, (5, ...,
            n), with h in [rad].
        prior: Standard deviations.

    Returns:
        (..., n) [1].
    """
    number, h, hh, y, hy = sums
    weight = number + (prior.noise_rad / prior.offset_rad) ** 2  # c is eliminated
    information = (hh - h * h / weight) / prior.noise_rad**2
    right_side = (hy - h * y / weight) / prior.noise_rad**2
    own = prior.own**2
    common = prior.common**2
    n = h.shape[-1]
    diagonal = 1.0 / own + information
    rank_one = common / (own * (own + n * common))
    diagonal_solution = right_side / diagonal
    ratio = rank_one / diagonal
    total = diagonal_solution.sum(axis=-1) / (1.0 - ratio.sum(axis=-1))
    return diagonal_solution + ratio * total[..., None]


_BENDING = SignalTable(BendingObserver.signals)
_ERROR = _BENDING.group("model_error")
_LOAD = _BENDING.names.index("excess_load")
_AXIS = np.array([0, 0, 1, 1, 1, 0])  # roll or pitch, of the joints of a leg
_CORRECTED = np.array([0.0, 1.0, 1.0, 1.0, 1.0, 1.0])  # the yaw hardly bends
ASSUMED_LOADS = 5.0
"""Number of measurements that have the weight of the assumed load."""


class Estimator(Protocol):
    """Estimates r from observations; its memory is an array or a named tuple, one row per world.

    Attributes:
        measures_load: True if r contains an excess load.
    """

    measures_load = False

    @abstractmethod
    def begin(self, num_worlds: int) -> Any:
        """Memory before the first estimate."""

    @abstractmethod
    def estimate(self, rows: Array, memory: Any) -> tuple[Array, Array | None, Any]:
        """Correction r of every joint, the excess load within it, and the new memory.

        Returns:
            r, (num_worlds, n) [1].
            Mean excess load μ, (num_worlds, 1) [1]; None for none.
            Memory.
        """


class EstimatorMemory(NamedTuple):
    """Number and sum of the measured excess loads, (num_worlds, 2), and the observer's memory."""

    loads: Array
    observer: Any


class LegEstimator(Estimator):
    """r of each leg by motors, foot sensors and IMU, and by joint torques where there are any.

    Attributes:
        observer: Estimates the relative error of each leg.
        sensors: Joint torque sensors; None without.

    Args:
        model: Assumed walker.
        sensors: Joint torque sensors, if it has them.
    """

    measures_load = True

    def __init__(self, model: WalkerModel, sensors: DeflectionSensors | None = None) -> None:
        self.observer = BendingObserver(model)
        self.sensors = sensors
        self._axis = np.zeros_like(_AXIS) if sensors is None else _AXIS

    @override
    def begin(self, num_worlds: int) -> EstimatorMemory:
        loads = np.zeros((num_worlds, 2))
        return EstimatorMemory(loads, self.observer.begin(num_worlds))

    def observe(self, rows: Array, memory: EstimatorMemory) -> tuple[Array, Array, Any]:
        """Values of the observer, the mean excess load, (num_worlds, 1) [1], and new memory."""
        bending = None if self.sensors is None else self.sensors.deflection(rows)
        values, observer = self.observer.observe(rows, memory.observer, bending)
        load, loads = mean_load(memory.loads, values[:, [_LOAD]])
        return values, load, EstimatorMemory(loads, observer)

    @override
    def estimate(self, rows: Array, memory: EstimatorMemory) -> tuple[Array, Array, Any]:
        values, load, memory = self.observe(rows, memory)
        error = values[:, _ERROR].reshape(len(rows), 2, 2)[:, :, self._axis]
        joints = ((1.0 + error) * (1.0 + load[:, :, None]) - 1.0) * _CORRECTED
        return joints.reshape(len(rows), -1), load, memory


class RegressionMemory(NamedTuple):
    """Memory of a regression.

    Attributes:
        friction: Friction that holds the links back, (num_worlds, n) [N·m].
        q: Link angles of the last measurement, (num_worlds, n) [rad].
        sums: Argument of `regress`, (num_worlds, 5, n).
    """

    friction: Array
    q: Array
    sums: Array


class EncoderEstimator(Estimator):
    """r of each joint by encoders on all links, see the module.

    Args:
        model: Assumed robot on a fixed base.
        sensors: Its link encoders.
    """

    prior = StiffnessPrior(own=0.3, noise_rad=0.005)
    """Joints of an arm are less alike than joints of two legs, and foot sensors add no errors."""

    def __init__(self, model: RobotModel, sensors: DeflectionSensors) -> None:
        self._model = model
        model.require_constant_friction("the estimate of the stiffness")
        self._sensors = sensors
        self._view = ObservationView(model)
        self._torque_model = self._make_torque_model(model)

    def _make_torque_model(self, model: RobotModel) -> Any:
        """Make the model of the expected deflection."""
        return make_gravity(model)

    @override
    def begin(self, num_worlds: int) -> Any:
        zero = np.zeros((num_worlds, self._view.num_joints))
        return RegressionMemory(zero, zero, np.stack([zero] * 5, axis=1))

    @override
    def estimate(self, rows: Array, memory: Any) -> tuple[Array, Array | None, Any]:
        deflection = self._sensors.deflection(rows)
        q = self._view.theta(rows) - deflection
        displacement = np.where(memory.sums[:, 0] > 0.0, q - memory.q, 0.0)
        coulomb = self._model.coulomb_friction
        friction = presliding_friction(memory.friction, displacement, coulomb)
        h = self._expected_deflection(rows, q, friction)
        y = deflection - h
        terms = np.stack([np.ones_like(h), h, h * h, y, h * y], axis=1)
        sums = memory.sums + self._sensors.has * terms
        r = regress(sums.swapaxes(0, 1), self.prior)
        return r, None, RegressionMemory(friction, q, sums)

    def _expected_deflection(self, rows: Array, q: Array, friction: Array) -> Array:
        """Deflection h under the torque of the motion and under friction, (num_worlds, n) [rad]."""
        motion = self._view.motion(rows)
        torque = self._torque_model.inverse_dynamics(q, motion.q_dot, motion.q_ddot)
        torque = torque + self._model.viscous_friction * motion.q_dot
        return (torque + friction) / self._model.stiffness


class LegEncoderEstimator(EncoderEstimator):
    """r of a walker's joints; for joints without a link encoder by the load only."""

    prior = StiffnessPrior()
    measures_load = True

    @override
    def _make_torque_model(self, model: Any) -> Any:
        self._wrench = model.observation_table.group("wrench")
        self._carried = model.biped.chains_above_feet.mass * model.biped.gravity
        return GravityCompensator(model, output="wrench")

    @override
    def begin(self, num_worlds: int) -> EstimatorMemory:
        return EstimatorMemory(np.zeros((num_worlds, 2)), super().begin(num_worlds))

    @override
    def estimate(self, rows: Array, memory: EstimatorMemory) -> tuple[Array, Array, Any]:
        error, _, observer = super().estimate(rows, memory.observer)
        force = rows[:, self._wrench].reshape(len(rows), 2, 2, 3)[:, :, 0, 2]
        excess = force.sum(axis=1, keepdims=True) / self._carried - 1.0
        load, loads = mean_load(memory.loads, excess)
        r = (1.0 + self._sensors.has * error) * (1.0 + load) - 1.0
        return r, load, EstimatorMemory(loads, observer)

    @override
    def _expected_deflection(self, rows: Array, q: Array, friction: Array) -> Array:
        theta = self._view.theta(rows)
        modelled = theta - self._torque_model.at(rows).link_angle(theta)
        return modelled + friction / self._model.stiffness


def make_estimator(model: RobotModel, sensors: DeflectionSensors) -> Estimator:
    """Make the estimator for a robot's sensors."""
    if not isinstance(model, WalkerModel):
        return EncoderEstimator(model, sensors)
    if sensors.are_torques:
        return LegEstimator(model, sensors)
    return LegEncoderEstimator(model, sensors)


def mean_load(memory: Array, excess: Array) -> tuple[Array, Array]:
    """Mean excess load of the feet, (num_worlds, 1) [1], and the new number and sum.

    Args:
        memory: Number and sum, (num_worlds, 2).
        excess: Measured over assumed load less one, (num_worlds, 1) [1].
    """
    memory = memory + np.hstack([np.ones_like(excess), excess])
    return memory[:, 1:] / (ASSUMED_LOADS + memory[:, :1]), memory
