"""Packets, control tables, late replies: against the maker's examples, the SDK's own functions,
and random bytes."""

import io
import itertools
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from dynamixel_sdk import COMM_SUCCESS
from dynamixel_sdk.protocol2_packet_handler import Protocol2PacketHandler
from hypothesis import given
from hypothesis import strategies as st

from elastic_env.core.errors import ConfigurationError
from elastic_env.hardware.buses import feetech_packets, packets
from elastic_env.hardware.buses.dynamixel_bus import DynamixelBus
from elastic_env.hardware.buses.packet_line import Status
from elastic_env.hardware.buses.servo_models import (
    LARGEST_TORQUE_NM,
    NUM_BLOCKS,
    servo_model,
    servo_models,
    torque_of_current,
)
from elastic_env.hardware.emulator.imu import attitude_packet, checksum
from elastic_env.hardware.emulator.servos import EmulatedServo
from elastic_env.hardware.errors import HardwareError
from elastic_env.hardware.settings import SafetyLimits
from elastic_env.joint.dynamixel import LOSS_NM, TORQUE_PER_CURRENT
from elastic_env.joint.small_servos import SMALL_SERVOS
from tests.lines import Loop

# of the ROBOTIS e-manual, Protocol 2.0: instruction or status, and the bytes on the wire
EXAMPLES = [
    ((1, packets.PING, b""), "FF FF FD 00 01 03 00 01 19 4E"),
    ((1, packets.STATUS, bytes([0, 6, 4, 0x26])), "FF FF FD 00 01 07 00 55 00 06 04 26 65 5D"),
    ((1, packets.READ, bytes([0x84, 0, 4, 0])), "FF FF FD 00 01 07 00 02 84 00 04 00 1D 15"),
    (
        (1, packets.WRITE, bytes([0x74, 0, 0, 2, 0, 0])),
        "FF FF FD 00 01 09 00 03 74 00 00 02 00 00 CA 89",
    ),
    (
        (254, packets.SYNC_READ, bytes([0x84, 0, 4, 0, 1, 2])),
        "FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA",
    ),
    ((1, 0x08, b""), "FF FF FD 00 01 03 00 08 2F 4E"),
]

# FT-SCS protocol manual (Feetech), likewise
FEETECH_EXAMPLES = [
    ((1, packets.PING, b""), "FF FF 01 02 01 FB"),
    ((1, packets.READ, bytes([0x38, 2])), "FF FF 01 04 02 38 02 BE"),
    ((1, 0, bytes([0x18, 5])), "FF FF 01 04 00 18 05 DD"),
    (
        (1, packets.WRITE, bytes([0x2A, 0, 8, 0, 0, 0xE8, 3])),
        "FF FF 01 09 03 2A 00 08 00 00 E8 03 D5",
    ),
]


@pytest.mark.parametrize(
    ("protocol", "content", "wire"),
    [
        *((packets, *example) for example in EXAMPLES),
        *((feetech_packets, *example) for example in FEETECH_EXAMPLES),
    ],
)
def test_packets_are_those_of_the_makers_examples(
    protocol: Any, content: tuple[int, int, bytes], wire: str
) -> None:
    """Catches a wrong checksum, byte order or length in what both our ends would agree on."""
    assert protocol.packet(*content) == bytes.fromhex(wire)
    found = protocol.Parser().parse(bytes.fromhex(wire))
    assert [(p.servo_id, p.instruction, p.parameters, p.is_intact) for p in found] == [
        (*content, True)
    ]


@given(st.binary(max_size=60))
def test_checksum_is_the_sdks(data: bytes) -> None:
    """Catches a table of ours that differs from the SDK's in a single entry."""
    assert packets.crc16(data) == Protocol2PacketHandler().updateCRC(0, list(data), len(data))


@given(st.binary(max_size=60).filter(lambda data: b"\xff\xff\xfd" not in data))
def test_packets_are_those_that_the_sdk_sends_and_reads(data: bytes) -> None:
    """Catches a layout of ours that the maker's own program would not understand; the SDK's
    stuffing is left out, which is wrong."""
    sdk = Protocol2PacketHandler()
    sent = bytearray()
    line: Any = SimpleNamespace(
        is_using=False,
        clearPort=lambda: None,
        writePort=lambda wire: sent.extend(wire) or len(wire),
    )
    length = packets.word(len(data) + 3)
    sdk.txPacket(line, [0, 0, 0, 0, 7, *length, packets.WRITE, *data, 0, 0])
    assert bytes(sent) == packets.packet(7, packets.WRITE, data)
    coming = io.BytesIO(packets.status(7, 0, data))
    line = SimpleNamespace(readPort=coming.read, isPacketTimeout=lambda: False)
    received, result = sdk.rxPacket(line, False)
    assert (result, bytes(received[9:-2])) == (COMM_SUCCESS, data)


def test_an_echo_of_the_instruction_is_no_reply() -> None:
    """Catches an adapter that echoes, whose echoes pass as answers or keep the answers out."""

    class Echo(Loop):
        def writePort(self, wire: bytes) -> int:  # noqa: N802
            self._coming += bytes(wire)
            return super().writePort(wire)

    bus = DynamixelBus("loop")
    bus.port = Echo([EmulatedServo(1, servo_model(1020), lambda *_: None)])  # type: ignore[assignment]
    bus.attach([1])
    bus.write_goal(1, 0.5)
    states = bus.read_states(0.003)
    assert states.is_fresh.all()
    assert [servo.model_number for servo in bus.scan()] == [1020]
    assert bus.num_retries == 0


@given(st.lists(st.sampled_from([0xFF, 0xFD, 0x00, 0x55]), max_size=30).map(bytes))
def test_stuffed_bytes_hold_no_header_and_come_back(data: bytes) -> None:
    """Catches a header that survives stuffing, and stuffing that takes a byte of the data away."""
    assert packets.stuff(data).replace(b"\xff\xff\xfd\xfd", b"").find(b"\xff\xff\xfd") < 0
    assert packets.unstuff(packets.stuff(data)) == data


@given(
    st.lists(
        st.lists(st.sampled_from([0xFF, 0xFD, 0x00, 0x07]), max_size=12).map(bytes),
        min_size=1,
        max_size=4,
    ),
    st.lists(st.integers(1, 9), min_size=1, max_size=8),
)
def test_parser_finds_packets_in_pieces_behind_noise(
    bodies: list[bytes], pieces: list[int]
) -> None:
    """Catches a parser that needs whole packets at a time, or that loses step by what lies
    before the first."""
    stream = b"\xff\xff\x00\xfd" + b"".join(packets.status(7, 0, body) for body in bodies)
    parser = packets.Parser()
    found = []
    at = 0
    for number in range(len(stream)):
        step = pieces[number % len(pieces)]
        found += parser.parse(stream[at : at + step])
        at += step
    assert [packet.parameters[1:] for packet in found] == bodies


def test_parser_gives_a_damaged_packet_as_damaged_and_goes_on() -> None:
    """Catches a flipped bit that is taken for data, and a lost tail that swallows the next
    packet."""
    good = packets.status(1, 0, b"\x01\x02\x03\x04")
    flipped = bytearray(good)
    flipped[10] ^= 1
    assert [p.is_intact for p in packets.Parser().parse(bytes(flipped) + good)] == [False, True]
    for end in range(4, len(good)):
        found = [p.parameters for p in packets.Parser().parse(good[:end] + good) if p.is_intact]
        assert found == [b"\x00\x01\x02\x03\x04"]


def test_a_checksum_that_completes_a_header_is_no_header() -> None:
    """Catches a packet that is dropped for the header in its end: goal −26843 to id 1 ends FF
    FF, its CRC FD 00."""
    goal = bytes([0x54, 2, 4, 0, 1]) + (-26_843).to_bytes(4, "little", signed=True)
    wire = packets.packet(packets.BROADCAST, packets.SYNC_WRITE, goal)
    assert wire.endswith(packets.HEADER)
    parser = packets.Parser()
    found = [packet for byte in wire + wire for packet in parser.parse(bytes([byte]))]
    assert [(p.parameters, p.is_intact) for p in found] == [(goal, True)] * 2


def test_tables_have_the_registers_of_the_maker() -> None:
    """Catches a shifted row of the data: addresses that the issue's robots rely on."""
    pro = servo_model(54024)
    advanced = servo_model(2020)
    assert [
        pro.table[name].address for name in ("torque_enable", "goal_position", "present_position")
    ] == [
        562,
        596,
        611,
    ]
    names = (
        "torque_enable",
        "goal_position",
        "present_current",
        "present_velocity",
        "present_position",
    )
    assert [advanced.table[name].address for name in names] == [512, 564, 574, 576, 580]
    assert not pro.has_watchdog
    assert advanced.has_watchdog
    assert servo_model(54025).table == advanced.table


@pytest.mark.parametrize("number", sorted(servo_models()))
def test_registers_do_not_overlap_and_blocks_are_of_whole_registers(number: int) -> None:
    """Catches a wrong size in the data, and a block whose lengths would not tell requests apart."""
    model = servo_model(number)
    registers = list(model.table.values())
    assert all(a.end <= b.address for a, b in itertools.pairwise(registers))
    lengths = {len(block) for block in model.blocks}
    assert len(lengths) == len(model.blocks) == NUM_BLOCKS
    with pytest.raises(
        ConfigurationError, match="patience_cycles"
    ):  # a motion ends before a length comes again
        SafetyLimits(patience_cycles=len(lengths))
    for block in model.blocks:
        assert block.start in {register.address for register in registers}
        assert block.stop in {register.end for register in registers}
        for name in ("present_position", "present_velocity", model.load_register):
            assert block.start <= model.table[name].address < model.table[name].end <= block.stop


@given(st.lists(st.sampled_from([0, 0, 1, 2, 4, 10, NUM_BLOCKS - 1, math.inf]), max_size=60))
def test_a_late_reply_is_never_taken_for_another_requests(lateness: list[float]) -> None:
    """Catches a reply of some cycles ago that passes as new; each says in its position which
    request it answers."""
    model = servo_model(54024)
    position = model.table["present_position"]
    on_the_way: dict[float, list[bytes]] = {}

    class Line(DynamixelBus):
        """A bus whose servo answers a request so many requests later."""

        requests = 0

        def _transmit(self, servo_id: int, instruction: int, data: bytes) -> None:
            assert (servo_id, instruction) == (packets.BROADCAST, packets.SYNC_READ)
            start, length = (int.from_bytes(data[i : i + 2], "little") for i in (0, 2))
            reply = bytearray(length)
            at = position.address - start
            reply[at : at + position.size] = position.encode(self.requests)
            on_the_way.setdefault(self.requests + lateness[self.requests], []).append(bytes(reply))

        def _receive(self) -> Status | None:
            waiting = on_the_way.get(self.requests)
            return Status(1, 0, False, waiting.pop(0)) if waiting else None

    bus = Line("nowhere")
    bus.attach_known({1: model.number})
    for bus.requests, late in enumerate(lateness):
        states = bus.read_states(0.0)
        assert states.is_fresh.tolist() == [late == 0]
        if late == 0:
            assert states.position == pytest.approx([bus.requests * model.position_unit])


def test_units_are_the_makers() -> None:
    """Catches counts of one model used for another: half a turn, 33.1 rpm without load, 9.99 A
    of current limit."""
    assert 250_961.5 * servo_model(54024).position_unit == pytest.approx(np.pi)
    assert 501_923 * servo_model(2020).position_unit == pytest.approx(np.pi)
    assert 620 * servo_model(54024).current_unit == pytest.approx(9.99, abs=0.005)
    assert 2900 * servo_model(2020).velocity_unit == pytest.approx(29.0 * 2 * np.pi / 60)
    assert 17000 * servo_model(54024).velocity_unit == pytest.approx(
        33.87 * 2 * np.pi / 60, rel=1e-4
    )


def test_unknown_names_are_answered_with_those_that_exist() -> None:
    """Catches a KeyError in place of a message."""
    with pytest.raises(HardwareError, match="54024"):
        servo_model(1021)
    with pytest.raises(ConfigurationError, match="goal_position"):
        servo_models()[54024].table["goal_positon"]
    with pytest.raises(HardwareError, match="does not fit"):
        servo_models()[54024].table["goal_torque"].encode(40_000)
    assert servo_model(54024).explain_errors(0b100100) == "overheating, overload"
    assert servo_model(777).explain_errors(0b101000) == "overcurrent, overload"


@pytest.mark.parametrize("number", sorted(servo_models()))
def test_torque_line_runs_both_ways(number: int) -> None:
    """Catches a sign or an offset that emulator and driver would not share."""
    model = servo_model(number)
    for torque in (-52.5, -1.0, 0.5, 34.6):
        current = np.array(model.current(torque))
        found = torque_of_current(current, model.torque_per_ampere, model.loss)
        assert found == pytest.approx(torque)


def test_the_torque_line_of_the_table_is_that_of_the_joint() -> None:
    """Catches a figure that is changed in one of two places."""
    model = servo_model(54024)
    assert (model.torque_per_ampere, model.loss) == (TORQUE_PER_CURRENT, LOSS_NM)
    assert torque_of_current(np.array(0.3), model.torque_per_ampere, model.loss) == 0.0
    assert model.largest_torque == LARGEST_TORQUE_NM
    for name in ("STS3215", "STS3250"):
        (small,) = (one for one in servo_models().values() if one.name == name)
        motor = SMALL_SERVOS[name].motor
        assert small.torque_per_ampere == pytest.approx(motor.torque_constant, rel=1e-3)
        assert 1e3 * small.current_unit == pytest.approx(motor.voltage / motor.resistance, rel=1e-3)
        assert small.largest_torque == pytest.approx(0.8 * motor.stall_torque, rel=0.01)


def test_ping_of_the_imus_protocol_has_the_makers_checksum() -> None:
    """Catches a checksum that only our own reader would accept: 75 65 01 02 02 01 E0 C6 is the
    maker's ping."""
    assert checksum(bytes.fromhex("756501020201")) == bytes.fromhex("E0C6")
    packet = attitude_packet(0.1, -0.2, 0.3, 1.0)
    assert packet[:4] == bytes([0x75, 0x65, 0x82, len(packet) - 6])
