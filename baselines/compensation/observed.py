"""A walker's observations as rows with named fields, as compiled kernels read them."""

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from elastic_env.core.signals import Array, SignalTable

Records: TypeAlias = npt.NDArray[Any]
"""An array of a structured type, one row per world."""

_GROUPS: Mapping[str, tuple[int, ...]] = {
    "encoder_angle": (12,), "encoder_rate": (12,), "imu_attitude": (2,), "imu_rate": (3,), "wrench": (2, 2, 3),
    "reference_angle": (12,), "reference_rate": (12,), "clock": (3,), "load_share": (), "zmp_reference": (2,),
}  # fmt: skip
"""Groups of the observation that kernels read, and the shapes of their fields; wrench: feet, force and moment, axes."""


class ObservedWalk:
    """Where a walker's observation has its groups.

    Args:
        table: Of the observation.
    """

    def __init__(self, table: SignalTable) -> None:
        groups = [table.group(name) for name in _GROUPS]
        self._type = np.dtype(
            (
                np.record,
                {
                    "names": list(_GROUPS),
                    "formats": [(np.float64, shape) for shape in _GROUPS.values()],
                    "offsets": [8 * group.start for group in groups],
                    # without the sensors behind them, so that one kernel fits all walkers
                    "itemsize": 8 * max(group.stop for group in groups),
                },
            )
        )

    def fields(self, rows: Array) -> Records:
        """Observations, (num_worlds, m), as rows with fields, (num_worlds,), in the same memory."""
        rows = np.ascontiguousarray(rows)
        return np.ndarray(len(rows), self._type, rows, 0, rows.strides[:1])
