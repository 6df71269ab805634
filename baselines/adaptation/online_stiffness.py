"""A compensated policy whose model of the joints is corrected while the robot walks, as adaptive control does.

The deflection that is compensated, and seen, is (1 + r) times that of the model. An estimator of
`baselines.adaptation.estimators` says r every tenth of a second, and a first-order filter smooths it: the command must
change more slowly than what it is estimated from [Spong1995].

[Spong1995] M. W. Spong, "Adaptive Control of Flexible Joint Manipulators: Comments on Two Papers", Automatica 31(4).
"""

from typing import Any

import numpy as np

from baselines.adaptation.adaptation_kernels import count_due, follow
from baselines.adaptation.estimators import Estimator
from baselines.compensation.inputs import PolicyInputs
from baselines.compensation.policy import Action, ObservationView, PolicyAround, PolicyWithInputs, taken_up
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array
from elastic_env.runtime.robot_model import RobotModel


class AdaptationGains(Model):
    """How fast the model of the joints is corrected."""

    period_s: float = quantity("s", 0.1, gt=0, description="time between two estimates")
    filter_s: float = quantity("s", 0.08, gt=0, description="time constant of the correction's filter")
    limit: float = quantity("1", 1.0, gt=0, lt=10, description="largest correction of the deflection")


class OnlineStiffness(PolicyAround):
    """A compensated policy whose model of the joints is corrected by what is measured, see the module.

    Memory per world: steps, target and filtered r of the joints, then that of the estimator.

    Args:
        policy: The policy that is corrected.
        model: Assumed robot.
        estimator: Says r.
        gains: How fast.
    """

    def __init__(
        self, policy: PolicyWithInputs, model: RobotModel, estimator: Estimator, gains: AdaptationGains | None = None
    ) -> None:
        gains = gains or AdaptationGains()
        self._policy, self._estimator, self._n = policy, estimator, len(model.joint_names)
        self._view = ObservationView(model.observation_table, model.control_period_s)
        self._every = max(round(gains.period_s / model.control_period_s), 1)
        self._gain, self._limit = 1.0 - float(np.exp(-model.control_period_s / gains.filter_s)), gains.limit

    def predict_with(
        self,
        observation: Array,
        inputs: PolicyInputs,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Action, Any]:
        """See `PolicyWithInputs`; the input `deflection` r' comes on top, (1 + r) (1 + r') δ."""
        rows, n = self._view.rows(observation), self._n
        memory, inner = taken_up(state, episode_start, rows, self._view, lambda: self._begin(len(rows)))
        memory = self._adapted(rows, memory)
        own = memory[:, 1 + n : 1 + 2 * n]
        further = inputs.deflection
        together = own if further is None else (1.0 + own) * (1.0 + further) - 1.0
        corrected = inputs.with_deflection(together)
        action, inner = self._policy.predict_with(observation, corrected, inner, episode_start, deterministic)
        return action, (memory, inner)

    def _begin(self, num_worlds: int) -> Array:
        return np.hstack([np.zeros((num_worlds, 1 + 2 * self._n)), self._estimator.begin(num_worlds)])

    def _adapted(self, rows: Array, memory: Array) -> Array:
        """Memory after a control step: a new target where one is due, and the filtered correction."""
        memory, n = memory.copy(), self._n
        if count_due(memory, self._every) > 0:
            due = np.flatnonzero(memory[:, 0] % self._every == 0)
            target, kept = memory[:, 1 : 1 + n], memory[:, 1 + 2 * n :]
            wanted, kept[due] = self._estimator.estimate(rows[due], kept[due])
            target[due] = np.clip(wanted, -self._limit, self._limit)
        follow(memory, n, self._gain)
        return memory
