"""An emulated servo: its registers with their rules, and what it answers to the instructions of Protocol 2.0."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from elastic_env.hardware.servo_bus import protocol
from elastic_env.hardware.servo_bus.control_table import Register, ServoModel
from elastic_env.hardware.servo_bus.torque_line import LARGEST_TORQUE_NM, current_of_torque

OVERLOAD = 1 << 5
"""Bit of an overload in the hardware error status."""

_COOL_C, _HOT_C = 35, 95

_SWITCHES = ("torque_enable", "goal_position", "bus_watchdog")
_WATCHDOG_UNIT_S = 0.02
_WATCHDOG_FIRED = -1

Notify = Callable[[int, str, int], None]


class Motor(Protocol):
    """What a servo measures of its motor side, now."""

    @property
    def position(self) -> float:
        """Angle [rad]."""
        ...

    @property
    def velocity(self) -> float:
        """Its rate [rad/s]."""
        ...

    @property
    def torque(self) -> float:
        """Torque of the servo [N·m]."""
        ...


@dataclass
class MotorAtRest:
    """A motor that nothing moves."""

    position: float = 0.0
    velocity: float = 0.0
    torque: float = 0.0


@dataclass
class EmulatedServo:
    """One servo on an emulated bus.

    Attributes:
        servo_id: Its id.
        model: Its type, by which its registers and units go.
        notify: Called with id, register and value when torque, goal or watchdog change.
        model_number: What it says that it is; another one than its type's to try out that case.
        motor: What it measures.
    """

    servo_id: int
    model: ServoModel
    notify: Notify
    model_number: int | None = None
    motor: Motor = field(default_factory=MotorAtRest)
    _memory: bytearray = field(init=False)
    _registered: tuple[int, bytes] | None = None
    _heard_s: float = 0.0

    def __post_init__(self) -> None:
        self._memory = bytearray(self.model.table.size)
        self._restore()

    def _restore(self) -> None:
        for register in self.model.table.values():
            self._store(register, register.initial)
        self._set("model_number", self.model_number or self.model.number)
        self._set("firmware_version", 38)
        self._set("id", self.servo_id)
        self._set("return_delay_time", 0)
        current_limit, allowed_a = self.model.current_limit, current_of_torque(LARGEST_TORQUE_NM)
        self._set(current_limit, min(self._get(current_limit), int(allowed_a / self.model.current_unit)))
        self._set("present_input_voltage", 240)
        self.heat(False)

    @property
    def is_on(self) -> bool:
        """Whether torque is on."""
        return bool(self._get("torque_enable"))

    @property
    def is_watched(self) -> bool:
        """Whether its bus watchdog is set."""
        return self.model.has_watchdog and self._get("bus_watchdog") > 0

    @property
    def goal(self) -> float:
        """Goal position [rad]."""
        return self._get("goal_position") * self.model.position_unit

    @property
    def present_position(self) -> int:
        """What it measured last [count]."""
        return self._get("present_position")

    def measure(self) -> None:
        """Put what it measures into its registers."""
        model, motor = self.model, self.motor
        self._set("present_position", round(motor.position / model.position_unit))
        self._set("present_velocity", round(motor.velocity / model.velocity_unit))
        self._set("present_current", round(current_of_torque(motor.torque) / model.current_unit))

    def heat(self, is_hot: bool) -> None:
        """Make it hot, which it shows as its temperature alone, or let it cool."""
        self._set("present_temperature", _HOT_C if is_hot else _COOL_C)

    def overload(self, is_overloaded: bool) -> None:
        """Begin or end an overload: the status shows it, and the servo lets go (factory setting of shutdown)."""
        self._set("hardware_error_status", OVERLOAD if is_overloaded else 0)
        if is_overloaded and self.is_on:
            self._change("torque_enable", 0)

    def watch(self, now_s: float) -> None:
        """Stop where it is if the bus has been silent for longer than the watchdog allows (models that have one).

        Torque stays on, and no goal is taken before the watchdog is written to 0 (e-manual, Bus Watchdog).
        """
        if self.is_watched and now_s - self._heard_s > self._get("bus_watchdog") * _WATCHDOG_UNIT_S:
            self.measure()
            self._change("goal_position", self.present_position)
            self._change("bus_watchdog", _WATCHDOG_FIRED)

    def hear(self, now_s: float) -> None:
        """An instruction for anybody came over the bus."""
        self._heard_s = now_s

    def answer(self, instruction: int, parameters: bytes) -> tuple[int, bytes] | None:
        """Error number and data of the reply to an instruction; None for none."""
        match instruction:
            case protocol.PING:
                number = self._get("model_number").to_bytes(2, "little")
                return self._alert, number + bytes([self._get("firmware_version")])
            case protocol.READ if len(parameters) == 4:
                address, length = (int.from_bytes(parameters[i : i + 2], "little") for i in (0, 2))
                return self.read(address, length)
            case protocol.WRITE if len(parameters) > 2:
                return self.write(int.from_bytes(parameters[:2], "little"), parameters[2:]), b""
            case protocol.REG_WRITE if len(parameters) > 2:
                self._registered = (int.from_bytes(parameters[:2], "little"), parameters[2:])
                self._set("registered_instruction", 1)
                return self._alert, b""
            case protocol.ACTION if self._registered is not None:
                address, data = self._registered
                self._registered = None
                self._set("registered_instruction", 0)
                return self.write(address, data), b""
            case protocol.FACTORY_RESET | protocol.REBOOT:
                self._change("torque_enable", 0)
                if instruction == protocol.FACTORY_RESET:
                    self._restore()
                self._set("hardware_error_status", 0)
                return 0, b""
            case _:
                return protocol.INSTRUCTION_ERROR | self._alert, b""

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Error number and bytes; beyond the table there is nothing to read."""
        if address + length > len(self._memory) or length == 0:
            return protocol.ACCESS_ERROR | self._alert, b""
        self.measure()
        return self._alert, bytes(self._memory[address : address + length])

    def write(self, address: int, data: bytes) -> int:
        """Write whole registers from an address on; the error number, and then nothing is written."""
        register, at, writes = self.model.table.at(address), 0, []
        while at < len(data):
            if register is None or not register.is_writable or register.address != address + at:
                return protocol.ACCESS_ERROR | self._alert
            if register.memory == "EEPROM" and self.is_on:
                return protocol.ACCESS_ERROR | self._alert
            stored = data[at : at + register.size]
            if len(stored) < register.size:
                return protocol.LENGTH_ERROR | self._alert
            value = register.decode(stored)
            error = self._refusal(register, value)
            if error:
                return error | self._alert
            writes.append((register.name, value))
            at += register.size
            register = self.model.table.at(address + at)
        for name, value in writes:
            self._change(name, value)
        return self._alert

    def _refusal(self, register: Register, value: int) -> int:
        """Error number of a value that the servo does not take, 0 if it does."""
        if register.name.startswith("goal_") and self._watchdog_has_fired:
            return protocol.RANGE_ERROR
        if register.name == "goal_position":
            within = self._get("min_position_limit") <= value <= self._get("max_position_limit")
            return 0 if within else protocol.LIMIT_ERROR
        if register.name == "torque_enable":
            if value not in (0, 1):
                return protocol.RANGE_ERROR
            return protocol.RESULT_FAIL if value and self._get("hardware_error_status") else 0
        if register.name == "id":
            return 0 if 0 <= value <= protocol.LARGEST_ID else protocol.RANGE_ERROR
        return 0

    def _change(self, name: str, value: int) -> None:
        """Store a value with all that follows from it.

        A servo that gets torque keeps its goal, and runs to it: nobody says of the real ones that they do not.
        """
        self._set(name, value)
        if name == "id":
            self.servo_id = value
        if name in _SWITCHES:
            self.notify(self.servo_id, name, value)

    @property
    def _watchdog_has_fired(self) -> bool:
        return self.model.has_watchdog and self._get("bus_watchdog") == _WATCHDOG_FIRED

    @property
    def _alert(self) -> int:
        return protocol.ALERT if self._get("hardware_error_status") else 0

    def _get(self, name: str) -> int:
        register = self.model.table[name]
        return register.decode(self._memory[register.address : register.end])

    def _set(self, name: str, value: int) -> None:
        self._store(self.model.table[name], value)

    def _store(self, register: Register, value: int) -> None:
        self._memory[register.address : register.end] = register.encode(value)
