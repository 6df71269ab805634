"""Limits by themselves; bus and supervisor through the real SDK on an emulated bus, in good
times and bad."""

import os
import pty
import re
import signal
import subprocess
import sys
import time
import tty
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np
import pytest

from elastic_env.core.errors import ConfigurationError
from elastic_env.hardware.buses.bus import States
from elastic_env.hardware.buses.dynamixel_bus import DynamixelBus
from elastic_env.hardware.buses.port import Port
from elastic_env.hardware.buses.servo_models import servo_model
from elastic_env.hardware.emulator.launch import EmulatorConfig, RunningEmulator
from elastic_env.hardware.emulator.servos import EmulatedServo
from elastic_env.hardware.emulator.virtual import VirtualBus
from elastic_env.hardware.errors import (
    BusGoneError,
    FaultError,
    HardwareError,
    PortError,
    ReplyError,
)
from elastic_env.hardware.imu import AttitudeStream
from elastic_env.hardware.safety import supervised_bus
from elastic_env.hardware.safety.checks import check_bus
from elastic_env.hardware.safety.guard import Guard
from elastic_env.hardware.safety.realtime import (
    LONGEST_WAIT_S,
    Priority,
    give_up_realtime,
    prefer_realtime,
)
from elastic_env.hardware.safety.supervised_bus import SupervisedBus
from elastic_env.hardware.settings import SafetyLimits
from tests.busy import once_more
from tests.emulators import stopped, wait_until_free, wait_until_rest
from tests.lines import looped

PERIOD_S = 0.004
PATIENT = SafetyLimits(patience_cycles=10, hang_s=0.09)
"""Limits for tests of other things: a busy computer delays pseudo-terminals."""

pytestmark = once_more


def states(
    position: list[float], velocity: float = 0.0, torque: float = 0.0, fresh: bool = True
) -> States:
    n = len(position)
    values = np.array(position) if fresh else np.full(n, np.nan)
    return States(
        values,
        np.full(n, velocity),
        np.full(n, torque),
        np.full(n, fresh),
        np.zeros(n, dtype=np.bool_),
        0.0,
    )


def test_first_commands_lead_away_from_where_the_servo_stands_no_faster_than_allowed() -> None:
    """Catches the jump to the first goal, and a limit that holds for one step but not for the
    next."""
    guard = Guard(SafetyLimits(slew_rad_s=1.0), np.array([0.2]), ["it"])
    at = [float(guard.command(np.array([1.0]), 0.004)[0][0]) for _ in range(3)]
    np.testing.assert_allclose(at, [0.204, 0.208, 0.212])


def test_goals_stay_within_the_position_limits() -> None:
    """Catches limits that only one side has, or that the slew limit undoes."""
    guard = Guard(
        SafetyLimits(lowest_rad=-0.1, highest_rad=0.3, slew_rad_s=10.0), np.zeros(2), ["one", "two"]
    )
    goals, is_limited = guard.command(np.array([-5.0, 5.0]), 0.5)
    assert goals.tolist() == [-0.1, 0.3]
    assert is_limited.all()


@pytest.mark.parametrize("goals", [[np.nan], [np.inf], [0.0, 0.0]])
def test_goals_that_are_no_angles_stop_the_motion(goals: list[float]) -> None:
    """Catches a NaN that becomes some count on the wire."""
    with pytest.raises(FaultError, match="finite"):
        Guard(SafetyLimits(), np.zeros(1), ["it"]).command(np.array(goals), 0.004)


@pytest.mark.parametrize("begin", [-0.6, -0.51, np.nan])
def test_motion_does_not_begin_outside_the_limits(begin: float) -> None:
    """Catches a first command beyond the limit, also within the margin that is for what is
    measured on the way."""
    with pytest.raises(FaultError, match="by hand"):
        Guard(SafetyLimits(lowest_rad=-0.5), np.array([begin]), ["it"])


def test_a_missing_reply_holds_the_command_and_the_third_stops_the_motion() -> None:
    """Catches commands that go on blindly, a fault at the first hiccup, and a count that a good
    reply does not end."""
    guard = Guard(SafetyLimits(slew_rad_s=1.0), np.zeros(1), ["it"])
    guard.command(np.array([1.0]), 0.004)
    assert guard.check(states([0.0], fresh=False)) == ""
    held, is_limited = guard.command(np.array([1.0]), 0.004)
    assert held.tolist() == [0.004]
    assert is_limited.all()
    assert guard.check(states([0.0], fresh=False)) == ""
    assert guard.check(states([0.0])) == ""
    assert guard.command(np.array([1.0]), 0.004)[0].tolist() == [0.008]
    reasons = [guard.check(states([0.0], fresh=False)) for _ in range(3)]
    assert reasons[:2] == ["", ""]
    assert "no usable reply from it in 3 cycles" in reasons[2]


@pytest.mark.parametrize(
    ("measured", "words"),
    [
        (states([1.7]), "position"),
        (states([0.0], velocity=-5.0), "speed"),
        (states([0.5]), "goal"),
    ],
)
def test_what_is_measured_stops_the_motion(measured: States, words: str) -> None:
    """Catches a limit that is never looked at."""
    assert words in Guard(SafetyLimits(), np.zeros(1), ["it"]).check(measured)


def test_too_much_torque_stops_the_motion_when_it_lasts() -> None:
    """Catches a stop at one spike of the current, and none under a load that stays."""
    guard = Guard(SafetyLimits(torque_nm=40.0), np.zeros(1), ["it"])
    strained = states([0.0], torque=-49.4)
    assert [
        guard.check(s) != ""
        for s in (strained, strained, states([0.0]), strained, strained, strained)
    ] == [
        False,
        False,
        False,
        False,
        False,
        True,
    ]


def test_missing_replies_do_not_hide_too_much_torque() -> None:
    """Catches a load that lasts for ever because every second reply is lost."""
    guard = Guard(SafetyLimits(torque_nm=40.0), np.zeros(1), ["it"])
    strained = states([0.0], torque=-49.4)
    missing = states([np.nan], torque=np.nan, fresh=False)
    reasons = [guard.check(s) for s in (strained, missing, strained, missing, strained)]
    assert reasons[:4] == [""] * 4
    assert "torque exceeds 40 N·m: it: " in reasons[4]


def test_limits_in_the_wrong_order_are_refused() -> None:
    """Catches a range that nothing can be in."""
    with pytest.raises(ConfigurationError, match="lowest_rad"):
        SafetyLimits(lowest_rad=1.0, highest_rad=-1.0)


@pytest.fixture(scope="module")
def running() -> Iterator[RunningEmulator]:
    with RunningEmulator(EmulatorConfig(ids=(1, 2))) as running:
        yield running


def without_faults(emulator: RunningEmulator) -> None:
    """Undo the faults that a test may have left, and wait for the servos' rest."""
    emulator.faults(overload=False, silent=False, unheard=0, late=0, latency_s=0)
    wait_until_rest(emulator)


@pytest.fixture(scope="module")
def buses() -> Iterator[list[SupervisedBus]]:
    """The bus, or none, that tests after one another share: its process takes long to start."""
    shared: list[SupervisedBus] = []
    yield shared
    close_all(shared)


def close_all(shared: list[SupervisedBus]) -> None:
    while shared:
        with suppress(HardwareError):
            shared.pop().close()


@pytest.fixture
def emulator(running: RunningEmulator, buses: list[SupervisedBus]) -> RunningEmulator:
    """The one emulator, at rest and without faults; its port is free."""
    close_all(buses)
    without_faults(running)
    return running


@pytest.fixture
def supervised(running: RunningEmulator, buses: list[SupervisedBus]) -> Iterator[SupervisedBus]:
    """The one bus at the emulator, at rest and without faults; torque is off when a test ends."""
    without_faults(running)
    if not buses:
        buses.append(SupervisedBus({running.port: [1, 2]}))
    yield buses[0]
    try:
        buses[0].disable()
    except HardwareError:  # a test has ended its supervisor
        close_all(buses)
    assert running.state()["torque_on"] == [False, False]


def cycle(bus: SupervisedBus, goals: list[float], number: int = 1) -> None:
    for _ in range(number):
        bus.exchange(np.array(goals), time.monotonic() + PERIOD_S)


def torque_events(emulator: RunningEmulator, value: int) -> list[float]:
    return [t for t, _, name, v in emulator.events() if name == "torque_enable" and v == value]


def test_registers_and_positions_that_look_like_a_header_pass_both_ways(
    emulator: RunningEmulator,
) -> None:
    """Catches the SDK's missing stuffing: −131073 is FF FF FD FF on the wire."""
    with DynamixelBus(emulator.port) as bus:
        assert [(f.servo_id, f.model_number) for f in (bus.ping(1), bus.ping(2))] == [
            (1, 54024),
            (2, 54024),
        ]
        bus.attach([1, 2])
        for value in (-131_073, -131_072, -3, 250_961):
            bus.write_register(1, "goal_position", value)
            bus.write_all("goal_position", {2: value})
            assert [bus.read_register(i, "goal_position") for i in (1, 2)] == [value, value]
        with pytest.raises(ReplyError, match=r"servo 1 .*EEPROM"):
            bus.write_register(1, "present_position", 0)
        with pytest.raises(ReplyError, match=r"servo 9 at .* does not answer"):
            bus.attach([9])


def test_check_finds_nothing_wrong_with_good_servos(emulator: RunningEmulator) -> None:
    """Catches a check that reads the wrong register: the emulated servos are set as they should
    be."""
    with DynamixelBus(emulator.port) as bus:
        checks = check_bus(bus, [1, 2])
    of_the_computer = (
        "round trip of a ping",
        "lost replies",
    )  # pseudo-terminals are slow where it is busy
    assert [one.name for one in checks if not one.is_good and one.name not in of_the_computer] == []
    assert any("54024 H54-200-S500-R" in one.value for one in checks)


def test_check_finds_nothing_wrong_with_the_newer_servos() -> None:
    """Catches emulated servos that are delivered with settings that nothing but the maker's
    program can change."""
    newer = VirtualBus(EmulatorConfig(model_number=2020)).driver
    found = {one.name: one.is_good for one in check_bus(newer, [1]) if one.name.startswith("1: ")}
    assert set(found.values()) == {True}


def test_a_reply_that_came_while_the_program_did_not_run_is_read(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Catches a good reply that counts as damaged: the computer let the program read one byte, and
    then did not run it until the time was over."""
    bus = VirtualBus(EmulatorConfig())
    port = bus.driver.port
    read = port.readPort
    pauses = iter([0.1])

    def read_late(length: int) -> bytes:
        for pause_s in pauses:
            bus.sleep(pause_s)
            return read(1)
        return read(length)

    monkeypatch.setattr(port, "readPort", read_late)
    assert bus.driver.ping(1).model_number == 54024
    assert next(pauses, None) is None
    assert bus.driver.num_retries == 0


def test_a_second_answer_to_one_request_is_not_taken_for_the_next_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Catches a register with the value of another: a line that stood still passes on two tries of
    a request, and the second answer comes when the next request is under way."""
    bus = VirtualBus(EmulatorConfig())
    port = bus.driver.port
    names = ("min_voltage_limit", "max_voltage_limit")
    expected = [bus.driver.read_register(1, name) for name in names]
    write = port.writePort
    delays = iter([0.09, 0.012])

    def write_to_slow_line(wire: bytes) -> int:
        bus.emulator.set_faults({"late": 1.0, "late_s": next(delays, 0.0)})
        return write(wire)

    monkeypatch.setattr(port, "writePort", write_to_slow_line)
    assert [bus.driver.read_register(1, name) for name in names] == expected
    assert bus.driver.num_retries == 1
    assert expected[0] != expected[1]


def test_servos_have_as_long_to_confirm_before_a_second_motion_as_before_the_first() -> None:
    """Catches the short time that replies have in motion, and that stays when the motion ends."""
    bus = VirtualBus(EmulatorConfig())
    ranges = np.array([[-1.0, 1.0]])
    for _ in range(2):
        bus.emulator.set_faults({"late": 1.0, "late_s": 0.02})
        bus.enable(PATIENT, ranges)
        bus.emulator.set_faults({"late": 0.0})
        bus.close()


@pytest.mark.parametrize("fault", ["lost", "corrupted"])
def test_a_bad_line_is_seen_by_its_lost_and_damaged_replies(fault: str) -> None:
    """Catches a check that calls a line fine whose replies come at the second try."""
    bus = VirtualBus(EmulatorConfig(seed=5))
    assert {one.name: one for one in check_bus(bus.driver, [1])}["lost replies"].is_good
    bus.emulator.set_faults({fault: 0.1})
    found = {one.name: one for one in check_bus(bus.driver, [1])}
    assert not found["lost replies"].is_good
    assert "cable" in found["lost replies"].cure
    assert not found["lost replies"].is_vital


def test_slow_adapter_is_refused_with_its_cure(emulator: RunningEmulator) -> None:
    """Catches a loop that would begin on an adapter as it is delivered: 16 ms, four control
    periods."""
    emulator.faults(latency_s=0.016)
    with pytest.raises(HardwareError, match=r"round trip .* is 1[67].*latency timer to 1 ms"):
        SupervisedBus({emulator.port: [1]})


def read_until(port: Port, number: int, at_once: int) -> list[bytes]:
    """Pieces of together so many bytes, within a second."""
    parts = []
    end = time.monotonic() + 1.0
    while sum(map(len, parts)) < number and time.monotonic() < end:
        parts.append(port.readPort(at_once))
    return parts


def test_a_read_takes_no_more_than_it_asked_for_and_loses_nothing() -> None:
    """Catches bytes read ahead that are lost, given twice, or still there after the port was
    cleared."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    port = Port(os.ttyname(slave), 1_000_000)
    port.open()
    try:
        os.write(master, bytes(range(30)))
        parts = read_until(port, 30, at_once=11)
        assert max(map(len, parts)) <= 11
        assert b"".join(parts) == bytes(range(30))
        assert port.readPort(1) == b""
        os.write(master, b"old")
        assert b"".join(read_until(port, 1, at_once=1)) == b"o"
        time.sleep(0.01)
        port.clearPort()
        os.write(master, b"new")
        assert b"".join(read_until(port, 3, at_once=3)) == b"new"
    finally:
        port.closePort()
        os.close(master)
        os.close(slave)


def test_late_replies_are_not_taken_for_the_next_ones(emulator: RunningEmulator) -> None:
    """Catches the SDK's habit of giving the answer of the last request to this one."""
    with DynamixelBus(emulator.port) as bus:
        bus.attach([1])
        emulator.faults(late=1.0, late_s=0.006)
        missing = 0
        for _ in range(
            20
        ):  # fewer than there are lengths: whatever the delay, an old reply has another one
            begin = time.monotonic()
            replied = bus.read_states(0.004)
            missing += not replied.is_fresh.all()
            # its own answer takes 6 ms; one that is there sooner is that of a request before
            assert not replied.is_fresh.any() or replied.time_s - begin >= 0.006
        emulator.faults(late=0)
        assert missing > 10
        assert bus.read_states(0.1).is_fresh.all()


def test_servos_follow_and_torque_goes_off_at_the_end(emulator: RunningEmulator) -> None:
    """Catches goals that do not arrive in the servos' units, and a program that ends by Ctrl-C
    with torque on; the tests of the shared bus end by themselves."""
    with suppress(KeyboardInterrupt), SupervisedBus({emulator.port: [1, 2]}) as bus:
        assert bus._answer_s == supervised_bus._ANSWER_S
        start = bus.enable(PATIENT)
        begin = time.monotonic()
        while (elapsed := time.monotonic() - begin) < 0.6:
            share = min(elapsed / 0.4, 1.0)
            cycle(bus, (start + share * (np.array([0.1, -0.1]) - start)).tolist())
        assert emulator.state()["theta"] == pytest.approx([0.1, -0.1], abs=0.02)
        assert emulator.state()["torque_on"] == [True, True]
        signal.raise_signal(signal.SIGINT)
        pytest.fail("nothing was interrupted")
    assert emulator.state()["torque_on"] == [False, False]


def test_second_program_is_told_which_port_is_taken(
    running: RunningEmulator, supervised: SupervisedBus
) -> None:
    """Catches two programs on one bus, one directly and one through a supervisor; and a port that
    is opened for an IMU, and its input thrown away, before anybody has asked whether it is free."""
    for intrude in (
        lambda: DynamixelBus(running.port).open(),
        lambda: SupervisedBus({running.port: [1]}),
    ):
        with pytest.raises(PortError, match=running.port):
            intrude()
    start = supervised.enable(PATIENT)
    assert len(start) == 2
    cycle(supervised, start.tolist(), 5)
    for _ in range(5):
        with pytest.raises(PortError, match=f"another program uses {running.port}"):
            AttitudeStream(running.port)
        cycle(supervised, start.tolist(), 5)


def test_the_supervisor_runs_before_the_program(supervised: SupervisedBus) -> None:
    """Catches a supervisor that waits in a line with the program whose hang it is to end."""
    is_granted = prefer_realtime(Priority.LOOP)
    give_up_realtime()
    expected = Priority.SUPERVISOR if is_granted else 0
    assert os.sched_getparam(supervised.process_id).sched_priority == expected


def test_the_limit_on_silence_is_the_one_that_was_given(supervised: SupervisedBus) -> None:
    """Catches a limit that `enable` does not pass on, or does not pass on the second time."""
    for hang_s in (0.05, 0.09, 0.005):
        supervised.enable(SafetyLimits(hang_s=hang_s))
        assert supervised._answer_s == max(hang_s, 0.02)
        assert ("--patient" in supervised._hint) == (hang_s < 0.09)
        supervised.disable()


def test_torque_is_off_when_the_program_waits_too_long(
    running: RunningEmulator, supervised: SupervisedBus
) -> None:
    """Catches a supervisor that waits for ever, and a program that is not told why nothing
    moves."""
    supervised.enable(PATIENT.replace(hang_s=0.05))
    running.events()
    cycle(supervised, [0.0, 0.0], 3)
    last = time.monotonic()
    time.sleep(0.15)
    off = torque_events(running, 0)
    assert min(off) - last < 0.1
    with pytest.raises(FaultError, match="no command for 50 ms"):
        cycle(supervised, [0.0, 0.0])


def test_overload_stops_all_and_is_named(
    running: RunningEmulator, supervised: SupervisedBus
) -> None:
    """Catches an alert bit that is overlooked because it comes with success."""
    supervised.enable(PATIENT)
    running.faults(overload=True)
    with pytest.raises(FaultError, match=r"torque is off \(servo 1 at .*overload"):
        cycle(supervised, [0.0, 0.0], 12)
    with pytest.raises(FaultError, match="overload"):
        supervised.enable()
    running.faults(overload=False)
    assert running.state()["torque_on"] == [False, False]


def test_a_supervisor_that_waits_for_silent_servos_is_not_taken_for_dead(
    running: RunningEmulator, supervised: SupervisedBus
) -> None:
    """Catches a limit on its answer that is shorter than the tries to have torque off confirmed."""
    supervised.enable()
    running.events()
    running.faults(silent=True)
    with pytest.raises(
        FaultError, match=r"sent, but not confirmed by servo 1 at .*, servo 2 at .*: switch"
    ):
        cycle(supervised, [0.0, 0.0], 12)
    running.faults(silent=False)
    assert torque_events(running, 0)
    supervised.disable()


def test_a_supervisor_that_hangs_is_ended_and_torque_switched_off(
    running: RunningEmulator, supervised: SupervisedBus
) -> None:
    """Catches a program that waits for ever for an answer while a servo holds its last goal, and
    a supervisor that may hang for 100 ms where its program may hang for 50 ms."""
    supervised.enable(PATIENT)
    supervised._answer_s = 0.05
    running.events()
    said = r"did not answer within (\d+) ms and was ended; torque is off; end what else keeps"
    with stopped(supervised.process_id), pytest.raises(FaultError, match=said) as caught:
        cycle(supervised, [0.0, 0.0])
    found = re.search(r"within (\d+) ms", str(caught.value))
    assert found is not None
    assert 50 <= int(found[1]) <= 50 + 1000 * LONGEST_WAIT_S
    assert torque_events(running, 0)
    with pytest.raises(FaultError, match="torque is off"):
        cycle(supervised, [0.0, 0.0])


def test_torque_goes_off_when_the_supervisor_dies(
    running: RunningEmulator, supervised: SupervisedBus
) -> None:
    """Catches a servo that holds its last goal when nobody watches over it any more."""
    cycle(supervised, supervised.enable(PATIENT).tolist(), 5)
    running.events()
    begin = time.monotonic()
    os.kill(supervised.process_id, signal.SIGKILL)
    with pytest.raises(FaultError, match=r"ended \(exit code -9\); torque is off"):
        cycle(supervised, [0.0, 0.0], 5)
    assert min(torque_events(running, 0)) - begin < 0.1


def test_instructions_that_are_lost_reach_no_servo(emulator: RunningEmulator) -> None:
    """Catches a switch that loses replies only: the servo would have done what it was told."""
    with DynamixelBus(emulator.port) as bus:
        bus.attach([1, 2])
        emulator.events()
        emulator.faults(unheard=1.0)
        bus.write_goals(np.zeros(2))
        with pytest.raises(ReplyError, match="does not answer"):
            bus.write_goal(1, 0.1)
        assert emulator.events() == []


def test_ids_that_cannot_be_are_refused_before_anything_starts() -> None:
    """Catches a supervisor that dies of them with a traceback."""
    with pytest.raises(ConfigurationError, match=r"different numbers .* got \[1, 1\]"):
        SupervisedBus({"/dev/ttyNOTHING": [1, 1]})


@pytest.mark.parametrize(
    "how",
    [
        "kill",
        *(
            pytest.param(how, marks=pytest.mark.slow)
            for how in ("kill-supervisor", "stop", "interrupt")
        ),
    ],
)
def test_torque_goes_off_whatever_ends_the_program(emulator: RunningEmulator, how: str) -> None:
    """Catches every way of leaving a servo under torque: death, hang, Ctrl-C, and the death of
    the supervisor."""
    command = [sys.executable, "-m", "tests.hardware_trials.wave", emulator.port, "1"]
    program = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True)
    try:
        assert program.stdout is not None
        supervisor = int(program.stdout.readline())
        emulator.events()
        begin = time.monotonic()
        if how == "kill-supervisor":
            os.kill(supervisor, signal.SIGKILL)
        else:
            program.send_signal(
                {"kill": signal.SIGKILL, "stop": signal.SIGSTOP, "interrupt": signal.SIGINT}[how]
            )
        off: list[float] = []
        while not off and time.monotonic() - begin < 1.0:
            time.sleep(0.05)
            off = torque_events(emulator, 0)
        assert off
        assert min(off) - begin < 0.1
    finally:
        program.kill()
        program.communicate()
        wait_until_free(emulator.port)


@pytest.mark.slow
def test_two_buses_are_read_side_by_side(emulator: RunningEmulator) -> None:
    """Catches arrays that mix up the servos of two buses, and one bus whose loss keeps torque on
    at the other."""
    with RunningEmulator(EmulatorConfig(ids=(7,), model_number=2020)) as other:
        ports = {other.port: [7], emulator.port: [1, 2]}
        with SupervisedBus(ports) as bus:
            assert bus.models == [[2020], [54024, 54024]]
            bus.enable(PATIENT)
            cycle(bus, [0.0, 0.0, 0.0], 5)
            states = bus.exchange(np.zeros(3), time.monotonic()).states
            assert len(states.position) == 3
            other.faults(unplugged=True)
            emulator.events()
            with pytest.raises(BusGoneError, match=r"gone .*power"):
                cycle(bus, [0.0, 0.0, 0.0], 12)
            assert torque_events(emulator, 0)


def test_wrong_model_number_is_refused_before_anything_is_written() -> None:
    """Catches registers of one model written to another."""
    events: list[tuple[int, str, int]] = []

    def note(*event: Any) -> None:
        events.append(event)

    model = servo_model(54024)
    with pytest.raises(HardwareError, match="no control table for model number 1021"):
        looped([EmulatedServo(1, model, note, registers={"model_number": 1021})])
    assert events == []
    looped([EmulatedServo(1, model, note)]).write_torque(1, True)
    assert events


def test_no_port_says_what_there_is() -> None:
    """Catches a traceback of the serial library."""
    with pytest.raises(PortError, match="no such device"):
        DynamixelBus("/dev/ttyNOTHING").open()
    with pytest.raises(PortError, match="57600"):
        DynamixelBus("/dev/ttyNOTHING", baudrate=123).open()


@pytest.mark.parametrize(("begin", "is_taken"), [(0.304, True), (0.306, False)])
def test_a_motion_may_begin_where_weight_presses_a_servo_on_its_stop(
    begin: float, is_taken: bool
) -> None:
    """Catches an arm that hangs on its stop and is refused, and a first goal beyond the stop."""
    ends = np.array([[-0.3, 0.3]])
    arguments = (SafetyLimits(), np.array([begin]), ["it"])
    if not is_taken:
        with pytest.raises(FaultError, match="must begin between"):
            Guard(*arguments, ranges=ends)
        return
    goals, _ = Guard(*arguments, ranges=ends).command(np.array([begin]), 0.02)
    assert goals[0] <= 0.3
