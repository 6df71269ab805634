"""Pseudo-terminals in the place of serial ports, and the damage that a bad line does to replies."""

import contextlib
import fcntl
import os
import pty
import struct
import termios
import tty

import numpy as np

from elastic_env.hardware.emulator.settings import Faults

_UNREAD_BYTES = 2000
_OUTPUT_SPEED = 5  # in what tcgetattr returns


class Terminal:
    """A pseudo-terminal that passes bytes through as they are; programs open its name as they would a serial port."""

    def __init__(self) -> None:
        self.master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self.master, False)
        self.name = os.ttyname(self._slave)

    def write(self, data: bytes) -> None:
        """Pass bytes on; they are lost where nobody has read what is there, as on a line to nobody."""
        unread = struct.unpack("i", fcntl.ioctl(self._slave, termios.FIONREAD, b"\0\0\0\0"))[0]
        if unread > _UNREAD_BYTES:
            termios.tcflush(self._slave, termios.TCIFLUSH)
        with contextlib.suppress(OSError):
            os.write(self.master, data)

    def read(self) -> bytes:
        """Bytes that have come."""
        with contextlib.suppress(OSError):
            return os.read(self.master, 4096)
        return b""

    def has_rate(self, baudrate: int) -> bool:
        """Whether the program at the other end has set a baud rate; one that the system has no name for passes."""
        return termios.tcgetattr(self._slave)[_OUTPUT_SPEED] == getattr(termios, f"B{baudrate}")

    def close(self) -> None:
        """Take it away, as an unplugged adapter is."""
        os.close(self.master)
        os.close(self._slave)


def damage(faults: Faults, reply: bytes, generator: np.random.Generator) -> tuple[bytes, float]:
    """A reply as the line delivers it: its bytes, none if it is lost, and its delay [s]."""
    delay = faults.latency_s
    chance = generator.random(4)
    if faults.silent or chance[0] < faults.lost:
        return b"", 0.0
    if chance[1] < faults.late:
        delay += faults.late_s
    if chance[2] < faults.corrupted:
        reply = flip_bit(reply, generator)
    if chance[3] < faults.truncated:
        reply = reply[: int(generator.integers(1, len(reply)))]
    return reply, delay


def flip_bit(data: bytes, generator: np.random.Generator) -> bytes:
    """The same bytes with one bit inverted."""
    changed = bytearray(data)
    bit = int(generator.integers(8 * len(data)))
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)
