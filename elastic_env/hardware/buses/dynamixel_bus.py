"""Dynamixel servos of Protocol 2.0: PRO, P, X, and MX that are set to it."""

from typing_extensions import override

from elastic_env.hardware.buses import packets
from elastic_env.hardware.buses.bus import ServoInfo
from elastic_env.hardware.buses.packet_line import STRANGE, Status
from elastic_env.hardware.buses.packets import Packet
from elastic_env.hardware.buses.servo_bus import ServoBus


class DynamixelBus(ServoBus):
    """Dynamixel servos of Protocol 2.0 at a port."""

    protocol = "dynamixel"
    rates = packets.RATES
    packet = staticmethod(packets.packet)
    parser = packets.Parser
    position_mode = 3
    full_replies = 2
    status_bytes = 11
    word_bytes = 2
    ping_bytes = 3
    patience_s = 0.003
    slowest_trip_s = 2.5e-3

    @override
    def _identify(self, servo_id: int, answer: bytes) -> ServoInfo:
        return ServoInfo(servo_id, int.from_bytes(answer[:2], "little"), answer[2])

    @override
    def _status(self, packet: Packet) -> Status:
        if packet.instruction != packets.STATUS or not packet.parameters:
            return STRANGE  # such as our own instruction, which some adapters echo
        error = packet.parameters[0]
        return Status(
            servo_id=packet.servo_id,
            error=error & ~packets.ALERT,
            has_alert=bool(error & packets.ALERT),
            data=packet.parameters[1:],
        )
