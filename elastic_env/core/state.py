"""State of what changes from step to step, as arrays and plain values, for checkpoints.

A class says by name what of it changes. Everything else is made again from the same configuration.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from elastic_env.core.errors import ElasticError
from elastic_env.core.rows import Rows

_PLAIN = (bool, int, float, str, type(None))
_CLASS, _PARTS, _GENERATOR = "class", "parts", "generator"


class Stateful:
    """Base of what goes on from a state; `STATE` names its attributes that change.

    They are plain values, arrays, random generators, rows, what has a state itself, and lists, tuples and dictionaries
    of these.
    """

    STATE: ClassVar[tuple[str, ...]]

    def get_state(self) -> dict[str, Any]:
        """All that the next steps depend on, as nested dictionaries and lists of arrays and plain values."""
        parts = {name: dump_state(getattr(self, name), f"{type(self).__name__}.{name}") for name in self.STATE}
        return {_CLASS: type(self).__name__, _PARTS: parts}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state of the same class.

        Raises:
            ElasticError: It is of another class, or of another version of it.
        """
        own = type(self).__name__
        if state.get(_CLASS) != own:
            raise ElasticError(f"a checkpoint of {state.get(_CLASS)} cannot be restored into {own}")
        parts = state[_PARTS]
        if other := sorted(set(parts) ^ set(self.STATE)):
            raise ElasticError(
                f"the checkpoint is of another version of this software, its {own} differs in {', '.join(other)}; "
                "resume it with that version (metadata.json tells the commit), or train anew"
            )
        for name in self.STATE:
            setattr(self, name, load_state(getattr(self, name), parts[name]))


def dump_state(value: Any, owner: str) -> Any:
    """The state of a value.

    Args:
        value: It.
        owner: What it is part of, for errors.

    Raises:
        ElasticError: It is nothing that a state can hold.
    """
    if isinstance(value, _PLAIN):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray) and value.dtype != object:
        return value.copy()
    if isinstance(value, np.random.Generator):
        return {_GENERATOR: value.bit_generator.state}
    if isinstance(value, Rows):
        return {name: dump_state(getattr(value, name), owner) for name in value._names()}
    if isinstance(value, tuple | list):
        return [dump_state(part, owner) for part in value]
    if isinstance(value, dict):
        return {name: dump_state(part, owner) for name, part in value.items()}
    get_state = getattr(value, "get_state", None)
    if get_state is not None:
        return get_state()
    raise ElasticError(
        f"a checkpoint cannot hold {owner}, an object of {type(value).__name__}; it holds numbers, arrays, random "
        "generators, lists and dictionaries of these, and what has get_state and set_state"
    )


def load_state(value: Any, state: Any) -> Any:
    """The value to keep for a state: the same object brought into it, or a new one.

    Args:
        value: What is there, built alike.
        state: What `dump_state` returned for its like.
    """
    if isinstance(value, np.random.Generator):
        value.bit_generator.state = state[_GENERATOR]
        return value
    if hasattr(value, "set_state"):
        value.set_state(state)
        return value
    if isinstance(value, Rows):
        return type(value)(*(load_state(getattr(value, name), part) for name, part in state.items()))
    if isinstance(state, np.ndarray):
        # not in place: what was one array may have become two; a file does not keep the class of rows with fields
        return state.astype(value.dtype) if isinstance(value, np.ndarray) and state.dtype.names else state.copy()
    if isinstance(state, dict):
        known: Mapping[str, Any] = value if isinstance(value, dict) else {}
        return {name: load_state(known.get(name), part) for name, part in state.items()}
    if isinstance(state, list):
        old = value if isinstance(value, list | tuple) and len(value) == len(state) else [None] * len(state)
        parts = [load_state(mine, part) for mine, part in zip(old, state, strict=True)]
        return tuple(parts) if isinstance(value, tuple) else parts
    return state
