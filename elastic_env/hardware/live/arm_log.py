"""Log of an arm's motion: a CSV file with a row for every cycle."""

import csv
from collections.abc import Sequence
from typing import TextIO

import numpy as np

from elastic_env.hardware.live.arm_state import ArmState

_SIGNALS = ("target", "desired", "command", "theta", "link", "torque", "temperature")
_UNITS = {"torque": "N·m", "temperature": "°C"}


class ArmLog:
    """Writes every cycle of a motion as a row of a CSV file.

    Args:
        file: Open file that gets the rows.
        joints: Names of the joints.
    """

    def __init__(self, file: TextIO, joints: Sequence[str]) -> None:
        self._writer = csv.writer(file, lineterminator="\n")
        columns = [
            f"{signal}.{joint} [{_UNITS.get(signal, 'rad')}]"
            for signal in _SIGNALS
            for joint in joints
        ]
        self._writer.writerow(["time [s]", *columns, "late [s]", "held [1]", "target [1]"])

    def write(self, state: ArmState, number: int) -> None:
        """Write one cycle, with the number of its target."""
        values = np.concatenate([getattr(state, signal) for signal in _SIGNALS])
        cells = [f"{value:.6g}" for value in values.tolist()]
        end = [f"{state.late_s:.6f}", int(state.is_held), number]
        self._writer.writerow([f"{state.time_s:.6f}", *cells, *end])
