"""States in files: arrays and JSON, nothing is pickled."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from elastic_env.core.signals import Array

_ARRAY = "array"


def write_state(folder: Path, name: str, state: Any) -> None:
    """Write a state as `name.npz` and `name.json`."""
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
                    arrays[value[_ARRAY]]
                    if set(value) == {_ARRAY}
                    else {k: whole(part) for k, part in value.items()}
                )
            return [whole(part) for part in value] if isinstance(value, list) else value

        return whole(json.loads((folder / f"{name}.json").read_text()))
