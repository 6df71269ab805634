"""Dynamixel servos of Protocol 2.0, by dynamixel-sdk: PRO, P, X, and MX that are set to it."""

from typing_extensions import override

from elastic_env.hardware.buses import packets
from elastic_env.hardware.buses import port as ports
from elastic_env.hardware.buses.bus import ServoInfo
from elastic_env.hardware.buses.packets import word
from elastic_env.hardware.buses.port import bus_gone, sdk
from elastic_env.hardware.buses.servo_bus import DAMAGED, ServoBus, Status
from elastic_env.hardware.errors import ReplyError


class DynamixelBus(ServoBus):
    """Dynamixel servos of Protocol 2.0 on a port, see `ServoBus`."""

    protocol = "dynamixel"
    rates = packets.RATES
    position_mode = 3
    full_replies = 2
    status_bytes = 11
    word_bytes = 2
    ping_bytes = 3
    patience_s = 0.003
    slowest_trip_s = 2.5e-3

    def __init__(self, port: str, baudrate: int | None = None) -> None:
        super().__init__(port, baudrate)
        self._handler = ports.PacketHandler()

    @override
    def scan(self) -> list[ServoInfo]:
        with bus_gone(self.name):
            answers, _ = self._handler.broadcastPing(self.port)
        return [ServoInfo(i, *values) for i, values in sorted(answers.items())]

    @override
    def ping(self, servo_id: int) -> ServoInfo:
        reply = self.knock(servo_id)
        return ServoInfo(servo_id, int.from_bytes(reply[:2], "little"), reply[2])

    @override
    def _transmit(self, servo_id: int, instruction: int, data: bytes) -> None:
        length = word(len(data) + 3)
        frame = [0, 0, 0, 0, servo_id, *length, instruction, *data, 0, 0]
        self.port.release()
        with bus_gone(self.name):
            result = self._handler.txPacket(self.port, frame)
        if result:  # 0 is success
            problem = self._handler.getTxRxResult(result)
            raise ReplyError(f"cannot send at {self.name}: {problem}")

    @override
    def _receive(self) -> Status | None:
        with bus_gone(self.name):
            received, result = self._handler.rxPacket(self.port, False)
        if result == sdk.COMM_RX_CORRUPT:
            return DAMAGED
        if result:
            return None
        error = received[8]
        return Status(
            servo_id=received[4],
            error=error & ~packets.ALERT,
            has_alert=bool(error & packets.ALERT),
            data=bytes(received[9:-2]),
        )
