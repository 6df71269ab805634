"""Named arrays that know their units: the one description of what an observation or an action holds."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

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

    def columns(self, *names: str) -> slice | list[int]:
        """Where the named columns stand, a slice if they are neighbours."""
        indices = [self.names.index(name) for name in names]
        if indices == list(range(indices[0], indices[0] + len(indices))):
            return slice(indices[0], indices[0] + len(indices))
        return indices

    def space(self, dtype: type[np.float32] | type[np.float64]) -> Any:
        """The Gymnasium space of one world."""
        low = np.array([signal.low for signal in self.signals])
        high = np.array([signal.high for signal in self.signals])
        return spaces.Box(low.astype(dtype), high.astype(dtype), dtype=dtype)


NO_SIGNALS = SignalTable(())
"""The table of an observation that holds nothing."""
