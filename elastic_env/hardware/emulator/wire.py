"""The emulated bus: hands instructions to its servos and orders what they answer, as the protocol says."""

from collections.abc import Sequence

from elastic_env.hardware.emulator.servo import EmulatedServo
from elastic_env.hardware.servo_bus import protocol
from elastic_env.hardware.servo_bus.protocol import Packet


class EmulatedBus:
    """Servos that hear the same instructions.

    Args:
        servos: In any order.
    """

    def __init__(self, servos: Sequence[EmulatedServo]) -> None:
        self.servos = {servo.servo_id: servo for servo in servos}

    def answer(self, packet: Packet, now_s: float) -> list[bytes]:
        """Replies to an instruction, each as it goes over the wire, in their order."""
        for servo in self.servos.values():
            servo.hear(now_s)
        if not packet.is_intact:
            servo = self.servos.get(packet.servo_id)
            return [] if servo is None else [protocol.status(packet.servo_id, protocol.CRC_ERROR)]
        match packet.instruction:
            case protocol.STATUS:
                return []
            case protocol.SYNC_READ | protocol.FAST_SYNC_READ:
                address, length = _words(packet.parameters)
                asked = [(servo_id, address, length) for servo_id in packet.parameters[4:]]
                return self._read(asked, packet.instruction == protocol.FAST_SYNC_READ)
            case protocol.BULK_READ | protocol.FAST_BULK_READ:
                groups = [packet.parameters[i : i + 5] for i in range(0, len(packet.parameters), 5)]
                asked = [(group[0], *_words(group[1:])) for group in groups]
                return self._read(asked, packet.instruction == protocol.FAST_BULK_READ)
            case protocol.SYNC_WRITE:
                self._sync_write(packet.parameters)
                return []
            case protocol.BULK_WRITE:
                self._bulk_write(packet.parameters)
                return []
            case protocol.PING if packet.servo_id == protocol.BROADCAST:
                return [reply for servo_id in sorted(self.servos) for reply in self._single(servo_id, packet)]
            case _ if packet.servo_id == protocol.BROADCAST:
                for servo in list(self.servos.values()):
                    servo.answer(packet.instruction, packet.parameters)
                return []
            case _:
                return self._single(packet.servo_id, packet)

    def _single(self, servo_id: int, packet: Packet) -> list[bytes]:
        servo = self.servos.get(servo_id)
        reply = None if servo is None else servo.answer(packet.instruction, packet.parameters)
        if servo is None or reply is None:
            return []
        if servo.servo_id != servo_id:
            self.servos[servo.servo_id] = self.servos.pop(servo_id)
        return [protocol.status(servo_id, *reply)]

    def _read(self, asked: Sequence[tuple[int, int, int]], is_fast: bool) -> list[bytes]:
        replies = [(i, *self.servos[i].read(address, length)) for i, address, length in asked if i in self.servos]
        if not is_fast:
            return [protocol.status(servo_id, error, data) for servo_id, error, data in replies]
        return [_joined(replies)] if len(replies) == len(asked) else []

    def _sync_write(self, parameters: bytes) -> None:
        address, length = _words(parameters)
        for at in range(4, len(parameters) - length, length + 1):
            servo = self.servos.get(parameters[at])
            if servo is not None:
                servo.write(address, parameters[at + 1 : at + 1 + length])

    def _bulk_write(self, parameters: bytes) -> None:
        at = 0
        while at + 5 <= len(parameters):
            address, length = _words(parameters[at + 1 :])
            servo = self.servos.get(parameters[at])
            if servo is not None:
                servo.write(address, parameters[at + 5 : at + 5 + length])
            at += 5 + length


def _words(parameters: bytes) -> tuple[int, int]:
    return int.from_bytes(parameters[:2], "little"), int.from_bytes(parameters[2:4], "little")


def _joined(replies: Sequence[tuple[int, int, bytes]]) -> bytes:
    """A fast reply: one packet, in which every servo's part but the last ends with a checksum of all up to there."""
    content = b"".join(bytes([error, servo_id]) + data for servo_id, error, data in replies)
    length = 1 + len(content) + 2 * len(replies)
    sent = protocol.HEADER + bytes([protocol.BROADCAST]) + length.to_bytes(2, "little") + bytes([protocol.STATUS])
    for servo_id, error, data in replies:
        sent += bytes([error, servo_id]) + data
        sent += protocol.crc16(sent).to_bytes(2, "little")
    return sent
