"""Rows with named fields, as compiled kernels of policies read them."""

from collections.abc import Mapping
from functools import cache
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from elastic_env.core.compiled import record_type
from elastic_env.core.signals import Array, SignalTable

Records: TypeAlias = npt.NDArray[Any]
"""Array of a structured type, one row per world."""


_WALK_FIELDS: Mapping[str, tuple[int, ...]] = {
    "encoder_angle": (12,),
    "encoder_rate": (12,),
    "imu_attitude": (2,),
    "imu_rate": (3,),
    "wrench": (2, 2, 3),
    "reference_angle": (12,),
    "reference_rate": (12,),
    "clock": (3,),
    "load_share": (),
    "zmp_reference": (2,),
}
"""Groups of a walker's observation, and the shapes of their fields; wrench: feet, force and
moment, axes.
"""


class WalkView:
    """Observations of a walker as rows with named fields, as compiled kernels read them.

    Args:
        table: Columns of the observation.
    """

    def __init__(self, table: SignalTable) -> None:
        groups = [table.group(name) for name in _WALK_FIELDS]
        layout = {
            "names": list(_WALK_FIELDS),
            "formats": [(np.float64, shape) for shape in _WALK_FIELDS.values()],
            "offsets": [8 * group.start for group in groups],
            # without the columns behind them, so that one kernel fits all walkers
            "itemsize": 8 * max(group.stop for group in groups),
        }
        self._type = np.dtype((np.record, layout))

    def fields(self, rows: Array) -> Records:
        """Observations, (num_worlds, m), as rows with fields, (num_worlds,), in the same memory."""
        rows = np.ascontiguousarray(rows)
        return np.ndarray(len(rows), self._type, rows, 0, rows.strides[:1])


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
