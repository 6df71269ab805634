"""From the numbers of a residual to the inputs of a base policy: which column gets which number, and how much of it."""

import numpy as np

from baselines.compensation.inputs import COMMAND, INPUTS, InputKind, PolicyInputs, input_signals
from baselines.residual.residual_kernels import approach
from baselines.residual.settings import ResidualSettings
from elastic_env.core.errors import ConfigurationError, unknown_name
from elastic_env.core.signals import Array, BoolArray, Signal
from elastic_env.runtime.robot_model import RobotModel


class Channels:
    """What a residual acts on, by its settings: the columns of all its inputs, one input after the other.

    Args:
        model: What may be known of the robot.
        settings: How the residual acts.

    Attributes:
        signals: The numbers of a residual, (k,), as signals; those that left and right share have no side.
        bounds: Bound of every column, (width,); zero where the residual does not act.

    Raises:
        ConfigurationError: A joint or an axis that does not exist, or a joint without a bound.
    """

    def __init__(self, model: RobotModel, settings: ResidualSettings) -> None:
        self._names, self._ends = list(settings.acts_on), [0]
        signals: dict[str, Signal] = {}
        bounds, sources = [], []
        for name in self._names:
            of_input = _bounds(name, settings, model.joint_names)
            columns = input_signals(name, model)
            called = [_shared(s.name) if settings.shared and INPUTS[name].axes is None else s.name for s in columns]
            acting = np.flatnonzero(of_input)
            for column in acting:
                signals.setdefault(called[column], columns[column])
            order = list(signals)
            sources.append([order.index(called[column]) for column in acting])
            bounds.append(of_input)
            self._ends.append(self._ends[-1] + len(of_input))
        self.bounds = np.concatenate(bounds)
        self._source = np.full(len(self.bounds), -1, dtype=np.int64)
        self._source[np.flatnonzero(self.bounds)] = np.concatenate(sources)
        spans = dict(zip(self._names, map(slice, self._ends, self._ends[1:]), strict=False))
        self._command = spans.pop(COMMAND, None)
        self._spans = [spans.get(name) for name in PolicyInputs._fields]
        self.signals = tuple(_renamed(signal, name) for name, signal in signals.items())

    @property
    def width(self) -> int:
        """Columns of all inputs."""
        return len(self.bounds)

    def towards(self, values: Array, residual: Array, share: float) -> Array:
        """Values of all columns after a share of their way to what a residual wants, (num_worlds, width).

        Args:
            values: Before.
            residual: Within [−1, 1], (num_worlds, k).
            share: 1 for all of the way.
        """
        now = np.empty((len(residual), self.width))
        approach(
            np.ascontiguousarray(values), np.ascontiguousarray(residual, dtype=np.float64), self._source, self.bounds,
            share, now,
        )  # fmt: skip
        return now

    def parts(self, values: Array) -> dict[str, Array]:
        """Values by input, (..., width) to (..., columns of the input)."""
        spans = zip(self._names, self._ends, self._ends[1:], strict=False)
        return {name: values[..., begin:end] for name, begin, end in spans}

    def inputs(self, values: Array) -> tuple[PolicyInputs, Array | None]:
        """Values as inputs of a base policy, and as an offset of its command, if there is one [rad]."""
        inputs = PolicyInputs._make([None if span is None else values[:, span] for span in self._spans])
        return inputs, None if self._command is None else values[:, self._command]


def _bounds(name: str, settings: ResidualSettings, joint_names: list[str]) -> Array:
    """Bound of every column of an input, (columns,); zero where the residual does not act."""
    kind, bound = INPUTS[name], settings.bounds[name]
    names = kind.columns(joint_names)
    chosen = np.ones(len(names), dtype=np.bool_)
    if kind.axes is None and settings.joints is not None:
        chosen = np.any([fitting(wanted, names, kind) for wanted in settings.joints], axis=0)
    if not isinstance(bound, dict):
        return np.where(chosen, bound, 0.0)
    bounds = np.zeros(len(names))
    for wanted, value in bound.items():
        bounds[fitting(wanted, names, kind)] = value
    missing = [column for column, acts in zip(names, chosen & (bounds == 0.0), strict=True) if acts]
    if missing and kind.axes is None and settings.joints is not None:
        raise ConfigurationError(f"{name} must have a bound for every joint of `joints`, none fits {missing}")
    return np.where(chosen, bounds, 0.0)


def fitting(wanted: str, names: list[str], kind: InputKind) -> BoolArray:
    """Columns that are called so, or whose names end so.

    Raises:
        ConfigurationError: There is none.
    """
    fits = np.array([name == wanted or name.endswith(f"_{wanted}") for name in names])
    if not fits.any():
        raise unknown_name("joint" if kind.axes is None else "axis of an input", wanted, names)
    return fits


def _shared(name: str) -> str:
    """A column's name without its side."""
    group, _, part = name.partition(".")
    return f"{group}.{part.removeprefix('l_').removeprefix('r_')}"


def _renamed(signal: Signal, name: str) -> Signal:
    return Signal(name, signal.unit, signal.meaning, -1.0, 1.0, mirrored=signal.mirrored)
