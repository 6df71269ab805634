"""Policies: their protocol, the base classes of ours, and policies of users.

Policies take observations of one world, (m,), or of many, (num_worlds, m). A policy with memory
keeps it in `state`, one row per world: pass the returned state back, and `episode_start` where
episodes begin, as Stable-Baselines3 does.

A policy of ours acts on rows: `BatchPolicy.predict` makes them once for a whole chain of policies.
Each policy implements `begin` for its memory, and `act`. Memory is a named tuple of arrays with one
row per world; the memory of the policy inside it is one of its fields.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt
from typing_extensions import override

from baselines.compensation.memory import resume_memory
from baselines.compensation.observation_view import ObservationView
from elastic_env.core.errors import unknown_name
from elastic_env.core.signals import Array, BoolArray, Signal
from elastic_env.world.robot_model import RobotModel

Action = npt.NDArray[np.float32]
Step: TypeAlias = tuple[Array, Any]
"""Offsets of the joints, (num_worlds, n) [rad], and the memory after a control step."""


class Policy(Protocol):
    """Commands the robot; a Stable-Baselines3 model is a policy too."""

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Any, Any]:
        """Action and new state for an observation."""
        ...


class PolicyInputs(NamedTuple):
    """Values of a policy's inputs, (num_worlds, columns) each; None for an input without a value.

    A policy uses its own inputs and passes the others on. `baselines.compensation.inputs` describes
    them. `command` is no field: it is added to the command of any policy. `load` is no input: it is
    the mean excess load μ within `deflection`, (num_worlds, 1) [1]. The last two fields are
    arguments of `predict`, for policies of users.
    """

    deflection: Array | None = None
    load: Array | None = None
    zmp: Array | None = None
    com: Array | None = None
    leg_length: Array | None = None
    hip: Array | None = None
    posture_gain: Array | None = None
    balance_gain: Array | None = None
    is_single: bool = False
    deterministic: bool = True

    @property
    def zmp_shift(self) -> Array | None:
        """Shift of the planned ZMP, (num_worlds, 2) [m]; None without.

        A constant shift of the center of mass shifts the ZMP too.
        """
        if self.zmp is None or self.com is None:
            return self.com if self.zmp is None else self.zmp
        return self.zmp + self.com


NO_INPUTS = PolicyInputs()
ONE_WORLD = PolicyInputs(is_single=True)
"""Empty inputs, for many worlds and for one."""


class BatchPolicy(ABC):
    """A policy that commands a batch of worlds at once.

    Args:
        model: Assumed robot.
    """

    reads_rates = True
    """False for a policy that does not need rates of the joints: then nobody estimates them."""

    def __init__(self, model: RobotModel) -> None:
        self.model = model
        self.view = ObservationView(model)
        self.inputs: tuple[str, ...] = ()
        """Names of its inputs except `command`, and of the inputs of the policies inside it."""
        self.estimates: Mapping[str, tuple[Signal, ...]] = {}
        """Quantities of the robot that it estimates, by name: values of `estimate`."""

    def predict(
        self,
        observation: Array,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
        inputs: PolicyInputs = NO_INPUTS,
    ) -> tuple[Action, Any]:
        """Action and new state.

        Args:
            observation: Observation of one world, (m,), or of many, (num_worlds, m).
            state: State that the last call returned; None at the start of an episode.
            episode_start: Worlds whose episode begins; None where no episode begins.
            deterministic: Argument for a policy of a user inside it.
            inputs: Values of its inputs; zeros give the same bits as no values.

        Raises:
            ElasticError: Called in the middle of an episode without the state of the last call.
        """
        rows = self.view.rows(observation)
        memory = resume_memory(self, rows, state, episode_start)
        is_single = np.ndim(observation) == 1
        if inputs is NO_INPUTS and deterministic:
            inputs = ONE_WORLD if is_single else NO_INPUTS
        else:
            inputs = inputs._replace(is_single=is_single, deterministic=deterministic)
        action, memory = self.act(rows, memory, inputs)
        return as_action(action, is_single), memory

    def link_estimate(self, observation: Array, state: Any) -> Array:
        """Link angles that the policy saw instead of encoder angles, (..., n) [rad].

        Args:
            observation: Argument of `predict`.
            state: State that `predict` returned for it.
        """
        angles = self.link_angles(self.view.rows(observation), state)
        return angles.reshape((*np.shape(observation)[:-1], angles.shape[-1]))

    @abstractmethod
    def begin(self, rows: Array) -> Any:
        """Memory at the start of an episode, None for a policy without memory.

        Args:
            rows: First observations of the episodes, (num_worlds, m).
        """

    @abstractmethod
    def act(self, rows: Array, memory: Any, inputs: PolicyInputs) -> Step:
        """Offsets of the joints, (num_worlds, n) in single precision [rad], and the new memory.

        Args:
            rows: Observations, (num_worlds, m).
            memory: Memory of the last control step; it is not changed.
            inputs: Values of its inputs.
        """

    def estimate(self, name: str, rows: Array, memory: Any) -> Array:  # noqa: ARG002
        """One of its `estimates` from its memory, (num_worlds, columns).

        Args:
            name: Name of the estimate.
            rows: Observations with the reference, (num_worlds, m).
            memory: Memory of the last control step.

        Raises:
            ConfigurationError: There is none of that name.
        """
        raise unknown_name("estimate of a policy", name, self.estimates)

    def link_angles(self, rows: Array, memory: Any) -> Array:  # noqa: ARG002
        """Link angles for `link_estimate`, (num_worlds, n) [rad]; here the encoder angles."""
        return self.view.theta(rows)


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


class Zero(BatchPolicy):
    """Commands the reference itself: no offset and no memory."""

    reads_rates = False

    @override
    def begin(self, rows: Array) -> None:
        return None

    @override
    def act(self, rows: Array, memory: None, inputs: PolicyInputs) -> Step:
        return np.zeros((len(rows), self.view.num_joints), dtype=np.float32), None


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


def as_action(offsets: Array, is_single: bool) -> Action:
    """Offsets in single precision: all rows, or the only row for an observation of one world."""
    return (offsets[0] if is_single else offsets).astype(np.float32, copy=False)
