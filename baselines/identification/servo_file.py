"""Files of logs in time: CSV, the JSON of Rhoban's recorder, and episodes of LeRobot in parquet.

docs/identification.md describes the columns.
"""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from elastic_env.core.csv_table import LARGEST_BYTES, read_table
from elastic_env.core.errors import ConfigurationError, MissingExtraError, quote
from elastic_env.core.files import read_bounded
from elastic_env.core.json_text import parse_json
from elastic_env.core.signals import Array, IntArray

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
    "inertia": "kg·m²",
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
"""Columns by the keys of Rhoban's recorder, which others use too."""
_FACTS = {"mass": "kg", "length": "m", "kp": "1", "vin": "V", "arm_mass": "kg"}
"""Facts of a run with their units; others are not used."""
_LONGEST_JSON = 20_000_000
"""Characters of a JSON file, at most."""
_LARGEST_NUMBER = 1e300


class Content(NamedTuple):
    """Columns of a file, facts of the run, and the unit of angles if the file gives one."""

    columns: dict[str, Array]
    facts: dict[str, float]
    unit: AngleUnit | None = None


def is_servo_log(path: Path) -> bool:
    """True if a file is a log in time: JSON, parquet, or CSV with a column `time`."""
    if path.suffix.lower() in (".json", ".parquet"):
        return True
    try:
        if not path.is_file():  # reading a named pipe would wait for data
            return False
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            head = file.readline(10_000)
    except (OSError, ValueError):
        return False
    return "time" in [_column_name(cell) for cell in head.split(",")]


def read_content(path: Path, joint: str | None) -> Content:
    """Columns and facts of a file.

    Args:
        path: CSV file, JSON file of a recorder of servos, or parquet file of LeRobot.
        joint: Joint to read, where the file has several.

    Raises:
        ConfigurationError: It cannot be read, or lacks time, goal or position.
    """
    readers = {".json": _read_json, ".parquet": _read_parquet}
    content = readers.get(path.suffix.lower(), _read_csv)(path, joint)
    for name in ("time", "goal", "position"):
        if name not in content.columns:
            raise ConfigurationError(
                f"{path} has no column {name}; a log in time needs time [s], goal [rad] and"
                f" position [rad], it has {', '.join(content.columns) or 'none of them'}"
            )
    return content


def _column_name(cell: str) -> str:
    """Name of a column without its unit."""
    return cell.strip().strip('"').partition("[")[0].strip()


def _read_csv(path: Path, joint: str | None) -> Content:
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
        name = _column_name(text)
        is_torque = name == "tau_known" or name.startswith("tau_known.")
        if is_torque and joint is not None and name not in ("tau_known", f"tau_known.{joint}"):
            continue
        unit = "N·m" if is_torque else _COLUMNS.get(name)
        if unit is None:
            raise ConfigurationError(
                f"{path} has the column {quote(text)}; columns are {', '.join(_COLUMNS)} and"
                " tau_known.JOINT"
            )
        file_unit = text.partition("[")[2].rstrip("] ").replace("Nm", "N·m")
        allowed = ("rad", "deg") if unit == "rad" else (unit,)
        if file_unit and file_unit not in allowed:
            choices = " or ".join(f"[{choice}]" for choice in allowed)
            raise ConfigurationError(
                f"{path}, column {name}: the unit must be {choices}, got"
                f" [{quote(file_unit)[1:-1]}]; convert the column"
            )
        if unit == "rad":
            units[name] = file_unit
        field = "known_torque" if is_torque else name
        if field in columns:
            cure = "name the joint by --joints" if is_torque else "keep one of them"
            raise ConfigurationError(f"{path} has several columns {name.partition('.')[0]}; {cure}")
        columns[field] = values
    return Content(columns, {}, _angle_unit(path, units))


def _angle_unit(path: Path, units: Mapping[str, str]) -> AngleUnit | None:
    """Unit of the angles in the header; None if the header has none.

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


def _read_json(path: Path, joint: str | None) -> Content:
    """Read a log of Rhoban's recorder: facts of the run, and a list of entries."""
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
            [_entry_value(path, n, key, e[key]) for n, e in enumerate(entries, 1)]
        )
    return Content(columns, _facts(path, content))


def _facts(path: Path, content: Mapping[str, Any]) -> dict[str, float]:
    """Facts of a run that are used.

    Raises:
        ConfigurationError: A fact is no positive number.
    """
    facts = {}
    for key, unit in _FACTS.items():
        value = content.get(key)
        if value is None:
            continue
        may_be_zero = key == "arm_mass"
        if not _is_number(value) or value < 0.0 or (value == 0.0 and not may_be_zero):
            raise ConfigurationError(
                f"{path}: {key} must be a number {'of at least' if may_be_zero else 'above'} 0"
                f" [{unit}], got {quote(str(value))[1:-1]}"
            )
        facts[key] = float(value)
    return facts


def _entry_value(path: Path, number: int, key: str, value: Any) -> float:
    """Value of an entry; only `torque_enable` may be a boolean."""
    if not _is_number(value) and not (key == "torque_enable" and isinstance(value, bool)):
        raise ConfigurationError(
            f"{path}, entry {number}: {key} must be a number, got {quote(str(value))[1:-1]}"
        )
    return float(value)


def _is_number(value: Any) -> bool:
    is_real = isinstance(value, int | float) and not isinstance(value, bool)
    return is_real and abs(value) < _LARGEST_NUMBER


def _read_parquet(path: Path, joint: str | None) -> Content:
    """Read an episode of LeRobot."""
    table = read_episodes(path)
    episodes = np.unique(table.episode)
    if len(episodes) > 1:
        raise ConfigurationError(
            f"{path} has {len(episodes)} episodes; elastic lerobot FOLDER writes a log of each"
        )
    count = min(table.goal.shape[1], table.position.shape[1])
    index = _joint_number(path, joint, count)
    columns = {
        "time": table.time,
        "goal": table.goal[:, index],
        "position": table.position[:, index],
    }
    return Content(columns, {})


class EpisodeTable(NamedTuple):
    """Rows of a parquet file of LeRobot.

    Attributes:
        time: Time since the start of the episode, (N,) [s].
        goal: Values of `action`, (N, n).
        position: Values of `observation.state`, (N, m).
        episode: Number of the episode; 0 where the file has none, (N,).
    """

    time: Array
    goal: Array
    position: Array
    episode: IntArray


def read_episodes(path: Path, most_bytes: int = LARGEST_BYTES) -> EpisodeTable:
    """Read `timestamp`, `action` and `observation.state` of a parquet file of LeRobot.

    Args:
        path: The file.
        most_bytes: Largest size of the file.

    Raises:
        ConfigurationError: It cannot be read, or has other columns.
        MissingExtraError: The package pyarrow is missing.
    """
    import pandas as pd

    try:
        table = pd.read_parquet(io.BytesIO(read_bounded(path, most_bytes)))
    except ImportError:
        raise MissingExtraError(
            "reading parquet files needs the package pyarrow; install it with: pip install pyarrow"
        ) from None
    except ConfigurationError:
        raise
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"{path} is no parquet file that can be read: {error}") from None
    names = ("timestamp", "action", "observation.state")
    if missing := [key for key in names if key not in table]:
        raise ConfigurationError(
            f"{path} has no column {missing[0]}; an episode of LeRobot has timestamp, action and"
            " observation.state"
        )
    if not 0 < len(table) <= MOST_ROWS:
        raise ConfigurationError(
            f"{path} must have 1 to {MOST_ROWS} rows, it has {len(table)}; give an episode"
        )
    time, goal, position = (_parquet_column(path, key, list(table[key])) for key in names)
    episode = np.zeros((len(table), 1))
    if "episode_index" in table:
        episode = _parquet_column(path, "episode_index", list(table["episode_index"]))
    return EpisodeTable(time[:, 0], goal, position, episode[:, 0].astype(np.int64))


def _parquet_column(path: Path, key: str, cells: list[Any]) -> Array:
    """Numbers of a column, (N, number of joints).

    Raises:
        ConfigurationError: The rows have different lengths, or not all numbers are finite.
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
    """Index of a joint; a file of one joint needs no number.

    Raises:
        ConfigurationError: `joint` is no number of a joint.
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
