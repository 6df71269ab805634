"""A user's log of static poses: a CSV file with a row per pose and columns `quantity.joint [unit]`.

docs/identification.md describes it.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd

from elastic_env.core.csv_table import read_table
from elastic_env.core.errors import ConfigurationError, quote, unknown_name
from elastic_env.core.signals import Array, IntArray

Kind = Literal["link_encoders", "end_effector", "markers", "imu", "torques"]
"""Measurement of a log besides the motor encoders."""

KINDS: dict[str, tuple[Kind, str]] = {
    "q": ("link_encoders", "rad"),
    "end_effector": ("end_effector", "m"),
    "marker": ("markers", "m"),
    "imu": ("imu", "rad"),
    "torque": ("torques", "N·m"),
}
"""Kind of measurement and unit by the quantity of a column."""
MEASUREMENT_UNITS: dict[Kind, str] = dict(KINDS.values())
"""Unit by the kind of measurement."""
AXES: dict[Kind, tuple[str, ...]] = {"end_effector": ("x", "y", "z"), "imu": ("roll", "pitch")}
"""Columns of measurements that are not made at joints."""
UNITS = {
    "theta": "rad",
    "direction": "1",
    "tau_known": "N·m",
    **{name: unit for name, (_, unit) in KINDS.items()},
}
"""Unit by the quantity of a column."""
MOST_POSES = 10_000
"""Rows of a log."""

_UNIT_SPELLINGS = {"Nm": "N·m", "N*m": "N·m", "N m": "N·m", "": "1", "-": "1"}
_RANGE_MARGIN_RAD = 0.5
"""Angle beyond the model's range that is accepted: homing errors and bent joints need less."""
_UNLIMITED_RAD = 4.0 * math.pi
"""Largest angle of joints without a range."""
_EQUAL_WITHIN_RAD = 1e-3
"""Difference of encoders up to which two poses are the same."""


@dataclass(frozen=True)
class PoseLog:
    """Static poses and the measurements at them.

    Attributes:
        joints: Names of the joints, (n,).
        theta: Motor encoders, (N, n) [rad].
        kind: Kind of the measurement.
        columns: Joints or axes of the measurement, (m,).
        measured: The measurement, (N, m), in the unit of its kind.
        direction: Side of approach, (N, n): +1 from below, -1 from above, 0 unknown; None where the
            log has none.
        known_torque: Known further torque on the joints, (N, n) [N·m], positive where it turns the
            joint forward; None where the log has none.
    """

    joints: tuple[str, ...]
    theta: Array
    kind: Kind
    columns: tuple[str, ...]
    measured: Array
    direction: Array | None = None
    known_torque: Array | None = None

    def __len__(self) -> int:
        return len(self.theta)

    def part(self, poses: IntArray) -> "PoseLog":
        """Log of some of the poses."""
        arrays = {k: v[poses] for k, v in vars(self).items() if isinstance(v, np.ndarray)}
        return replace(self, **arrays)


def read_log(
    path: Path, ranges: Mapping[str, tuple[float, float]], kind: Kind | None = None
) -> PoseLog:
    """Read and check a log.

    Args:
        path: CSV file with a header.
        ranges: Hinges of the robot and their ranges, infinite for a joint without one [rad].
        kind: Measurement to use; needed only where the log has several.

    Raises:
        ConfigurationError: The log cannot be used; the message says what to change.
    """
    columns = _columns(path)
    names: dict[str, list[str]] = {quantity: [] for quantity in UNITS}
    for key in columns:
        quantity, _, name = key.partition(".")
        names[quantity].append(name)
    for quantity in ("theta", "q", "torque", "direction", "tau_known"):
        for joint in names[quantity]:
            if joint not in ranges:
                raise ConfigurationError(
                    f"{path}, column {quantity}.{quote(joint)[1:-1]}:"
                    f" {unknown_name('joint', joint, ranges)}"
                )
    joints = tuple(joint for joint in ranges if joint in names["theta"])
    if not joints:
        raise ConfigurationError(
            f"{path} has no motor encoders; give a column theta.JOINT [rad] for each of:"
            f" {', '.join(ranges)}"
        )
    quantity = _choose_quantity(path, [name for name in KINDS if names[name]], kind)
    kind = KINDS[quantity][0]
    order = _column_order(path, kind, names[quantity], joints)
    log = PoseLog(
        joints,
        theta=_table(columns, "theta", joints),
        kind=kind,
        columns=order,
        measured=_table(columns, quantity, order),
        direction=_table(columns, "direction", joints) if names["direction"] else None,
        known_torque=_table(columns, "tau_known", joints) if names["tau_known"] else None,
    )
    sides = np.zeros(0) if log.direction is None else log.direction.ravel()
    if len(wrong := sides[~np.isin(sides, (-1.0, 0.0, 1.0))]):
        raise ConfigurationError(
            f"{path}: directions must be 1 (approached from below), -1 (from above) or 0 (unknown),"
            f" got {wrong[0]:g}"
        )
    _require_radians(path, "theta", joints, log.theta, ranges)
    if kind == "link_encoders":
        _require_radians(path, "q", order, log.measured, ranges)
    if kind == "imu":
        turn = dict.fromkeys(order, (-math.pi, math.pi))
        _require_radians(path, "imu", order, log.measured, turn)
    if np.ptp(log.theta, axis=0).max() < _EQUAL_WITHIN_RAD:
        raise ConfigurationError(
            f"all {len(log)} poses of {path} are alike: no joint moves by {_EQUAL_WITHIN_RAD} rad;"
            " log poses that differ in all joints, such as those that --plan proposes"
        )
    return average_poses(log)


def average_poses(log: PoseLog) -> PoseLog:
    """Replace consecutive rows with equal encoders and sides of approach by their mean.

    Their friction and the errors of the model are equal, so that they are not independent.
    """
    sides = np.zeros_like(log.theta) if log.direction is None else log.direction
    known = log.known_torque
    starts = [0]
    for row in range(1, len(log)):
        moved = np.abs(log.theta[row] - log.theta[starts[-1]]).max() > _EQUAL_WITHIN_RAD
        moved |= known is not None and (known[row] != known[starts[-1]]).any()
        if moved or (sides[row] != sides[starts[-1]]).any():
            starts.append(row)
    count = np.diff([*starts, len(log)])[:, None]
    return replace(
        log,
        theta=np.add.reduceat(log.theta, starts) / count,
        measured=np.add.reduceat(log.measured, starts) / count,
        direction=None if log.direction is None else sides[starts],
        known_torque=None if known is None else np.add.reduceat(known, starts) / count,
    )


def write_poses(path: Path, columns: Mapping[str, Array]) -> Path:
    """Write columns such as `theta.elbow`, each (N,), as a log with units in its header."""
    table = pd.DataFrame(columns)
    header = []
    for name in columns:
        unit = UNITS[name.split(".", 1)[0]]
        needs_no_unit = unit == "1" and not name.endswith("]")
        header.append(name if needs_no_unit else f"{name} [{unit}]")
    table.to_csv(path, header=header, index=False, float_format="%.9g", lineterminator="\n")
    return path


def _columns(path: Path) -> dict[str, Array]:
    """All columns of the file by their names without units."""
    table = read_table(
        path,
        what="log",
        row="pose",
        most_rows=MOST_POSES,
        example="theta.JOINT [rad] and q.JOINT [rad]",
    )
    names = [_column_name(path, text) for text in table.names]
    if repeated := [name for name in names if names.count(name) > 1]:
        raise ConfigurationError(f"{path} has the column {repeated[0]} twice; keep one of them")
    return dict(zip(names, table.values.T, strict=True))


def _split_unit(text: str) -> tuple[str, str | None]:
    """A name and the unit in brackets behind it; None without brackets.

    A regular expression would take minutes for a long text.
    """
    if text.endswith("]"):
        first = max(text.rfind("]", 0, -1) + 1, 1)
        bracket = text.find("[", first)
        if bracket > 0:
            return text[:bracket].rstrip(), text[bracket + 1 : -1].strip()
    return text, None


def _column_name(path: Path, text: str) -> str:
    """Name of a column without its unit."""
    quantity, _, rest = text.strip().partition(".")
    name, unit = _split_unit(rest)
    if quantity not in UNITS or not name or "\n" in name:
        raise ConfigurationError(
            f"{path} has the column {quote(text)}; columns are theta.JOINT, q.JOINT, torque.JOINT,"
            " direction.JOINT, tau_known.JOINT, end_effector.x, .y, .z, marker.NAME.x, .y, .z,"
            " imu.roll and imu.pitch"
        )
    if unit is not None and _UNIT_SPELLINGS.get(unit, unit) != UNITS[quantity]:
        raise ConfigurationError(
            f"{path}, column {quantity}.{quote(name)[1:-1]}: the unit must be [{UNITS[quantity]}],"
            f" got [{quote(unit)[1:-1]}]; convert the column"
        )
    return f"{quantity}.{name}"


def _table(columns: Mapping[str, Array], quantity: str, names: Sequence[str]) -> Array:
    """A quantity of joints or axes, zero where there is no column, (N, n)."""
    zero = np.zeros(len(next(iter(columns.values()))))
    table = [columns.get(f"{quantity}.{name}", zero) for name in names]
    return np.stack(table, axis=-1)


def _choose_quantity(path: Path, quantities: Sequence[str], kind: Kind | None) -> str:
    """The measured quantity to use, one of those in the log."""
    kinds: dict[str, str] = {KINDS[name][0]: name for name in quantities}
    if kind is not None and kind in kinds:
        return kinds[kind]
    if len(quantities) == 1 and kind is None:
        return quantities[0]
    if len(quantities) > 1:
        raise ConfigurationError(
            f"{path} has several measurements ({', '.join(kinds)}) and one is used; choose it by"
            " --measured-by"
        )
    missing = f"none of {kind}" if kind else "none"
    raise ConfigurationError(
        f"{path} needs a measurement besides the motor encoders and has {missing}; add columns"
        " q.JOINT [rad], end_effector.x, .y, .z [m], imu.roll, imu.pitch [rad], or torque.JOINT"
        " [N·m]"
    )


def _column_order(
    path: Path, kind: Kind, columns: Sequence[str], joints: Sequence[str]
) -> tuple[str, ...]:
    """Columns of a measurement in order.

    Raises:
        ConfigurationError: An axis is missing, or the motor encoder of a joint.
    """
    if kind in AXES:
        if sorted(columns) != sorted(AXES[kind]):
            raise ConfigurationError(
                f"{path}: {kind} needs exactly the columns {', '.join(AXES[kind])}, got"
                f" {', '.join(columns)}"
            )
        return AXES[kind]
    if kind != "markers":
        if without := [joint for joint in columns if joint not in joints]:
            raise ConfigurationError(
                f"{path} measures {', '.join(without)} and lacks theta.{without[0]}; add the column"
            )
        return tuple(joint for joint in joints if joint in columns)
    order: list[str] = []
    for name in dict.fromkeys(column.rpartition(".")[0] for column in columns):
        axes = sorted(column for column in columns if column.rpartition(".")[0] == name)
        if not name or axes != [f"{name}.{axis}" for axis in "xyz"]:
            raise ConfigurationError(
                f"{path}: a marker needs the columns marker.NAME.x, .y and .z, where NAME is a site"
                f" or body of the model; got marker.{axes[0]}"
            )
        order += axes
    return tuple(order)


def _require_radians(
    path: Path,
    quantity: str,
    names: Sequence[str],
    angles: Array,
    ranges: Mapping[str, tuple[float, float]],
) -> None:
    """Refuse angles that the joints cannot reach, such as degrees."""
    bounds = np.array([ranges[name] for name in names])
    finite = np.isfinite(bounds)
    low = np.where(finite[:, 0], bounds[:, 0] - _RANGE_MARGIN_RAD, -_UNLIMITED_RAD)
    high = np.where(finite[:, 1], bounds[:, 1] + _RANGE_MARGIN_RAD, _UNLIMITED_RAD)
    outside = (angles < low) | (angles > high)
    if not outside.any():
        return
    pose, column = np.argwhere(outside)[0]
    in_degrees = np.deg2rad(angles)
    cure = "give angles in radians, in the zero and the sign of the model"
    if ((in_degrees >= low) & (in_degrees <= high)).all():
        cure = "the angles look like degrees: convert them to radians"
    raise ConfigurationError(
        f"{path}, pose {pose + 1}, column {quantity}.{names[column]}: {angles[pose, column]:g} rad"
        f" lies beyond the joint's range of {bounds[column, 0]:g} to {bounds[column, 1]:g} rad;"
        f" {cure}"
    )
