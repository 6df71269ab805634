"""Emulated servos and their bus: registers with their rules, and answers to instructions."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from elastic_env.hardware.buses import feetech_packets, packets, servo_models
from elastic_env.hardware.buses.packets import Packet, word
from elastic_env.hardware.buses.servo_models import Protocol, Register, ServoModel

Notify = Callable[[int, str, int], None]

_COOL_C = 35
_HOT_C = 95
_FIRMWARE = 38
_SUPPLY_DV = 240
_SWITCHES = ("torque_enable", "goal_position", "bus_watchdog")
_WATCHDOG_UNIT_S = 0.02
_WATCHDOG_FIRED = -1


@dataclass
class EmulatedServo:
    """One servo on an emulated bus.

    Attributes:
        servo_id: Id of the servo.
        model: Type of the servo, with its registers and units.
        notify: Called with id, register and value when torque, goal or watchdog change.
        motion: Returns the measured angle [rad], its rate [rad/s] and torque [N·m].
        registers: Values that differ from the factory settings, by name [count].
    """

    servo_id: int
    model: ServoModel
    notify: Notify
    motion: Callable[[], tuple[float, float, float]] = lambda: (0.0, 0.0, 0.0)
    registers: Mapping[str, int] = field(default_factory=dict)
    _memory: bytearray = field(init=False)
    _heard_s: float = 0.0

    def __post_init__(self) -> None:
        self._memory = bytearray(self.model.table.size)
        for register in self.model.table.values():
            self[register.name] = register.initial
        self["model_number"] = self.model.number
        self["firmware_version"] = _FIRMWARE
        self["id"] = self.servo_id
        self["return_delay_time"] = 0
        if limit := self.model.current_limit:
            strongest = self.model.current(self.model.largest_torque)
            self[limit] = min(self[limit], int(strongest / self.model.current_unit))
        ends = (self["min_voltage_limit"], self["max_voltage_limit"])
        is_usual = ends[0] < _SUPPLY_DV < ends[1]
        self["present_input_voltage"] = _SUPPLY_DV if is_usual else sum(ends) // 2
        for name, value in self.registers.items():
            self[name] = value
        self.heat(False)

    def __getitem__(self, name: str) -> int:
        """Value of a register [count]."""
        register = self.model.table[name]
        return register.decode(self._memory[register.address : register.end])

    def __setitem__(self, name: str, value: int) -> None:
        """Set a register [count], without the rules of instructions."""
        register = self.model.table[name]
        self._memory[register.address : register.end] = register.encode(value)

    @property
    def is_on(self) -> bool:
        """True if torque is on."""
        return bool(self["torque_enable"])

    @property
    def goal(self) -> float:
        """Goal position [rad]."""
        return self.model.angle(self["goal_position"])

    @property
    def effort(self) -> float:
        """Share of its torque that it may give."""
        name = self.model.effort_register
        return self[name] / self[self.model.effort_maximum] if name else 1.0

    def measure(self) -> None:
        """Write the measured motion into the registers."""
        position, velocity, torque = self.motion()
        self["present_position"] = self.model.count(position)
        self["present_velocity"] = round(velocity / self.model.velocity_unit)
        load = self.model.current(torque) / self.model.current_unit
        self[self.model.load_register] = round(load)

    def heat(self, is_hot: bool) -> None:
        """Make the servo hot or cool; only the temperature shows it."""
        self["present_temperature"] = _HOT_C if is_hot else _COOL_C

    def overload(self, is_overloaded: bool) -> None:
        """Begin or end an overload: the status shows it, and torque goes off."""
        self["hardware_error_status"] = servo_models.OVERLOAD if is_overloaded else 0
        if is_overloaded and self.is_on:
            self._change("torque_enable", 0)

    def watch(self, now_s: float) -> None:
        """Stop at the present position if the bus has been silent longer than the watchdog allows.

        Torque stays on, and goals are refused until 0 is written to the watchdog (e-manual, Bus
        Watchdog).
        """
        if not self.model.has_watchdog or self["bus_watchdog"] <= 0:
            return
        if now_s - self._heard_s > self["bus_watchdog"] * _WATCHDOG_UNIT_S:
            self.measure()
            self._change("goal_position", self["present_position"])
            self._change("bus_watchdog", _WATCHDOG_FIRED)

    def hear(self, now_s: float) -> None:
        """Note an instruction on the bus, for any servo."""
        self._heard_s = now_s

    def answer(self, instruction: int, parameters: bytes) -> bytes:
        """Reply to an instruction, as bytes on the wire."""
        wire = WIRES[self.model.protocol]
        match instruction:
            case packets.PING:
                version = word(self["model_number"]) + bytes([self["firmware_version"]])
                return wire.status(self, self._alert, version if wire.is_talkative else b"")
            case packets.READ if len(parameters) == 2 * wire.word_bytes:
                return wire.status(self, *self.read_memory(*wire.place(parameters)))
            case packets.WRITE if len(parameters) > wire.word_bytes:
                address, _ = wire.place(parameters)
                data = parameters[wire.word_bytes :]
                return wire.status(self, self.write_memory(address, data))
            case _:
                return wire.status(self, packets.INSTRUCTION_ERROR | self._alert)

    def read_memory(self, address: int, length: int) -> tuple[int, bytes]:
        """Error number and bytes; addresses beyond the table are refused."""
        if address + length > len(self._memory) or length == 0:
            return packets.ACCESS_ERROR | self._alert, b""
        self.measure()
        return self._alert, bytes(self._memory[address : address + length])

    def write_memory(self, address: int, data: bytes) -> int:
        """Write whole registers from an address on, all or none.

        Returns:
            Error number; if it is one, nothing is written.
        """
        values: dict[str, int] = {}
        end = address + len(data)
        while address < end:
            register = self.model.table.find(address)
            if register is None or register.address != address:
                return packets.ACCESS_ERROR | self._alert
            is_locked = register.memory == "EEPROM" and self.is_on
            if is_locked or not register.is_writable:
                return packets.ACCESS_ERROR | self._alert
            if register.end > end:
                return packets.LENGTH_ERROR | self._alert
            value = register.decode(data[: register.size])
            error = self._refusal(register, value)
            if error:
                return error | self._alert
            values[register.name] = value
            data = data[register.size :]
            address = register.end
        for name, value in values.items():
            self._change(name, value)
        return self._alert

    def _refusal(self, register: Register, value: int) -> int:
        """Error number of a value that the servo refuses, 0 if it accepts."""
        if (
            register.name.startswith("goal_")
            and self.model.has_watchdog
            and self["bus_watchdog"] == _WATCHDOG_FIRED
        ):
            return packets.RANGE_ERROR
        match register.name:
            case "goal_position" if self.model.protocol == "feetech":
                return 0  # a goal beyond the limits is clipped, see `_change`
            case "goal_position":
                lowest = self["min_position_limit"]
                is_within = lowest <= value <= self["max_position_limit"]
                return 0 if is_within else packets.LIMIT_ERROR
            case "torque_enable" if value not in (0, 1):
                return packets.RANGE_ERROR
            case "torque_enable":
                has_error = self["hardware_error_status"] != 0
                return packets.RESULT_FAIL if value and has_error else 0
            case _:
                return 0

    def _change(self, name: str, value: int) -> None:
        """Store a value, and notify the joint.

        A servo that gets torque keeps its goal and moves to it: no manual excludes this.
        """
        if name == "goal_position" and self.model.protocol == "feetech":
            value = max(value, self["min_position_limit"])
            value = min(value, self["max_position_limit"])
        self[name] = value
        if name in (*_SWITCHES, self.model.effort_register):
            self.notify(self.servo_id, name, value)

    @property
    def _alert(self) -> int:
        return packets.ALERT if self["hardware_error_status"] else 0


@dataclass(frozen=True)
class Wire:
    """Differences between the protocols, as servos speak them.

    Attributes:
        word_bytes: Length of an address, and of a length, in an instruction.
        parser: Parser of instructions.
        status: Encodes a reply of a servo; its error is that of Protocol 2.0, with its alert bit.
        is_talkative: True if a ping gives the model, and damaged instructions are answered.
    """

    word_bytes: int
    parser: type[packets.Parser]
    status: Callable[..., bytes]
    is_talkative: bool

    def place(self, parameters: bytes) -> tuple[int, int]:
        """Address and length at the beginning of an instruction."""
        length = self.word_bytes
        numbers = (parameters[:length], parameters[length : 2 * length])
        address, size = (int.from_bytes(number, "little") for number in numbers)
        return address, size


def _dynamixel_status(servo: EmulatedServo, error: int, data: bytes = b"") -> bytes:
    return packets.status(servo.servo_id, error, data)


def _feetech_status(servo: EmulatedServo, _: int, data: bytes = b"") -> bytes:
    """Encode a reply; no manual says how these servos refuse, so a refusal has no data."""
    status = servo["hardware_error_status"]
    return feetech_packets.packet(servo.servo_id, status, data)


WIRES: dict[Protocol, Wire] = {
    "dynamixel": Wire(2, packets.Parser, _dynamixel_status, is_talkative=True),
    "feetech": Wire(1, feetech_packets.Parser, _feetech_status, is_talkative=False),
}
"""Differences between the protocols, by protocol."""


class EmulatedBus:
    """Passes instructions to its servos, and orders their replies as the protocol requires.

    Args:
        servos: Servos of one protocol, in any order.
    """

    def __init__(self, servos: Sequence[EmulatedServo]) -> None:
        self.servos = {servo.servo_id: servo for servo in servos}
        self.wire = WIRES[servos[0].model.protocol]

    def answer(self, packet: Packet, now_s: float) -> list[bytes]:
        """Replies to an instruction in their order, as bytes on the wire."""
        for servo in self.servos.values():
            servo.hear(now_s)
        if not packet.is_intact:
            addressed = self.servos.get(packet.servo_id)
            if addressed is None or not self.wire.is_talkative:
                return []
            return [self.wire.status(addressed, packets.CRC_ERROR)]
        parameters = packet.parameters
        begin = 2 * self.wire.word_bytes
        match packet.instruction:
            case packets.SYNC_READ:
                place = self.wire.place(parameters)
                named = [self.servos[i] for i in parameters[begin:] if i in self.servos]
                return [self.wire.status(s, *s.read_memory(*place)) for s in named]
            case packets.SYNC_WRITE:
                address, length = self.wire.place(parameters)
                for at in range(begin, len(parameters) - length, length + 1):
                    if servo := self.servos.get(parameters[at]):
                        data = parameters[at + 1 : at + 1 + length]
                        servo.write_memory(address, data)
                return []
        is_ping = packet.instruction == packets.PING
        is_to_all = is_ping and packet.servo_id == packets.BROADCAST
        ids = sorted(self.servos) if is_to_all else [packet.servo_id]
        chosen = [self.servos[i] for i in ids if i in self.servos]
        return [servo.answer(packet.instruction, parameters) for servo in chosen]
