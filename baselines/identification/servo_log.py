"""Logs in time of one position servo: goals and angles from CSV, JSON and parquet.

docs/identification.md describes the columns.
"""

import io
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

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
FEWEST_ROWS = 50
"""Rows that a fit needs."""

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
        if not path.is_file():  # a named pipe would be waited for
            return False
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            head = file.readline(10_000)
    except (OSError, ValueError):
        return False
    return "time" in [_plain(cell) for cell in head.split(",")]


def read_servo_log(
    path: Path,
    load: Load | None = None,
    gain: float | None = None,
    unit: AngleUnit | None = None,
    joint: str | None = None,
) -> ServoLog:
    """Read and check a log.

    Args:
        path: CSV file, JSON file of a recorder of servos, or parquet file of LeRobot.
        load: What hangs on the joint; None for what the file says.
        gain: Value of the gain register; None for what the file says.
        unit: Unit of the angles; None for what the file says, or radians.
        joint: Joint to read, where the file has several.

    Raises:
        ConfigurationError: The log cannot be used; the message says what to change.
    """
    readers = {".json": _read_json, ".parquet": _read_parquet}
    columns, facts, stated = readers.get(path.suffix.lower(), _read_csv)(path, joint)
    for name in ("time", "goal", "position"):
        if name not in columns:
            raise ConfigurationError(
                f"{path} has no column {name}; a log in time needs time [s], goal [rad] and"
                f" position [rad], it has {', '.join(columns) or 'none of them'}"
            )
    if unit is not None and stated not in (None, unit):
        raise ConfigurationError(
            f"{path}: its header says [{stated}], and --angles {unit}; leave --angles out"
        )
    scale = math.pi / 180.0 if "deg" in (unit, stated) else 1.0
    load = _load(path, load, facts)
    gain = _gain(path, gain, columns, facts)
    if "voltage" in columns and not columns["voltage"].min() > 0.0:
        raise ConfigurationError(
            f"{path}, column voltage: a supply must be above 0 V, got"
            f" {columns['voltage'].min():g}; leave the column out if it is not known"
        )
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


def _load(path: Path, load: Load | None, facts: Mapping[str, float]) -> Load | None:
    """What hangs on the joint by options and file.

    Raises:
        ConfigurationError: They contradict each other.
    """
    if not {"mass", "length"} <= set(facts):
        return load
    rod = facts.get("arm_mass", 0.0)
    own = Load.pendulum(facts["mass"], facts["length"], rod)
    if load is not None and not _is_same_load(load, own):
        arm = f" and an arm of {rod:g} kg" if rod else ""
        raise ConfigurationError(
            f"{path} says that {facts['mass']:g} kg hang at {facts['length']:g} m{arm}, and the"
            " options say another load; leave --mass-kg, --lever-m and --robot out, or correct"
            " the file"
        )
    return own


def _is_same_load(one: Load, other: Load) -> bool:
    if one.inertia is None or other.inertia is None:
        return one == other
    turn = abs(one.rest - other.rest)
    return (
        math.isclose(one.torque, other.torque, rel_tol=_SAME)
        and math.isclose(one.inertia, other.inertia, rel_tol=_SAME)
        and turn < _SAME
    )


def _gain(
    path: Path, gain: float | None, columns: Mapping[str, Array], facts: Mapping[str, float]
) -> float:
    """Value of the gain register by option and file.

    Raises:
        ConfigurationError: They contradict each other, or it is not positive.
    """
    own = facts.get("kp")
    if "gain" in columns:
        own = _constant_gain(path, columns["gain"])
    if own is not None and gain is not None and not math.isclose(own, gain, rel_tol=_SAME):
        raise ConfigurationError(
            f"{path} says that the gain is {own:g}, and --gain {gain:g}; leave --gain out, or"
            " correct the file"
        )
    value = own if own is not None else 1.0 if gain is None else gain
    if not value > 0.0:
        raise ConfigurationError(f"{path}: the gain must be positive, got {value:g}")
    return value


_SAME = 1e-6
"""Share within which option and file say the same."""


def require_usable(path: Path, log: ServoLog) -> None:
    """Refuse what no servo can have logged, each by one sentence.

    Raises:
        ConfigurationError: Too few rows, a clock that stops, goes back or jumps, angles in another
            unit or wrapped, a goal that never moves, or goal and position exchanged.
    """
    if len(log) < FEWEST_ROWS:
        raise ConfigurationError(
            f"{path} has {len(log)} rows, and at least {FEWEST_ROWS} are needed; log the whole"
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
    goal = log.goal[log.enabled]
    position = log.position[log.enabled]
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


class _Content(NamedTuple):
    """Content of a file: columns, facts of the run, and the unit of angles if it says one."""

    columns: dict[str, Array]
    facts: dict[str, float]
    unit: AngleUnit | None = None


def _read_csv(path: Path, joint: str | None) -> _Content:
    table = read_table(
        path,
        what="log",
        row="row",
        most_rows=MOST_ROWS,
        example="time [s], goal [rad] and position [rad]",
    )
    columns: dict[str, Array] = {}
    units: dict[str, str] = {}
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
            allowed = "[rad] or [deg]" if unit == "rad" else f"[{unit}]"
            raise ConfigurationError(
                f"{path}, column {name}: the unit must be {allowed}, got [{quote(given)[1:-1]}];"
                " convert the column"
            )
        if unit == "rad":
            units[name] = given
        name = "known" if known else name
        if name in columns:
            raise ConfigurationError(
                f"{path} has several columns {name}; name the joint by --joints"
            )
        columns[name] = values
    return _Content(columns, {}, _angle_unit(path, units))


def _angle_unit(path: Path, units: Mapping[str, str]) -> AngleUnit | None:
    """Unit of the angles by the header; None if it says none.

    Raises:
        ConfigurationError: Only one of goal and position is in degrees.
    """
    if "deg" not in units.values():
        return "rad" if "rad" in units.values() else None
    if other := [name for name, unit in units.items() if unit != "deg"]:
        raise ConfigurationError(
            f"{path}: its header says [deg] for one angle, but not for {other[0]}; give goal and"
            " position in one unit, and name it for both"
        )
    return "deg"


def _read_json(path: Path, joint: str | None) -> _Content:
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
        has = [entry.get(key) is not None for entry in entries]
        if not any(has):
            continue
        if not all(has):
            raise ConfigurationError(
                f"{path}: entry {has.index(False) + 1} has no {key}, and others have one; give it"
                " in all entries or in none"
            )
        columns[name] = np.array(
            [_entry(path, number, key, entry[key]) for number, entry in enumerate(entries, 1)]
        )
    return _Content(columns, _facts(path, content))


_FACTS = {"mass": "kg", "length": "m", "kp": "1", "vin": "V", "arm_mass": "kg"}
"""Facts of a run with their units; others are not used."""


def _facts(path: Path, content: Mapping[str, Any]) -> dict[str, float]:
    """Facts of a run that are used.

    Raises:
        ConfigurationError: One is no positive number.
    """
    facts = {}
    for key, unit in _FACTS.items():
        value = content.get(key)
        if value is None:
            continue
        may_vanish = key == "arm_mass"
        if not _is_number(value) or value < 0.0 or (value == 0.0 and not may_vanish):
            raise ConfigurationError(
                f"{path}: {key} must be a number {'of at least' if may_vanish else 'above'} 0"
                f" [{unit}], got {quote(str(value))[1:-1]}"
            )
        facts[key] = float(value)
    return facts


def _entry(path: Path, number: int, key: str, value: Any) -> float:
    """Value of an entry; only whether the torque is on may be a truth value."""
    if not _is_number(value) and not (key == "torque_enable" and isinstance(value, bool)):
        raise ConfigurationError(
            f"{path}, entry {number}: {key} must be a number, got {quote(str(value))[1:-1]}"
        )
    return float(value)


def _is_number(value: Any) -> bool:
    is_real = isinstance(value, int | float) and not isinstance(value, bool)
    return is_real and abs(value) < _LARGEST


_LARGEST = 1e300


def _read_parquet(path: Path, joint: str | None) -> _Content:
    """An episode of LeRobot: `timestamp`, and the lists `action` and `observation.state`."""
    import pandas as pd

    try:
        table = pd.read_parquet(io.BytesIO(read_bounded(path, LARGEST_BYTES)))
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
    if not 0 < len(table) <= MOST_ROWS:
        raise ConfigurationError(
            f"{path} must have 1 to {MOST_ROWS} rows, it has {len(table)}; give an episode"
        )
    parts = {name: _parquet_column(path, key, list(table[key])) for key, name in names.items()}
    count = min(parts["goal"].shape[1], parts["position"].shape[1])
    at = _joint_number(path, joint, count)
    return _Content(
        {name: part[:, 0 if name == "time" else at] for name, part in parts.items()}, {}
    )


def _parquet_column(path: Path, key: str, cells: list[Any]) -> Array:
    """Numbers of a column, (N, number of joints).

    Raises:
        ConfigurationError: They are not as many in each row, or no finite numbers.
    """
    rows = [np.ravel(cell) for cell in cells]
    if len({len(row) for row in rows}) > 1 or not len(rows[0]):
        raise ConfigurationError(
            f"{path}, column {key}: each row must hold as many numbers as the others, one a joint"
        )
    for number, row in enumerate(rows, 1):
        if row.dtype.kind not in "fiu" or not np.isfinite(row).all():
            raise ConfigurationError(
                f"{path}, column {key}, row {number}: needs finite numbers, got"
                f" {quote(str(row[0]))[1:-1] if row.dtype.kind not in 'fiu' else 'nan or inf'}"
            )
    return np.array(rows, dtype=np.float64)


def _joint_number(path: Path, joint: str | None, count: int) -> int:
    """Place of a joint; a file of one joint needs no number.

    Raises:
        ConfigurationError: It is no number of a joint.
    """
    is_number = joint is not None and joint.isascii() and joint.isdecimal() and len(joint) < 10
    if count == 1 and not is_number:
        return 0
    if joint is None or not is_number or int(joint) >= count:
        got = "" if joint is None else f", got {quote(joint)[1:-1]}"
        raise ConfigurationError(
            f"{path} has {count} joint{'s' * (count > 1)}; choose one by its number, --joints 0"
            f" to {count - 1}{got}"
        )
    return int(joint)


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
