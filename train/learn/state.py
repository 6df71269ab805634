"""State of environments, policies and random generators as arrays and plain values, for checkpoints.

The state of an object is that of its attributes: arrays that can be written to, random generators, plain values,
records of rows, and containers and objects of these. What does not change is left out: read-only arrays, frozen
models, compiled physics models, functions, networks. Anything else is refused, so that no state is left out that would
be missed when a training goes on. Nothing is pickled: a state is arrays and JSON.
"""

import json
from collections import deque
from collections.abc import Iterable, Mapping
from concurrent.futures import Executor
from enum import Enum
from functools import partial
from pathlib import Path
from types import BuiltinFunctionType, FunctionType, MethodType
from typing import Any

import numpy as np
from gymnasium import Space
from gymnasium.envs.registration import EnvSpec
from mujoco import MjModel

from elastic_env.core.config import Model
from elastic_env.core.errors import ElasticError
from elastic_env.core.rows import Rows
from elastic_env.core.signals import Array
from elastic_env.runtime.physics import ManyWorlds
from elastic_env.runtime.worlds import Worlds

_PLAIN = (bool, int, float, str, type(None))
_FUNCTIONS = (FunctionType, MethodType, BuiltinFunctionType, partial)
_FIXED = (*_FUNCTIONS, Model, Enum, MjModel, Space, EnvSpec, Executor, slice)
"""Types whose objects do not change, or whose changes make no difference to what comes."""
_HELD = "it holds numbers, arrays, random generators, and lists, dictionaries by name and objects of these alone"
_ARRAY, _TUPLE, _ROWS, _GENERATOR = "array", "tuple", "rows", "generator"


def capture(value: Any) -> Any:
    """The state of something, as nested dictionaries and lists of arrays and plain values."""
    return _Captured().of(value)


def restore(value: Any, state: Any) -> Any:
    """Bring something that is built alike back into a captured state.

    Args:
        value: What to change; objects and generators are changed in place.
        state: What `capture` returned for it, or for its like.

    Returns:
        The value to keep: the same object, or a new one for what cannot be changed in place.

    Raises:
        ElasticError: The state is of something else.
    """
    if isinstance(state, dict) and _GENERATOR in state:
        value.bit_generator.state = state[_GENERATOR]
        return value
    if isinstance(state, dict) and _ROWS in state:
        return type(value)(*(restore(getattr(value, name), part) for name, part in state[_ROWS].items()))
    if isinstance(state, dict) and "worlds" in state and isinstance(value, ManyWorlds):
        value.set_state(state["worlds"])
        return value
    if isinstance(state, dict) and "object" in state:
        if type(value).__name__ != state["object"]:
            raise ElasticError(f"a checkpoint of {state['object']} cannot be restored into {type(value).__name__}")
        if unknown := sorted(set(state["attributes"]) - set(vars(value))):
            raise ElasticError(
                f"the checkpoint is of another version of this software, its {state['object']} has "
                f"{', '.join(unknown)}; resume it with that version (metadata.json tells the commit), or train anew"
            )
        for name, part in state["attributes"].items():
            setattr(value, name, restore(getattr(value, name), part))
        return value
    if isinstance(state, dict) and _TUPLE in state:
        parts = state[_TUPLE]
        old = value if isinstance(value, tuple) and len(value) == len(parts) else [None] * len(parts)
        return tuple(restore(mine, part) for mine, part in zip(old, parts, strict=True))
    if isinstance(state, dict):
        return {name: restore(_get(value, name), part) for name, part in state["dict"].items()}
    if isinstance(state, list):
        old = value if isinstance(value, list) and len(value) == len(state) else [None] * len(state)
        return [restore(mine, part) for mine, part in zip(old, state, strict=True)]
    if isinstance(state, np.ndarray):
        # not in place: what was one array may have become two; a file does not keep the class of rows with fields
        return state.astype(value.dtype) if isinstance(value, np.ndarray) and state.dtype.names else state.copy()
    return state


def _get(value: Any, name: str) -> Any:
    return value.get(name) if isinstance(value, Mapping) else None


class _Captured:
    """Walks over objects, each once."""

    def __init__(self) -> None:
        self._seen: set[int] = set()

    def of(self, value: Any) -> Any:
        """State of a value; None where there is none."""
        if isinstance(value, _PLAIN):
            return value
        if isinstance(value, np.generic):
            return value.item()
        if isinstance(value, np.ndarray):
            return value.copy()
        if isinstance(value, np.random.Generator):
            return {_GENERATOR: value.bit_generator.state}
        if isinstance(value, Rows):
            return {_ROWS: {name: self.of(getattr(value, name)) for name in value._names()}}
        if isinstance(value, tuple):
            return {_TUPLE: [self.of(part) for part in value]}
        if isinstance(value, list | deque):
            return [self.of(part) for part in value]
        if isinstance(value, dict):
            return {"dict": {name: self.of(part) for name, part in value.items()}}
        if isinstance(value, ManyWorlds):
            return {"worlds": value.get_state()}
        self._seen.add(id(value))
        if isinstance(value, Worlds):
            value.score_samples()
        kind = type(value).__name__
        attributes = {name: part for name, part in vars(value).items() if self._changes(part, f"{kind}.{name}")}
        return {"object": kind, "attributes": {name: self.of(part) for name, part in attributes.items()}}

    def _changes(self, value: Any, owner: str) -> bool:
        """Whether an attribute has state that can change, and that is not taken yet."""
        if isinstance(value, (*_PLAIN, np.generic, np.random.Generator, Rows, ManyWorlds)):
            return True
        if isinstance(value, np.ndarray):
            return value.flags.writeable and value.dtype != object
        if isinstance(value, tuple | list | deque):
            return self._all_change(value, owner)
        if isinstance(value, dict) and all(isinstance(name, str) for name in value):
            return self._all_change(value.values(), owner)
        if id(value) in self._seen or isinstance(value, _FIXED) or _is_frozen(value) or _is_network(value):
            return False
        if hasattr(value, "__dict__"):
            return True
        raise ElasticError(f"a checkpoint cannot hold {owner}, an object of {type(value).__name__}; {_HELD}")

    def _all_change(self, parts: Iterable[Any], owner: str) -> bool:
        changing = [self._changes(part, owner) for part in parts]
        if any(changing) and not all(changing):
            raise ElasticError(f"a checkpoint cannot hold {owner}, some of whose parts change and others not; {_HELD}")
        return all(changing)


def _is_frozen(value: Any) -> bool:
    parameters = getattr(type(value), "__dataclass_params__", None)
    return parameters is not None and parameters.frozen


def _is_network(value: Any) -> bool:
    """Whether it is of torch or SB3, told by name, as the classes would load torch: a policy played does not change."""
    return any(kind.__module__.split(".")[0] in ("torch", "stable_baselines3") for kind in type(value).__mro__)


def write_state(folder: Path, name: str, state: Any) -> None:
    """Write a captured state as `name.npz` and `name.json`."""
    arrays: dict[str, Array] = {}

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            arrays[key := f"a{len(arrays)}"] = value
            return {_ARRAY: key}
        if isinstance(value, dict):
            return {name: plain(part) for name, part in value.items()}
        return [plain(part) for part in value] if isinstance(value, list) else value

    text = json.dumps(plain(state))
    np.savez(folder / f"{name}.npz", **arrays)  # type: ignore[arg-type]
    (folder / f"{name}.json").write_text(text)


def read_state(folder: Path, name: str) -> Any:
    """A state that `write_state` wrote; runs no code from the files."""
    with np.load(folder / f"{name}.npz", allow_pickle=False) as arrays:

        def whole(value: Any) -> Any:
            if isinstance(value, dict):
                return (
                    arrays[value[_ARRAY]] if set(value) == {_ARRAY} else {k: whole(part) for k, part in value.items()}
                )
            return [whole(part) for part in value] if isinstance(value, list) else value

        return whole(json.loads((folder / f"{name}.json").read_text()))
