"""Process of the emulator: pseudo-terminals in real time, a channel for faults and events."""

import contextlib
import fcntl
import json
import math
import os
import pty
import select
import sys
import termios
import time
import tty
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from elastic_env.core.errors import ConfigurationError
from elastic_env.hardware.buses import packets
from elastic_env.hardware.buses.servo_models import servo_model
from elastic_env.hardware.clock import Clock
from elastic_env.hardware.emulator.imu import EmulatedImu
from elastic_env.hardware.emulator.joints import ArmJoints, Joints, ServoJoints
from elastic_env.hardware.emulator.launch import EmulatorConfig, damage
from elastic_env.hardware.emulator.servos import EmulatedBus, EmulatedServo
from elastic_env.hardware.safety.realtime import Priority, prefer_realtime

_PHYSICS_S = 2e-3  # usual time between two advances of the joints
_LONGEST_PHYSICS_S = 5e-3  # longest time, while replies go out
_PACKET_BYTES = 62  # a USB adapter passes on so many bytes at once
_PACKET_S = 1e-3  # or the bytes that it has after this time
_SETTLE_S = 3e-4  # after a write, for the kernel to pass it on at its lower priority
_WAIT_S = 0.1
_KEPT_EVENTS = 100_000
_UNREAD_BYTES = 2000
_COLLISION_MASK = 0x11  # bits that remain where two servos reply at once
_OUTPUT_SPEED = 5  # in what tcgetattr returns


class Terminal:
    """A pseudo-terminal that passes bytes through unchanged.

    Programs open its name like a serial port.
    """

    def __init__(self) -> None:
        self.master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self.master, False)
        self.name = os.ttyname(self._slave)

    def write(self, data: bytes) -> None:
        """Send bytes; those that no program reads are lost, as on a real line."""
        unread = fcntl.ioctl(self._slave, termios.FIONREAD, bytes(4))
        if int.from_bytes(unread, sys.byteorder) > _UNREAD_BYTES:
            termios.tcflush(self._slave, termios.TCIFLUSH)
        with contextlib.suppress(OSError):
            os.write(self.master, data)

    def read_bytes(self) -> bytes:
        """Read received bytes."""
        with contextlib.suppress(OSError):
            return os.read(self.master, 4096)
        return b""

    def has_rate(self, baudrate: int) -> bool:
        """Return True if the program at the other end has set this baud rate."""
        speed = termios.tcgetattr(self._slave)[_OUTPUT_SPEED]
        return speed == getattr(termios, f"B{baudrate}")

    def close(self) -> None:
        """Remove the terminal, as if its adapter were unplugged."""
        os.close(self.master)
        os.close(self._slave)


class Emulator:
    """Servos, joints and IMU behind two pseudo-terminals.

    Args:
        config: Configuration of the emulator.
        clock: Its clock; default the system's.
        terminals: Makes the terminals for programs.

    Attributes:
        events: Changes of torque, goal and watchdog, and requests of positions: time [s], id,
            register and value [count].
    """

    def __init__(
        self,
        config: EmulatorConfig,
        clock: Clock = time,
        terminals: Callable[[], Terminal] = Terminal,
    ) -> None:
        now = clock.monotonic()
        self._clock = clock
        self._terminals = terminals
        model = servo_model(config.model_number)
        self.config = config
        self.faults = config.faults
        self.events: deque[tuple[float, int, str, int]] = deque(maxlen=_KEPT_EVENTS)
        self.bus_terminal: Terminal | None = terminals()
        self.imu_terminal = terminals()
        # separate streams: the same requests meet the same faults, whatever their timing
        self._reply_faults = np.random.default_rng([config.seed, 0])
        self._instruction_faults = np.random.default_rng([config.seed, 2])
        arm = config.arm
        self._joints: ServoJoints = (
            ArmJoints(arm, now) if arm else Joints(config.testbed, len(config.ids), now)
        )
        self._servos: list[EmulatedServo] = []
        for index, servo_id in enumerate(config.ids):
            motion = partial(self._joints.motion, index)
            notify = partial(self._apply_change, index)
            servo = EmulatedServo(servo_id, model, notify, motion, config.registers)
            self._servos.append(servo)
        self._bus = EmulatedBus(self._servos)
        self._imu = EmulatedImu(config, now)
        self._parser = self._bus.wire.parser()
        self._replies: deque[tuple[float, bytes]] = deque()
        self._settled_s = now

    def step(self, wait_s: float, control: int) -> bool:
        """Wait for an event on bus or channel, or for a time [s], and process it.

        Returns:
            True if a message waits in the control channel.
        """
        sources = [control]
        if self.bus_terminal is not None:
            sources.append(self.bus_terminal.master)
        ready, _, _ = select.select(sources, [], [], self._idle_s(wait_s))
        now = self._clock.monotonic()
        self._send_due(now)  # replies first
        is_idle = not self._replies and now >= self._settled_s
        for servo in self._servos:
            servo.watch(now)
        has_instruction = any(source != control for source in ready)
        if has_instruction:
            now = self.answer_instructions()
        # after the answers, which are urgent
        if has_instruction or is_idle or self._joints.lag(now) > _LONGEST_PHYSICS_S:
            self._joints.advance(now)
        self._send_due(self._clock.monotonic())
        self._imu.measure(self._joints.q[0], now, self.faults)
        attitudes = self._imu.pop_due(now)
        if attitudes:
            self.imu_terminal.write(attitudes)
        return control in ready

    def pass_time(self) -> None:
        """Simulate the joints and send replies up to the present time."""
        now = self._clock.monotonic()
        self._joints.advance(now)
        self._send_due(now)

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
            self.bus_terminal = self._terminals()
            self._parser = self._bus.wire.parser()
            self._replies.clear()

    @property
    def ports(self) -> dict[str, str | None]:
        """Names of the ports of servos and IMU."""
        bus = None if self.bus_terminal is None else self.bus_terminal.name
        return {"port": bus, "imu_port": self.imu_terminal.name}

    @property
    def state(self) -> dict[str, Any]:
        """True state of joints and servos."""
        return {
            "time_s": self._clock.monotonic(),
            "theta": self._joints.theta.tolist(),
            "q": self._joints.q.tolist(),
            "torque_on": [servo.is_on for servo in self._servos],
            "skipped_s": self._joints.skipped_s,
        }

    def _idle_s(self, wait_s: float) -> float:
        """Time until the next task [s], at most `wait_s`."""
        now = self._clock.monotonic()
        physics_s = self._settled_s if self._settled_s > now else now + _PHYSICS_S
        at = min(now + wait_s, physics_s, self._imu.next_s, self._next_packet_s())
        return max(at - now, 0.0)

    def _next_packet_s(self) -> float:
        """Time at which the adapter has enough bytes to pass on, or has waited long enough [s]."""
        at = math.inf
        length = 0
        for due, reply in self._replies:
            if due > self._replies[0][0] + _PACKET_S:
                break
            at = due
            length += len(reply)
            if length >= _PACKET_BYTES:
                break
        return at

    def _apply_change(self, index: int, servo_id: int, name: str, value: int) -> None:
        """Record a change of a servo's register, and apply it to the joint."""
        self.events.append((self._clock.monotonic(), servo_id, name, value))
        servo = self._servos[index]
        if name in ("torque_enable", servo.model.effort_register):
            self._joints.set_torque(index, servo.effort if servo.is_on else 0.0)
        if name == "torque_enable":
            self._joints.command(index, servo.goal)
        if name == "goal_position" and servo.is_on:
            self._joints.command(index, servo.goal)

    def answer_instructions(self) -> float:
        """Answer the received instructions; return the time at which they were read [s]."""
        terminal = self.bus_terminal
        data = b"" if terminal is None else terminal.read_bytes()
        now = self._clock.monotonic()
        if terminal is None or not terminal.has_rate(self.config.rate):
            return now  # noise
        for packet in self._parser.parse(data):
            if self._instruction_faults.random() < self.faults.unheard:
                continue
            for reply in self._bus.answer(packet, now):
                self._queue(self._collide(reply), now)
            if packet.instruction == packets.SYNC_READ:
                name = "present_position"
                for servo in self._servos:
                    self.events.append((now, servo.servo_id, name, servo[name]))
        return now

    def _collide(self, reply: bytes) -> bytes:
        """Mix a reply with that of a second servo, if two have the first id; low bits win."""
        at = {"dynamixel": 4, "feetech": 2}[self._servos[0].model.protocol]
        if not self.faults.same_id or reply[at] != self._servos[0].servo_id:
            return reply
        return reply[:-4] + bytes(byte & _COLLISION_MASK for byte in reply[-4:])

    def _queue(self, reply: bytes, now: float) -> None:
        """Apply faults to a reply, and queue it until it is due."""
        data, delay_s = damage(self.faults, reply, self._reply_faults)
        wire_s = 10.0 * len(reply) / self.config.rate
        begin_s = max(now + delay_s, self._replies[-1][0] if self._replies else now)
        if data:
            self._replies.append((begin_s + wire_s, data))

    def _send_due(self, now: float) -> None:
        """Send the replies that are due."""
        due = b""
        while self._replies and self._replies[0][0] <= now:
            due += self._replies.popleft()[1]
        if due and self.bus_terminal is not None:
            self.bus_terminal.write(due)
            self._settled_s = self._clock.monotonic() + _SETTLE_S


def serve(config: EmulatorConfig) -> None:
    """Emulate until the input ends.

    Requests and answers are JSON objects, one per line.
    """
    emulator = Emulator(config)
    prefer_realtime(Priority.EMULATOR)
    control = sys.stdin.fileno()
    answer: Any = emulator.ports
    pending = b""
    while True:
        print(json.dumps(answer), flush=True)
        while b"\n" not in pending:
            if emulator.step(_WAIT_S, control):
                data = os.read(control, 65536)
                if not data:
                    return
                pending += data
        line, _, pending = pending.partition(b"\n")
        answer = _answer(emulator, json.loads(line))


def _answer(emulator: Emulator, request: dict[str, Any]) -> Any:
    """Execute a request and return its answer."""
    if "faults" in request:
        emulator.set_faults(request["faults"])
        return emulator.ports
    if "events" in request:
        events = list(emulator.events)
        emulator.events.clear()
        return events
    return emulator.state


if __name__ == "__main__":
    try:
        serve(EmulatorConfig.model_validate_json(sys.argv[1]))
    except ConfigurationError as error:
        print(json.dumps({"error": str(error)}), flush=True)
