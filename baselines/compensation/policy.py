"""Policies: their protocol, and the base class of ours.

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

from baselines.compensation.compiled_rows import Records
from baselines.compensation.first_observation import require_start
from baselines.compensation.memory_rows import put_rows, select_rows
from elastic_env.core.errors import ElasticError, unknown_name
from elastic_env.core.signals import Array, IntArray, Signal, SignalTable
from elastic_env.world.robot_model import RobotModel


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


class Zero(BatchPolicy):
    """Commands the reference itself: no offset and no memory."""

    reads_rates = False

    @override
    def begin(self, rows: Array) -> None:
        return None

    @override
    def act(self, rows: Array, memory: None, inputs: PolicyInputs) -> Step:
        return np.zeros((len(rows), self.view.num_joints), dtype=np.float32), None


def as_action(offsets: Array, is_single: bool) -> Action:
    """Offsets in single precision: all rows, or the only row for an observation of one world."""
    return (offsets[0] if is_single else offsets).astype(np.float32, copy=False)


def resume_memory(policy: Any, rows: Array, state: Any, episode_start: Any) -> Any:
    """Memory for this call: the one of the last call, with new rows for new episodes.

    Args:
        policy: Policy that begins the memory, with its `model`.
        rows: Observations, (num_worlds, m).
        state: State that the last call returned, or None.
        episode_start: Worlds whose episode begins; None for none where there is a state.

    Raises:
        ElasticError: No state in the middle of an episode, or one of another number of worlds.
    """
    if state is None:
        memory = policy.begin(rows)
        if memory is not None:
            require_start(policy.model, rows, episode_start)
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
