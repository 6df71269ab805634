"""Every fault that the emulator has, in the midst of a motion: it stops and is named, or goes on
for a reason."""

import math
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from elastic_env.hardware.buses.bus import TEMPERATURE_CYCLES
from elastic_env.hardware.emulator.launch import EmulatorConfig, Faults, RunningEmulator
from elastic_env.hardware.emulator.virtual import VirtualBus
from elastic_env.hardware.errors import BusGoneError, FaultError, HardwareError, PortError
from elastic_env.hardware.imu import AttitudeStream
from elastic_env.hardware.live import plant
from elastic_env.hardware.safety import supervised_bus
from elastic_env.hardware.safety.guard import Guard
from elastic_env.hardware.safety.realtime import LONGEST_WAIT_S
from elastic_env.hardware.safety.supervised_bus import SupervisedBus
from elastic_env.hardware.settings import SafetyLimits
from tests.busy import once_more
from tests.emulators import stopped, wait_until_rest
from tests.test_hardware_safety import PATIENT, states
from tests.test_hardware_supervisor import ENABLE, attached, served
from tests.test_hardware_testbed import make_hardware
from train.commands.cli import main

PERIOD_S = 0.004
STOP_CYCLES = 60
LET_GO = ("torque_enable", 0)
"""Within which every fault that stops is to be found, the slowest in 35: temperatures are read
in every 25th cycle."""

pytestmark = once_more


@dataclass(frozen=True)
class Case:
    """A fault, and the words of the error that stops the motion, or why it goes on."""

    faults: dict[str, Any]
    stops: str = ""
    goes_on: str = ""


SERVO = [
    Case(
        {"unheard": 0.1},
        goes_on="lost instructions within patience_cycles: the last command is repeated",
    ),
    Case({"unheard": 1.0}, stops="no usable reply|not answer"),
    Case({"lost": 0.1}, goes_on="lost replies within patience_cycles"),
    Case({"lost": 1.0}, stops="no usable reply"),
    Case(
        {"late": 0.1, "late_s": 0.006},
        goes_on="late replies are known as old and count as lost ones",
    ),
    Case({"late": 1.0, "late_s": 0.02}, stops="no usable reply"),
    Case({"corrupted": 0.1}, goes_on="damaged replies fail their checksum and count as lost ones"),
    Case({"corrupted": 1.0}, stops="no usable reply"),
    Case({"truncated": 0.1}, goes_on="replies that end too early count as lost ones"),
    Case({"truncated": 1.0}, stops="no usable reply"),
    Case({"latency_s": 0.001}, goes_on="an adapter as it must be set"),
    Case({"latency_s": 0.016}, stops="no usable reply"),
    Case({"overload": True}, stops="reports a hardware error.*overload"),
    Case({"hot": True}, stops=r"too hot: servo 1 at .*: 95.000 °C, at most 80 °C"),
    Case({"silent": True}, stops="no usable reply"),
    Case({"same_id": True}, stops="no usable reply"),
    Case({"unplugged": True}, stops="is gone"),
]
IN_PROCESSES = {"unplugged=True"}
"""Fault that is played to real processes on every commit, all of them every night."""
IMU = [
    Case({"imu_silent": True}, stops=r"has sent no attitude for \d+ ms"),
    Case({"imu_late_s": 0.02}, goes_on="attitudes are younger than imu_oldest_s"),
    Case({"imu_late_s": 0.9}, stops=r"has sent no attitude for \d+ ms"),
    Case({"imu_nan": True}, stops="sends roll = nan rad"),
    Case({"imu_inf": True}, stops="sends roll = inf rad"),
    Case({"imu_out_of_range": True}, stops="sends roll = 8 rad.*-3.1416 and 3.1416"),
    Case({"imu_frozen": True}, stops=r"same attitude in all bits for \d+ ms"),
    Case(
        {"imu_corrupted": 0.2},
        goes_on="damaged packets fail their checksum, the others are young enough",
    ),
    Case({"imu_corrupted": 1.0}, stops=r"has sent no attitude for \d+ ms"),
]


def named(case: Case) -> str:
    return ",".join(f"{name}={value}" for name, value in case.faults.items())


def test_every_fault_of_the_emulator_is_played() -> None:
    """Catches a new kind of fault that nobody has said what becomes of."""
    assert {name for case in SERVO + IMU for name in case.faults} == set(Faults.model_fields)
    assert all(bool(case.stops) != bool(case.goes_on) for case in SERVO + IMU)
    stopping = {name for case in SERVO + IMU if case.stops for name in case.faults}
    assert stopping == set(Faults.model_fields)


@pytest.fixture(scope="module")
def running() -> Iterator[RunningEmulator]:
    with RunningEmulator() as running:
        yield running


@pytest.fixture
def emulator(running: RunningEmulator) -> RunningEmulator:
    """The one emulator, at rest and without faults."""
    running.faults(**Faults().model_dump())
    wait_until_rest(running)
    return running


def cycles(bus: SupervisedBus, number: int) -> None:
    for _ in range(number):
        bus.exchange(np.zeros(1), time.monotonic() + PERIOD_S)


@pytest.mark.parametrize("case", SERVO, ids=named)
def test_no_fault_of_a_servo_is_silent(case: Case) -> None:
    """Catches a fault after which the motion goes on for no reason, or stops without torque off
    or its cause: driver and supervisor in virtual time."""
    bus = VirtualBus(EmulatorConfig())
    bus.enable(PATIENT, np.array([[-1.0, 1.0]]))

    def move(number: int) -> None:
        for _ in range(number):
            bus.exchange(np.zeros(1), bus.now_s + PERIOD_S)

    move(5)
    bus.emulator.events.clear()
    bus.emulator.set_faults(case.faults)
    if case.goes_on:
        move(STOP_CYCLES)
        assert bus.emulator.state["torque_on"] == [True]
        return
    with pytest.raises(HardwareError, match=case.stops.replace(" at .*", ".*")) as caught:
        move(STOP_CYCLES)
    events = [(name, value) for _, _, name, value in bus.emulator.events]
    require_told_and_off(case, caught.value, events)


def require_told_and_off(case: Case, error: Exception, events: list[tuple[str, int]]) -> None:
    """Check that torque is off, or that the error says that nobody knows."""
    if "unplugged" in case.faults:
        assert isinstance(error, BusGoneError)
        assert "Switch their power off" in str(error)  # nobody can switch it off over the bus
    elif "unheard" in case.faults:
        assert "not confirmed by servo 1" in str(error)
    else:
        # an overloaded servo lets go by itself, and gets commands until a reply reports it
        offs = [number for number, event in enumerate(events) if event == LET_GO]
        off_by_the_bus = offs[1] if "overload" in case.faults else offs[0]
        assert "goal_position" not in [name for name, _ in events[off_by_the_bus:]]


@pytest.mark.parametrize(
    "case",
    [
        case if named(case) in IN_PROCESSES else pytest.param(case, marks=pytest.mark.slow)
        for case in SERVO
    ],
    ids=named,
)
def test_no_fault_of_the_bus_is_silent(emulator: RunningEmulator, case: Case) -> None:
    """Catches a fault after which the motion goes on for no reason, or stops without torque off
    or its cause: driver and supervisor in a process of their own."""
    with SupervisedBus({emulator.port: [1]}) as bus:
        bus.enable(PATIENT)
        cycles(bus, 5)
        emulator.events()
        emulator.faults(**case.faults)
        if case.goes_on:
            cycles(bus, STOP_CYCLES)
            assert emulator.state()["torque_on"] == [True]
            return
        with pytest.raises(HardwareError, match=case.stops) as caught:
            cycles(bus, STOP_CYCLES)
        events = [(name, value) for _, _, name, value in emulator.events()]
        emulator.faults(**Faults().model_dump())
        require_told_and_off(case, caught.value, events)
        if "unplugged" in case.faults:
            bus._is_enabled = False
        elif "unheard" in case.faults:
            bus.disable()


@pytest.mark.parametrize(
    "case",
    [IMU[0], *(pytest.param(case, marks=pytest.mark.slow) for case in IMU[1:])],
    ids=named,
)
def test_no_fault_of_the_imu_is_silent(
    emulator: RunningEmulator, case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches an IMU's fault, with its valid flag, that the motion goes on with."""
    for name in ("_SHORTEST_MOVE_S", "_SETTLE_S"):
        monkeypatch.setattr(plant, name, 0.05)
    env = make_hardware(
        emulator, imu_port=emulator.imu_port, reference={"kind": "hold", "lower": 0.0}
    )
    testbed = env.unwrapped.task.plant
    testbed.begin(0.0)
    emulator.faults(**case.faults)
    try:
        if case.goes_on:
            advance(testbed, 0.4)
            assert emulator.state()["torque_on"] == [True]
            return
        with pytest.raises(HardwareError, match=case.stops) as caught:
            advance(testbed, 5.0)
        assert caught.value.__notes__ == [f"torque at {emulator.port} is off"]
        assert caught.value.exit_code == 3
        assert emulator.state()["torque_on"] == [False]
    finally:
        env.close()


def advance(testbed: Any, duration_s: float) -> None:
    end_s = time.monotonic() + duration_s
    while time.monotonic() < end_s:
        testbed.advance(1)


@pytest.mark.parametrize("number", [54024, 2020])
def test_temperatures_are_read_in_the_first_cycle_and_every_25th_after(number: int) -> None:
    """Catches a temperature that is never asked for, and one whose bytes every cycle carries."""
    line = attached("one", 1, 2, number=number)
    line.servos[2].heat(True)
    told = [line.read_states(0.01).temperature for _ in range(2 * TEMPERATURE_CYCLES + 1)]
    assert [k for k, one in enumerate(told) if not np.isnan(one).any()] == [
        0,
        TEMPERATURE_CYCLES,
        2 * TEMPERATURE_CYCLES,
    ]
    assert told[0].tolist() == [35.0, 95.0]
    assert np.isnan(told[1]).all()


def test_a_temperature_that_was_not_told_is_asked_for_again() -> None:
    """Catches a lost reply that costs 25 cycles, and old replies taken for new because of the
    temperature."""
    line = attached("one", 1)
    line.lost = {0, 1}
    told = [line.read_states(0.01).temperature[0] for _ in range(4)]
    assert np.isnan(told[:2]).all()
    assert told[2] == 35.0
    assert np.isnan(told[3])


@pytest.mark.parametrize("limit", ["servo", "ours"])
def test_the_lower_limit_on_the_temperature_holds_in_motion_and_before(limit: str) -> None:
    """Catches torque that goes on while a servo is too hot, and a limit of its own that nobody
    has read."""
    limits = SafetyLimits(temperature_c=60.0 if limit == "ours" else 80.0)
    enable = ("enable", {"limits": limits.model_dump()})
    for degrees, words in ((60, ""), (61, "too hot: servo 2 at one: 61.*at most 60 °C")):
        line = attached("one", 1, 2)
        if limit == "servo":
            line.write_register(2, "temperature_limit", 60)
        line.servos[2]["present_temperature"] = degrees
        (answer,) = served([line], enable)
        assert ("message" in answer) == bool(words)
        assert not words or re.search(words, answer["message"])
        assert ((2, "torque_enable", 1) in line.events) != bool(words)


@pytest.mark.parametrize("value", [80.1, math.inf, -math.inf])
def test_a_temperature_beyond_its_limit_stops_the_motion(value: float) -> None:
    """Catches a limit that is never looked at."""
    said = Guard(SafetyLimits(), np.zeros(1), ["it"]).check(
        replace(states([0.0]), temperature=np.array([value]))
    )
    assert f"too hot: it: {value:.3f} °C, at most 80 °C" in said


def test_a_servo_that_never_tells_its_temperature_stops_the_motion() -> None:
    """Catches nan that counts as cool for ever; one that tells it now and then is fine."""
    guard = Guard(SafetyLimits(), np.zeros(1), ["it"])
    cool = replace(states([0.0]), temperature=np.array([80.0]))
    said = [
        guard.check(one)
        for _ in range(4)
        for one in (*[states([0.0])] * 2 * TEMPERATURE_CYCLES, cool)
    ]
    assert set(said) == {""}
    said = [guard.check(states([0.0])) for _ in range(61)]
    assert set(said[:60]) == {""}
    assert "no temperature from it in 60 cycles" in said[60]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hang_s", "said_ms"),
    [
        (0.05, 50),
        (0.09, 90),
        (0.001, 20),
    ],
)
def test_a_supervisor_in_motion_may_be_silent_for_as_long_as_the_program(
    emulator: RunningEmulator, hang_s: float, said_ms: int
) -> None:
    """Catches a servo that is held for 100 ms by a supervisor that hangs, where its program may
    hang for 50 ms."""
    with SupervisedBus({emulator.port: [1]}) as bus:
        bus.enable(PATIENT.replace(hang_s=0.09))
        cycles(bus, 2)
        bus._answer_s = max(hang_s, supervised_bus._LEAST_ANSWER_S)
        said = r"did not answer within (\d+) ms and was ended; torque is off"
        with stopped(bus.process_id), pytest.raises(FaultError, match=said) as caught:
            cycles(bus, 1)
    found = re.search(r"within (\d+) ms", str(caught.value))
    assert found is not None
    assert said_ms <= int(found[1]) <= said_ms + 1000 * LONGEST_WAIT_S
    assert emulator.state()["torque_on"] == [False]


def test_the_imus_stream_is_read_and_its_damaged_packets_are_not(emulator: RunningEmulator) -> None:
    """Catches a wrong field or byte order, and a packet that is taken in spite of its checksum."""
    with AttitudeStream(emulator.imu_port, oldest_s=0.5) as stream:
        emulator.faults(imu_corrupted=0.5)
        rolls = []
        for _ in range(40):
            time.sleep(0.01)
            rolls.append(stream.latest().roll)
    assert (
        np.abs(np.array(rolls) - emulator.state()["q"][0]).max() < 0.01
    )  # offset and noise of the scenario
    with pytest.raises(PortError, match="/dev/ttyNOTHING: there is no such device"):
        AttitudeStream("/dev/ttyNOTHING")


def test_the_watchdog_is_set_where_there_is_one() -> None:
    """Catches a bus watchdog that is left off, or written to a model whose table has none there."""
    for number, expected in ((54024, []), (2020, [0, 3])):
        line = attached("one", 1, number=number)
        served([line], ENABLE)
        assert [value for _, name, value in line.events if name == "bus_watchdog"] == expected


def test_an_emulated_fault_that_does_not_exist_is_refused(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Catches a share or a wrong word that is taken for a switch."""
    for name in ("lost", "imu_nam"):
        with pytest.raises(SystemExit):
            main(["hardware", "emulate", "--fault", name])
        assert "imu_nan" in capsys.readouterr().err
