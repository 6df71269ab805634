"""Learned offsets of `iterative` as a folder: `iterative.json` and `offsets.safetensors`.

The table has a row for every control step of the motion and a column for every learned signal, in
SI units. Loading runs no code from the folder. The table plays in environments of the same robot,
motion and control period only.
"""

from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field
from safetensors.numpy import save

from baselines.adaptation.learned_signals import LearningGains
from elastic_env.core.config import MOST_ENTRIES, Model, Title, load_json, quantity
from elastic_env.core.errors import ConfigurationError, quote
from elastic_env.core.files import write_whole
from elastic_env.core.signals import Array
from elastic_env.core.tensors import read_tensors

DESCRIPTION = "iterative.json"
OFFSETS = "offsets.safetensors"
_TENSOR = "offsets"
_LARGEST_OFFSET = 1.0
"""Bound on an offset [rad] or [m]."""


def _require_base(name: str) -> str:
    if ":" in name or name == "iterative":
        raise ValueError(f"the base must be a baseline without learning, got {name!r}")
    return name


class TableDescription(Model):
    """Content of `iterative.json`, which describes the table in the same folder."""

    robot: Title
    """Task of the environment, walker or testbed."""
    base: Annotated[Title, AfterValidator(_require_base)]
    """Name of the policy that the offsets are added to."""
    learning: LearningGains = LearningGains()
    signals: list[Title] = Field(min_length=1, max_length=MOST_ENTRIES)
    """Learned signals with their unit, one per column."""
    motion: dict[str, Any]
    """Gait or reference; the environment must have the same."""
    control_period_s: float = quantity("s", gt=0)
    """Time between rows [s]."""
    scenario: Title
    """Scenario in which it was learned."""
    training: dict[str, Any] = {}
    """Seed of the robot, commit, versions."""


def motion_of(env: Any) -> dict[str, Any]:
    """Gait or reference of an environment."""
    config = env.unwrapped.task.config
    return (getattr(config, "gait", None) or config.reference).model_dump(mode="json")


def save_table(folder: Path, description: TableDescription, table: Array) -> None:
    """Write a table, (T, k), that `load_table` reads.

    Raises:
        ConfigurationError: The table is not valid.
    """
    _require_table(description, table)
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / OFFSETS, save({_TENSOR: np.ascontiguousarray(table)}))
    write_whole(folder / DESCRIPTION, description.model_dump_json(indent=2) + "\n")


def read_table_description(folder: Path) -> TableDescription:
    """Read the description of a table.

    Raises:
        ConfigurationError: There is none, or it is not valid.
    """

    def missing(why: str) -> str:
        needed = f"a folder with {DESCRIPTION} and {OFFSETS} is needed ({why})"
        return f"no learned offsets at {folder}: {needed}, as `elastic iterate` writes it"

    return load_json(folder / DESCRIPTION, TableDescription, "table", missing, folder)


def load_table(folder: Path, env: Any) -> tuple[TableDescription, Array]:
    """Read a table for an environment, (T, k).

    Raises:
        ConfigurationError: There is none, it is damaged, or it was learned for something else.
    """
    description = read_table_description(folder)
    tensors, _ = read_tensors(folder / OFFSETS)
    if set(tensors) != {_TENSOR}:
        raise ConfigurationError(
            f"{folder / OFFSETS} must hold one tensor, {_TENSOR!r}, got {quote(sorted(tensors))}"
        )
    table = np.asarray(tensors[_TENSOR], dtype=np.float64)
    try:
        _require_table(description, table)
    except ConfigurationError as error:
        raise ConfigurationError(f"{folder / OFFSETS}: {error}") from None
    _require_same(folder, description, table, env)
    return description, table


def _require_table(description: TableDescription, table: Array) -> None:
    k = len(description.signals)
    if table.ndim != 2 or table.shape[1] != k or len(table) < 2:
        raise ConfigurationError(
            f"the table must have the shape (T, {k}) with T >= 2, got {table.shape}"
        )
    if not np.isfinite(table).all() or np.abs(table).max() > _LARGEST_OFFSET:
        raise ConfigurationError(f"offsets must be finite within ±{_LARGEST_OFFSET:g} rad or m")


def _require_same(folder: Path, learned: Any, table: Array, env: Any) -> None:
    """Refuse a table of another robot or motion."""
    task = env.unwrapped.task
    period_s = task.assumed_model.control_period_s
    # another robot may have another kind of motion
    motion = motion_of(env) if learned.robot == task.name else {}
    properties = [
        ("the robot", learned.robot, task.name),
        ("the control period", learned.control_period_s, period_s),
        ("the number of rows", len(table), task.num_steps + 1),
    ]
    for key in {**motion, **learned.motion}:
        name = f"a motion whose {key} is"
        properties.append((name, learned.motion.get(key), motion.get(key)))
    for name, in_folder, in_env in properties:
        if in_folder != in_env:
            raise ConfigurationError(
                f"{folder} was learned with {name} {quote(in_folder)}, the environment has"
                f" {quote(in_env)}; learn it again: offsets of one motion are wrong in another"
            )
