"""An emulated bus, its driver and its supervisor in one process, on a simulated clock.

They exchange the same bytes as separate processes, but without terminals and delays, and faster
than real time.
"""

import os
import time
from contextlib import AbstractContextManager
from types import SimpleNamespace
from typing import Any

import numpy as np

from elastic_env.core.signals import Array
from elastic_env.hardware import errors
from elastic_env.hardware.buses.protocols import BUSES
from elastic_env.hardware.buses.servo_models import servo_model
from elastic_env.hardware.clock import Clock
from elastic_env.hardware.emulator.launch import EmulatorConfig
from elastic_env.hardware.emulator.process import Emulator, Terminal
from elastic_env.hardware.safety.realtime import sleep_until
from elastic_env.hardware.safety.supervised_bus import Cycle
from elastic_env.hardware.safety.supervisor import Supervisor
from elastic_env.hardware.settings import SafetyLimits

_SLICE_S = 1e-3
_NAME = "the emulated bus"


class _Wire(Terminal):
    """Emulator's end of a line."""

    name = _NAME
    master = -1

    def __init__(self) -> None:
        self.sent = b""
        """Bytes to the servos that they have not read yet."""
        self.received = b""
        """Bytes from the servos that the driver has not read yet."""

    def write(self, data: bytes) -> None:
        self.received += data

    def read_bytes(self) -> bytes:
        data = self.sent
        self.sent = b""
        return data

    def has_rate(self, baudrate: int) -> bool:  # noqa: ARG002
        return True

    def close(self) -> None:
        pass


class _Line:
    """Driver's end of a line, instead of a `serial.Serial`; waiting for bytes lets time pass."""

    def __init__(self, emulator: Emulator, clock: "VirtualBus") -> None:
        self._emulator = emulator
        self._clock = clock

    @property
    def _wire(self) -> Any:
        if self._emulator.bus_terminal is None:
            raise OSError("no such device")
        return self._emulator.bus_terminal

    @property
    def in_waiting(self) -> int:
        if not self._wire.received:
            self._clock.sleep(_SLICE_S)
        return len(self._wire.received)

    def write(self, data: bytes) -> int:
        self._wire.sent += bytes(data)
        self._clock.sleep(10.0 * len(data) / self._emulator.config.rate)
        self._emulator.answer_instructions()
        return len(data)

    def read(self, length: int) -> bytes:
        data = self._wire.received[:length]
        self._wire.received = self._wire.received[length:]
        return data

    def reset_input_buffer(self) -> None:
        self._wire.received = b""

    def close(self) -> None:
        pass


class VirtualBus(AbstractContextManager["VirtualBus"]):
    """Emulated servos with the methods of a `SupervisedBus`; also their clock.

    Args:
        config: Configuration of the emulator.

    Attributes:
        now_s: Time of the clock [s].
        clock: The bus itself.
        emulator: Servos, joints and faults.
        driver: Driver with attached servos.
    """

    def __init__(self, config: EmulatorConfig) -> None:
        self.now_s = 0.0
        self.clock: Clock = self
        self._ahead_s = -np.inf
        self.emulator = Emulator(config, self, _Wire)
        protocol = servo_model(config.model_number).protocol
        self.driver = BUSES[protocol](_NAME, config.rate)
        self.driver.port.clock = self
        self.driver.port.use(_Line(self.emulator, self))
        self.driver.attach(config.ids)
        channel: Any = SimpleNamespace(send=lambda _: None)
        self._supervisor = Supervisor(channel, [self.driver], os.getpid())

    @property
    def links(self) -> Array:
        """True angles of the links, (n,) [rad]."""
        return np.array(self.emulator.state["q"])

    def monotonic(self) -> float:
        """Time of the clock [s]."""
        return self.now_s

    def sleep(self, seconds: float, /) -> None:
        """Let a time pass [s], with physics and replies."""
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            self.now_s = min(self.now_s + _SLICE_S, end_s)
            self.emulator.pass_time()
        sleep_until(self._ahead_s + self.now_s)

    def keep_pace(self) -> None:
        """Run no faster than real time from now on, because a user sends targets in real time."""
        self._ahead_s = time.monotonic() - self.now_s

    def enable(self, limits: SafetyLimits, ranges: Array) -> Array:
        """Switch torque on, see `SupervisedBus.enable`."""
        arguments = {"limits": limits.model_dump(), "ranges": ranges.tolist()}
        return np.array(self._request("enable", **arguments)["position"])

    def exchange(self, goals: Array, at: float) -> Cycle:
        """Run one control cycle, see `SupervisedBus.exchange`."""
        return Cycle.load(self._request("exchange", goals=goals.tolist(), at=at))

    def keep(self, goals: Array, limit_s: float = 5.0) -> None:
        """Do nothing: no time passes until the next cycle."""

    def stop_keeping(self) -> None:
        """Do nothing, as `keep`."""

    def close(self) -> None:
        """Switch torque off."""
        self._request("disable")

    def __exit__(self, *_: object) -> None:
        self.close()

    def _request(self, action: str, **arguments: Any) -> dict[str, Any]:
        answer = self._supervisor.answer({"do": action, "with": arguments})
        if "error" in answer:
            raise getattr(errors, answer["error"])(answer["message"])
        return answer
