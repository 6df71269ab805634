"""Messages between a program and its supervisor: one JSON object each, numbered, over a pair of sockets."""

import json
import select
import socket
from typing import Any

LONGEST_WAIT_S = 0.02
"""How far ahead a cycle may ask to be read [s]."""

_LONGEST = 65536


class Channel:
    """One end.

    Args:
        end: A socket that keeps messages apart (SOCK_SEQPACKET).
    """

    def __init__(self, end: socket.socket) -> None:
        self._end = end

    @staticmethod
    def pair() -> tuple[socket.socket, socket.socket]:
        """Both ends."""
        return socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)

    def send(self, message: dict[str, Any]) -> None:
        """Send.

        Raises:
            OSError: The other end is gone.
        """
        self._end.send(json.dumps(message).encode())

    def is_waiting(self, timeout_s: float | None) -> bool:
        """Whether a message, or the end of the other side, comes within a time."""
        return bool(select.select([self._end], [], [], timeout_s)[0])

    def receive(self) -> dict[str, Any] | None:
        """The next message; None if the other end is gone."""
        try:
            data = self._end.recv(_LONGEST)
        except ConnectionError:
            return None
        return json.loads(data) if data else None

    def close(self) -> None:
        """Close this end."""
        self._end.close()
