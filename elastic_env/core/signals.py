"""Named arrays that know their units: the columns of observations and actions."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, Self, TypeAlias

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from elastic_env.core.errors import ConfigurationError, unknown_name

Array: TypeAlias = npt.NDArray[np.floating[Any]]
"""Real numbers, float64 throughout."""
Signals: TypeAlias = dict[str, npt.NDArray[Any]]
"""Named values of one step, one row per world."""
Parameter: TypeAlias = Array | float
"""A parameter that is broadcast against an array: one number, or one per joint."""
BoolArray: TypeAlias = npt.NDArray[np.bool_]
IntArray: TypeAlias = npt.NDArray[np.int64]
Kind: TypeAlias = Literal["measured", "reference", "command"]
Mirrored: TypeAlias = Literal["same", "opposite", "complement"]
"""A value p after left and right have changed places: p, −p, or 1 − p for a share."""


@dataclass(frozen=True)
class Signal:
    """One scalar of an observation or action.

    Attributes:
        name, unit, meaning: In words.
        low, high: Bounds of its values.
        kind: Source: sensors, the plan, or the command; None for a value computed from these.
        mirrored: Value after left and right have changed places; None where it is not declared.
    """

    name: str
    unit: str
    meaning: str
    low: float = -np.inf
    high: float = np.inf
    kind: Kind | None = None
    mirrored: Mirrored | None = None


@dataclass(frozen=True)
class SignalGroup:
    """Signals that are read together: neighbours in the observation, one field of a structured row.

    Attributes:
        name: Name of the field. Its columns are called `name.part`, a single one `name`.
        signals: Its columns.
        shape: Shape of the field.
    """

    name: str
    signals: tuple[Signal, ...]
    shape: tuple[int, ...]

    @classmethod
    def of(
        cls,
        name: str,
        unit: str,
        meaning: str,
        parts: Mapping[str, Mirrored | None],
        kind: Kind | None,
    ) -> Self:
        """Make a group of one unit.

        Args:
            name: Name of the group.
            unit: Unit of its columns.
            meaning: Meaning of a column, with {part} for the name of the part.
            parts: Names of the columns, and `mirrored` of each, see `Signal`.
            kind: See `Signal`.
        """
        names = [f"{name}.{part}" for part in parts] if len(parts) > 1 else [name]
        signals = tuple(
            Signal(column, unit, meaning.format(part=part), kind=kind, mirrored=image)
            for column, (part, image) in zip(names, parts.items(), strict=True)
        )
        return cls(name, signals, (len(signals),))


@dataclass(frozen=True)
class SignalTable:
    """An ordered list of signals, the columns of an array."""

    signals: tuple[Signal, ...]

    def __len__(self) -> int:
        return len(self.signals)

    def __iter__(self) -> Iterator[Signal]:
        return iter(self.signals)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Column names in order."""
        return tuple(signal.name for signal in self.signals)

    @classmethod
    def of(cls, groups: Sequence[SignalGroup]) -> Self:
        """Make a table of the columns of groups, one group after the other."""
        return cls(tuple(signal for group in groups for signal in group.signals))

    def signals_of(self, name: str) -> tuple[Signal, ...]:
        """Return the signals of a group, see `group`."""
        return self.signals[self.group(name)]

    def columns(self, *names: str) -> slice | list[int]:
        """Return the indices of the named columns, a slice if they are neighbours."""
        indices = [self.names.index(name) for name in names]
        if indices == list(range(indices[0], indices[0] + len(indices))):
            return slice(indices[0], indices[0] + len(indices))
        return indices

    @cached_property
    def _groups(self) -> dict[str, list[int]]:
        """Columns by the name of a signal, and by each part of it that ends before a dot."""
        groups: dict[str, list[int]] = {}
        for i, name in enumerate(self.names):
            for part in itertools.accumulate(name.split("."), "{}.{}".format):
                groups.setdefault(part, []).append(i)
        return groups

    def group(self, name: str) -> slice:
        """Return the columns of a signal, or of all signals whose names begin with it and a dot.

        Raises:
            ConfigurationError: There is none, or they are not neighbours.
        """
        indices = self._groups.get(name)
        if indices is None:
            groups = dict.fromkeys(column.split(".")[0] for column in self.names)
            error = unknown_name("signal", name, groups)
            error.add_note("an environment's argument `sensors` adds signals to an observation")
            raise error
        if indices != list(range(indices[0], indices[-1] + 1)):
            problem = f"the columns of {name!r} must be neighbours, they are {indices}"
            raise ConfigurationError(problem)
        return slice(indices[0], indices[-1] + 1)

    def space(self, dtype: type[np.float32] | type[np.float64]) -> Any:
        """Return the Gymnasium space of one world."""
        low = np.array([signal.low for signal in self.signals])
        high = np.array([signal.high for signal in self.signals])
        return spaces.Box(low.astype(dtype), high.astype(dtype), dtype=dtype)


def rename_group(signals: Sequence[Signal], group: str) -> tuple[Signal, ...]:
    """Return the same quantities, from another source, under the name of another group."""
    return tuple(
        replace(signal, name=".".join([group, *signal.name.split(".")[1:]]), kind=None)
        for signal in signals
    )


NO_SIGNALS = SignalTable(())
"""The table of an empty observation."""
