"""State of an arm in one control cycle: as arrays, message, table, and row of a log."""

import csv
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TextIO

import numpy as np

from elastic_env.core.signals import Array, BoolArray
from elastic_env.hardware.live.targets import Targets

_LOGGED = ("target", "desired", "command", "theta", "link", "torque", "temperature")
_UNITS = {"torque": "N·m", "temperature": "°C"}


@dataclass(frozen=True)
class ArmState:
    """An arm in one control cycle, (n,) each; angles are those of the model's joints.

    Attributes:
        time_s: Time since torque went on [s].
        target: Target of the links [rad].
        desired: Desired angles of the links now [rad].
        command: Goal of the servos, within all limits [rad].
        theta: Motor encoders [rad]; nan where a reply is missing.
        link: Estimate of the links at rest [rad].
        torque: Load of the servos [N·m].
        temperature: Last temperature of each servo that is known [°C].
        is_limited: True where a limit changed the command.
        late_s: Delay of the reading [s].
        is_held: True if the last command was repeated, because a reply was missing.
    """

    time_s: float
    target: Array
    desired: Array
    command: Array
    theta: Array
    link: Array
    torque: Array
    temperature: Array
    is_limited: BoolArray
    late_s: float
    is_held: bool


@dataclass
class Counts:
    """Number of cycles of a motion, and of those in which something went wrong."""

    cycles: int = 0
    late: int = 0
    """Cycles more than half a period late."""
    held: int = 0
    """Cycles without all replies; the last command was repeated."""
    limited: int = 0
    """Cycles with a command that a limit changed."""


def state_message(state: ArmState, joints: Sequence[str]) -> dict[str, object]:
    """State for a client, ready for JSON: values by joint, None where they are not finite."""

    def by_joint(values: Iterable[float]) -> dict[str, float | None]:
        pairs = zip(joints, values, strict=True)
        return {name: float(value) if math.isfinite(value) else None for name, value in pairs}

    signals = ("theta", "link", "torque", "temperature")
    values = {name: by_joint(getattr(state, name)) for name in signals}
    return {"time_s": state.time_s, **values}


def live_table(state: ArmState, joints: Sequence[str], counts: Counts, targets: Targets) -> str:
    """Text with a line for each joint: target, link, error, load and temperature."""
    width = max(map(len, joints))
    lines = [f"{'':{width}}   target     link  error   load  temp"]
    lines[0] += f"\n{'':{width}}      rad      rad   mrad    N·m    °C"
    for i, name in enumerate(joints):
        error = 1e3 * (state.link[i] - state.target[i])
        mark = " *" if state.is_limited[i] else ""
        lines.append(
            f"{name:{width}} {state.target[i]:+8.4f} {state.link[i]:+8.4f}"
            f" {error:+6.0f} {state.torque[i]:+6.2f} {state.temperature[i]:5.0f}{mark}"
        )
    lines.append(
        f"{state.time_s:.1f} s, target {targets.number}, {counts.cycles} cycles, {counts.late}"
        f" late, {counts.held} without all replies, {counts.limited} with limited commands (*)"
        + (f", {targets.refused} lines refused" if targets.refused else "")
    )
    return "\n".join(lines)


class ArmLog:
    """Writes every cycle of a motion as a row of a CSV file.

    Args:
        file: Open file that gets the rows.
        joints: Names of the joints.
    """

    def __init__(self, file: TextIO, joints: Sequence[str]) -> None:
        self._writer = csv.writer(file, lineterminator="\n")
        columns = [f"{name}.{j} [{_UNITS.get(name, 'rad')}]" for name in _LOGGED for j in joints]
        self._writer.writerow(["time [s]", *columns, "late [s]", "held [1]", "target [1]"])

    def write(self, state: ArmState, number: int) -> None:
        """Write one cycle, with the number of its target."""
        values = np.concatenate([getattr(state, signal) for signal in _LOGGED])
        cells = [f"{value:.6g}" for value in values.tolist()]
        end = [f"{state.late_s:.6f}", int(state.is_held), number]
        self._writer.writerow([f"{state.time_s:.6f}", *cells, *end])
