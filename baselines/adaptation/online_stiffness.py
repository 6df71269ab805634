"""Adaptive control: a compensated policy whose joint model is corrected while the robot moves.

The compensated deflection is (1 + r) times the deflection of the model. An estimator of
`baselines.adaptation.estimators` gives r every tenth of a second, and a first-order filter smooths
it: the command must change more slowly than the measurements behind the estimate [Spong1995].

[Spong1995] M. W. Spong, "Adaptive Control of Flexible Joint Manipulators: Comments on Two Papers",
Automatica 31(4).
"""

from typing import Any, NamedTuple

import numpy as np
from typing_extensions import override

from baselines.compensation.filters import filter_share
from baselines.compensation.memory_rows import put_rows, select_rows
from baselines.compensation.policy import PolicyInputs, Step
from baselines.compensation.policy_around import PolicyAround
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, IntArray
from elastic_env.world.robot_model import RobotModel


class AdaptationGains(Model):
    """Period, filter and limit of the correction of the joint model."""

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
        load: Excess load within the last estimate, (num_worlds, 1) [1]; None for none.
        estimator: Memory of the estimator.
        inner: Memory of the policy.
    """

    wait: IntArray
    target: Array
    correction: Array
    load: Array | None
    estimator: Any
    inner: Any


class OnlineStiffness(PolicyAround):
    """A compensated policy whose joint model is corrected by measurements.

    Attributes:
        estimator: Estimates r.
        every: Control steps from an estimate to the next one.
        share: Share of its way to the estimate that the correction goes in a control step [1].
        limit: Largest correction [1].

    Args:
        policy: Policy that is corrected; it has the input `deflection`.
        model: Assumed robot.
        estimator: Estimates r.
        gains: Period, filter and limit.
    """

    def __init__(
        self, policy: Any, model: RobotModel, estimator: Any, gains: AdaptationGains
    ) -> None:
        super().__init__(policy, model)
        dt = model.control_period_s
        self.estimator = estimator
        self.every = max(round(gains.period_s / dt), 1)
        self.share = filter_share(dt, gains.filter_s)
        self.limit = gains.limit

    @override
    def begin(self, rows: Array) -> StiffnessMemory:
        zero = np.zeros((len(rows), self.view.num_joints))
        return StiffnessMemory(
            wait=np.zeros(len(rows), dtype=np.int64),
            target=zero,
            correction=zero,
            load=np.zeros((len(rows), 1)) if self.estimator.measures_load else None,
            estimator=self.estimator.begin(len(rows)),
            inner=self.policy.begin(rows),
        )

    @override
    def act(self, rows: Array, memory: StiffnessMemory, inputs: PolicyInputs) -> Step:
        """Act for a control step; an input `deflection` r' multiplies, (1 + r) (1 + r') δ."""
        wait = memory.wait - 1
        target = memory.target
        load = memory.load
        estimator = memory.estimator
        if np.count_nonzero(memory.wait) < len(rows):
            due = memory.wait == 0
            wait[due] = self.every - 1
            remembered = select_rows(estimator, due)
            estimate, excess, remembered = self.estimator.estimate(rows[due], remembered)
            target = put_rows(target, due, np.clip(estimate, -self.limit, self.limit))
            load = put_rows(load, due, excess)
            estimator = put_rows(estimator, due, remembered)
        correction = memory.correction + self.share * (target - memory.correction)
        deflection = correction
        if inputs.deflection is not None:
            deflection = (1.0 + correction) * (1.0 + inputs.deflection) - 1.0
        inputs = inputs._replace(deflection=deflection, load=load)
        action, inner = self.policy.act(rows, memory.inner, inputs)
        return action, StiffnessMemory(wait, target, correction, load, estimator, inner)
