"""Emulated servos on a line without terminals and without waiting: bytes in, bytes out."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from elastic_env.core.signals import Array
from elastic_env.hardware.buses.dynamixel_bus import DynamixelBus
from elastic_env.hardware.buses.feetech_bus import FeetechBus
from elastic_env.hardware.buses.servo_bus import BusGroup, ServoBus
from elastic_env.hardware.buses.servo_models import servo_model
from elastic_env.hardware.emulator.joints import ArmJoints, EmulatedArm
from elastic_env.hardware.emulator.servos import EmulatedBus, EmulatedServo
from elastic_env.hardware.errors import FaultError
from elastic_env.hardware.safety.guard import Guard
from elastic_env.hardware.safety.supervised_bus import Cycle
from elastic_env.hardware.settings import SafetyLimits


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


class VirtualArm:
    """An emulated arm on its bus, on a clock that only its bus moves: packets, limits, physics.

    Args:
        arm: The arm.
        number: Model number of its servos.
        ids: Their ids; default 1, 2, ...
    """

    is_confirmed_off = True

    def __init__(
        self, arm: EmulatedArm, number: int = 777, ids: Sequence[int] | None = None, **options: Any
    ) -> None:
        self.now_s = 0.0
        self.joints = ArmJoints(arm, 0.0)
        model = servo_model(number)
        self.servos = [
            EmulatedServo(
                servo_id, model, partial(self._note, i), motion=partial(self.joints.motion, i)
            )
            for i, servo_id in enumerate(ids or range(1, len(arm.order) + 1))
        ]
        self.bus = looped(self.servos, **options)
        self.group = BusGroup([self.bus])
        self.goals: list[Array] = []
        self._guard: Guard | None = None

    @property
    def clock(self) -> "VirtualArm":
        return self

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, duration_s: float) -> None:
        self.advance(duration_s)

    def advance(self, duration_s: float) -> None:
        """Let time pass."""
        self.now_s += duration_s
        self.joints.advance(self.now_s + 1e-9)

    def enable(self, limits: SafetyLimits | None = None, ranges: Array | None = None) -> Array:
        stands = np.array([self.bus.read_position(i) for i in self.bus.ids])
        strongest = [model.largest_torque for model in self.bus.models.values()]
        allowed = limits or SafetyLimits()
        self._guard = Guard(allowed, stands, self.group.names, np.inf, strongest, ranges)
        for servo_id, angle in zip(self.bus.ids, stands.tolist(), strict=True):
            self.bus.write_goal(servo_id, angle)
            self.bus.write_torque(servo_id, True)
        return stands

    def exchange(self, goals: Array, at: float) -> Cycle:
        assert self._guard is not None
        period_s = at - self.now_s
        allowed, is_limited = self._guard.command(goals, period_s)
        self.goals.append(allowed)
        is_held = self._guard.is_holding
        self.bus.write_goals(allowed)
        while self.now_s < at - 1e-9:  # the physics leaves out what is too much at a time
            self.advance(min(0.1, at - self.now_s))
        states = replace(self.bus.read_states(0.003), time_s=self.now_s)
        if reason := self._guard.check(states):
            raise FaultError(reason)
        return Cycle(states, allowed, is_limited, is_held, late_s=0.0)

    def keep(self, goals: Array, limit_s: float = 5.0) -> None:
        pass

    def stop_keeping(self) -> None:
        pass

    def disable(self) -> None:
        self.bus.torque_off()

    close = disable

    def _note(self, index: int, servo_id: int, name: str, value: int) -> None:
        servo = self.servos[index]
        if name in ("torque_enable", servo.model.effort_register):
            self.joints.set_torque(index, servo.effort if servo.is_on else 0.0)
        if servo.is_on:
            self.joints.command(index, servo.goal)
