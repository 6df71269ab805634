"""Port of dynamixel-sdk, with corrections of faults in version 4.1.

Its packet handler is not used: it does not stuff sent bytes, and unstuffs by bytes that it has
already moved. `packets` does both correctly.

| fault of dynamixel-sdk 4.1 | here |
|---|---|
| every reply may take 34 ms before it counts as missing | `ServoBus.reply_timeout_s` |
| waiting for a reply is a busy loop | `Port` blocks in the read |
| each reply is read in two pieces | `Port.readPort` reads all available bytes |
| an unplugged port raises one of three errors | `bus_gone` makes one error of them |
| two programs can open one port and speak at the same time | `Port` locks it, see `port_lock` |
"""

import os
import termios
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from elastic_env.core.errors import missing_extra
from elastic_env.hardware.buses import packets
from elastic_env.hardware.buses.port_lock import cannot_open, lock_port
from elastic_env.hardware.clock import Clock
from elastic_env.hardware.errors import BusGoneError, PortError

try:
    import serial
    from dynamixel_sdk.port_handler import PortHandler
except ModuleNotFoundError as error:
    # raised only when a port is opened: settings and help need no extra
    _MISSING = missing_extra(str(error.name), "hardware", "a bus of servos")
    serial: Any = SimpleNamespace(SerialException=OSError)
    PortHandler: Any = object
else:
    _MISSING = None

_READ_SLICE_S = 1e-3
"""Longest wait of a read for its first byte [s]."""


@contextmanager
def bus_gone(port: str) -> Iterator[None]:
    """Turn the errors of a vanished port into one.

    Raises:
        BusGoneError: The port failed in the block.
    """
    try:
        yield
    except (serial.SerialException, OSError, termios.error) as error:
        raise BusGoneError(
            f"the bus at {port} is gone ({_reason(error)}): unplugged, or its adapter "
            "failed. Its servos may be under torque: at their last goal, or where a "
            "bus watchdog has stopped them. Switch their power off"
        ) from None


class Port(PortHandler):
    """A serial port that only one program can use at a time.

    Args:
        name: Device, such as /dev/ttyUSB0.
        baudrate: Bits per second.

    Attributes:
        clock: Clock of timeouts: that of the system, or of an emulated line.

    Raises:
        MissingExtraError: The SDK is not installed.
    """

    def __init__(self, name: str, baudrate: int) -> None:
        if _MISSING is not None:
            raise _MISSING
        super().__init__(name)
        self.baudrate = baudrate
        self.clock: Clock = time
        self._lock: int | None = None

    def open(self) -> None:
        """Open and lock the port.

        Raises:
            PortError: It does not exist, cannot be opened, or another program uses it.
        """
        name = self.port_name
        if self.getCFlagBaud(self.baudrate) < 0:
            rates = f"{self.baudrate} bit/s for {name}; try one of {packets.RATES}"
            raise PortError(f"the SDK has no rate of {rates}")
        self._lock = lock_port(name)
        try:
            rate = self.baudrate
            self.use(serial.Serial(name, rate, timeout=_READ_SLICE_S, write_timeout=0.1))
        except (OSError, termios.error) as error:  # SerialException is an OSError
            self.closePort()
            raise cannot_open(name, error.args[0], _reason(error)) from None
        except BaseException:
            self.closePort()
            raise

    def use(self, line: Any) -> None:
        """Use an open line, such as a `serial.Serial`."""
        self.ser = line
        self.is_open = True
        self.tx_time_per_byte = 1e4 / self.baudrate

    def readPort(self, length: int) -> bytes:  # noqa: N802
        """Read available bytes, at most `length`; wait a short while for the first one."""
        return self.ser.read(min(max(self.ser.in_waiting, 1), length))

    def getCurrentTime(self) -> float:  # noqa: N802
        """Time of a monotonic clock [ms]."""
        return 1e3 * self.clock.monotonic()

    def closePort(self) -> None:  # noqa: N802
        """Close the port; do nothing if it is not open."""
        lock = self._lock
        self._lock = None
        try:
            if self.ser is not None:
                with bus_gone(self.port_name):
                    self.ser.close()
        finally:
            self.is_open = False
            if lock is not None:
                os.close(lock)

    @property
    def latency_timer(self) -> Path:
        """File with the adapter's latency timer, if it has one."""
        device = Path(os.path.realpath(self.port_name)).name
        return Path("/sys/bus/usb-serial/devices") / device / "latency_timer"

    @property
    def latency_timer_ms(self) -> int | None:
        """Time that a USB adapter collects bytes before it passes them on [ms]; None if unknown."""
        try:
            return int(self.latency_timer.read_text())
        except (OSError, ValueError):
            return None


def _reason(error: Exception) -> str:
    """Text of an error; termios puts a number before it."""
    return str(error.args[1]) if len(error.args) > 1 else str(error)
