"""Targets of a live arm from a file: poses held one after another, or angles in time."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from typing_extensions import override

from elastic_env.core.csv_table import read_table
from elastic_env.core.errors import ConfigurationError, require_known
from elastic_env.core.signals import Array
from elastic_env.motion.arm_references import Csv, Workspace

_MAX_POSES = 10_000
_REACHED_RAD = 1e-3
"""Distance from a pose below which it counts as reached [rad]."""


class Targets(ABC):
    """Link angles that an arm is to take, one after another.

    Attributes:
        refused: Number of lines of a stream that were no targets.
        problem: Reason of the last refusal; empty without any.
        number: Number of the current target.
    """

    def __init__(self) -> None:
        self.refused: int = 0
        self.problem = ""
        self.number: int = 0

    @abstractmethod
    def next(self, desired: Array, period_s: float) -> Array | None:
        """Target of the next cycle, (n,) [rad]; None when the motion is over.

        Args:
            desired: Desired link angles now, (n,) [rad].
            period_s: Duration of a cycle [s].
        """

    def report_state(self, state: dict[str, object]) -> None:  # noqa: B027  files need no answer
        """Send the state of the arm to the sender of the targets."""

    def close(self) -> None:  # noqa: B027
        """Release files and sockets."""


class Poses(Targets):
    """Poses one after another, each held for a while.

    Args:
        poses: (N, n) [rad].
        hold_s: How long the desired angles stay at each [s].

    Attributes:
        poses: The same.
    """

    def __init__(self, poses: Array, hold_s: float) -> None:
        super().__init__()
        self.poses = poses
        self._hold_s = hold_s
        self._held_s = 0.0

    @override
    def next(self, desired: Array, period_s: float) -> Array | None:
        if _is_reached(desired, self.poses[self.number]):
            self._held_s += period_s
        if self._held_s > self._hold_s:
            self._held_s = 0.0
            self.number += 1
        if self.number >= len(self.poses):
            return None
        return self.poses[self.number]


class Trajectory(Targets):
    """Angles in time; they start when the arm has reached the first ones.

    Args:
        q: A row for each cycle, (T, n) [rad].
    """

    def __init__(self, q: Array) -> None:
        super().__init__()
        self._q = q
        self._has_begun = False

    @override
    def next(self, desired: Array, period_s: float) -> Array | None:
        if not self._has_begun:
            self._has_begun = _is_reached(desired, self._q[0])
            return self._q[0]
        self.number += 1
        return self._q[self.number] if self.number < len(self._q) else None


def _is_reached(desired: Array, pose: Array) -> bool:
    """Return True if the desired angles are at a pose."""
    return bool(np.abs(desired - pose).max() < _REACHED_RAD)


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
    return column.partition("[")[0].strip().removeprefix("theta.").removeprefix("q.")


def require_in_range(
    source: str, joints: Sequence[str], angles: Array, lowest: Array, highest: Array
) -> None:
    """Check that targets lie within the joints' ranges; angles in degrees do not.

    Args:
        source: File or line, for the message.
        joints: Names of the joints, (n,).
        angles: (..., n) [rad].
        lowest: Lowest angles, (n,) [rad].
        highest: Highest angles, (n,) [rad].

    Raises:
        ConfigurationError: A target lies beyond its range.
    """
    rows = angles.reshape(-1, len(joints))
    beyond = (rows < lowest) | (rows > highest)
    if not beyond.any():
        return
    row, column = np.argwhere(beyond)[0]
    in_degrees = np.deg2rad(rows)
    cure = "give angles within it"
    if ((in_degrees >= lowest) & (in_degrees <= highest)).all() and np.abs(rows).max() > math.tau:
        cure = "the angles look like degrees: convert them to radians"
    raise ConfigurationError(
        f"{source}: the target {rows[row, column]:g} rad of joint {joints[column]!r}"
        f" (row {row + 1}) lies beyond its range of {lowest[column]:.4g} to"
        f" {highest[column]:.4g} rad; {cure}"
    )
