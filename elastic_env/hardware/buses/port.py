"""Port and packet handler of dynamixel-sdk, with the faults of version 4.1 mended.

| trap of dynamixel-sdk 4.1 | here |
|---|---|
| outgoing packets are not byte-stuffed | `PacketHandler.txPacket` stuffs them |
| unstuffing looks at bytes that it has already moved | `PacketHandler.removeStuffing` |
| every reply may take 34 ms before it counts as missing | `ServoBus.reply_timeout_s` |
| waiting for a reply is a busy loop | `Port` blocks in the read |
| each reply is read in two pieces | `Port.readPort` reads all that is there |
| an interrupted read leaves the port "in use", and torque off is refused | `Port.release` |
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
from typing import Any, Literal

from elastic_env.core.errors import missing_extra
from elastic_env.hardware.buses import packets
from elastic_env.hardware.buses.port_lock import cannot_open, lock_port
from elastic_env.hardware.clock import Clock
from elastic_env.hardware.errors import BusGoneError, PortError

try:
    import dynamixel_sdk as sdk
    import serial
    from dynamixel_sdk.port_handler import PortHandler
    from dynamixel_sdk.protocol2_packet_handler import Protocol2PacketHandler
except ModuleNotFoundError as error:
    # said where a port is opened: settings and help come without the extra
    _MISSING = missing_extra(str(error.name), "hardware", "a bus of servos")
    _absent: Any = SimpleNamespace(SerialException=OSError)
    sdk = serial = _absent
    PortHandler: Any = object
    Protocol2PacketHandler: Any = object
else:
    _MISSING = None

DEFAULT_BAUDRATE = 3_000_000
"""Bits per second: the fastest that servos, adapter and SDK share without an odd rate."""

_READ_SLICE_S = 1e-3


@contextmanager
def bus_gone(port: str) -> Iterator[None]:
    """Turn what a vanished port raises into one error.

    Raises:
        BusGoneError: The port failed within.
    """
    try:
        yield
    except (serial.SerialException, OSError, termios.error) as error:
        raise BusGoneError(
            f"the bus at {port} is gone ({_reason(error)}): unplugged, or its adapter failed. Its "
            "servos may be under torque: at their last goal, or where a bus watchdog has stopped "
            "them. Switch their power off"
        ) from None


class Port(PortHandler):
    """A serial port for one program alone.

    Args:
        name: Device, such as /dev/ttyUSB0.
        baudrate: Bits per second.

    Attributes:
        clock: By which timeouts go; the system's, or that of an emulated line.

    Raises:
        MissingExtraError: The SDK is not installed.
    """

    def __init__(self, name: str, baudrate: int = DEFAULT_BAUDRATE) -> None:
        if _MISSING is not None:
            raise _MISSING
        super().__init__(name)
        self.baudrate = baudrate
        self.clock: Clock = time
        self._read_ahead = b""
        self._lock: int | None = None

    def open(self) -> None:
        """Open and lock the port.

        Raises:
            PortError: It does not exist, may not be opened, or another program has it.
        """
        name = self.port_name
        if self.getCFlagBaud(self.baudrate) < 0:
            rates = f"{self.baudrate} bit/s for {name}; try one of {packets.RATES}"
            raise PortError(f"the SDK has no rate of {rates}")
        self._lock = lock_port(name)
        try:
            self.setupPort(self.baudrate)
        except (OSError, termios.error) as error:  # of which SerialException is one
            self.closePort()
            raise cannot_open(name, error.args[0], _reason(error)) from None
        except BaseException:
            self.closePort()
            raise

    def setupPort(self, cflag_baud: int) -> Literal[True]:  # noqa: ARG002, N802  the SDK's name
        """Open the device such that a read blocks for a short while instead of not at all."""
        name = self.port_name
        rate = self.baudrate
        self.use(serial.Serial(name, rate, timeout=_READ_SLICE_S, write_timeout=0.1))
        return True

    def use(self, line: Any) -> None:
        """Speak over a line that is open, as `serial.Serial` is."""
        self.ser = line
        self.is_open = True
        self.tx_time_per_byte = 1e4 / self.baudrate

    def readPort(self, length: int) -> bytes:  # noqa: N802
        """Bytes that have come, at most so many; waits a short while for the first one."""
        if len(self._read_ahead) < length:
            self._read_ahead += self.ser.read(max(self.ser.in_waiting, 1))
        data = self._read_ahead[:length]
        self._read_ahead = self._read_ahead[length:]
        return data

    def clearPort(self) -> None:  # noqa: N802
        """Forget what has come."""
        self._read_ahead = b""
        super().clearPort()

    def getCurrentTime(self) -> float:  # noqa: N802
        """Milliseconds of a clock that nobody sets."""
        return 1e3 * self.clock.monotonic()

    def release(self) -> None:
        """Make the port usable again after an interrupted read."""
        self.is_using = False

    def closePort(self) -> None:  # noqa: N802
        """Close; a second time, or without having been open, does nothing."""
        lock = self._lock
        self._lock = None
        self._read_ahead = b""
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
        """The file that holds the adapter's latency timer, if it has one."""
        device = Path(os.path.realpath(self.port_name)).name
        return Path("/sys/bus/usb-serial/devices") / device / "latency_timer"

    @property
    def latency_timer_ms(self) -> int | None:
        """How long a USB adapter collects bytes before it passes them on [ms].

        None where nobody says.
        """
        try:
            return int(self.latency_timer.read_text())
        except (OSError, ValueError):
            return None


class PacketHandler(Protocol2PacketHandler):
    """The SDK's packet handler with byte stuffing in both directions."""

    def txPacket(self, port: Any, txpacket: list[int]) -> Any:  # noqa: N802  the SDK's name
        """Send an instruction that the SDK has laid out."""
        if port.is_using:
            return sdk.COMM_PORT_BUSY
        length = txpacket[5] | txpacket[6] << 8
        wire = packets.packet(txpacket[4], txpacket[7], bytes(txpacket[8 : 5 + length]))
        if len(wire) > packets.LONGEST_PACKET:
            return sdk.COMM_TX_ERROR
        port.is_using = True
        port.clearPort()
        if port.writePort(wire) != len(wire):
            port.is_using = False
            return sdk.COMM_TX_FAIL
        return sdk.COMM_SUCCESS

    def removeStuffing(self, packet: list[int]) -> list[int]:  # noqa: N802
        """A received packet without its stuffing; its length field fits again."""
        body = packets.unstuff(bytes(packet[7:-2]))
        length = len(body) + 2
        return [*packet[:5], length & 0xFF, length >> 8, *body, *packet[-2:]]


def _reason(error: Exception) -> str:
    """The text of an error; termios gives a number before it."""
    return str(error.args[1]) if len(error.args) > 1 else str(error)
