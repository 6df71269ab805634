"""Logs in time of one position servo: goals and angles from CSV, JSON and parquet.

docs/identification.md describes the columns.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.signal import savgol_filter

from baselines.identification.servo_load import NO_LOAD, Load
from elastic_env.core.csv_table import LARGEST_BYTES, read_table
from elastic_env.core.errors import ConfigurationError, MissingExtraError, quote
from elastic_env.core.files import read_bounded
from elastic_env.core.json_text import parse_json
from elastic_env.core.signals import Array, BoolArray

AngleUnit = Literal["rad", "deg"]
"""Unit of the angles of a file."""
MOST_ROWS = 200_000
"""Rows of a log."""

_COLUMNS = {
    "time": "s",
    "goal": "rad",
    "position": "rad",
    "speed": "rad/s",
    "current": "A",
    "pwm": "1",
    "torque_enable": "1",
    "gain": "1",
    "voltage": "V",
}
_JSON_NAMES = {
    "timestamp": "time",
    "goal_position": "goal",
    "position": "position",
    "speed": "speed",
    "load": "pwm",
    "present_current": "current",
    "torque_enable": "torque_enable",
}
"""Names of Rhoban's recorder, and of others who follow it."""
_FEWEST_ROWS = 50
_LONGEST_ROW_S = 0.2
_LONGEST_GAP_S = 0.3
_LARGEST_ANGLE = 4.0 * math.pi
_LARGEST_JUMP = 3.0
_LEAST_MOTION = 0.01
_SMOOTHED_S = 0.06
_LONGEST_JSON = 20_000_000


@dataclass(frozen=True)
class ServoLog:
    """One motion of one servo.

    Attributes:
        name: Of the log, for tables.
        time: Clock, growing, (N,) [s].
        goal: Commanded angle, (N,) [rad].
        position: Measured angle, (N,) [rad].
        enabled: True while the servo's torque is on, (N,).
        gain: Value of the servo's gain register; 1 where none is known [1].
        load: What hangs on the joint.
        pwm: Duty of the motor's voltage in any unit, (N,); None if not logged.
        known: Known further torque on the joint, (N,) [N·m]; None if there is none.
        supply: Voltage of the supply [V]; 1 where it is not known.
    """

    name: str
    time: Array
    goal: Array
    position: Array
    enabled: BoolArray
    gain: float = 1.0
    load: Load = NO_LOAD
    pwm: Array | None = None
    known: Array | None = None
    supply: float = 1.0

    def __len__(self) -> int:
        return len(self.time)

    def part(self, rows: slice) -> "ServoLog":
        """Some of its rows."""
        return replace(
            self,
            time=self.time[rows],
            goal=self.goal[rows],
            position=self.position[rows],
            enabled=self.enabled[rows],
            pwm=None if self.pwm is None else self.pwm[rows],
            known=None if self.known is None else self.known[rows],
        )

    def external_torque(self, q: Array) -> Array:
        """Torque of weight and known torque on the joint, (N,) [N·m]."""
        pull = self.load.pull(q)
        return pull if self.known is None else pull + self.known

    def derivatives(self) -> tuple[Array, Array]:
        """Speed and acceleration by a moving parabola over 60 ms, (N,) [rad/s], [rad/s²]."""
        step = float(np.median(np.diff(self.time)))
        window = max(5, 2 * int(0.5 * _SMOOTHED_S / step) + 1)
        grid = np.arange(self.time[0], self.time[-1] + step, step)
        q = np.interp(grid, self.time, self.position)
        window = min(window, 2 * ((len(grid) - 1) // 2) + 1)
        slopes = [np.asarray(savgol_filter(q, window, 2, deriv=n, delta=step)) for n in (1, 2)]
        return np.interp(self.time, grid, slopes[0]), np.interp(self.time, grid, slopes[1])


def is_servo_log(path: Path) -> bool:
    """True if a file is a log in time: JSON, parquet, or CSV with a column `time`."""
    if path.suffix.lower() in (".json", ".parquet"):
        return True
    try:
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            head = file.readline(10_000)
    except (OSError, ValueError):
        return False
    return "time" in [_plain(cell) for cell in head.split(",")]


def read_servo_log(
    path: Path,
    load: Load | None = None,
    gain: float | None = None,
    unit: AngleUnit = "rad",
    joint: str | None = None,
) -> ServoLog:
    """Read and check a log.

    Args:
        path: CSV file, JSON file of a recorder of servos, or parquet file of LeRobot.
        load: What hangs on the joint; None for what the file says.
        gain: Value of the gain register; None for what the file says.
        unit: Unit of the angles.
        joint: Joint to read, where the file has several.

    Raises:
        ConfigurationError: The log cannot be used; the message says what to change.
    """
    readers = {".json": _read_json, ".parquet": _read_parquet}
    columns, facts = readers.get(path.suffix.lower(), _read_csv)(path, joint)
    for name in ("time", "goal", "position"):
        if name not in columns:
            raise ConfigurationError(
                f"{path} has no column {name}; a log in time needs time [s], goal [rad] and"
                f" position [rad], it has {', '.join(columns) or 'none of them'}"
            )
    scale = 1.0 if unit == "rad" else math.pi / 180.0
    if load is None and {"mass", "length"} <= set(facts):
        load = Load.pendulum(facts["mass"], facts["length"])
    if gain is None:
        gain = facts.get("kp", 1.0)
        if "gain" in columns:
            gain = _constant_gain(path, columns["gain"])
    if not gain > 0.0:
        raise ConfigurationError(f"{path}: the gain must be positive, got {gain:g}")
    enabled = columns.get("torque_enable", np.ones(len(columns["time"]))) > 0.5
    pwm = columns.get("pwm")
    log = ServoLog(
        name=path.stem,
        time=columns["time"],
        goal=scale * columns["goal"],
        position=scale * columns["position"],
        enabled=enabled,
        gain=gain,
        load=load or NO_LOAD,
        pwm=None if pwm is None or not pwm.any() else _signed(pwm),
        known=columns.get("known"),
        supply=float(np.median(columns["voltage"]))
        if "voltage" in columns
        else facts.get("vin", 1.0),
    )
    if load is None and log.known is None:
        raise ConfigurationError(
            f"{path} does not say what hangs on the joint; give --mass-kg and --lever-m of a"
            " pendulum, --robot with --joints, or a column tau_known [N·m]"
        )
    require_usable(path, log)
    return log


def require_usable(path: Path, log: ServoLog) -> None:
    """Refuse what no servo can have logged, each by one sentence.

    Raises:
        ConfigurationError: Too few rows, a clock that stops, goes back or jumps, angles in another
            unit or wrapped, a goal that never moves, or goal and position exchanged.
    """
    if len(log) < _FEWEST_ROWS:
        raise ConfigurationError(
            f"{path} has {len(log)} rows, and at least {_FEWEST_ROWS} are needed; log the whole"
            " motion, some ten rows or more a second"
        )
    step = np.diff(log.time)
    if step.min() <= 0.0:
        row = int(np.argmax(step <= 0.0)) + 2
        raise ConfigurationError(
            f"{path}: the time must grow, and in row {row} it goes from {log.time[row - 2]:g} to"
            f" {log.time[row - 1]:g} s; sort the rows, and give each clock a file of its own"
        )
    if np.median(step) > _LONGEST_ROW_S:
        raise ConfigurationError(
            f"{path}: rows are {np.median(step):g} s apart, at most {_LONGEST_ROW_S} are usable;"
            " convert a time in milliseconds to seconds, or log faster"
        )
    if step.max() > _LONGEST_GAP_S:
        row = int(np.argmax(step)) + 1
        raise ConfigurationError(
            f"{path} has a gap of {step.max():.2g} s after row {row}, at most {_LONGEST_GAP_S} are"
            " bridged; cut the log there and give both parts"
        )
    for name, angles in (("goal", log.goal), ("position", log.position)):
        if np.abs(angles).max() > _LARGEST_ANGLE:
            raise ConfigurationError(
                f"{path}, column {name}: {np.abs(angles).max():.4g} rad is beyond two turns;"
                " convert degrees or counts to radians, or say --angles deg"
            )
        jump = np.abs(np.diff(angles))
        if jump.max() > _LARGEST_JUMP and (name == "position" or jump.max() > 5.5):
            row = int(np.argmax(jump)) + 1
            raise ConfigurationError(
                f"{path}, column {name}: the angle jumps by {jump.max():.3g} rad after row {row};"
                " unwrap angles that wrap at ±π or 2π"
            )
    if np.ptp(log.position) < _LEAST_MOTION:
        raise ConfigurationError(
            f"{path}: the position moves by {np.ptp(log.position):.2g} rad only; log a motion of"
            " some tenths of a radian"
        )
    if log.enabled.any():
        _require_plausible_goal(path, log)


def _require_plausible_goal(path: Path, log: ServoLog) -> None:
    goal, position = log.goal[log.enabled], log.position[log.enabled]
    if np.ptp(goal) < _LEAST_MOTION and log.enabled.all():
        raise ConfigurationError(
            f"{path}: the goal is constant at {goal[0]:.3g} rad and tells nothing of the servo;"
            " command a slow motion up and down"
        )
    spans = np.ptp(goal), np.ptp(position)
    if max(spans) > _MOST_APART * max(min(spans), 0.1):
        raise ConfigurationError(
            f"{path}: the goal spans {np.ptp(goal):.3g} and the position {np.ptp(position):.3g};"
            " give both in radians"
        )
    pull = log.external_torque(log.position)[log.enabled]
    error = goal - position
    if min(np.ptp(pull), np.ptp(error)) > 0.0 and np.corrcoef(error, pull)[0, 1] > _AGAINST:
        raise ConfigurationError(
            f"{path}: the joint goes beyond its goal against the load; are goal and position"
            " exchanged, or is a sign or the zero (hanging down) wrong?"
        )


_MOST_APART = 8.0
_AGAINST = 0.5
"""Correlation of the error with the torque of the load, from which a log contradicts itself."""


def _plain(cell: str) -> str:
    """A column's name without its unit."""
    return cell.strip().strip('"').partition("[")[0].strip()


def _read_csv(path: Path, joint: str | None) -> tuple[dict[str, Array], dict[str, float]]:
    table = read_table(
        path,
        what="log",
        row="row",
        most_rows=MOST_ROWS,
        example="time [s], goal [rad] and position [rad]",
    )
    columns: dict[str, Array] = {}
    for text, values in zip(table.names, table.values.T, strict=True):
        name = _plain(text)
        known = name == "tau_known" or name.startswith("tau_known.")
        if known and joint is not None and name not in ("tau_known", f"tau_known.{joint}"):
            continue
        unit = "N·m" if known else _COLUMNS.get(name)
        if unit is None:
            raise ConfigurationError(
                f"{path} has the column {quote(text)}; columns are {', '.join(_COLUMNS)} and"
                " tau_known.JOINT"
            )
        given = text.partition("[")[2].rstrip("] ").replace("Nm", "N·m")
        if given and given != unit and not (unit == "rad" and given == "deg"):
            raise ConfigurationError(
                f"{path}, column {name}: the unit must be [{unit}], got [{quote(given)[1:-1]}];"
                " convert the column"
            )
        name = "known" if known else name
        if name in columns:
            raise ConfigurationError(
                f"{path} has several columns {name}; name the joint by --joints"
            )
        columns[name] = values
    return columns, {}


def _read_json(path: Path, joint: str | None) -> tuple[dict[str, Array], dict[str, float]]:
    """A log of Rhoban's recorder: facts of the run, and a list of entries."""
    del joint
    try:
        content = parse_json(read_bounded(path, LARGEST_BYTES).decode("utf-8"), most=_LONGEST_JSON)
    except OSError as error:
        raise ConfigurationError(f"no log at {path}: {error.strerror}") from None
    except ConfigurationError:
        raise
    except ValueError as error:
        raise ConfigurationError(f"{path} is no JSON that can be read: {error}") from None
    entries = content.get("entries") if isinstance(content, Mapping) else None
    if not isinstance(entries, list) or not all(isinstance(e, Mapping) for e in entries):
        raise ConfigurationError(
            f"{path} must hold a mapping with a list of entries, each with timestamp [s],"
            " goal_position and position [rad]"
        )
    if not entries:
        raise ConfigurationError(f"{path} has no entries; log a motion")
    columns: dict[str, Array] = {}
    for key, name in _JSON_NAMES.items():
        if all(_is_number(entry.get(key)) for entry in entries):
            columns[name] = np.array([float(entry[key]) for entry in entries])
    return columns, {str(k): float(v) for k, v in content.items() if _is_number(v)}


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float)


def _read_parquet(path: Path, joint: str | None) -> tuple[dict[str, Array], dict[str, float]]:
    """An episode of LeRobot: `timestamp`, and the lists `action` and `observation.state`."""
    import pandas as pd

    try:
        table = pd.read_parquet(path)
    except ImportError:
        raise MissingExtraError(
            "reading parquet files needs the package pyarrow; install it with: pip install pyarrow"
        ) from None
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"{path} is no parquet file that can be read: {error}") from None
    names = {"timestamp": "time", "action": "goal", "observation.state": "position"}
    if missing := [key for key in names if key not in table]:
        raise ConfigurationError(
            f"{path} has no column {missing[0]}; an episode of LeRobot has timestamp, action and"
            " observation.state"
        )
    at = int(joint) if joint is not None and joint.isdecimal() else 0
    columns = {}
    for key, name in names.items():
        values = np.array([np.ravel(cell) for cell in table[key]], dtype=np.float64)
        if joint is None and values.shape[1] > 1:
            raise ConfigurationError(
                f"{path} has {values.shape[1]} joints; choose one by its number, --joints 0"
            )
        columns[name] = values[:, min(at, values.shape[1] - 1)]
    return columns, {}


def _constant_gain(path: Path, column: Array) -> float:
    if np.ptp(column) > 0.0:
        raise ConfigurationError(
            f"{path}: the gain changes within the log; give each gain a file of its own"
        )
    return float(column[0])


def _signed(register: Array) -> Array:
    """Values of a register of 16 bits with their sign, if it was read without one."""
    is_register = register.max() > 2**15 and register.max() < 2**16
    return np.where(register > 2**15, register - 2**16, register) if is_register else register
