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
"""A value p where left and right change places: p, −p, or 1 − p as of a share."""


@dataclass(frozen=True)
class Signal:
    """One scalar of an observation or action.

    Attributes:
        name, unit, meaning: In words.
        low, high: Values that it can take.
        kind: Whether sensors show it, the plan has it, or it was commanded; None for what follows
            from these.
        mirrored: What it is in the mirror; None where nobody has said so.
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
        name: Of the field. Its columns are called `name.part`, a single one has the name alone.
        signals: Its columns.
        shape: Of the field.
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
        """A group of one unit.

        Args:
            name: Of the group.
            unit: Of its columns.
            meaning: Of a column, which may name its {part}.
            parts: Names of the columns, and what each is in the mirror.
            kind: See `Signal`.
        """
        names = [f"{name}.{part}" for part in parts] if len(parts) > 1 else [name]
        signals = tuple(
            Signal(own, unit, meaning.format(part=part), kind=kind, mirrored=mirrored)
            for own, (part, mirrored) in zip(names, parts.items(), strict=True)
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
        """The columns of groups, one group after the other."""
        return cls(tuple(signal for group in groups for signal in group.signals))

    def signals_of(self, name: str) -> tuple[Signal, ...]:
        """The signals of a group, see `group`."""
        return self.signals[self.group(name)]

    def columns(self, *names: str) -> slice | list[int]:
        """Indices of the named columns, a slice if they are neighbours."""
        indices = [self.names.index(name) for name in names]
        if indices == list(range(indices[0], indices[0] + len(indices))):
            return slice(indices[0], indices[0] + len(indices))
        return indices

    @cached_property
    def _groups(self) -> dict[str, list[int]]:
        """Columns by the name of a signal, and by each part of it that ends before a dot."""
        found: dict[str, list[int]] = {}
        for i, name in enumerate(self.names):
            for part in itertools.accumulate(name.split("."), "{}.{}".format):
                found.setdefault(part, []).append(i)
        return found

    def group(self, name: str) -> slice:
        """Columns of the signal of that name, or of those whose names begin with it and a dot.

        Raises:
            ConfigurationError: There is none, or they are not neighbours.
        """
        found = self._groups.get(name)
        if found is None:
            groups = dict.fromkeys(own.split(".")[0] for own in self.names)
            error = unknown_name("signal", name, groups)
            error.add_note("an environment's argument `sensors` adds signals to an observation")
            raise error
        if found != list(range(found[0], found[-1] + 1)):
            problem = f"the columns of {name!r} must be neighbours, they are {found}"
            raise ConfigurationError(problem)
        return slice(found[0], found[-1] + 1)

    def space(self, dtype: type[np.float32] | type[np.float64]) -> Any:
        """The Gymnasium space of one world."""
        low = np.array([signal.low for signal in self.signals])
        high = np.array([signal.high for signal in self.signals])
        return spaces.Box(low.astype(dtype), high.astype(dtype), dtype=dtype)


def rename_group(signals: Sequence[Signal], group: str) -> tuple[Signal, ...]:
    """The same quantities by another way, under the name of another group."""
    return tuple(
        replace(signal, name=".".join([group, *signal.name.split(".")[1:]]), kind=None)
        for signal in signals
    )


NO_SIGNALS = SignalTable(())
"""The table of an observation that holds nothing."""
