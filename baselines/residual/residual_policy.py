"""Trained residuals as policies: a network corrects the base that it belongs to.

The policy normalises the observation for the network only: the base sees it as it is.
"""

from typing import Any, NamedTuple

import numpy as np
from typing_extensions import override

from baselines.compensation.memory_rows import put_rows, select_rows
from baselines.compensation.policy import BatchPolicy, PolicyInputs, Step
from baselines.residual.correction import Corrected, CorrectedMemory
from baselines.residual.features import Features, FeaturesMemory
from baselines.residual.network import Network
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, BoolArray, IntArray


class ResidualMemory(NamedTuple):
    """Memory of a residual policy.

    Attributes:
        wait: Control steps until the next decision, (num_worlds,); -1 before the first.
        residual: Residual of the last decision, (num_worlds, k).
        features: Memory of the features.
        inner: Memory of the corrected base.
    """

    wait: IntArray
    residual: Array
    features: FeaturesMemory
    inner: CorrectedMemory


class ResidualPolicy(BatchPolicy):
    """A base policy with a network that corrects it.

    Args:
        corrected: The base and its correction.
        network: Decides the residual.

    Attributes:
        features: Features for the network.

    Raises:
        ConfigurationError: The network does not fit the settings, or they do not fit the robot.
    """

    def __init__(self, corrected: Corrected, network: Network) -> None:
        super().__init__(corrected.model)
        self.corrected = corrected
        self._network = network
        self.features = Features(corrected)
        self._period = corrected.settings.decision_period
        expected = (self.features.width, corrected.num_residuals)
        if (network.num_features, network.num_outputs) != expected:
            raise ConfigurationError(
                f"the network must take {expected[0]} features and give {expected[1]} residuals for"
                f" these settings, it has {network.num_features} and {network.num_outputs}"
            )

    @override
    def begin(self, rows: Array) -> ResidualMemory:
        n = len(rows)
        wait = np.full(n, _UNDECIDED)
        residual = np.zeros((n, self.corrected.num_residuals))
        features = self.features.begin(n)
        return ResidualMemory(wait, residual, features, self.corrected.begin(rows))

    @override
    def act(self, rows: Array, memory: ResidualMemory, inputs: PolicyInputs) -> Step:
        due = memory.wait <= 0
        if np.count_nonzero(due) > 0:
            decided = select_rows(self._decide(rows, memory, due), due)
            memory = put_rows(memory, due, decided)
        action, inner = self.corrected.correct(rows, memory.residual, memory.inner, inputs)
        return action, memory._replace(wait=memory.wait - 1, inner=inner)

    @override
    def link_angles(self, rows: Array, memory: ResidualMemory) -> Array:
        return self.corrected.base.link_angles(rows, memory.inner.inner)

    def _decide(self, rows: Array, memory: ResidualMemory, due: BoolArray) -> Any:
        """Memory after a decision of the worlds that are due."""
        is_first = memory.wait == _UNDECIDED
        inner = memory.inner
        values, features = self.features.at(rows, memory.features, is_first, inner, None)
        residual = memory.residual.copy()
        residual[due] = self.features.turn_back(rows[due], self._network(values[due]))
        wait = np.full_like(memory.wait, self._period)
        return ResidualMemory(wait, residual, features, inner)


_UNDECIDED = -1
