"""The emulated servo: registers, rights, errors, watchdog, and the order of replies, without any
terminal."""

import numpy as np
import pytest

from elastic_env.core.errors import ConfigurationError
from elastic_env.hardware.buses import packets
from elastic_env.hardware.buses.packets import Packet, Parser
from elastic_env.hardware.buses.servo_models import servo_model
from elastic_env.hardware.emulator.joints import Joints
from elastic_env.hardware.emulator.launch import EmulatorConfig, Faults, damage
from elastic_env.hardware.emulator.servos import EmulatedBus, EmulatedServo
from elastic_env.motion.trajectory import quintic
from elastic_env.robots.testbed.config import TestbedConfig
from elastic_env.world.scenario import make_scenario


def make_servo(number: int = 54024, servo_id: int = 1) -> EmulatedServo:
    return EmulatedServo(servo_id, servo_model(number), lambda *_: None)


def write(servo: EmulatedServo, name: str, value: int) -> int:
    register = servo.model.table[name]
    return servo.write_memory(register.address, register.encode(value))


def read(servo: EmulatedServo, name: str) -> int:
    register = servo.model.table[name]
    error, data = servo.read_memory(register.address, register.size)
    assert error & ~packets.ALERT == 0
    return register.decode(data)


def test_registers_keep_their_rights() -> None:
    """Catches a servo that lets itself be written where the real one refuses."""
    servo = make_servo()
    assert write(servo, "present_position", 5) == packets.ACCESS_ERROR
    assert write(servo, "goal_position", 300_000) == packets.LIMIT_ERROR
    assert write(servo, "torque_enable", 2) == packets.RANGE_ERROR
    assert servo.write_memory(596, b"\x01\x02") == packets.LENGTH_ERROR
    assert servo.write_memory(597, b"\x01\x02\x03\x04") == packets.ACCESS_ERROR
    assert write(servo, "goal_position", -131_073) == 0
    assert read(servo, "goal_position") == -131_073


def test_eeprom_is_locked_while_torque_is_on() -> None:
    """Catches an emulator on which a driver could change limits in motion."""
    servo = make_servo()
    assert write(servo, "max_position_limit", 100_000) == 0
    assert write(servo, "torque_enable", 1) == 0
    assert write(servo, "max_position_limit", 200_000) == packets.ACCESS_ERROR
    assert read(servo, "max_position_limit") == 100_000


def test_a_servo_that_gets_torque_keeps_its_goal() -> None:
    """Catches an emulator that forgives a program which switches torque on before it has set the
    goal."""
    servo = EmulatedServo(1, servo_model(54024), lambda *_: None, motion=lambda: (0.25, 0.0, 0.0))
    write(servo, "goal_position", 1000)
    write(servo, "torque_enable", 1)
    assert read(servo, "goal_position") == 1000


def test_overload_lets_go_and_raises_the_alert_bit_with_every_reply() -> None:
    """Catches an alert that comes as an error: it arrives with success, which a driver must not
    overlook."""
    servo = make_servo()
    write(servo, "torque_enable", 1)
    servo.overload(True)
    assert not servo.is_on
    error, data = servo.read_memory(611, 4)
    assert error == packets.ALERT
    assert len(data) == 4
    assert write(servo, "torque_enable", 1) == packets.ALERT | packets.RESULT_FAIL


def test_watchdog_stops_models_that_have_one() -> None:
    """Catches a watchdog that fires while the bus speaks, or never, or on the firmware that has
    none.

    A fired one holds the servo where it is, under torque, and refuses goals until it is cleared.
    """
    servo = make_servo(2020)
    servo.hear(10.0)
    write(servo, "torque_enable", 1)
    write(servo, "bus_watchdog", 3)
    write(servo, "goal_position", 5000)
    servo.watch(10.05)
    assert read(servo, "goal_position") == 5000
    servo.watch(10.07)
    assert servo.is_on
    assert (read(servo, "goal_position"), read(servo, "bus_watchdog")) == (0, -1)
    assert write(servo, "goal_position", 5000) == packets.RANGE_ERROR
    write(servo, "bus_watchdog", 0)
    assert write(servo, "goal_position", 5000) == 0
    old = make_servo(54024)
    old.hear(0.0)
    write(old, "goal_position", 5000)
    old.watch(100.0)
    assert read(old, "goal_position") == 5000


def answers(bus: EmulatedBus, wire: bytes) -> list[Packet]:
    (instruction,) = Parser().parse(wire)
    return [reply for sent in bus.answer(instruction, 0.0) for reply in Parser().parse(sent)]


def test_sync_instructions_reach_their_servos_in_order() -> None:
    """Catches a group that is cut at the wrong byte, and replies in the order of ids instead of
    the request's."""
    bus = EmulatedBus([make_servo(servo_id=i) for i in (1, 2, 3)])
    values = {1: -131_073, 3: 77}
    data = b"".join(bytes([i]) + v.to_bytes(4, "little", signed=True) for i, v in values.items())
    assert (
        answers(bus, packets.packet(0xFE, packets.SYNC_WRITE, bytes([0x54, 2, 4, 0]) + data)) == []
    )
    replies = answers(bus, packets.packet(0xFE, packets.SYNC_READ, bytes([0x54, 2, 4, 0, 3, 1, 2])))
    assert [r.servo_id for r in replies] == [3, 1, 2]
    assert [int.from_bytes(r.parameters[1:], "little", signed=True) for r in replies] == [
        77,
        -131_073,
        0,
    ]


def test_damaged_instruction_is_answered_with_an_error_and_not_obeyed() -> None:
    """Catches a servo that moves on a packet whose checksum is wrong."""
    servo = make_servo()
    wire = bytearray(packets.packet(1, packets.WRITE, bytes([0x32, 2, 1])))
    wire[10] ^= 0x02
    (reply,) = answers(EmulatedBus([servo]), bytes(wire))
    assert reply.parameters[0] == packets.CRC_ERROR
    assert not servo.is_on


def test_faults_come_as_often_as_they_are_asked_for() -> None:
    """Catches a switch that does nothing, or that damages what it should leave alone."""
    generator = np.random.default_rng(0)
    reply = packets.status(1, 0, b"\x01\x02\x03\x04")
    half = [damage(Faults(lost=0.5), reply, generator)[0] for _ in range(400)]
    assert 150 < half.count(b"") < 250
    assert all(damage(Faults(), reply, generator) == (reply, 0.0) for _ in range(20))
    changed = [damage(Faults(corrupted=1.0), reply, generator)[0] for _ in range(20)]
    assert all(
        sum(bin(a ^ b).count("1") for a, b in zip(c, reply, strict=True)) == 1 for c in changed
    )
    assert all(
        len(damage(Faults(truncated=1.0), reply, generator)[0]) < len(reply) for _ in range(20)
    )
    assert damage(Faults(late=1.0, late_s=0.01, latency_s=0.016), reply, generator)[
        1
    ] == pytest.approx(0.026)


def test_emulated_joint_is_the_testbeds_own() -> None:
    """Catches a second model of the plant: at rest the spring carries what gravity asks for."""
    config = TestbedConfig(scenario=make_scenario("ideal"))
    joints = Joints(config, 2, start_s=0.0)
    joints.set_torque(0, 1.0)
    for step, share in enumerate(quintic(np.arange(1200) / 500)[0]):
        joints.command(0, 0.5 * float(share))
        joints.advance(0.004 * step)
    deflection = joints.theta - joints.q
    torque = config.true_pendulum.torque(joints.q)
    assert config.true_joint.stiffness * deflection[0] == pytest.approx(torque[0], rel=2e-3)
    assert torque[0] > 25.0
    assert joints.motion(0)[0] == joints.theta[0]
    assert joints.motion(0)[2] == pytest.approx(torque[0], rel=0.1)
    assert joints.q[1] == 0.0
    joints.set_torque(0, 0.0)
    joints.advance(4.9)
    assert joints.motion(0)[2] == 0.0


def test_emulator_that_cannot_be_is_refused() -> None:
    """Catches two servos of one id, and an id that the protocol keeps for itself."""
    for ids in ((1, 1), (0xFD,), ()):
        with pytest.raises(ConfigurationError, match="ids"):
            EmulatorConfig(ids=ids)
