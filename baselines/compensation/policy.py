"""What a policy is, and what policies share: the columns of an observation, and memory from call to call.

Policies take observations of one world, (m,), or of many, (num_worlds, m). Those with memory keep it in `state`, one
row per world: pass the returned state back, and `episode_start` where episodes begin, as Stable-Baselines3 does.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from baselines.compensation.compensators import Motion
from baselines.compensation.inputs import NO_INPUTS, PolicyInputs, inputs_of
from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array, BoolArray, SignalTable

Action = npt.NDArray[np.float32]


class Policy(Protocol):
    """Commands the robot; a Stable-Baselines3 model is one too."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Any, Any]:
        """Action and new state for an observation."""
        ...


class PolicyWithInputs(ABC):
    """A policy in whose own quantities something outside can act, see `baselines.compensation.inputs`."""

    @property
    @abstractmethod
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs that it has beside `command`: its own, and those of the policies inside it."""

    def predict(
        self, observation: Array, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Action, Any]:
        """Action and new state.

        Raises:
            ElasticError: Called in the middle of an episode without the state of the last call.
        """
        return self.predict_with(observation, NO_INPUTS, state, episode_start, deterministic)

    @abstractmethod
    def predict_with(
        self,
        observation: Array,
        inputs: PolicyInputs,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Action, Any]:
        """`predict` under inputs: a policy takes what is its own and passes on the rest.

        Args:
            observation: As in `predict`.
            inputs: Their values; zeros are as if there were none, to the last bit.
            state: As in `predict`.
            episode_start: As in `predict`.
            deterministic: As in `predict`.
        """

    @abstractmethod
    def link_estimate(self, observation: Array, state: Any) -> Array:
        """Link angles that the policy saw in the place of an observation's encoders, (..., n) [rad].

        Args:
            observation: As in `predict`.
            state: What `predict` returned for it.
        """


class PolicyAround(PolicyWithInputs):
    """A policy around another one, whose state is the second part of its own."""

    _policy: Any

    @property
    def inputs(self) -> tuple[str, ...]:
        """Those of the policy inside it."""
        return inputs_of(self._policy)[1:]

    def link_estimate(self, observation: Array, state: Any) -> Array:
        """Link angles that the policy inside it saw, (..., n) [rad]."""
        return self._policy.link_estimate(observation, state[1])


def predicted(policy: Any, observation: Array, inputs: PolicyInputs, *call: Any) -> tuple[Any, Any]:
    """Action and new state of a policy under inputs; one that gets none need not know of any.

    Args:
        policy: Any policy.
        observation: As in `predict`.
        inputs: What is left for it.
        *call: state, episode_start and deterministic as in `predict`.
    """
    if inputs.is_empty:
        return policy.predict(observation, *call)
    return policy.predict_with(observation, inputs, *call)


class Zero:
    """Plays the reference back: no offset, no memory, and it takes the encoder for the link."""

    def __init__(self, table: SignalTable) -> None:
        self._encoder = table.group("encoder_angle")

    def predict(
        self,
        observation: Array,
        state: Any = None,
        episode_start: Any = None,  # noqa: ARG002  the interface's
        deterministic: bool = True,  # noqa: ARG002
    ) -> tuple[Action, Any]:
        """Zero offset, (..., n)."""
        return np.zeros(observation[..., self._encoder].shape, dtype=np.float32), state

    def link_estimate(self, observation: Array, state: Any) -> Array:  # noqa: ARG002
        """The encoder angle, (..., n) [rad]."""
        return observation[..., self._encoder]


class ObservationView:
    """Where an observation table holds what compensators need, by name."""

    def __init__(self, table: SignalTable, control_period_s: float) -> None:
        self._width, self._period_s = len(table), control_period_s
        self._clock = table.group("clock") if "clock.time" in table.names else None
        self._theta, self._theta_dot = table.group("encoder_angle"), table.group("encoder_rate")
        self._q, self._q_dot = table.group("reference_angle"), table.group("reference_rate")
        self._q_ddot, self._command = table.group("reference_acceleration"), table.group("last_command")

    def theta(self, rows: Array) -> Array:
        """Encoder angles, (num_worlds, n) [rad]."""
        return rows[:, self._theta]

    def theta_dot(self, rows: Array) -> Array:
        """Encoder rates, (num_worlds, n) [rad/s]."""
        return rows[:, self._theta_dot]

    def motion(self, rows: Array) -> Motion:
        """Reference motion for the coming control period, (num_worlds, n) each."""
        return Motion(rows[:, self._q], rows[:, self._q_dot], rows[:, self._q_ddot])

    def with_links(self, rows: Array, q: Array, q_dot: Array) -> Array:
        """A copy of the observation with link angles and rates in place of the encoders'."""
        seen = rows.copy()
        seen[:, self._theta], seen[:, self._theta_dot] = q, q_dot
        return seen

    def rows(self, observation: Array) -> Array:
        """The observation with one row per world, (num_worlds, m).

        Raises:
            ElasticError: It does not have the columns of the table.
        """
        rows = np.asarray(observation, dtype=np.float64)
        rows = rows[None] if rows.ndim < 2 else rows
        if rows.ndim != 2 or rows.shape[1] != self._width:
            raise ElasticError(
                f"an observation must have the {self._width} columns of its table, one row per world, got shape "
                f"{np.shape(observation)}"
            )
        return rows

    def is_start(self, rows: Array) -> BoolArray:
        """Whether an observation can be the first of an episode: by its clock, or standing with nothing commanded.

        Nothing is commanded where the last command is the reference, or zero, as an environment may begin with.
        """
        if self._clock is not None:
            return rows[:, self._clock][:, 0] < 1.5 * self._period_s
        command = rows[:, self._command]
        nothing = (command == rows[:, self._q]).all(axis=1) | (command == 0.0).all(axis=1)
        return (rows[:, self._q_dot] == 0.0).all(axis=1) & nothing

    @property
    def sign_of_start(self) -> str:
        """By what `is_start` knows it, in words."""
        return "clock.time" if self._clock is not None else "a reference at rest, and no command yet"


def taken_up(
    state: Any, episode_start: Any, rows: Array, view: ObservationView, begin: Callable[[], Array]
) -> tuple[Array, Any]:
    """Memory and inner state for this call, with the rows of new episodes begun afresh."""
    if state is None:
        starts = view.is_start(rows) if episode_start is None else np.broadcast_to(episode_start, (len(rows),))
        if not np.all(starts):
            raise ElasticError(
                "predict() was called without `state` in what looks like the middle of an episode (a beginning is "
                f"known by {view.sign_of_start}): this policy has memory; pass the state that the last call returned, "
                "and episode_start=True where an episode begins"
            )
        return begin(), None
    memory, inner_state = state
    if len(memory) != len(rows):
        raise ElasticError(f"`state` must have one row per world, {len(rows)}, got {len(memory)}")
    if episode_start is not None and episode_start is not False and np.count_nonzero(episode_start) > 0:
        fresh = np.broadcast_to(np.asarray(episode_start, dtype=np.bool_), (len(rows),))
        memory = np.where(fresh[:, None], begin(), memory)
    return memory, inner_state
