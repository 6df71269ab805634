"""Policies around another one, which may be a user's."""

from typing import Any, NamedTuple

import numpy as np
from typing_extensions import override

from baselines.compensation.policy import BatchPolicy, PolicyInputs, Step
from elastic_env.core.signals import Array, BoolArray
from elastic_env.world.robot_model import RobotModel


class MemoryAround(NamedTuple):
    """Memory of a policy around another one: its own rows, (num_worlds, ...), and the other's."""

    own: Any
    inner: Any


class PolicyAround(BatchPolicy):
    """A policy around another one, whose memory is the field `inner` of its memory.

    Args:
        policy: Any policy.
        model: Assumed robot.

    Attributes:
        memory_type: Type of the rows of a `MemoryAround`, which are zero at the start; a policy
            with other memory overrides `begin`.
    """

    memory_type: Any

    def __init__(self, policy: Any, model: RobotModel) -> None:
        super().__init__(model)
        self.policy = as_batch_policy(policy, model)
        self.inputs = self.policy.inputs
        self.estimates = self.policy.estimates

    @override
    def begin(self, rows: Array) -> Any:
        own = np.zeros(len(rows), self.memory_type)
        return MemoryAround(own, self.policy.begin(rows))

    def inner_memory(self, memory: Any) -> Any:
        """Memory of the policy inside."""
        return memory.inner

    @override
    def estimate(self, name: str, rows: Array, memory: Any) -> Array:
        return self.policy.estimate(name, rows, self.inner_memory(memory))

    @override
    def link_angles(self, rows: Array, memory: Any) -> Array:
        return self.policy.link_angles(rows, self.inner_memory(memory))


class PassingMemory(PolicyAround):
    """A policy around another one whose memory is the other's, as it has none itself."""

    @override
    def begin(self, rows: Array) -> Any:
        return self.policy.begin(rows)

    @override
    def inner_memory(self, memory: Any) -> Any:
        return memory


class UserMemory(NamedTuple):
    """Memory of a policy of a user.

    Attributes:
        has_begun: Worlds whose episode has begun before, (num_worlds,).
        state: Its state in a list of one. The policy itself resets it where `episode_start` is
            true.
    """

    has_begun: BoolArray
    state: list[Any]


class UserPolicy(BatchPolicy):
    """A policy of a user as one of ours; it gets observations of the shape that the caller gave."""

    def __init__(self, policy: Any, model: RobotModel) -> None:
        super().__init__(model)
        self._policy = policy
        self.reads_rates = getattr(policy, "reads_rates", True)

    @override
    def begin(self, rows: Array) -> UserMemory:
        return UserMemory(np.zeros(len(rows), dtype=np.bool_), [None])

    @override
    def act(self, rows: Array, memory: UserMemory, inputs: PolicyInputs) -> Step:
        obs = rows[0] if inputs.is_single else rows
        start = ~memory.has_begun
        state = memory.state[0]
        action, state = self._policy.predict(obs, state, start, inputs.deterministic)
        offset = np.atleast_2d(np.asarray(action, dtype=np.float64))
        return offset, UserMemory(np.ones(len(rows), dtype=np.bool_), [state])

    @override
    def link_angles(self, rows: Array, memory: UserMemory) -> Array:
        return self._policy.link_estimate(rows, memory.state[0])


def as_batch_policy(policy: Any, model: RobotModel) -> BatchPolicy:
    """The policy itself if it is a `BatchPolicy`, else a `UserPolicy` around it."""
    return policy if isinstance(policy, BatchPolicy) else UserPolicy(policy, model)
