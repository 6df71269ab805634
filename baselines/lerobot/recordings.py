"""LeRobot's data sets as logs in time of single joints, which `elastic identify --log` reads.

A data set is a folder: `meta/info.json` names the columns, and `data/**/*.parquet` has the rows. A
file has one episode (v2.1) or several (v3.0). Pictures are not read.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from baselines.identification.servo_file import read_episodes
from baselines.identification.servo_load import Load
from baselines.identification.servo_log import ServoLog, known_loads
from baselines.lerobot.arm import LeRobotArm
from elastic_env.core.config import read_json
from elastic_env.core.errors import ConfigurationError, list_names, shorten
from elastic_env.core.signals import Array

_MOST_BYTES = 200_000_000
"""Largest size of a file of rows; LeRobot starts another file at 100 MB."""
_OLD_PREFIX = "main_"
"""Prefix of the motors' names in data sets of 2024."""
_FEWEST_ROWS = 3
"""Rows of an episode that give an acceleration."""
_LONGEST_GAP = 1000
"""Longest time between two rows, in usual steps."""
_ROBOT_TYPES = {"so_follower": "so101_follower"}
"""Types of robots with the same motors, by their names in data sets."""


@dataclass(frozen=True)
class Recording:
    """An episode in LeRobot's own values.

    Attributes:
        episode: Number of the episode.
        motors: Names of the motors that have a goal and a position, (n,).
        time: Time since the start of the episode, (N,) [s].
        goal: Goals of these motors, (N, n).
        position: Positions of these motors, (N, n).
    """

    episode: int
    motors: tuple[str, ...]
    time: Array
    goal: Array
    position: Array


def robot_of(folder: Path) -> str:
    """Type of the robot that a data set names.

    Raises:
        ConfigurationError: The folder is no data set, or names no robot.
    """
    robot = _read_info(folder).get("robot_type")
    if not isinstance(robot, str) or not robot:
        raise ConfigurationError(f"{shorten(folder)} names no robot; use --robot")
    name = robot if robot.endswith("_follower") else f"{robot}_follower"
    return _ROBOT_TYPES.get(name, name)


def read_recordings(folder: Path, episodes: Sequence[int] = ()) -> list[Recording]:
    """Read episodes of a data set.

    Args:
        folder: Folder of the data set.
        episodes: Numbers of the episodes; empty for all.

    Raises:
        ConfigurationError: The folder is no data set, or an episode is not in it.
    """
    info = _read_info(folder)
    goals = _motor_columns(folder, info, "action")
    positions = _motor_columns(folder, info, "observation.state")
    motors = tuple(name for name in goals if name in positions)
    if not motors:
        raise ConfigurationError(
            f"{shorten(folder)} has no motor with an action and a position; its actions are"
            f" {list_names(goals)}"
        )
    recordings: list[Recording] = []
    for file in sorted((folder / "data").rglob("*.parquet")):
        recordings += _read_file(file, motors, goals, positions, episodes)
    recordings.sort(key=lambda recording: recording.episode)
    present = {recording.episode for recording in recordings}
    missing = [f"episode {episode}" for episode in episodes if episode not in present]
    if missing or not recordings:
        what = missing[0] if missing else "episodes"
        raise ConfigurationError(f"{shorten(folder)} has no {what} in its folder data")
    return recordings


def joint_logs(recording: Recording, arm: LeRobotArm) -> list[ServoLog]:
    """Logs of the joints of an arm, in rad, with the torque by its model.

    Args:
        recording: An episode.
        arm: Units and model; the stiffness of its joints has no effect.

    Returns:
        A log JOINT_EPISODE for each joint, with the inertia of the links about it, mean over the
        rows. The known torque is that of weight and of the other joints' motion.

    Raises:
        ConfigurationError: The episode lacks a motor of the arm.
    """
    if missing := [name for name in arm.motors if name not in recording.motors]:
        raise ConfigurationError(
            f"episode {recording.episode} has no motor {missing[0]!r}; it has"
            f" {list_names(recording.motors)}"
        )
    columns = [recording.motors.index(name) for name in arm.motors]
    goal = arm.units.angle(recording.goal[:, columns])
    position = arm.units.angle(recording.position[:, columns])
    inertia, known = known_loads(arm.compensator.constants.body, recording.time, position)
    return [
        ServoLog(
            name=f"{name.replace('/', '_')}_{recording.episode}",
            time=recording.time,
            goal=goal[:, joint],
            position=position[:, joint],
            enabled=np.ones(len(goal), dtype=np.bool_),
            load=Load(inertia=float(inertia[joint])),
            known_torque=known[:, joint],
        )
        for joint, name in enumerate(arm.compensator.joints)
    ]


def log_text(log: ServoLog) -> str:
    """Text of the CSV file of a log of `joint_logs`, for `elastic identify --log`."""
    inertia = np.full_like(log.time, log.load.inertia)
    known = log.external_torque(log.position)
    rows = np.column_stack([log.time, log.goal, log.position, inertia, known])
    lines = [",".join(f"{value:.9g}" for value in row) for row in rows]
    head = "time [s],goal [rad],position [rad],inertia [kg·m²],tau_known [N·m]"
    return "\n".join([head, *lines, ""])


def _read_info(folder: Path) -> Mapping[str, Any]:
    """Read meta/info.json."""
    path = folder / "meta" / "info.json"
    content = read_json(
        path,
        _MOST_BYTES,
        lambda reason: (
            f"{shorten(folder)} is no data set of LeRobot, which has meta/info.json and"
            f" data/ ({reason})"
        ),
    )
    features = content.get("features") if isinstance(content, Mapping) else None
    if not isinstance(features, Mapping):
        problem = f"{shorten(path)} describes no features; record the data set again"
        raise ConfigurationError(problem)
    return content


def _motor_columns(folder: Path, info: Mapping[str, Any], key: str) -> dict[str, int]:
    """Columns of the motors within `action` or `observation.state`, by their names."""
    feature = info["features"].get(key)
    names = feature.get("names") if isinstance(feature, Mapping) else None
    if isinstance(names, Mapping):  # {"motors": [...]}
        names = next(iter(names.values()), None)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ConfigurationError(f"{shorten(folder)} does not name the motors of {key}")
    plain = [name.removeprefix(_OLD_PREFIX).removesuffix(".pos") for name in names]
    return {name: column for column, name in enumerate(plain) if "." not in name}


def _require_clock(file: Path, episode: int, time: Array) -> None:
    """Refuse a clock that does not grow, has gaps, or has too few rows for an acceleration."""
    step = np.diff(time)
    usual = np.median(step) if len(step) else 0.0
    if len(time) < _FEWEST_ROWS or step.min() <= 0.0 or step.max() > _LONGEST_GAP * usual:
        steps = f", {step.min():.3g} to {step.max():.3g} s apart" if len(step) else ""
        raise ConfigurationError(
            f"{shorten(file)}, episode {episode}: needs at least {_FEWEST_ROWS} rows with a"
            f" timestamp that grows, without gaps of {_LONGEST_GAP} usual steps, it has"
            f" {len(time)}{steps}; name the other episodes by --episodes"
        )


def _read_file(
    file: Path,
    motors: Sequence[str],
    goals: Mapping[str, int],
    positions: Mapping[str, int],
    episodes: Sequence[int],
) -> Iterator[Recording]:
    """Read some or all episodes of a file of rows."""
    table = read_episodes(file, _MOST_BYTES)
    for values, columns in ((table.goal, goals), (table.position, positions)):
        if values.shape[1] <= max(columns.values()):
            raise ConfigurationError(
                f"{shorten(file)} has {values.shape[1]} columns, and meta/info.json names"
                f" {max(columns.values()) + 1}"
            )
    for episode in np.unique(table.episode):
        if episodes and episode not in episodes:
            continue
        rows = table.episode == episode
        _require_clock(file, episode, table.time[rows])
        yield Recording(
            episode=int(episode),
            motors=tuple(motors),
            time=table.time[rows],
            goal=table.goal[rows][:, [goals[name] for name in motors]],
            position=table.position[rows][:, [positions[name] for name in motors]],
        )
