"""The supervisor in this process, on emulated servos without terminals: faults at the very
moment that matters."""

import itertools
import os
import re
import signal
import socket
import subprocess
import time
from collections import deque
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from elastic_env.hardware.buses import packets
from elastic_env.hardware.buses.dynamixel_bus import DynamixelBus
from elastic_env.hardware.buses.packet_line import Status
from elastic_env.hardware.buses.packets import Packet, Parser
from elastic_env.hardware.buses.servo_models import servo_model
from elastic_env.hardware.emulator.servos import EmulatedBus, EmulatedServo
from elastic_env.hardware.errors import BusGoneError, ReplyError
from elastic_env.hardware.safety import emergency_stop, supervisor
from elastic_env.hardware.safety.processes import Channel, is_ending
from elastic_env.hardware.safety.supervisor import Supervisor
from elastic_env.hardware.settings import SafetyLimits

MODEL = servo_model(54024)
ENABLE = ("enable", {"limits": SafetyLimits().model_dump()})


def exchange(*goals: float) -> tuple[str, dict[str, Any]]:
    return "exchange", {"goals": list(goals), "at": 0.0}


class Line(DynamixelBus):
    """A bus whose servos answer at once.

    Attributes:
        sent: Instructions that were sent, (id, instruction).
        events: What changed at the servos, (id, register, value).
        goals_at_torque_on: Where a servo was told to go when it got torque, less where it stood
            [rad].
        lost: Numbers of the instructions, as they are sent, that reach no servo.
        damaged: Likewise those that arrive damaged.
        silent: Ids of servos that hear but do not answer.
        gone_at: Instruction from which on the port is gone.
    """

    def __init__(
        self, name: str, *ids: int, log: list[tuple[str, int]] | None = None, number: int = 54024
    ) -> None:
        super().__init__(name)
        self.motions = dict.fromkeys(ids, (0.0, 0.0, 0.0))
        self.servos = {
            i: EmulatedServo(
                i, servo_model(number), self._note, partial(self.motions.__getitem__, i)
            )
            for i in ids
        }
        self.sent: list[tuple[int, int]] = []
        self.log = [] if log is None else log
        self.events: list[tuple[int, str, int]] = []
        self.goals_at_torque_on: list[float] = []
        self.lost: set[int] = set()
        self.damaged: set[int] = set()
        self.silent: set[int] = set()
        self.gone_at = -1
        self._line = EmulatedBus(list(self.servos.values()))
        self._is_gone = False
        self._refusals = 0
        self._coming: deque[Packet] = deque()

    def open(self) -> None:
        pass

    def _note(self, servo_id: int, name: str, value: int) -> None:
        self.events.append((servo_id, name, value))
        if (name, value) == ("torque_enable", 1):
            self.goals_at_torque_on.append(self.servos[servo_id].goal - self.motions[servo_id][0])

    def _transmit(self, servo_id: int, instruction: int, parameters: bytes) -> None:
        self._is_gone |= instruction == self.gone_at
        if self._is_gone:
            self._refusals += 1  # a lost port tells of its loss in other words the second time
            raise BusGoneError(
                f"the bus at {self.name} is gone (error {self._refusals}): switch their power off"
            )
        number = len(self.sent)
        self.sent.append((servo_id, instruction))
        self.log.append((self.name, instruction))
        self._coming.clear()
        if number not in self.lost:
            packet = Packet(servo_id, instruction, parameters, number not in self.damaged)
            wire = b"".join(self._line.answer(packet, 0.0))
            self._coming += [
                reply for reply in Parser().parse(wire) if reply.servo_id not in self.silent
            ]

    def _receive(self) -> Status | None:
        if not self._coming:
            return None
        reply = self._coming.popleft()
        error = reply.parameters[0]
        has_alert = bool(error & packets.ALERT)
        return Status(reply.servo_id, error & ~packets.ALERT, has_alert, reply.parameters[1:])

    def _wait_for_silence(self) -> None:
        pass


def attached(
    name: str, *ids: int, log: list[tuple[str, int]] | None = None, number: int = 54024
) -> Line:
    line = Line(name, *ids, log=log, number=number)
    line.attach(ids)
    line.sent.clear()
    line.log.clear()
    return line


def served(lines: list[Line], *requests: tuple[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """What a supervisor answers to requests which all have come before it begins, and then the
    program is gone."""
    own, other = Channel.pair()
    program = Channel(own)
    for number, (action, arguments) in enumerate(requests, 1):
        program.send({"number": number, "do": action, "with": arguments})
    own.shutdown(socket.SHUT_WR)
    try:
        Supervisor(Channel(other), list(lines), os.getpid()).run()
    finally:
        other.close()
    answers = iter(program.receive, None)
    try:
        return [answer for answer in answers if answer is not None and "busy" not in answer]
    finally:
        own.close()


@pytest.fixture
def handlers() -> Iterator[None]:
    """The supervisor's handlers of signals, for a test."""
    before = {number: signal.signal(number, supervisor._end) for number in supervisor._SIGNALS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", [1, 2, 3])
@pytest.mark.usefixtures("handlers")
def test_signals_in_the_last_moment_do_not_keep_torque_on(number: int) -> None:
    """Catches torque off that a signal interrupts before it is sent, or a second one that comes
    with the first."""
    pending = [signal.SIGTERM, signal.SIGHUP, signal.SIGINT][:number]

    class Interrupted(Line):
        def torque_off(self) -> None:
            if pending:
                signal.raise_signal(pending.pop(0))
            super().torque_off()

    line = Interrupted("one", 1)
    line.attach([1])
    with pytest.raises(SystemExit):
        served([line])
    assert (1, "torque_enable", 0) in line.events


def test_a_bus_that_is_lost_before_the_first_step_is_remembered() -> None:
    """Catches "torque is off" as the answer where nobody knows: the first to hear of the loss
    was the keeper."""
    line = attached("one", 1)
    line.gone_at = packets.SYNC_READ
    answers = served([line], ENABLE, exchange(0.0), exchange(0.0), ENABLE, ("disable", {}))
    assert [answer.get("error", "") for answer in answers] == ["", *["BusGoneError"] * 4]
    assert all(answer["message"].count("the bus at one is gone") == 1 for answer in answers[1:])


def test_a_lost_bus_leaves_the_others_off_and_confirmed() -> None:
    """Catches a loss that ends the attempt at the others, and a message that tells of one bus
    only."""
    lost = attached("one", 1)
    left = attached("two", 1, 2)
    lost.gone_at = packets.SYNC_READ
    _, answer = served([lost, left], ENABLE, exchange(0.0, 0.0, 0.0))
    assert answer["error"] == "BusGoneError"
    said = r"the bus at one is gone \(error \d+\): switch their power off; torque is off at two"
    assert re.fullmatch(said, answer["message"])
    assert [servo.is_on for servo in left.servos.values()] == [False, False]
    after = left.sent[left.sent.index((packets.BROADCAST, packets.SYNC_READ)) + 1 :]
    off = (packets.BROADCAST, packets.SYNC_WRITE)
    assert after[:4] == [off, off, (1, packets.READ), (2, packets.READ)]


def test_no_lost_instruction_lets_a_servo_jump() -> None:
    """Catches torque that is switched on although the goal before it never arrived: the servo
    keeps an old one."""
    for lost in itertools.count():
        line = attached("one", 1, 2)
        line.motions |= dict.fromkeys((1, 2), (0.3, 0.0, 0.0))
        line.lost = {lost}
        (answer,) = served([line], ENABLE)
        assert "error" not in answer
        assert len(line.goals_at_torque_on) == 2
        assert max(map(abs, line.goals_at_torque_on)) <= MODEL.position_unit
        if lost >= len(line.sent):
            break


def test_a_goal_that_is_refused_keeps_torque_off() -> None:
    """Catches torque that is switched on at whatever goal the servo has."""
    line = attached("one", 1)
    line.motions[1] = (0.3, 0.0, 0.0)
    line.write_register(1, "max_position_limit", 1000)
    (answer,) = served([line], ENABLE)
    assert "beyond the servo's limit" in answer["message"]
    assert (1, "torque_enable", 1) not in line.events


def test_torque_goes_on_at_rest_only() -> None:
    """Catches a pendulum that still swings after a fault and is stopped with a jerk."""
    line = attached("one", 1, 2)
    line.motions[2] = (0.0, -0.5, 0.0)
    (answer,) = served([line], ENABLE)
    assert answer["error"] == "FaultError"
    assert "servo 2 at one moves at 0.50 rad/s" in answer["message"]
    assert (1, "torque_enable", 1) not in line.events
    line.motions[2] = (0.0, 0.1, 0.0)
    (answer,) = served([line], ENABLE)
    assert "error" not in answer


def test_emergency_stop_does_not_wait_for_a_servo_that_does_not_answer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Catches a stop that asks all servos before it switches any off, or one port after the
    other."""
    log: list[tuple[str, int]] = []
    lines = {"one": attached("one", 1, 2, log=log), "two": attached("two", 3, log=log)}
    monkeypatch.setitem(emergency_stop.BUSES, "dynamixel", lambda port, _: lines[port])
    ports = {"one": [1, 2], "two": [3]}
    for line in lines.values():
        line.write_all("torque_enable", dict.fromkeys(line.ids, 1))
    log.clear()
    lines["one"].silent = {2}
    said = emergency_stop.switch_torque_off(ports, models=[[54024, 54024], [54024]])
    assert not any(servo.is_on for line in lines.values() for servo in line.servos.values())
    assert "not confirmed by servo 2 at one: switch the power off" in said
    assert "torque is off at two" in said
    assert {instruction for _, instruction in log[:4]} == {packets.SYNC_WRITE}
    assert sorted(name for name, _ in log[:4]) == ["one", "one", "two", "two"]


def test_emergency_stop_without_models_takes_those_that_answer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Catches one servo without power that keeps all others under torque."""
    line = attached("one", 1, 2)
    monkeypatch.setitem(emergency_stop.BUSES, "dynamixel", lambda *_: line)
    line.write_all("torque_enable", {1: 1, 2: 1})
    line.silent = {1}
    said = emergency_stop.switch_torque_off({"one": [1, 2]})
    assert not line.servos[2].is_on
    assert "servo 1 at one does not answer" in said
    assert said.endswith("torque of the others is off")


def test_an_instruction_that_arrives_damaged_is_sent_again() -> None:
    """Catches a bad line that is taken for a refusal, and one that is never given up."""
    line = attached("one", 1)
    line.damaged = {0, 1}
    line.write_goal(1, 0.1)
    assert line.servos[1].goal == pytest.approx(0.1, abs=MODEL.position_unit)
    assert line.num_retries == 2
    line.damaged = {3, 4, 5}
    with pytest.raises(
        ReplyError, match=r"servo 1 at one says that the instruction arrived damaged in 3 tries"
    ):
        line.write_goal(1, 0.2)


def test_an_error_number_that_nobody_knows_is_no_success() -> None:
    """Catches a refusal that passes as done because the protocol's list ends at 7."""

    class Strange(Line):
        def _receive(self) -> Status | None:
            return Status(1, 9, False, b"")

    line = Strange("one", 1)
    line.attach_known({1: 54024})
    with pytest.raises(ReplyError, match="refuses: error 9"):
        line.write_register(1, "torque_enable", 0)


def test_a_program_that_was_killed_and_still_has_its_channel_loses_torque_at_once() -> None:
    """Catches a supervisor that waits for a busy computer to close what a dead program had open."""
    line = attached("/dev/ttyA", 1)
    own, other = Channel.pair()
    Channel(own).send({"number": 1, "do": ENABLE[0], "with": ENABLE[1]})
    with subprocess.Popen(["true"]) as program:  # it has ended, and nobody has asked how
        while not is_ending(program.pid):
            time.sleep(0.001)
        Supervisor(
            Channel(other), [line], program.pid
        ).run()  # which waits for ever, as `own` is open
    own.close()
    other.close()
    assert line.events[-1] == (1, "torque_enable", 0)


STATUS = "Name:\tx\nSigPnd:\t0000000000000000\nShdPnd:\t{}\n"
STAT = "7 (a) b c) {} 1 7 7 0 -1 {} 0 0\n"


@pytest.mark.parametrize(
    ("pending", "state", "flags", "expected"),
    [
        ("0" * 16, "S", 0x400000, False),
        ("0000000000004000", "S", 0x400000, False),  # SIGTERM, which it may ignore
        ("0000000000000100", "S", 0x400000, True),
        ("0" * 16, "R", 0x400004, True),
        ("0" * 16, "D", 0x400200, True),
        ("0" * 16, "Z", 0x400000, True),
    ],
)
def test_linux_tells_that_a_program_ends(
    pending: str, state: str, flags: int, expected: bool, tmp_path: Path
) -> None:
    """Catches a signal, a state or a flag that is read from the wrong place."""
    (tmp_path / "7").mkdir()
    (tmp_path / "7" / "status").write_text(STATUS.format(pending))
    (tmp_path / "7" / "stat").write_text(STAT.format(state, flags))
    assert is_ending(7, tmp_path) == expected


def test_a_program_that_lives_does_not_end_and_one_that_is_gone_has_ended(tmp_path: Path) -> None:
    """Catches a supervisor that stops every motion, also where the system tells nothing."""
    assert not is_ending(os.getpid())
    assert not is_ending(7, tmp_path)
    (tmp_path / "self").mkdir()
    assert is_ending(7, tmp_path)
