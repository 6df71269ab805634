"""The control step of a robot of elastic joints, from the command to the observation.

    command → (physics) → truth → measured → ends, scores and observation

Kernels do the arithmetic, see `elastic_env.world.joint_kernels`. Blocks of records hold the last
control steps. Signals and metrics are computed from them on demand.
"""

import functools
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt
from gymnasium.error import ResetNeeded

from elastic_env.core.signals import Array, BoolArray, IntArray
from elastic_env.world import further_sensors as further
from elastic_env.world import joint_kernels as kernels
from elastic_env.world import records
from elastic_env.world.further_sensors import FurtherSensors, SensorInputs
from elastic_env.world.joint_signals import action_error
from elastic_env.world.noise_stream import NoiseStream
from elastic_env.world.physics import Simulation
from elastic_env.world.records import Records, Sample, spring_torque


class Transition(NamedTuple):
    """Result of a control step, one row per world."""

    observation: Array
    reward: Array
    terminated: BoolArray
    truncated: BoolArray
    info: dict[str, Any]

    @property
    def done(self) -> BoolArray:
        """Worlds whose episode has ended."""
        return self.terminated | self.truncated


class ControlStep(ABC):
    """The control step of all worlds, for `elastic_env.world.task.Task`, which sets its attributes.

    Attributes:
        config: Configuration with `sensors`.
        model: Plant of the robot without drawn parameters.
        num_worlds: Number of worlds.
        num_substeps: Physics steps in a control period.
        simulation: The physics.
        world_type: Structured type of a world's record in a control step: truth, measured, scores.
    """

    config: Any
    model: mujoco.MjModel
    num_worlds: int
    num_substeps: int
    simulation: Simulation
    world_type: np.dtype[Any]

    _joints: Records
    """Joints in the last control steps, (rows, num_worlds, n)."""
    _worlds: Records
    """Worlds in the last control steps, (rows, num_worlds)."""
    _row: int
    """Row of the present control step."""
    _unscored: int
    """First row that is not in the metrics yet."""
    _steps_per_block: int
    _constants: tuple[Any, ...]
    """Fields of `kernels.Step` from `addresses` on."""
    _rules: Records
    """Control period and encoder of each kind of worlds, (kinds,)."""
    _kind: IntArray
    """Index of the rules of each world, (num_worlds,)."""
    _noise: NoiseStream
    _sensors: FurtherSensors
    _has_sensors: bool
    _has_further_terms: bool
    """True if a user's task adds to the reward."""
    _has_episode: BoolArray
    _all_have_episodes: bool
    _bound: Array
    """Largest command offset of every joint [rad]."""
    _action_shape: tuple[int, ...]
    _action_rules: tuple[Any, ...]
    """Arguments of `action_error` after the action."""
    _width: int
    """Columns of the observation."""
    _failures: tuple[str, ...]
    """Reasons of termination, the first rows of `kernels.Control.ends`."""
    _no_reason: npt.NDArray[np.str_]
    """Reasons of termination where no world ends: empty texts."""

    _periods = 1.0
    """Control periods in the last step."""

    def step(self, action: npt.ArrayLike) -> Transition:
        """Advance by one control period under the actions, (num_worlds, n) [rad].

        Raises:
            ActionError: Wrong shape, or a value that is not finite.
            ResetNeeded: A world has not begun an episode yet.
        """
        if not self._all_have_episodes:
            missing = np.flatnonzero(~self._has_episode).tolist()
            some = f", of the worlds {missing} too" if self._has_episode.any() else ""
            raise ResetNeeded(f"reset() comes before the first step(){some}")
        offset, is_clipped = self._command(action)
        self._disturb()
        self.simulation.advance(self.num_substeps)
        self._advance_rows(1)
        observation, reward, ends, is_over = self._sense(offset, is_clipped)
        compute_rest = functools.partial(self._step_info, self.sample())
        info = StepInfo({"termination": self._no_reason}, compute_rest)
        if is_over:
            info.update(self._end_info(ends))
        return Transition(observation, reward, ends[-2], ends[-1], info)

    def observe(self) -> Array:
        """Observe the present state, (num_worlds, len(observation_table))."""
        observation = np.empty((self.num_worlds, self._width))
        kernels.observe_all_joints(self._step, observation)
        self._observe_worlds(observation)
        self._observe_sensors(observation)
        return observation

    def sample(self) -> Sample:
        """Return the records of the present control step."""
        return Sample(self._joints[self._row], self._worlds[self._row])

    @property
    def _step(self) -> tuple[Any, ...]:
        """Arguments of `kernels.step_at` for the present step."""
        return (self._joints, self._worlds, self._row, *self._constants)

    def _command(self, action: npt.ArrayLike) -> tuple[Array, BoolArray]:
        """Command the servos; return the clipped offsets and the worlds with a clipped one."""
        values = np.asarray(action)
        if values.dtype.kind not in "fiub" or values.shape != self._action_shape:
            raise action_error(values, *self._action_rules)
        offset = values.astype(np.float64, order="C")
        is_clipped = np.empty(self.num_worlds, dtype=np.bool_)
        arrays = (offset, self._bound, is_clipped, self.simulation.ctrl)
        if not kernels.write_commands(self._step, *arrays, *kernels.EVERY_WORLD):
            raise action_error(values.astype(np.float64), *self._action_rules)
        return offset, is_clipped

    def _sense(self, offset: Array, is_clipped: BoolArray) -> tuple[Array, Array, BoolArray, bool]:
        """Return observation, reward and ends of the last step, and True if an episode ends."""
        n = self.num_worlds
        observation = np.empty((n, self._width))
        reward = np.empty(n)
        ends = np.empty((len(self._failures) + 2, n), dtype=np.bool_)
        diverged = self.simulation.divergence()
        command = (offset, is_clipped, diverged, self._periods)
        is_over = self._sense_worlds((*command, observation, reward, ends))
        if self._has_sensors:
            self._sensors.measure(~diverged, self._sensor_inputs())
            self._observe_sensors(observation)
        if self._has_further_terms:
            for term in self.further_reward_terms(self.sample()).values():
                reward += term
        return observation, reward, ends, is_over

    def _observe_sensors(self, observation: Array) -> None:
        """Fill the columns of further sensors."""
        if self._has_sensors:
            is_delayed = self._rules["is_delayed"][self._kind]
            first = self._width - len(self._sensors.signals)
            observation[:, first:] = self._sensors.columns(is_delayed)

    def _sensor_inputs(self) -> SensorInputs:
        """Return the truth for further sensors; that of the accelerometer is a physics step old."""
        truth = self._joints[self._row]["truth"]
        force = np.full((self.num_worlds, 3), np.nan)
        if further.ACCELEROMETER in self.config.sensors:
            begin = int(self.model.sensor(further.ACCELEROMETER).adr[0])
            force = self.simulation.bind("sensordata")[:, begin : begin + 3].copy()
        return SensorInputs(truth["q"].copy(), spring_torque(truth), force)

    def _advance_rows(self, count: int) -> None:
        """Advance to new records, in a new block if this one is full.

        Samples may still refer to the old block.
        """
        if self._row + count >= len(self._joints):
            self.score()
            present = slice(self._row - 1, self._row + 1)
            self._begin_block(self._joints[present], self._worlds[present])
        self._row += count

    def _begin_block(self, joints: Records, worlds: Records) -> None:
        """Allocate records for the next steps, after those of the last step and the present one."""
        steps = self._steps_per_block + 2
        self._joints = np.zeros((steps, *joints.shape[1:]), records.JOINT)
        self._worlds = np.zeros((steps, self.num_worlds), self.world_type)
        self._joints[:2] = joints
        self._worlds[:2] = worlds
        self._row = 1
        self._unscored = 2
        self._noise.prepare(self._steps_per_block)

    # steps that tasks implement

    @abstractmethod
    def score(self) -> None:
        """Add all unscored steps to the metrics."""

    def further_reward_terms(self, sample: Sample) -> dict[str, Array]:  # noqa: ARG002
        """Return terms that a user's task adds to the reward, one value per row."""
        return {}

    def _disturb(self) -> None:  # noqa: B027  most robots are not pushed
        """Apply external forces during the coming control period."""

    @abstractmethod
    def _sense_worlds(self, control: tuple[Any, ...]) -> bool:
        """Sense, end, score and observe by parts of `kernels.Control`; True if an episode ends."""

    @abstractmethod
    def _observe_worlds(self, observation: Array) -> None:
        """Fill the columns of the present state that are not the joints'."""

    @abstractmethod
    def _step_info(self, sample: Sample) -> dict[str, Any]:
        """Reward terms, signals and clipping of a step."""

    @abstractmethod
    def _end_info(self, ends: BoolArray) -> dict[str, Any]:
        """Reasons of termination, and figures of the episodes that end."""


class StepInfo(dict[str, Any]):
    """A dictionary that computes some of its entries at first use.

    Reading a key of `known` costs nothing; any other access computes the rest, once.

    Args:
        known: Entries that exist from the start.
        compute_rest: Computes the other entries; the result must not depend on when it is called.
    """

    __slots__ = ("_compute_rest",)

    def __init__(self, known: dict[str, Any], compute_rest: Callable[[], dict[str, Any]]) -> None:
        super().__init__(known)
        self._compute_rest: Callable[[], dict[str, Any]] | None = compute_rest

    def _complete(self) -> None:
        if self._compute_rest is not None:
            compute_rest = self._compute_rest
            self._compute_rest = None
            for key, value in compute_rest().items():
                super().setdefault(key, value)

    def __missing__(self, key: str) -> Any:
        if self._compute_rest is None:
            raise KeyError(key)
        self._complete()
        return self[key]

    def __contains__(self, key: object) -> bool:
        if not super().__contains__(key):
            self._complete()
        return super().__contains__(key)

    def clear(self) -> None:
        """Remove all entries, including those not yet computed."""
        self._compute_rest = None
        super().clear()

    def __eq__(self, other: object) -> bool:
        theirs = other.copy() if isinstance(other, StepInfo) else other
        return self.copy() == theirs

    def __ne__(self, other: object) -> bool:
        return not self == other

    __hash__ = None  # type: ignore[assignment]

    def __reduce_ex__(self, protocol: Any) -> Any:
        return dict, (self.copy(),)


def _completing_method(name: str) -> Callable[..., Any]:
    """Return a method of `dict` that first computes the missing entries."""
    method: Callable[..., Any] = getattr(dict, name)

    @functools.wraps(method)
    def complete_and_call(self: StepInfo, *arguments: Any) -> Any:
        self._complete()
        return method(self, *arguments)

    return complete_and_call


_WRITERS = ("pop", "popitem", "setdefault", "__delitem__")
_READERS = ("get", "keys", "values", "items", "copy")
_OPERATORS = ("__iter__", "__reversed__", "__len__", "__repr__", "__or__")
for _name in (*_WRITERS, *_READERS, *_OPERATORS):
    setattr(StepInfo, _name, _completing_method(_name))
