"""How emulated servos speak: instructions taken apart, replies put together, by protocol."""

from abc import ABC, abstractmethod
from typing import Protocol as Structure

from typing_extensions import override

from elastic_env.hardware.buses import feetech_packets, packets
from elastic_env.hardware.buses.packets import Packet, word, words
from elastic_env.hardware.buses.servo_models import Protocol


class Registers(Structure):
    """A servo, of which replies show some registers."""

    servo_id: int

    def __getitem__(self, name: str) -> int:
        """Value of a register [count]."""
        ...


class Wire(ABC):
    """Packets of one protocol, as the servos see them."""

    place_bytes: int
    """Length of address and length of an instruction to several servos."""

    @abstractmethod
    def parser(self) -> packets.Parser | feetech_packets.Parser:
        """A new parser of instructions."""

    @abstractmethod
    def place(self, parameters: bytes) -> tuple[int, int]:
        """Address and length at the beginning of an instruction."""

    @abstractmethod
    def written(self, parameters: bytes) -> tuple[int, bytes]:
        """Address and content of an instruction to write."""

    @abstractmethod
    def greeting(self, servo: Registers) -> bytes:
        """What a servo answers to a ping."""

    @abstractmethod
    def status(self, servo: Registers, error: int, data: bytes = b"") -> bytes:
        """A reply; `error` is that of Protocol 2.0, with its alert bit."""

    @abstractmethod
    def complaint(self, servo: Registers) -> list[bytes]:
        """What a servo answers to an instruction that arrived damaged."""


class DynamixelWire(Wire):
    """Dynamixel Protocol 2.0."""

    place_bytes = 4

    @override
    def parser(self) -> packets.Parser:
        return packets.Parser()

    @override
    def place(self, parameters: bytes) -> tuple[int, int]:
        return words(parameters)

    @override
    def written(self, parameters: bytes) -> tuple[int, bytes]:
        return words(parameters)[0], parameters[2:]

    @override
    def greeting(self, servo: Registers) -> bytes:
        return word(servo["model_number"]) + bytes([servo["firmware_version"]])

    @override
    def status(self, servo: Registers, error: int, data: bytes = b"") -> bytes:
        return packets.status(servo.servo_id, error, data)

    @override
    def complaint(self, servo: Registers) -> list[bytes]:
        return [packets.status(servo.servo_id, packets.CRC_ERROR)]


class FeetechWire(Wire):
    """Feetech STS and SMS.

    Nobody says how these refuse an instruction; here such a reply has no data.
    """

    place_bytes = 2

    @override
    def parser(self) -> feetech_packets.Parser:
        return feetech_packets.Parser()

    @override
    def place(self, parameters: bytes) -> tuple[int, int]:
        return parameters[0], parameters[1]

    @override
    def written(self, parameters: bytes) -> tuple[int, bytes]:
        return parameters[0], parameters[1:]

    @override
    def greeting(self, servo: Registers) -> bytes:
        return b""

    @override
    def status(self, servo: Registers, error: int, data: bytes = b"") -> bytes:
        return feetech_packets.packet(servo.servo_id, servo["hardware_error_status"], data)

    @override
    def complaint(self, servo: Registers) -> list[bytes]:
        return []


WIRES: dict[Protocol, Wire] = {"dynamixel": DynamixelWire(), "feetech": FeetechWire()}
"""How servos speak, by protocol."""


def is_ping_to_all(packet: Packet) -> bool:
    """True if every servo answers."""
    return packet.instruction == packets.PING and packet.servo_id == packets.BROADCAST
