"""A base policy under a residual: the inputs that the residual acts on, and its low-pass.

The residual is a number in [−1, 1] for every column of the inputs that it acts on, or for every
pair of joints. A decision takes place once in `decision_period` control steps, by the features of
`baselines.residual.features`. The residual times the bound of its column passes a first-order
low-pass, and is an input of the base (`baselines.compensation.inputs`).
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from baselines.compensation.inputs import COMMAND, INPUTS, InputKind, input_signals, inputs_of
from baselines.compensation.policy import (
    NO_INPUTS,
    ONE_WORLD,
    Action,
    Step,
    as_action,
    resume_memory,
)
from baselines.compensation.policy_around import as_batch_policy
from baselines.residual.settings import ResidualSettings
from elastic_env.core.errors import ConfigurationError, unknown_name
from elastic_env.core.signals import Array, BoolArray, Signal
from elastic_env.world.robot_model import RobotModel

Truth: TypeAlias = Callable[[], Sequence[Any]]
"""Present true states and parameters, one entry per environment of a mixture."""


class CorrectedMemory(NamedTuple):
    """Values of the inputs behind the low-pass, (num_worlds, width), and the memory of the base."""

    values: Array
    inner: Any


class Corrected:
    """A base policy under a residual, which the caller decides.

    Args:
        base: Any policy that has the inputs; every policy has `command`.
        model: Assumed robot.
        settings: Settings of the residual.
        truth: Truth for a teacher, see `baselines.residual.true_robot.truth_of`.

    Raises:
        ConfigurationError: The base does not have an input, or the robot does not have a joint.
    """

    def __init__(
        self,
        base: Any,
        model: RobotModel,
        settings: ResidualSettings,
        truth: Truth | None = None,
    ) -> None:
        inputs = inputs_of(base)
        if missing := [name for name in settings.acts_on if name not in inputs]:
            raise ConfigurationError(
                f"the residual acts on {', '.join(missing)}, which {type(base).__name__} does not"
                f" have as an input; it has: {', '.join(inputs)}"
            )
        self.base = as_batch_policy(base, model)
        self.settings = settings
        self.model = model
        self.truth = truth
        self.view = self.base.view
        self.channels = Channels(model, settings)
        self.num_residuals = len(self.channels.signals)
        """Number k of values in a residual."""
        cycles = settings.cutoff_hz * model.control_period_s
        self._filter_share = 1.0 - float(np.exp(-2.0 * np.pi * cycles))

    def begin(self, rows: Array) -> CorrectedMemory:
        """Memory at the start of an episode with these first observations, (num_worlds, m)."""
        values = np.zeros((len(rows), len(self.channels.bounds)))
        return CorrectedMemory(values, self.base.begin(rows))

    def act(
        self, observation: Array, residual: Array, state: Any = None, episode_start: Any = None
    ) -> tuple[Action, Any]:
        """Action and new state under a residual, (num_worlds, k) within [−1, 1].

        A residual that has been zero since the start of the episode gives the bits of the base's
        action.
        """
        rows = self.view.rows(observation)
        memory = resume_memory(self, rows, state, episode_start)
        inputs = ONE_WORLD if np.ndim(observation) == 1 else NO_INPUTS
        action, memory = self.correct(rows, residual, memory, inputs)
        return as_action(action, inputs.is_single), memory

    def correct(self, rows: Array, residual: Array, memory: Any, inputs: Any) -> Step:
        """Act with the base and the correction: joint offsets, (num_worlds, n) [rad], and memory.

        Args:
            rows: Observations, (num_worlds, m).
            residual: Within [−1, 1], (num_worlds, k).
            memory: Memory of the last control step.
            inputs: Arguments of `predict`; the residual sets the values of the inputs.
        """
        values = self.channels.approach(memory.values, residual, self._filter_share)
        parts = self.channels.parts(values)
        offset = parts.pop(COMMAND, None)
        action, inner = self.base.act(rows, memory.inner, inputs._replace(**parts))
        if offset is not None:
            action = (action + offset).astype(np.float32)
        return action, CorrectedMemory(values, inner)

    def base_memory(self, rows: Array, state: Any, episode_start: Any) -> Any:
        """Memory of the base before it acts on observations, for the state of the last step."""
        inner = None if state is None else state.inner
        return resume_memory(self.base, rows, inner, episode_start)

    def base_action(self, rows: Array, state: Any, episode_start: Any) -> Array:
        """Command of the base alone, (num_worlds, n) [rad]."""
        memory = self.base_memory(rows, state, episode_start)
        return self.base.act(rows, memory, NO_INPUTS)[0]

    def link_estimate(self, observation: Array, state: Any) -> Array:
        """Estimated link angles for an observation and the state after it, (..., n) [rad]."""
        return self.base.link_estimate(observation, state.inner)


class Channels:
    """Columns on which a residual acts, input after input.

    Args:
        model: Assumed robot.
        settings: Settings of the residual.

    Attributes:
        signals: Values of a residual as signals, (k,); shared by left and right they have no side.
        bounds: Bound of every column, (width,); zero where the residual does not act.
        source: Number of the value that each column follows, (width,).
        columns: Signals of the columns, (width,).

    Raises:
        ConfigurationError: A joint or an axis that does not exist, or a joint without a bound.
    """

    def __init__(self, model: RobotModel, settings: ResidualSettings) -> None:
        signals: dict[str, Signal] = {}
        bounds: list[float] = []
        sources: list[str | None] = []
        columns: list[Signal] = []
        self._columns: dict[str, slice] = {}
        for name in settings.acts_on:
            first = len(bounds)
            input_bounds = _column_bounds(name, settings, model.joint_names).tolist()
            input_columns = input_signals(name, model)
            for column, bound in zip(input_columns, input_bounds, strict=True):
                shared = settings.shared and INPUTS[name].axes is None
                source = _without_side(column.name) if shared else column.name
                if bound > 0.0:
                    signals.setdefault(source, column)
                sources.append(source if bound > 0.0 else None)
            bounds += input_bounds
            columns += input_columns
            self._columns[name] = slice(first, len(bounds))
        self.bounds = np.array(bounds)
        self.columns = tuple(columns)
        order = {name: number for number, name in enumerate(signals)}
        self.source = np.array([order.get(source or "", 0) for source in sources])
        ends = {"low": -1.0, "high": 1.0}
        self.signals = tuple(replace(s, name=key, **ends) for key, s in signals.items())

    def approach(self, values: Array, residual: Array, share: float) -> Array:
        """Values of all columns after a share of their way to a residual, (num_worlds, width).

        Args:
            values: Values before.
            residual: Within [−1, 1], (num_worlds, k).
            share: 1 for the whole way.
        """
        target = self.bounds * residual.take(self.source, axis=1)
        return values + share * (target - values)

    def parts(self, values: Array) -> dict[str, Array]:
        """Values by input, (..., width) to (..., columns of the input)."""
        return {name: values[..., columns] for name, columns in self._columns.items()}


def _column_bounds(name: str, settings: ResidualSettings, joints: list[str]) -> Array:
    """Bound of every column of an input, (columns,); zero where the residual does not act."""
    kind = INPUTS[name]
    bound = settings.bounds[name]
    names = kind.columns(joints)
    chosen = np.ones(len(names), dtype=np.bool_)
    wanted_joints = settings.joints if kind.axes is None else None
    if wanted_joints is not None:
        chosen = np.any([fit_columns(j, names, kind) for j in wanted_joints], axis=0)
    if not isinstance(bound, dict):
        return np.where(chosen, bound, 0.0)
    bounds = np.zeros(len(names))
    for wanted, value in bound.items():
        bounds[fit_columns(wanted, names, kind)] = value
    missing = np.array(names)[chosen & (bounds == 0.0)].tolist()
    if missing and wanted_joints is not None:
        raise ConfigurationError(
            f"{name} must have a bound for every joint of `joints`, none fits {missing}"
        )
    return np.where(chosen, bounds, 0.0)


def fit_columns(wanted: str, names: list[str], kind: InputKind) -> BoolArray:
    """Columns with this name or ending of a name, a mask.

    Raises:
        ConfigurationError: There is none.
    """
    fits = np.array([name == wanted or name.endswith(f"_{wanted}") for name in names])
    if not fits.any():
        noun = "joint" if kind.axes is None else "axis of an input"
        raise unknown_name(noun, wanted, names)
    return fits


def _without_side(name: str) -> str:
    """Name of a column without its side."""
    group, _, part = name.partition(".")
    return f"{group}.{part.removeprefix('l_').removeprefix('r_')}"
