"""Policies: their protocol, the base classes of ours, and policies of users.

Policies take observations of one world, (m,), or of many, (num_worlds, m). A policy with memory
keeps it in `state`, one row per world: pass the returned state back, and `episode_start` where
episodes begin, as Stable-Baselines3 does.

A policy of ours acts on rows: `BatchPolicy.predict` makes them once for a whole chain of policies.
Each policy implements `begin` for its memory, and `act`. Memory is a named tuple of arrays with one
row per world; the memory of the policy inside it is one of its fields.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt
from typing_extensions import override

from elastic_env.core.compiled import record_type
from elastic_env.core.errors import ElasticError, unknown_name
from elastic_env.core.signals import Array, BoolArray, IntArray, Signal, SignalTable
from elastic_env.world.robot_model import RobotModel

Records: TypeAlias = npt.NDArray[Any]
"""Array of a structured type, one row per world."""


class Motion(NamedTuple):
    """Desired motion of the links, (..., n) each [rad], [rad/s], [rad/s²]."""

    q: Array
    q_dot: Array
    q_ddot: Array


class ObservationView:
    """Columns of an observation that policies need, by name."""

    def __init__(self, model: RobotModel) -> None:
        table = model.observation_table
        self._width = len(table)
        self._period_s = model.control_period_s
        self._clock: Any = table.group("clock") if "clock.time" in table.names else None
        self._theta = table.group("encoder_angle")
        self._q = table.group("reference_angle")
        self._q_dot = table.group("reference_rate")
        self._q_ddot = table.group("reference_acceleration")
        self._command = table.group("last_command")
        self.num_joints = self._theta.stop - self._theta.start

    def theta(self, rows: Array) -> Array:
        """Encoder angles, (num_worlds, n) [rad]."""
        return rows[:, self._theta]

    def plan_row(self, rows: Array) -> IntArray:
        """Row of a walk's plan at the end of the coming control period, (num_worlds,)."""
        return np.rint(rows[:, self._clock.start] / self._period_s).astype(np.int64)

    def motion(self, rows: Array) -> Motion:
        """Reference motion for the coming control period, (num_worlds, n) each."""
        return Motion(rows[:, self._q], rows[:, self._q_dot], rows[:, self._q_ddot])

    def rows(self, observation: Array) -> Array:
        """Observation with one row per world, (num_worlds, m).

        Raises:
            ElasticError: The observation does not have the columns of the table.
        """
        rows = np.asarray(observation, dtype=np.float64)
        rows = rows[None] if rows.ndim < 2 else rows
        if rows.ndim != 2 or rows.shape[1] != self._width:
            needed = f"the {self._width} columns of its table, one row per world"
            shape = np.shape(observation)
            raise ElasticError(f"an observation must have {needed}, got shape {shape}")
        return rows

    def require_start(self, rows: Array, episode_start: Any) -> None:
        """Refuse observations that are not the first of their episodes.

        Args:
            rows: Observations, (num_worlds, m).
            episode_start: Worlds whose episode begins; None to decide by the observations.

        Raises:
            ElasticError: An episode goes on.
        """
        if not np.all(self.is_start(rows) if episode_start is None else episode_start):
            at_rest = "a reference at rest, and no command yet"
            sign = at_rest if self._clock is None else "clock.time"
            raise ElasticError(
                "predict() was called without `state` in what looks like the middle of an episode"
                f" (a beginning is known by {sign}): this policy has memory; pass the state that"
                " the last call returned, and episode_start=True where an episode begins"
            )

    def is_start(self, rows: Array) -> BoolArray:
        """True for an observation that can be the first of an episode, (num_worlds,).

        The clock decides, or without one: a reference at rest and no command yet. The last command
        is then the reference, or zero, as an environment may begin.
        """
        if self._clock is not None:
            return rows[:, self._clock][:, 0] < 1.5 * self._period_s
        command = rows[:, self._command]
        is_reference = (command == rows[:, self._q]).all(axis=1)
        is_at_rest = (rows[:, self._q_dot] == 0.0).all(axis=1)
        return is_at_rest & (is_reference | (command == 0.0).all(axis=1))


_WALK_FIELDS: Mapping[str, tuple[int, ...]] = {
    "encoder_angle": (12,),
    "encoder_rate": (12,),
    "imu_attitude": (2,),
    "imu_rate": (3,),
    "wrench": (2, 2, 3),
    "reference_angle": (12,),
    "reference_rate": (12,),
    "clock": (3,),
    "load_share": (),
    "zmp_reference": (2,),
}
"""Groups of a walker's observation, and the shapes of their fields; wrench: feet, force and
moment, axes.
"""


class WalkView:
    """Observations of a walker as rows with named fields, as compiled kernels read them.

    Args:
        table: Columns of the observation.
    """

    def __init__(self, table: SignalTable) -> None:
        groups = [table.group(name) for name in _WALK_FIELDS]
        layout = {
            "names": list(_WALK_FIELDS),
            "formats": [(np.float64, shape) for shape in _WALK_FIELDS.values()],
            "offsets": [8 * group.start for group in groups],
            # without the columns behind them, so that one kernel fits all walkers
            "itemsize": 8 * max(group.stop for group in groups),
        }
        self._type = np.dtype((np.record, layout))

    def fields(self, rows: Array) -> Records:
        """Observations, (num_worlds, m), as rows with fields, (num_worlds,), in the same memory."""
        rows = np.ascontiguousarray(rows)
        return np.ndarray(len(rows), self._type, rows, 0, rows.strides[:1])


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


def record_rows(**fields: Any) -> Any:
    """Rows with named fields for compiled kernels, such as a plan, (rows,).

    Args:
        **fields: Values of each field, (rows, ...).
    """
    shapes = [(name, np.shape(values)[1:]) for name, values in fields.items()]
    rows = np.empty(len(next(iter(fields.values()))), _row_type(*shapes))
    for name, values in fields.items():
        rows[name] = values
    return rows


@cache
def _row_type(*shapes: tuple[str, tuple[int, ...]]) -> np.dtype[Any]:
    """Type of rows, the same object for equal fields: Numba compares others at every call."""
    return record_type(**dict(shapes))


def record_row(**fields: Any) -> Any:
    """One row of constants for compiled kernels, (1,), by field."""
    return record_rows(**{name: [value] for name, value in fields.items()})


def resume_memory(policy: Any, rows: Array, state: Any, episode_start: Any) -> Any:
    """Memory for this call: the one of the last call, with new rows for new episodes.

    Args:
        policy: Policy that begins the memory.
        rows: Observations, (num_worlds, m).
        state: State that the last call returned, or None.
        episode_start: Worlds whose episode begins; None for none where there is a state.

    Raises:
        ElasticError: No state in the middle of an episode, or one of another number of worlds.
    """
    if state is None:
        memory = policy.begin(rows)
        if memory is not None:
            policy.view.require_start(rows, episode_start)
        return memory
    n = len(rows)
    if (number := count_rows(state)) != n:
        raise ElasticError(f"`state` must have one row per world, {n}, got {number}")
    if episode_start is None or np.count_nonzero(episode_start) == 0:
        return state
    is_new = np.broadcast_to(np.asarray(episode_start, dtype=np.bool_), (n,))
    return put_rows(state, is_new, select_rows(policy.begin(rows), is_new))


def count_rows(memory: Any) -> int:
    """Number of worlds of a memory, by its first array."""
    while not isinstance(memory, np.ndarray):
        memory = memory[0]
    return len(memory)


def put_rows(memory: Any, worlds: BoolArray, rows: Any) -> Any:
    """Memory with other rows in some worlds, a (num_worlds,) mask.

    Values that are neither array nor tuple stay.
    """

    def replace(array: Array, other: Array) -> Array:
        result = array.copy()
        result[worlds] = other
        return result

    return _map_arrays(replace, memory, rows)


def select_rows(memory: Any, worlds: BoolArray) -> Any:
    """Memory of some worlds, a (num_worlds,) mask."""
    return _map_arrays(lambda array: array[worlds], memory)


def _map_arrays(function: Callable[..., Array], memory: Any, *others: Any) -> Any:
    """Apply a function to the arrays of memories of the same form."""
    if isinstance(memory, np.ndarray):
        return function(memory, *others)
    if not isinstance(memory, tuple):
        return memory
    parts = [_map_arrays(function, *part) for part in zip(memory, *others, strict=True)]
    return type(memory)(*parts) if hasattr(memory, "_fields") else tuple(parts)
