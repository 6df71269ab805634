"""The emulator's own process: pseudo-terminals in real time, and a line-based channel for faults and events."""

import contextlib
import fcntl
import json
import math
import os
import pty
import select
import struct
import sys
import termios
import time
import tty
from collections import deque
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from elastic_env.hardware.emulator.config import EmulatorConfig
from elastic_env.hardware.emulator.faults import Angles, damage, distort, flip_bit
from elastic_env.hardware.emulator.joints import Joints
from elastic_env.hardware.emulator.mip import attitude_packet
from elastic_env.hardware.emulator.servo import EmulatedServo
from elastic_env.hardware.emulator.wire import EmulatedBus
from elastic_env.hardware.safety.realtime import Priority, prefer_realtime
from elastic_env.hardware.servo_bus import protocol
from elastic_env.hardware.servo_bus.control_table import servo_model
from elastic_env.runtime.sensors import attitude

_PHYSICS_S, _LONGEST_PHYSICS_S = 2e-3, 5e-3  # between two advances: as a rule, and while replies go out
_PACKET_BYTES, _PACKET_S = 62, 1e-3  # a USB adapter passes on as many bytes at once, or what it has after that time
_SETTLE_S = 3e-4  # after a write, for the kernel to pass it on, which it does at a lower priority than ours
_UNREAD_BYTES = 2000
_KEPT_EVENTS = 100_000
_WOBBLE_RAD = 1e-5
_OUTPUT_SPEED = 5  # in what tcgetattr returns


@dataclass
class Terminal:
    """A pseudo-terminal; programs open its name as they would a serial port."""

    master: int
    slave: int
    name: str

    @staticmethod
    def opened() -> "Terminal":
        """A new one, which passes bytes through as they are."""
        master, slave = pty.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        return Terminal(master, slave, os.ttyname(slave))

    def write(self, data: bytes) -> None:
        """Pass bytes on; they are lost where nobody has read what is there, as on a line to nobody."""
        unread = struct.unpack("i", fcntl.ioctl(self.slave, termios.FIONREAD, b"\0\0\0\0"))[0]
        if unread > _UNREAD_BYTES:
            termios.tcflush(self.slave, termios.TCIFLUSH)
        with contextlib.suppress(OSError):
            os.write(self.master, data)

    def read(self) -> bytes:
        """What has come."""
        with contextlib.suppress(OSError):
            return os.read(self.master, 4096)
        return b""

    def speaks(self, baudrate: int) -> bool:
        """Whether the program at the other end has set a baud rate; one that the system has no name for passes."""
        return termios.tcgetattr(self.slave)[_OUTPUT_SPEED] == getattr(termios, f"B{baudrate}")

    def close(self) -> None:
        """Take it away, as an unplugged adapter is."""
        os.close(self.master)
        os.close(self.slave)


@dataclass
class Emulator:
    """Servos, joints and IMU behind two pseudo-terminals.

    Attributes:
        config: What is emulated.
    """

    config: EmulatorConfig
    events: deque[tuple[float, int, str, int]] = field(default_factory=lambda: deque(maxlen=_KEPT_EVENTS))
    """When, at which servo, which register became what: torque, goal and watchdog; and which position was asked for."""

    def __post_init__(self) -> None:
        config, model = self.config, servo_model(self.config.model_number)
        self.bus_terminal: Terminal | None = Terminal.opened()
        self.imu_terminal = Terminal.opened()
        self.faults = config.faults
        # of replies, IMU and instructions: who asks for replies gets the same faults, whatever the time
        self._line, self._imu, self._way, self._wobble = (
            np.random.default_rng([config.seed, stream]) for stream in range(4)
        )
        self._joints = Joints(config.testbed, len(config.ids), time.monotonic())
        self._servos = [
            EmulatedServo(servo_id, model, partial(self._note, index), config.claimed_model_number, motor)
            for index, (servo_id, motor) in enumerate(zip(config.ids, self._joints.motors, strict=True))
        ]
        self._with_watchdog = self._servos if model.has_watchdog else []
        self._bus = EmulatedBus(self._servos)
        self._parser = protocol.Parser()
        self._replies: deque[tuple[float, bytes]] = deque()
        self._attitudes: deque[tuple[float, bytes]] = deque()
        self._angles: Angles = (0.0, 0.0, 0.0)
        self._next_imu_s = self._start_s = self._settled_s = time.monotonic()

    def step(self, wait_s: float, control: int | None = None) -> bool:
        """Wait for something to happen, and let it; whether the control channel has something to say."""
        sources = [self.bus_terminal.master] if self.bus_terminal is not None else []
        ready, _, _ = select.select([*sources, *([] if control is None else [control])], [], [], self._idle(wait_s))
        now = time.monotonic()
        self._send_due(now)  # replies wait for nothing
        has_heard = self.bus_terminal is not None and self.bus_terminal.master in ready
        is_idle = not self._replies and now >= self._settled_s
        for servo in self._with_watchdog:
            servo.watch(now)
        if self.bus_terminal is not None and has_heard:
            heard = self.bus_terminal.read()
            now = time.monotonic()  # it may hold what came since the moment before
            if not self.bus_terminal.speaks(self.config.baudrate):
                heard = b""  # noise
            for packet in self._parser.feed(heard):
                if self._way.random() < self.faults.unheard:
                    continue
                self._queue(self._bus.answer(packet, now), now)
                if packet.instruction == protocol.SYNC_READ:
                    for servo in self._servos:
                        self.events.append((now, servo.servo_id, "present_position", servo.present_position))
        if has_heard or is_idle or self._joints.lag(now) > _LONGEST_PHYSICS_S:  # after the answers, which are urgent
            self._joints.advance(now)
        self._send_due(time.monotonic())
        self._measure_attitude(now)
        while self._attitudes and self._attitudes[0][0] <= now:
            self.imu_terminal.write(self._attitudes.popleft()[1])
        return control in ready

    def set_faults(self, changes: dict[str, Any]) -> None:
        """Switch faults on and off."""
        self.faults = self.faults.replace(**changes)
        for servo in self._servos:
            servo.overload(self.faults.overload)
            servo.heat(self.faults.hot)
        if self.faults.unplugged and self.bus_terminal is not None:
            self.bus_terminal.close()
            self.bus_terminal = None
        elif not self.faults.unplugged and self.bus_terminal is None:
            self.bus_terminal = Terminal.opened()
            self._parser = protocol.Parser()
            self._replies.clear()

    @property
    def ports(self) -> dict[str, str | None]:
        """Names of the servos' port and of the IMU's."""
        bus = None if self.bus_terminal is None else self.bus_terminal.name
        return {"port": bus, "imu_port": self.imu_terminal.name}

    @property
    def state(self) -> dict[str, Any]:
        """Truth about joints and servos."""
        return {
            "time_s": time.monotonic(),
            "theta": self._joints.theta.tolist(),
            "q": self._joints.q.tolist(),
            "torque_on": [servo.is_on for servo in self._servos],
            "skipped_s": self._joints.skipped_s,
        }

    def _idle(self, wait_s: float) -> float:
        now = time.monotonic()
        physics_s = self._settled_s if self._settled_s > now else now + _PHYSICS_S
        attitude_s = self._attitudes[0][0] if self._attitudes else math.inf
        return max(min(now + wait_s, physics_s, self._next_imu_s, attitude_s, self._next_packet_s()) - now, 0.0)

    def _next_packet_s(self) -> float:
        """When the adapter has enough replies to pass on, or has waited long enough."""
        at, length = math.inf, 0
        for due, reply in self._replies:
            if due > self._replies[0][0] + _PACKET_S:
                break
            at, length = due, length + len(reply)
            if length >= _PACKET_BYTES:
                break
        return at

    def _note(self, index: int, servo_id: int, name: str, value: int) -> None:
        self.events.append((time.monotonic(), servo_id, name, value))
        servo = self._servos[index]
        if name == "torque_enable":
            self._joints.set_torque(index, bool(value))
            self._joints.command(index, servo.goal)
        if name == "goal_position" and servo.is_on:
            self._joints.command(index, servo.goal)

    def _queue(self, replies: list[bytes], now: float) -> None:
        for reply in replies:
            sent, delay = damage(self.faults, reply, self._line)
            wire_s = 10.0 * len(reply) / self.config.baudrate
            begin = max(now + delay, self._replies[-1][0] if self._replies else now)
            if sent:
                self._replies.append((begin + wire_s, sent))

    def _send_due(self, now: float) -> None:
        due = b""
        while self._replies and self._replies[0][0] <= now:
            due += self._replies.popleft()[1]
        if due and self.bus_terminal is not None:
            self.bus_terminal.write(due)
            self._settled_s = time.monotonic() + _SETTLE_S

    def _measure_attitude(self, now: float) -> None:
        if now < self._next_imu_s:
            return
        period = 1.0 / self.config.imu_rate_hz
        self._next_imu_s = max(self._next_imu_s + period, now)
        if self.faults.imu_silent:
            return
        noise = self._imu.standard_normal(1)
        roll = attitude(self.config.testbed.scenario.imu, self._joints.q[:1], np.zeros(1), noise)
        # a real IMU should never send the same three angles twice; the roll is as good as the scenario says
        pitch, yaw = _WOBBLE_RAD * self._wobble.standard_normal(2)
        measured = math.remainder(float(roll[0]), 2.0 * math.pi), float(pitch), float(yaw)
        self._angles = distort(self.faults, measured, self._angles)
        sent = attitude_packet(*self._angles, now - self._start_s)
        if self._imu.random() < self.faults.imu_corrupted:
            sent = flip_bit(sent, self._imu)
        self._attitudes.append((now + self.faults.imu_late_s, sent))


def serve(config: EmulatorConfig) -> None:
    """Emulate until the input ends; requests come as JSON lines, one each, and so do the answers."""
    emulator = Emulator(config)
    prefer_realtime(Priority.EMULATOR)
    answer: Any = emulator.ports
    pending = b""
    while True:
        print(json.dumps(answer), flush=True)
        while b"\n" not in pending:
            if emulator.step(0.1, sys.stdin.fileno()):
                data = os.read(sys.stdin.fileno(), 65536)
                if not data:
                    return
                pending += data
        line, _, pending = pending.partition(b"\n")
        answer = _answer(emulator, json.loads(line))


def _answer(emulator: Emulator, request: dict[str, Any]) -> Any:
    if "faults" in request:
        emulator.set_faults(request["faults"])
        return emulator.ports
    if "events" in request:
        events = list(emulator.events)
        emulator.events.clear()
        return events
    return emulator.state


if __name__ == "__main__":
    serve(EmulatorConfig.model_validate_json(sys.argv[1]))
