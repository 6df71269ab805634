"""Emulated servos on a line without terminals and without waiting: bytes in, bytes out."""

import time
from collections.abc import Callable, Sequence
from typing import Any

from elastic_env.hardware.buses.dynamixel_bus import DynamixelBus
from elastic_env.hardware.buses.feetech_bus import FeetechBus
from elastic_env.hardware.buses.servo_bus import ServoBus
from elastic_env.hardware.emulator.servos import EmulatedBus, EmulatedServo


class Loop:
    """Stands for a serial port: what is written is answered at once.

    Args:
        servos: At the other end.
        change: What becomes of the bytes of each reply.
    """

    baudrate = 1_000_000
    tx_time_per_byte = 0.01
    clock = time

    def __init__(
        self, servos: Sequence[EmulatedServo], change: Callable[[bytes], bytes] = bytes
    ) -> None:
        self.bus = EmulatedBus(servos)
        self.change = change
        self.sent: list[bytes] = []
        self._parser = self.bus.wire.parser()
        self._coming = b""

    def writePort(self, wire: bytes) -> int:  # noqa: N802
        self.sent.append(bytes(wire))
        for packet in self._parser.parse(bytes(wire)):
            self._coming += b"".join(map(self.change, self.bus.answer(packet, 0.0)))
        return len(wire)

    def readPort(self, length: int) -> bytes:  # noqa: N802
        data = self._coming[:length]
        self._coming = self._coming[length:]
        return data

    def getBytesAvailable(self) -> int:  # noqa: N802
        return len(self._coming)

    def clearPort(self) -> None:  # noqa: N802
        self._coming = b""

    def isPacketTimeout(self) -> bool:  # noqa: N802
        return not self._coming

    def getTimeSinceStart(self) -> float:  # noqa: N802
        return 0.0 if self._coming else 1e9

    def setPacketTimeoutMillis(self, _: float) -> None:  # noqa: N802
        pass

    latency_timer_ms = 1
    latency_timer = "latency_timer"

    def closePort(self) -> None:  # noqa: N802
        pass

    def open(self) -> None:
        pass


def looped(servos: Sequence[EmulatedServo], **options: Any) -> ServoBus:
    """The driver of emulated servos, attached to them."""
    kinds = {"dynamixel": DynamixelBus, "feetech": FeetechBus}  # BUSES may be patched
    bus = kinds[servos[0].model.protocol]("loop")
    bus.port = Loop(servos, **options)  # type: ignore[assignment]
    bus._wait_for_silence = lambda: None  # type: ignore[method-assign]
    bus.attach([servo.servo_id for servo in servos])
    return bus
