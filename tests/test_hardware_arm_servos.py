"""Servos of small arms: packets against the makers' examples, tables against others' tables, and
every instruction through driver and emulated servo."""

import math
from importlib import resources
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from elastic_env.core.errors import ConfigurationError
from elastic_env.hardware.buses import bus_group, feetech_packets, packets
from elastic_env.hardware.buses.servo_models import Register, servo_model, servo_models
from elastic_env.hardware.emulator.launch import EmulatorConfig
from elastic_env.hardware.emulator.servos import EmulatedServo
from elastic_env.hardware.errors import HardwareError, ReplyError
from elastic_env.hardware.settings import SafetyLimits
from tests.lines import Loop, looped
from tests.test_hardware_supervisor import served

STS = 777
SMALL = sorted(number for number, one in servo_models().items() if one.counts_per_turn == 4096)


@given(
    st.lists(st.binary(max_size=9), min_size=1, max_size=4),
    st.lists(st.integers(1, 9), min_size=1, max_size=8),
    st.binary(max_size=3),
)
def test_feetech_parser_finds_packets_in_pieces_behind_noise(
    bodies: list[bytes], pieces: list[int], noise: bytes
) -> None:
    """Catches a parser that needs whole packets at a time, or loses step by what lies before."""
    bodies = [body.replace(b"\xff", b"\x7f") for body in bodies]
    noise = noise.replace(b"\xff", b"\x00")
    stream = noise + b"".join(feetech_packets.packet(7, 0, body) for body in bodies)
    parser = feetech_packets.Parser()
    found = []
    at = 0
    for number in range(len(stream)):
        step = pieces[number % len(pieces)]
        found += parser.parse(stream[at : at + step])
        at += step
    assert [packet.parameters for packet in found if packet.is_intact] == bodies


def test_a_feetech_packet_without_its_end_does_not_swallow_the_next() -> None:
    """Catches a reply that is made of two: a checksum of eight bits may fit by chance."""
    first = feetech_packets.packet(1, 0, b"\x01\x02\x03\x04")
    second = feetech_packets.packet(2, 0, b"\x05\x06\x07\x08")
    for end in range(4, len(first)):
        found = feetech_packets.Parser().parse(first[:end] + second)
        assert [p.parameters for p in found if p.is_intact] == [b"\x05\x06\x07\x08"]


@given(st.integers(0, 8 * 14 - 1), st.integers(0, 4095))
def test_no_flipped_bit_of_a_feetech_reply_passes(bit: int, position: int) -> None:
    """Catches a checksum that is not looked at, or that leaves bytes out."""
    reply = bytearray(feetech_packets.packet(1, 0, position.to_bytes(8, "little")))
    reply[bit // 8] ^= 1 << bit % 8
    found = feetech_packets.Parser().parse(bytes(reply))
    assert not any(one.is_intact and one.servo_id == 1 for one in found)


@pytest.mark.parametrize(
    ("bit", "value", "stored"),
    [(15, -1, 0x8001), (15, 2048, 0x0800), (11, -2047, 0x0FFF), (10, -300, 0x052C), (15, 0, 0)],
)
def test_signs_are_bits_of_their_own(bit: int, value: int, stored: int) -> None:
    """Catches two's complement, by which −1 step would be 32767 (LeRobot's tables of the bits)."""
    register = Register(0, 2, "it", True, "RAM", 0, False, bit)
    assert register.encode(value) == stored.to_bytes(2, "little")
    assert register.decode(stored.to_bytes(2, "little")) == value
    with pytest.raises(HardwareError, match="does not fit"):
        register.encode(-(1 << 16))


def test_feetech_registers_are_those_of_the_maker() -> None:
    """Catches a shifted row: addresses as LeRobot's table and Feetech's SMS_STS.h have them."""
    table = servo_model(STS).table
    names = {
        "position_p_gain": 21,
        "homing_offset": 31,
        "operating_mode": 33,
        "torque_enable": 40,
        "goal_position": 42,
        "torque_limit": 48,
        "present_position": 56,
        "present_velocity": 58,
        "present_load": 60,
        "present_input_voltage": 62,
        "present_temperature": 63,
        "hardware_error_status": 65,
    }
    assert {name: table[name].address for name in names} == names
    assert {
        one.name: number for number, one in servo_models().items() if number in (777, 2825)
    } == {
        "STS3215": 777,
        "STS3250": 2825,
    }


@pytest.mark.parametrize("number", [n for n in SMALL if servo_model(n).protocol == "dynamixel"])
def test_dynamixel_registers_are_those_of_the_sdk(number: int) -> None:
    """Catches a wrong row: dynamixel-sdk brings the maker's own tables and model numbers."""
    folder = resources.files("dynamixel_easy_sdk") / "control_table"
    files = dict(
        line.split("\t") for line in (folder / "dynamixel.model").read_text().splitlines()[1:]
    )
    text = (folder / files[str(number)].strip()).read_text()
    rows = [row.split("\t") for row in text.split("[control table]")[1].splitlines()[2:] if row]
    theirs = {name.strip().lower().replace(" ", "_"): (int(a), int(s)) for a, s, name in rows}
    model = servo_model(number)
    assert model.name.lower().replace("-", "_").startswith(files[str(number)].strip()[:-6])
    assert f"value_of_zero_radian_position\t{model.zero_count}" in text
    ours = {name: (one.address, one.size) for name, one in model.table.items()}
    same = ours.keys() & theirs.keys()
    assert {name: ours[name] for name in same} == {name: theirs[name] for name in same}
    needed = {"goal_position", "present_position", "torque_enable", "goal_pwm", "bus_watchdog"}
    assert needed <= same
    assert f"Present Velocity\t{model.velocity_unit:.5f}"[:-1] in text


def servos(number: int, *ids: int, **registers: int) -> list[EmulatedServo]:
    model = servo_model(number)
    found = []
    for servo_id in ids:
        motion = (0.1 * servo_id, -0.5, 0.25 * model.largest_torque)
        found.append(
            EmulatedServo(
                servo_id, model, lambda *_: None, motion=lambda own=motion: own, registers=registers
            )
        )
    return found


@pytest.mark.parametrize("number", SMALL)
def test_states_come_through_the_wire_in_si_units(number: int) -> None:
    """Catches a byte order, a sign or a unit that driver and table do not share: each of the
    servos is elsewhere."""
    bus = looped(servos(number, 1, 2, 6))
    model = servo_model(number)
    for _ in range(30):
        states = bus.read_states(0.001)
        assert states.is_fresh.all()
        np.testing.assert_allclose(
            states.position, [0.1, 0.2, 0.6], rtol=0, atol=0.51 * model.position_unit
        )
        np.testing.assert_allclose(states.velocity, -0.5, rtol=0, atol=0.51 * model.velocity_unit)
        torque = 0.51 * model.current_unit * model.torque_per_ampere
        np.testing.assert_allclose(states.torque, 0.25 * model.largest_torque, rtol=0, atol=torque)
        assert not states.has_alert.any()
        assert (states.temperature[~np.isnan(states.temperature)] == 35.0).all()


@pytest.mark.parametrize("number", SMALL)
def test_goals_and_torque_reach_every_servo(number: int) -> None:
    """Catches a zero at the end of the range in place of its middle, and a group that is cut."""
    emulated = servos(number, 1, 2)
    bus = looped(emulated)
    bus.write_goals(np.array([-1.0, 0.5]))
    unit = servo_model(number).position_unit
    assert [one.goal for one in emulated] == pytest.approx([-1.0, 0.5], abs=0.51 * unit)
    assert [one["goal_position"] for one in emulated] == [
        2048 + round(-1.0 / unit),
        2048 + round(0.5 / unit),
    ]
    bus.write_torque(2, True)
    assert [one.is_on for one in emulated] == [False, True]
    bus.torque_off()
    assert bus.confirm_torque_off() == []
    assert not any(one.is_on for one in emulated)


@pytest.mark.parametrize("number", [STS, 1020])
def test_effort_is_lowered_and_given_back(number: int) -> None:
    """Catches a servo that is left without strength for the next program, and a limit above what
    the user's own settings allow."""
    maximum = servo_model(number).effort_maximum
    emulated = servos(number, 1, **{maximum: 400})
    bus = looped(emulated)
    bus.restore_effort()
    name = servo_model(number).effort_register
    assert emulated[0][name] == 400
    bus.limit_effort(0.25)
    assert emulated[0][name] == 100
    assert emulated[0].effort == 0.25
    bus.torque_off()
    assert emulated[0][name] == 400


def test_an_alert_of_a_feetech_servo_shows_in_every_reply() -> None:
    """Catches a status byte that is taken for a refusal, or overlooked."""
    (servo,) = emulated = servos(STS, 1)
    bus = looped(emulated)
    servo.overload(True)
    assert bus.read_states(0.001).has_alert.all()
    assert bus.read_condition(1).error == "overload"
    bus.write_goal(1, 0.3)
    assert servo.goal == pytest.approx(0.3, abs=1e-3)


def test_goals_beyond_the_servos_own_limits_are_cut_by_it() -> None:
    """Catches an emulated servo that turns where a real one would not."""
    (servo,) = emulated = servos(STS, 1, max_position_limit=3000)
    looped(emulated).write_goal(1, 3.0)
    assert servo["goal_position"] == 3000


def test_a_servo_of_the_other_protocol_is_named() -> None:
    """Catches a Feetech servo whose registers are written at the addresses of a Dynamixel."""
    bus = looped(servos(1020, 1))
    with pytest.raises(HardwareError, match="is a STS3215, which speaks the protocol 'feetech'"):
        bus.attach_known({1: STS})
    with pytest.raises(HardwareError, match="no control table for model number 1021"):
        bus.attach_known({1: 1021})


@pytest.mark.parametrize("number", [STS])
def test_two_servos_with_one_id_are_told_from_silence(number: int) -> None:
    """Catches a hint at power and wiring where two servos answer at once."""

    def doubled(reply: bytes) -> bytes:
        return reply[:-2] + bytes(byte & (byte ^ 0x05) for byte in reply[-2:])

    def without_length(reply: bytes) -> bytes:
        return reply[:3] + bytes(byte & 0x10 for byte in reply[3:])

    bus = looped(servos(number, 1))
    for change in (doubled, without_length):
        bus.port.change = change  # type: ignore[attr-defined]
        with pytest.raises(ReplyError, match="damaged packets, as two servos with one id do"):
            bus.read_position(1)
    bus.port.change = lambda _: b""  # type: ignore[attr-defined]
    with pytest.raises(ReplyError, match="does not answer in 3 tries"):
        bus.read_position(1)


def test_the_driver_never_writes_the_torque_switch_to_calibrate() -> None:
    """Catches 128 in torque_enable, which moves the zero of a Feetech servo for good."""
    bus = looped(servos(STS, 1, 2))
    bus.write_torque(1, True)
    bus.torque_off()
    loop: Any = bus.port
    assert isinstance(loop, Loop)
    writes = [wire for wire in loop.sent if wire[4] in (packets.WRITE, packets.SYNC_WRITE)]
    register = servo_model(STS).table["torque_enable"].address
    assert any(wire[5] == register for wire in writes)
    assert not any(128 in wire[6:-1] for wire in writes if wire[5] == register)


def lowered(number: int, *more: tuple[str, dict[str, Any]]) -> list[tuple[str, int]]:
    """What a servo is told when its program is gone in motion, with `release_s`."""
    events: list[tuple[str, int]] = []
    model = servo_model(number)
    servo = EmulatedServo(1, model, lambda _, name, value: events.append((name, value)))
    limits = SafetyLimits(lowest_rad=-1.0, highest_rad=1.0, release_s=0.1, hang_s=0.09)
    enable = ("enable", {"limits": limits.model_dump()})
    served([looped([servo])], enable, *more)  # type: ignore[list-item]
    assert not servo.is_on
    return events[events.index(("torque_enable", 1)) + 1 :]


@pytest.mark.parametrize("number", [STS, 1020])
def test_torque_falls_in_steps_before_it_is_off(number: int) -> None:
    """Catches an arm that drops, and a servo that keeps a limit of zero for the next program."""
    name = servo_model(number).effort_register
    events = lowered(number)
    off = events.index(("torque_enable", 0))
    steps = [value for what, value in events[:off] if what == name]
    assert len(steps) >= 3
    assert steps == sorted(steps, reverse=True)
    assert steps[-1] == 0
    assert events[-1] == (name, servo_model(number).table[name].initial)


def test_servos_without_such_a_limit_lose_their_torque_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Catches a wait that leaves a testbed under torque for nothing."""
    monkeypatch.setattr(bus_group, "_LOWER_S", math.nan)  # no time to sleep
    assert {name for name, _ in lowered(54024)} <= {"goal_position", "torque_enable"}


def test_a_fault_lets_torque_fall_too() -> None:
    """Catches a fall that is slow when the program ends, and a drop when something is wrong."""
    far = ("exchange", {"goals": [math.nan], "at": 0.0})
    events = lowered(STS, far)
    values = [value for name, value in events if name == "torque_limit"]
    assert 0 < min(set(values) - {0}) < 1000
    assert events.count(("torque_enable", 0)) >= 1


def test_an_unknown_register_or_joint_of_an_emulated_arm_is_refused() -> None:
    """Catches a setting that changes nothing, and servos without joints."""
    with pytest.raises(ConfigurationError, match="position_p_gain"):
        EmulatorConfig(model_number=STS, registers={"p_gain": 16})
    arm = {
        "model": "arm.xml",
        "joints": {"one": 100.0},
        "order": ["one"],
        "direction": [1],
        "zero_rad": [0.0],
    }
    with pytest.raises(ConfigurationError, match="one id for each of its joints"):
        EmulatorConfig(model_number=STS, ids=(1, 2), arm=arm)  # type: ignore[arg-type]


def test_a_bus_waits_for_the_wire_of_all_replies(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches six servos at 1 Mbit/s whose last replies come after the patience: a fixed time
    holds for a fast bus alone."""
    asked: list[float] = []
    bus = looped(servos(STS, *range(1, 7)))
    monkeypatch.setattr(Loop, "setPacketTimeoutMillis", lambda _, ms: asked.append(ms))
    bus.read_states(0.003)
    block = next(filter(bus.models[1].has_temperature, bus.models[1].blocks))
    assert asked[0] == pytest.approx(3.0 + 6 * 0.01 * (6 + len(block)))
    assert bus_group._LOWER_S < 0.05
