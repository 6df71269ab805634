"""Named arrays that know their units: the one description of what an observation or an action holds."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

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


@dataclass(frozen=True)
class Signal:
    """One scalar of an observation or action: name, unit, meaning, and the values it can take."""

    name: str
    unit: str
    meaning: str
    low: float = -np.inf
    high: float = np.inf


@dataclass(frozen=True)
class SignalTable:
    """An ordered list of signals, the columns of an array."""

    signals: tuple[Signal, ...]

    def __len__(self) -> int:
        return len(self.signals)

    def __iter__(self) -> Iterator[Signal]:
        return iter(self.signals)

    @property
    def names(self) -> tuple[str, ...]:
        """Column names in order."""
        return tuple(signal.name for signal in self.signals)

    def extended(self, signals: Sequence[Signal]) -> "SignalTable":
        """This table with further columns behind its own."""
        return SignalTable((*self.signals, *signals))

    def columns(self, *names: str) -> slice | list[int]:
        """Where the named columns stand, a slice if they are neighbours."""
        indices = [self.names.index(name) for name in names]
        if indices == list(range(indices[0], indices[0] + len(indices))):
            return slice(indices[0], indices[0] + len(indices))
        return indices

    def group(self, name: str) -> slice:
        """Where the signal of that name stands, or the signals whose names begin with it and a dot, in order.

        Raises:
            ConfigurationError: There is none, or they are not neighbours.
        """
        found = [i for i, own in enumerate(self.names) if own == name or own.startswith(f"{name}.")]
        if not found:
            raise unknown_name("signal", name, dict.fromkeys(own.split(".")[0] for own in self.names))
        if found != list(range(found[0], found[-1] + 1)):
            raise ConfigurationError(f"the columns of {name!r} must be neighbours, they are {found}")
        return slice(found[0], found[-1] + 1)

    def space(self, dtype: type[np.float32] | type[np.float64]) -> Any:
        """The Gymnasium space of one world."""
        low = np.array([signal.low for signal in self.signals])
        high = np.array([signal.high for signal in self.signals])
        return spaces.Box(low.astype(dtype), high.astype(dtype), dtype=dtype)


NO_SIGNALS = SignalTable(())
"""The table of an observation that holds nothing."""
