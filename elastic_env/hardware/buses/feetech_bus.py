"""Feetech servos of the series STS and SMS, such as STS3215 and STS3250."""

from typing_extensions import override

from elastic_env.hardware.buses import feetech_packets, packets
from elastic_env.hardware.buses.bus import ServoInfo
from elastic_env.hardware.buses.packet_line import Status
from elastic_env.hardware.buses.packets import Packet
from elastic_env.hardware.buses.servo_bus import ServoBus
from elastic_env.hardware.buses.servo_models import servo_models

_IDENTITY = ("firmware_version", "model_number")


class FeetechBus(ServoBus):
    """Feetech servos of the series STS and SMS at a port.

    A status contains no refusal, only the bits of `hardware_error_status`.
    """

    protocol = "feetech"
    rates = feetech_packets.RATES
    packet = staticmethod(feetech_packets.packet)
    parser = feetech_packets.Parser
    position_mode = 0
    full_replies = 1
    status_bytes = 6
    word_bytes = 1
    ping_bytes = 0
    patience_s = 0.006
    slowest_trip_s = 5e-3

    @override
    def _identify(self, servo_id: int, answer: bytes) -> ServoInfo:
        models = servo_models().values()
        table = next(model.table for model in models if model.protocol == "feetech")
        first, last = (table[name] for name in _IDENTITY)
        length = last.end - first.address
        place = self._place(first.address, length)
        reply = self._request(servo_id, packets.READ, place, length)
        return ServoInfo(servo_id, int.from_bytes(reply[-2:], "little"), reply[0])

    @override
    def _status(self, packet: Packet) -> Status:
        return Status(packet.servo_id, 0, bool(packet.instruction), packet.parameters)
