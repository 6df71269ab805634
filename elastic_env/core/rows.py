"""Records of arrays with one row per world."""

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, Self

import numpy as np

from elastic_env.core.signals import BoolArray


class Rows:
    """Base of frozen dataclasses whose fields are arrays with one row per world, or such records themselves."""

    __slots__ = ()

    def with_worlds(self, worlds: BoolArray, other: Self) -> Self:
        """These values with those of another in some worlds, a (num_worlds,) mask."""

        def chosen(mine: Any, others: Any) -> Any:
            if isinstance(mine, Rows):
                return mine.with_worlds(worlds, others)
            return np.where(worlds.reshape(-1, *[1] * (mine.ndim - 1)), others, mine)

        return type(self)(*(chosen(getattr(self, name), getattr(other, name)) for name in self._names()))

    @classmethod
    def joined(cls, records: Sequence[Self]) -> Self:
        """The rows of several records, one record after the other."""

        def together(parts: list[Any]) -> Any:
            return type(parts[0]).joined(parts) if isinstance(parts[0], Rows) else _concatenated(parts)

        return cls(*(together([getattr(record, name) for record in records]) for name in cls._names()))

    @classmethod
    def _names(cls) -> list[str]:
        return [field.name for field in fields(cls)]  # type: ignore[arg-type]


def _concatenated(parts: list[Any]) -> Any:
    """Arrays one after the other; structured ones by their bytes, as NumPy would compare their fields for each part."""
    if parts[0].dtype.names is None:
        return np.concatenate(parts)
    return np.frombuffer(b"".join(parts), parts[0].dtype)
