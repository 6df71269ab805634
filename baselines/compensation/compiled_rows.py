"""Rows with named fields, as compiled kernels of policies read them."""

from functools import cache
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from elastic_env.core.compiled import record_type

Records: TypeAlias = npt.NDArray[Any]
"""Array of a structured type, one row per world."""


def record_rows(**fields: Any) -> Any:
    """Rows with named fields for compiled kernels, such as a plan, (rows,).

    Args:
        **fields: Values of each field, (rows, ...).
    """
    shapes = [(name, np.shape(values)[1:]) for name, values in fields.items()]
    rows = np.empty(len(next(iter(fields.values()))), _row_type(*shapes))
    for name, values in fields.items():
        rows[name] = values
    return rows


@cache
def _row_type(*shapes: tuple[str, tuple[int, ...]]) -> np.dtype[Any]:
    """Type of rows, the same object for equal fields: Numba compares others at every call."""
    return record_type(**dict(shapes))


def record_row(**fields: Any) -> Any:
    """One row of constants for compiled kernels, (1,), by field."""
    return record_rows(**{name: [value] for name, value in fields.items()})
