"""Rows of worlds in the memory of a policy: named tuples of arrays, nested."""

from collections.abc import Callable
from typing import Any

import numpy as np

from elastic_env.core.signals import Array, BoolArray


def put_rows(memory: Any, worlds: BoolArray, rows: Any) -> Any:
    """Memory with other rows in some worlds, a (num_worlds,) mask.

    Values that are neither array nor tuple stay.
    """

    def replace(array: Array, other: Array) -> Array:
        result = array.copy()
        result[worlds] = other
        return result

    return _map_arrays(replace, memory, rows)


def select_rows(memory: Any, worlds: BoolArray) -> Any:
    """Memory of some worlds, a (num_worlds,) mask."""
    return _map_arrays(lambda array: array[worlds], memory)


def _map_arrays(function: Callable[..., Array], memory: Any, *others: Any) -> Any:
    """Apply a function to the arrays of memories of the same form."""
    if isinstance(memory, np.ndarray):
        return function(memory, *others)
    if not isinstance(memory, tuple):
        return memory
    parts = [_map_arrays(function, *part) for part in zip(memory, *others, strict=True)]
    return type(memory)(*parts) if hasattr(memory, "_fields") else tuple(parts)
