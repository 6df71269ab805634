"""Targets from a CSV file: poses, or angles in time."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from elastic_env.core.csv_table import read_table
from elastic_env.core.errors import ConfigurationError, require_known
from elastic_env.core.signals import Array
from elastic_env.hardware.live.targets import Poses, Targets, Trajectory, require_in_range
from elastic_env.motion.arm_references import Csv, Workspace

_MAX_POSES = 10_000


def read_targets(
    file: Path,
    joints: Sequence[str],
    start: Array,
    lowest: Array,
    highest: Array,
    *,
    hold_s: float,
    period_s: float,
) -> Targets:
    """Read targets from a CSV file: poses, or with a column `time_s` angles in time.

    Args:
        file: Columns are the names of joints [rad]; joints without a column stay at `start`.
        joints: Names of the joints that are commanded, (n,).
        start: Their present angles, (n,) [rad].
        lowest: Lowest angles of the joints, (n,) [rad].
        highest: Highest angles, (n,) [rad].
        hold_s: How long each pose is held [s].
        period_s: Duration of a control cycle [s].

    Raises:
        ConfigurationError: The file cannot be read, or has a wrong column or value.
    """
    example = "joints, or time_s and joints"
    names, rows = read_table(
        file, what="file of targets", row="row", most_rows=_MAX_POSES * 100, example=example
    )
    if names[0] == "time_s":
        workspace = Workspace(tuple(joints), lowest, highest, start, None, None)
        path = Csv(file=str(file)).joint_plan(workspace, period_s).q
        require_in_range(str(file), joints, path, lowest, highest)
        return Trajectory(path)
    names = tuple(map(_joint_name, names))
    require_known(f"column of {file}", names, joints)
    if not 0 < len(rows) <= _MAX_POSES:
        raise ConfigurationError(f"{file} must have 1 to {_MAX_POSES} poses, it has {len(rows)}")
    poses = np.tile(start, (len(rows), 1))
    poses[:, [list(joints).index(name) for name in names]] = rows
    require_in_range(str(file), joints, poses, lowest, highest)
    return Poses(poses, hold_s)


def _joint_name(column: str) -> str:
    """Joint of a column; logs of poses have columns such as `theta.elbow [rad]`."""
    name = column.partition("[")[0].strip()
    return name.removeprefix("theta.").removeprefix("q.")
