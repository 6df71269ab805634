"""Targets from a stream of lines: standard input, or a TCP client on this machine."""

import json
import os
import select
import socket
from collections.abc import Sequence
from contextlib import suppress

import numpy as np
from typing_extensions import override

from elastic_env.core.errors import ConfigurationError, quote, require_known
from elastic_env.core.json_text import parse_json
from elastic_env.core.signals import Array
from elastic_env.hardware.live.targets import Targets, require_in_range

_MAX_READ = 4096
"""Most bytes of a stream that are read in a cycle."""
_MAX_LINE = 100_000
"""Longest line that is accepted [characters]."""


class Stream(Targets):
    """Targets from a stream of lines; the last target holds until the next line.

    A line is the angles of all joints with commas between them, or a JSON object of angles by
    joint [rad]. Other lines are counted and change nothing.

    Args:
        descriptor: File descriptor of a file, pipe or socket; None while no client is connected.
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

    @override
    def next(self, desired: Array, period_s: float) -> Array | None:
        if self._target is None:
            self._target = desired.copy()
        data = b""
        source = self._descriptor
        if source is not None and not self._is_over and select.select([source], [], [], 0.0)[0]:
            # the rest is read in the next cycle: a fast sender must not delay this one
            with suppress(OSError):  # the client is gone
                data = os.read(source, _MAX_READ)
            self._is_over = not data
        *lines, rest = (self._pending + data).split(b"\n")
        self._pending = rest[: _MAX_LINE + 1]
        for line in lines:
            if line.strip():
                self._target = self._parse_line(line, self._target)
        return None if self._is_over else self._target

    def _parse_line(self, line: bytes, previous: Array) -> Array:
        """Target of a line, or the previous one if the line is no target, (n,) [rad]."""
        try:
            target = parse_target(line.decode(), self._joints, previous)
            require_in_range("the line", self._joints, target, self._lowest, self._highest)
        except (TypeError, ValueError, ConfigurationError) as error:
            self.refused += 1
            self.problem = str(error)
            return previous
        self.number += 1
        return target


class Socket(Stream):
    """Targets from a client on the loopback; each line is answered with the state of the arm.

    Args:
        port: TCP port on 127.0.0.1; 0 for a free one.
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
        self._answered_lines = 0
        self.address = self._server.getsockname()

    @override
    def next(self, desired: Array, period_s: float) -> Array | None:
        if self._client is None and select.select([self._server], [], [], 0.0)[0]:
            self._client, _ = self._server.accept()
            self._client.setblocking(False)
            self._descriptor = self._client.fileno()
        return super().next(desired, period_s)

    @override
    def report_state(self, state: dict[str, object]) -> None:
        lines = self.number + self.refused
        if self._client is None or lines == self._answered_lines:
            return
        self._answered_lines = lines
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


def parse_target(line: str, joints: Sequence[str], previous: Array) -> Array:
    """Parse a line of a stream as a target, (n,) [rad].

    Args:
        line: Numbers with commas between them, or a JSON object of angles by joint.
        joints: Names of the joints.
        previous: Last target, for joints that an object does not name.

    Raises:
        ValueError: The line is neither.
        ConfigurationError: A joint does not exist.
    """
    n = len(joints)
    if len(line) > _MAX_LINE:
        raise ValueError(f"a line must have at most {_MAX_LINE} characters")
    if line.lstrip().startswith("{"):
        angles = parse_json(line)
        require_known("joint", angles, joints)
        target = previous.copy()
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
