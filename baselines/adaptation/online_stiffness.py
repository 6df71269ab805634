r"""Compensation whose model of the joints is corrected while the robot walks, as adaptive control does [Spong1995].

The deflection that is compensated, and seen, is (1 + r) times that of the model. What the robot measures says r:

* its motors, foot sensors and IMU, by `BendingObserver`: how much more the joints of a leg bend than the model, ρ, and
  how much more they carry, μ. Then 1 + r = (1 + ρ_roll) (1 + μ) for the joints of that leg but the yaw, which hardly
  bends. ρ of pitch is left out: friction hides the bending there.
* sensors of the joints' deflections, δ = (1 + r) δ_model + c, joint by joint, by recursive least squares. c takes what
  does not change with the load, as errors of homing.

r passes a first-order filter: it must change more slowly than what it is estimated from.

[Spong1995] M. W. Spong, "Adaptive Control of Flexible Joint Manipulators: Comments on Two Papers", Automatica 31(4).
"""

from typing import Any, Protocol

import numpy as np

from baselines.compensation.compensators import GravityCompensator
from baselines.compensation.measured import DeflectionSensors
from baselines.compensation.policy import Action, ObservationView, taken_up
from baselines.estimation.bending import BendingObserver
from baselines.estimation.least_squares import RatioFilter
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, SignalTable
from elastic_env.runtime.robot_model import RobotModel, WalkerModel

_SEEN = SignalTable(BendingObserver.signals)
_ERROR = _SEEN.columns("model_error.l_roll", "model_error.r_roll")
_LOAD = _SEEN.names.index("excess_load")
_JOINTS_THAT_BEND = np.array([0.0, 1.0, 1.0, 1.0, 1.0, 1.0])  # from hip yaw to ankle roll


class AdaptationGains(Model):
    """How fast the model of the joints is corrected."""

    period_s: float = quantity("s", 0.1, gt=0, description="time between two estimates")
    filter_s: float = quantity("s", 0.08, gt=0, description="time constant of the correction's filter")
    load_prior_s: float = quantity("s", 0.5, gt=0, description="time for which the assumed load counts in the mean")
    limit: float = quantity("1", 1.0, gt=0, lt=10, description="largest correction of the deflection")


class Correctable(Protocol):
    """A policy whose assumed deflection can be corrected, such as `baselines.Compensated`."""

    def predict_corrected(
        self,
        observation: Array,
        correction: Array | None,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Any, Any]:
        """`predict` with the deflection (1 + r) δ."""
        ...

    def link_estimate(self, observation: Array, state: Any) -> Array:
        """Link angles that it saw."""
        ...


class Estimator(Protocol):
    """What says r, from observations."""

    memory_width: int

    def begin(self, num_worlds: int) -> Array:
        """Memory before the first estimate, (num_worlds, memory_width)."""
        ...

    def estimate(self, rows: Array, memory: Array) -> tuple[Array, Array]:
        """The correction r of every joint, (num_worlds, n) [1], and the new memory."""
        ...


class LegEstimator:
    """r of each leg by motors, foot sensors and IMU, see the module.

    Memory per world: number and sum of the measured excess loads, then that of the observer.

    Args:
        model: Assumed walker.
        gains: Time between estimates, and of the prior of the load.
    """

    def __init__(self, model: WalkerModel, gains: AdaptationGains) -> None:
        self._observer, self._prior = BendingObserver(model), gains.load_prior_s / gains.period_s
        self.memory_width = 2 + self._observer.memory_width

    def begin(self, num_worlds: int) -> Array:
        """See `Estimator`."""
        return np.hstack([np.zeros((num_worlds, 2)), self._observer.begin(num_worlds)])

    def estimate(self, rows: Array, memory: Array) -> tuple[Array, Array]:
        """See `Estimator`."""
        seen, kept = self._observer.observe(rows, memory[:, 2:])
        number, total = memory[:, :1] + 1.0, memory[:, 1:2] + seen[:, [_LOAD]]
        of_legs = (1.0 + seen[:, _ERROR]) * (1.0 + total / (self._prior + number)) - 1.0
        joints = (of_legs[:, :, None] * _JOINTS_THAT_BEND).reshape(len(rows), -1)
        return joints, np.hstack([number, total, kept])


class JointEstimator:
    """r of each joint by sensors of its deflection, see the module; 0 for joints that have none.

    Args:
        model: Assumed robot.
        sensors: Of its joints.
    """

    def __init__(self, model: RobotModel, sensors: DeflectionSensors) -> None:
        self._sensors, self._compensator = sensors, GravityCompensator(model)
        self._view = ObservationView(model.observation_table, model.control_period_s)
        self._filter = RatioFilter(len(model.joint_names))
        self.memory_width = self._filter.memory_width

    def begin(self, num_worlds: int) -> Array:
        """See `Estimator`."""
        return self._filter.begin(num_worlds)

    def estimate(self, rows: Array, memory: Array) -> tuple[Array, Array]:
        """See `Estimator`."""
        expected, _ = self._compensator.at(rows).offset(self._view.motion(rows), np.zeros((len(rows), 0)))
        error, memory = self._filter.update(memory, expected, self._sensors.deflection(rows) - expected)
        return self._sensors.has * error, memory


class OnlineStiffness:
    """A compensated policy whose model of the joints is corrected by what is measured, see the module.

    Memory per world: steps, target and filtered r of the joints, then that of the estimator.

    Args:
        policy: What is corrected.
        model: Assumed robot.
        estimator: What says r.
        gains: How fast.
    """

    def __init__(
        self, policy: Correctable, model: RobotModel, estimator: Estimator, gains: AdaptationGains | None = None
    ) -> None:
        gains = gains or AdaptationGains()
        self._policy, self._estimator, self._n = policy, estimator, len(model.joint_names)
        self._view = ObservationView(model.observation_table, model.control_period_s)
        self._every = max(round(gains.period_s / model.control_period_s), 1)
        self._gain, self._limit = 1.0 - float(np.exp(-model.control_period_s / gains.filter_s)), gains.limit

    def predict(
        self, observation: Array, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Action, Any]:
        """Action and new state."""
        return self.predict_corrected(observation, None, state, episode_start, deterministic)

    def predict_corrected(
        self,
        observation: Array,
        correction: Array | None,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Action, Any]:
        """`predict` with a further correction r' on top: (1 + r) (1 + r') δ; arguments as `Compensated` has them."""
        rows, n = self._view.rows(observation), self._n
        memory, inner = taken_up(state, episode_start, rows, self._view, lambda: self._begin(len(rows)))
        memory = self._adapted(rows, memory)
        own = memory[:, 1 + n : 1 + 2 * n]
        together = own if correction is None else (1.0 + own) * (1.0 + correction) - 1.0
        action, inner = self._policy.predict_corrected(observation, together, inner, episode_start, deterministic)
        return action, (memory, inner)

    def link_estimate(self, observation: Array, state: Any) -> Array:
        """Link angles that the policy saw, (..., n) [rad]."""
        return self._policy.link_estimate(observation, state[1])

    def _begin(self, num_worlds: int) -> Array:
        return np.hstack([np.zeros((num_worlds, 1 + 2 * self._n)), self._estimator.begin(num_worlds)])

    def _adapted(self, rows: Array, memory: Array) -> Array:
        """Memory after a control step: a new target where one is due, and the filtered correction."""
        memory, n = memory.copy(), self._n
        steps, target, filtered, kept = np.split(memory, [1, 1 + n, 1 + 2 * n], axis=1)
        due = np.flatnonzero(steps[:, 0] % self._every == 0)
        if len(due):
            wanted, kept[due] = self._estimator.estimate(rows[due], kept[due])
            target[due] = np.clip(wanted, -self._limit, self._limit)
        filtered += self._gain * (target - filtered)
        steps += 1.0
        return memory
