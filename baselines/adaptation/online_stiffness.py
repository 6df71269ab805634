"""A compensated policy whose model of the joints is corrected while the robot walks.

Adaptive control does the same.

The deflection that is compensated, and seen, is (1 + r) times that of the model. An estimator of
`baselines.adaptation.estimators` says r every tenth of a second, and a first-order filter smooths
it: the command must change more slowly than what it is estimated from [Spong1995].

[Spong1995] M. W. Spong, "Adaptive Control of Flexible Joint Manipulators: Comments on Two Papers",
Automatica 31(4).
"""

from typing import Any, NamedTuple

import numpy as np
from typing_extensions import override

from baselines.compensation import policy as policies
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, IntArray
from elastic_env.world.robot_model import RobotModel


class AdaptationGains(Model):
    """How fast the model of the joints is corrected."""

    period_s: float = quantity("s", 0.1, gt=0)
    """Time between two estimates [s]."""
    filter_s: float = quantity("s", 0.08, gt=0)
    """Time constant of the correction's filter [s]."""
    limit: float = quantity("1", 1.0, gt=0, lt=10)
    """Largest correction of the deflection [1]."""


class StiffnessMemory(NamedTuple):
    """Memory of a policy whose stiffness is adapted.

    Attributes:
        wait: Control steps until the next estimate, (num_worlds,).
        target: Last estimate of r, (num_worlds, n) [1].
        correction: r behind the filter, (num_worlds, n) [1].
        estimator: Memory of the estimator.
        inner: Memory of the policy.
    """

    wait: IntArray
    target: Array
    correction: Array
    estimator: Any
    inner: Any


class OnlineStiffness(policies.PolicyAround):
    """A compensated policy whose model of the joints is corrected by what is measured.

    Attributes:
        estimator: Says r.
        every: Control steps from an estimate to the next one.
        share: Of its way to the estimate that the correction goes in a control step [1].
        limit: Largest correction [1].

    Args:
        policy: The policy that is corrected; it has the input `deflection`.
        model: Assumed robot.
        estimator: Says r.
        gains: How fast.
    """

    def __init__(
        self, policy: Any, model: RobotModel, estimator: Any, gains: AdaptationGains
    ) -> None:
        super().__init__(policy, model)
        dt = model.control_period_s
        self.estimator = estimator
        self.every = max(round(gains.period_s / dt), 1)
        self.share = policies.filter_share(dt, gains.filter_s)
        self.limit = gains.limit

    @override
    def begin(self, rows: Array) -> StiffnessMemory:
        wait = np.zeros(len(rows), dtype=np.int64)
        zero = np.zeros((len(rows), self.view.num_joints))
        estimator = self.estimator.begin(len(rows))
        return StiffnessMemory(wait, zero, zero, estimator, self.policy.begin(rows))

    @override
    def act(self, rows: Array, memory: StiffnessMemory, inputs: Any) -> policies.Step:
        """The input `deflection` r' comes on top, (1 + r) (1 + r') δ."""
        wait = memory.wait - 1
        target = memory.target
        own = memory.estimator
        if np.count_nonzero(memory.wait) < len(rows):
            due = memory.wait == 0
            wait[due] = self.every - 1
            before = policies.select_rows(own, due)
            estimate, after = self.estimator.estimate(rows[due], before)
            estimate = np.clip(estimate, -self.limit, self.limit)
            target = policies.put_rows(target, due, estimate)
            own = policies.put_rows(own, due, after)
        correction = memory.correction + self.share * (target - memory.correction)
        together = correction
        if inputs.deflection is not None:
            together = (1.0 + correction) * (1.0 + inputs.deflection) - 1.0
        inputs = inputs._replace(deflection=together, load=self.estimator.load(own))
        action, inner = self.policy.act(rows, memory.inner, inputs)
        return action, StiffnessMemory(wait, target, correction, own, inner)
