"""Where the targets of a live arm come from: a file of poses or angles in time, or a stream."""

import json
import math
import os
import select
import socket
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from typing_extensions import override

from elastic_env.core.csv_table import read_table
from elastic_env.core.errors import ConfigurationError, quote, require_known
from elastic_env.core.json_text import parse_json
from elastic_env.core.signals import Array
from elastic_env.motion.arm_references import Csv, Workspace

_MOST_POSES = 10_000
_MOST_READ = 4096
"""Bytes of a stream that are read in a cycle."""
_LONGEST_LINE = 100_000
_REACHED_RAD = 1e-3
_LAST_RAD = 1e-9
"""A way that is no step [rad]."""


class Targets(ABC):
    """Link angles that an arm is to take, one after another.

    Attributes:
        refused: Lines of a stream that were no targets.
        number: Number of the current target.
    """

    def __init__(self) -> None:
        self.refused: int = 0
        self.number: int = 0

    @abstractmethod
    def next(self, desired: Array, period_s: float) -> Array | None:
        """The target of the coming cycle, (n,) [rad]; None where the motion is over.

        Args:
            desired: Where the links should be now, (n,) [rad].
            period_s: Time of a cycle [s].
        """

    def tell(self, state: dict[str, object]) -> None:  # noqa: B027  a file listens to nobody
        """Tell whoever sends the targets what the arm does."""

    def close(self) -> None:  # noqa: B027
        """Give back what it holds."""


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
    """Angles in time, once the arm is where they begin.

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
    """True if the desired angles are those of a pose."""
    return bool(np.abs(desired - pose).max() < _REACHED_RAD)


class Stream(Targets):
    """Targets from a stream of lines, the last of which holds until another comes.

    A line is the angles of all joints with commas between them, or a JSON object of angles by
    joint [rad]. Other lines are counted and change nothing.

    Args:
        descriptor: Of a file, pipe or socket; None where nobody is there yet.
        joints: Names of the joints, (n,).
        lowest, highest: Their ranges, (n,) [rad].
    """

    def __init__(
        self, descriptor: int | None, joints: Sequence[str], lowest: Array, highest: Array
    ) -> None:
        super().__init__()
        self._descriptor = descriptor
        self._joints = list(joints)
        self._lowest = lowest
        self._highest = highest
        self._pending = b""
        self._target: Array | None = None
        self._is_over = False
        self.problem = ""

    @override
    def next(self, desired: Array, period_s: float) -> Array | None:
        if self._target is None:
            self._target = desired.copy()
        data = b""
        source = self._descriptor
        if source is not None and not self._is_over and select.select([source], [], [], 0.0)[0]:
            # what is left comes in the next cycle: a sender that is faster must not hold this one
            with suppress(OSError):  # the client is gone
                data = os.read(source, _MOST_READ)
            self._is_over = not data
        *lines, rest = (self._pending + data).split(b"\n")
        self._pending = rest[: _LONGEST_LINE + 1]
        for line in lines:
            if line.strip():
                self._take(line)
        return None if self._is_over else self._target

    def _take(self, line: bytes) -> None:
        assert self._target is not None
        try:
            target = parse_target(line.decode(), self._joints, self._target)
            require_in_range("the line", self._joints, target, self._lowest, self._highest)
        except (TypeError, ValueError, ConfigurationError) as error:
            self.refused += 1
            self.problem = str(error)
            return
        self._target = target
        self.number += 1


class Socket(Stream):
    """Targets from a client on the loopback, which is told the state of the arm after each line.

    Args:
        port: Port of TCP on 127.0.0.1; 0 for a free one.
        joints: Names of the joints, (n,).
        lowest, highest: Their ranges, (n,) [rad].

    Attributes:
        address: Address and port.
    """

    def __init__(self, port: int, joints: Sequence[str], lowest: Array, highest: Array) -> None:
        super().__init__(None, joints, lowest, highest)
        self._server = socket.create_server(("127.0.0.1", port))
        self._server.setblocking(False)
        self._client: socket.socket | None = None
        self._told = 0
        self.address = self._server.getsockname()

    @override
    def next(self, desired: Array, period_s: float) -> Array | None:
        if self._client is None and select.select([self._server], [], [], 0.0)[0]:
            self._client, _ = self._server.accept()
            self._client.setblocking(False)
            self._descriptor = self._client.fileno()
        return super().next(desired, period_s)

    @override
    def tell(self, state: dict[str, object]) -> None:
        lines = self.number + self.refused
        if self._client is None or lines == self._told:
            return
        self._told = lines
        answer = {**state, "refused": self.problem} if self.refused else state
        try:
            self._client.send(json.dumps(answer).encode() + b"\n")
        except OSError:
            self._is_over = True

    @override
    def close(self) -> None:
        for end in (self._client, self._server):
            if end is not None:
                end.close()


def parse_target(line: str, joints: Sequence[str], before: Array) -> Array:
    """A target of a line of a stream, (n,) [rad].

    Args:
        line: Numbers with commas between them, or a JSON object of angles by joint.
        joints: Names of the joints.
        before: The last target, for joints that an object does not name.

    Raises:
        ValueError: It is neither.
        ConfigurationError: A joint does not exist.
    """
    n = len(joints)
    if len(line) > _LONGEST_LINE:
        raise ValueError(f"a line must have at most {_LONGEST_LINE} characters")
    if line.lstrip().startswith("{"):
        angles = parse_json(line)
        require_known("joint", angles, joints)
        target = before.copy()
        for name, angle in angles.items():
            if isinstance(angle, bool | str):
                raise ValueError(f"angles must be numbers [rad], got {quote(angle)} for {name!r}")
            target[list(joints).index(name)] = float(angle)
    else:
        target = np.array([float(cell) for cell in line.split(",")])
    if target.shape != (n,) or not np.isfinite(target).all():
        problem = f"a target needs {n} finite angles [rad], of {', '.join(joints)}"
        raise ValueError(f"{problem}; got {quote(line.strip())}")
    return target


def require_in_range(
    where: str, joints: Sequence[str], angles: Array, lowest: Array, highest: Array
) -> None:
    """Refuse targets beyond the joints' ranges, such as degrees.

    Args:
        where: File or line, for the message.
        joints: Names of the joints, (n,).
        angles: (..., n) [rad].
        lowest: Lowest angles, (n,) [rad].
        highest: Highest ones.

    Raises:
        ConfigurationError: One lies beyond.
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
        f"{where}: the target {rows[row, column]:g} rad of joint {joints[column]!r} (row {row + 1})"
        f" lies beyond its range of {lowest[column]:.4g} to {highest[column]:.4g} rad; {cure}"
    )


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
    """Targets of a CSV file: poses, or with a column `time_s` angles in time.

    Args:
        file: Columns are the names of joints [rad]; joints without one stay where they are.
        joints: Names of the joints that are commanded, (n,).
        start: Where they are, (n,) [rad].
        lowest: Lowest angles of the joints, (n,) [rad].
        highest: Highest ones.
        hold_s: How long each pose is held [s].
        period_s: Time of a control cycle [s].

    Raises:
        ConfigurationError: It cannot be read, or a column or value is not what it has to be.
    """
    example = "joints, or time_s and joints"
    names, rows = read_table(
        file, what="file of targets", row="row", most_rows=_MOST_POSES * 100, example=example
    )
    if names[0] == "time_s":
        workspace = Workspace(tuple(joints), lowest, highest, start, None, None)
        path = Csv(file=str(file)).joint_plan(workspace, period_s).q
        require_in_range(str(file), joints, path, lowest, highest)
        return Trajectory(path)
    names = tuple(map(_joint_of, names))
    require_known(f"column of {file}", names, joints)
    if not 0 < len(rows) <= _MOST_POSES:
        raise ConfigurationError(f"{file} must have 1 to {_MOST_POSES} poses, it has {len(rows)}")
    poses = np.tile(start, (len(rows), 1))
    poses[:, [list(joints).index(name) for name in names]] = rows
    require_in_range(str(file), joints, poses, lowest, highest)
    return Poses(poses, hold_s)


def _joint_of(column: str) -> str:
    """The joint of a column, which may be one of a log of poses, such as `theta.elbow [rad]`."""
    name = column.partition("[")[0].strip()
    return name.removeprefix("theta.").removeprefix("q.")


class Follower:
    """Desired angles that go to a target within a speed and an acceleration.

    Args:
        start: Where they begin, (n,) [rad].
        speed: Largest speed [rad/s].
        acceleration: Largest acceleration [rad/s²].

    Attributes:
        q, q_dot, q_ddot: Desired angles, their rates and accelerations, (n,) [rad], [rad/s],
            [rad/s²].
    """

    def __init__(self, start: Array, speed: float, acceleration: float) -> None:
        self.q = np.array(start, dtype=np.float64)
        self.q_dot = np.zeros_like(self.q)
        self.q_ddot = np.zeros_like(self.q)
        self._speed = speed
        self._acceleration = acceleration

    def step(self, target: Array, period_s: float) -> None:
        r"""Go on towards a target, (n,) [rad], for a cycle.

        The speed is the fastest from which the way that is left suffices to brake:

        .. math:: v = \sqrt{(a T)^2 / 4 + 2 a |e|} - a T / 2

        Only the very last step brakes by up to twice the acceleration.
        """
        before = self.q_dot.copy()
        error = target - self.q
        step = self._acceleration * period_s
        braking = np.sqrt(0.25 * step**2 + 2.0 * self._acceleration * np.abs(error)) - 0.5 * step
        wanted = np.sign(error) * np.minimum(braking, self._speed)
        self.q_dot += np.clip(wanted - self.q_dot, -step, step)
        move = self.q_dot * period_s
        # the last step ends on the target
        is_last = np.abs(error) <= np.abs(move) + _LAST_RAD
        is_slow = np.abs(self.q_dot) <= 2.0 * step
        arrives = is_last & is_slow
        self.q = np.where(arrives, target, self.q + move)
        self.q_dot = np.where(arrives, 0.0, self.q_dot)
        self.q_ddot = (self.q_dot - before) / period_s
