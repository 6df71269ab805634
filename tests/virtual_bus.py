"""An emulated bus with its faults, its driver and its supervisor in one process, on a clock that
only the bus moves: as from process to process, but without terminals, and never too busy."""

import os
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from elastic_env.core.signals import Array
from elastic_env.hardware import errors
from elastic_env.hardware.buses import servo_bus
from elastic_env.hardware.buses.bus import States
from elastic_env.hardware.buses.feetech_bus import FeetechBus
from elastic_env.hardware.emulator import process
from elastic_env.hardware.emulator.launch import EmulatorConfig
from elastic_env.hardware.live import arm
from elastic_env.hardware.safety import realtime, supervisor
from elastic_env.hardware.safety.supervised_bus import Cycle
from elastic_env.hardware.settings import SafetyLimits

_SLICE_S = 1e-3
_BYTES_MS = 0.01
"""Time of a byte on the wire, at 1 Mbit/s [ms]."""


class Wire:
    """Stands for the emulator's pseudo-terminal, and holds what the other end has not read."""

    name = "wire"
    master = 0

    def __init__(self) -> None:
        self.sent = b""
        self.shown = b""

    def write(self, data: bytes) -> None:
        self.shown += data

    def read_bytes(self) -> bytes:
        data = self.sent
        self.sent = b""
        return data

    def has_rate(self, _: int) -> bool:
        return True

    def close(self) -> None:
        pass


class VirtualLine:
    """Stands for the SDK's port: whoever waits for bytes lets the time pass."""

    baudrate = 1_000_000
    tx_time_per_byte = _BYTES_MS
    is_using = False

    def __init__(self, emulator: process.Emulator, clock: "VirtualBus") -> None:
        self._emulator = emulator
        self._clock = clock
        self._begin_s = 0.0
        self._longest_s = 0.0

    @property
    def _wire(self) -> Any:
        if self._emulator.bus_terminal is None:
            raise OSError("no such device")
        return self._emulator.bus_terminal

    def writePort(self, wire: bytes) -> int:  # noqa: N802
        terminal = self._wire
        terminal.sent += bytes(wire)
        self._clock.sleep(1e-3 * _BYTES_MS * len(wire))
        self._emulator._hear(terminal)
        return len(wire)

    def readPort(self, length: int) -> bytes:  # noqa: N802
        if not self._wire.shown:
            self._clock.sleep(_SLICE_S)
        data = self._wire.shown[:length]
        self._wire.shown = self._wire.shown[length:]
        return data

    def clearPort(self) -> None:  # noqa: N802
        self._wire.shown = b""

    def setPacketTimeoutMillis(self, longest_ms: float) -> None:  # noqa: N802
        self._begin_s = self._clock.now_s
        self._longest_s = 1e-3 * longest_ms

    def getTimeSinceStart(self) -> float:  # noqa: N802
        return 1e3 * (self._clock.now_s - self._begin_s)

    def isPacketTimeout(self) -> bool:  # noqa: N802
        return self._clock.now_s - self._begin_s > self._longest_s

    def release(self) -> None:
        pass

    def closePort(self) -> None:  # noqa: N802
        pass


class VirtualBus:
    """What a `SupervisedBus` of Feetech servos offers, and the emulator behind it.

    Args:
        config: What is emulated.
        patch: Lets the clock of all be this one.

    Attributes:
        emulator: Servos, joints and faults.
        seen: When each cycle was read, and what came.
    """

    is_confirmed_off = False

    def __init__(self, config: EmulatorConfig, patch: pytest.MonkeyPatch) -> None:
        self.now_s = 0.0
        self.seen: list[tuple[float, States]] = []
        self._emulator: process.Emulator | None = None
        for module in (process, servo_bus, realtime, supervisor, arm):
            patch.setattr(module, "time", self)
        patch.setattr(process, "Terminal", Wire)
        self.emulator = self._emulator = process.Emulator(config)
        self.bus = FeetechBus("wire")
        self.bus.port = VirtualLine(self.emulator, self)  # type: ignore[assignment]
        self.bus.attach(config.ids)
        silent: Any = SimpleNamespace(send=lambda _: None)
        self._supervisor = supervisor.Supervisor(silent, [self.bus], os.getpid())

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, duration_s: float) -> None:
        """Let time pass: physics and replies."""
        end_s = self.now_s + duration_s
        while self.now_s < end_s:
            self.now_s = min(self.now_s + _SLICE_S, end_s)
            if self._emulator is not None:
                self._emulator._joints.advance(self.now_s)
                self._emulator._send_due(self.now_s)

    def enable(self, limits: SafetyLimits | None = None, ranges: Array | None = None) -> Array:
        ends = None if ranges is None else ranges.tolist()
        allowed = (limits or SafetyLimits()).model_dump()
        return np.array(self._ask("enable", limits=allowed, ranges=ends)["position"])

    def exchange(self, goals: Array, at: float) -> Cycle:
        answer = self._ask("exchange", goals=goals.tolist(), at=at)
        states = States.load(answer)
        self.seen.append((at + answer["late_s"], states))
        allowed, is_limited = (np.array(answer[name]) for name in ("goals", "is_limited"))
        return Cycle(states, allowed, is_limited, answer["is_held"], answer["late_s"])

    def keep(self, goals: Array, limit_s: float = 5.0) -> None:
        pass

    def stop_keeping(self) -> None:
        pass

    def close(self) -> None:
        """As when the supervisor's program is gone."""
        self._supervisor._lower()
        self._supervisor._torque_off()

    def _ask(self, action: str, **arguments: Any) -> dict[str, Any]:
        answer = self._supervisor._answer({"do": action, "with": arguments})
        if "error" in answer:
            raise getattr(errors, answer["error"])(answer["message"])
        return answer
