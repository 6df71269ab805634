"""Memory of policies: arrays with one row per world, within named tuples."""

from collections.abc import Callable
from typing import Any

import numpy as np

from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array, BoolArray


def resume_memory(policy: Any, rows: Array, state: Any, episode_start: Any) -> Any:
    """Memory for this call: the one of the last call, with new rows for new episodes.

    Args:
        policy: Policy that begins the memory.
        rows: Observations, (num_worlds, m).
        state: State that the last call returned, or None.
        episode_start: Worlds whose episode begins; None for none where there is a state.

    Raises:
        ElasticError: No state in the middle of an episode, or one of another number of worlds.
    """
    if state is None:
        memory = policy.begin(rows)
        if memory is not None:
            policy.view.require_start(rows, episode_start)
        return memory
    n = len(rows)
    if (number := count_rows(state)) != n:
        raise ElasticError(f"`state` must have one row per world, {n}, got {number}")
    if episode_start is None or np.count_nonzero(episode_start) == 0:
        return state
    is_new = np.broadcast_to(np.asarray(episode_start, dtype=np.bool_), (n,))
    return put_rows(state, is_new, select_rows(policy.begin(rows), is_new))


def count_rows(memory: Any) -> int:
    """Number of worlds of a memory, by its first array."""
    while not isinstance(memory, np.ndarray):
        memory = memory[0]
    return len(memory)


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
