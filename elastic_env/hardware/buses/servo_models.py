"""Servo types as data: control tables, units, and the line from current to torque.

`models.csv` lists the servos by the model number that they report, with their protocol and units.
The other files in this folder are the makers' tables of registers. A new servo of a known protocol
needs a row there and, if its registers differ, a table. Registers that the driver uses have the
same names in all tables.
"""

import functools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NoReturn, TypeVar

import numpy as np
from pydantic import TypeAdapter

from elastic_env.core.errors import ConfigurationError, unknown_name
from elastic_env.core.files import read_rows
from elastic_env.core.signals import Array, Parameter
from elastic_env.hardware.errors import HardwareError
from elastic_env.joint.dynamixel import SERVO

NUM_BLOCKS = 24
"""Number of blocks by which a servo's state can be read.

A late reply is recognised for as many requests: 96 ms, over twice the longest patience.
"""

LARGEST_TORQUE_NM = SERVO.torque_limit
"""Limit of the leg's servos of THORMANG3 [N·m]: 20 A on the measured line.

More damages the gear.
"""

Protocol = Literal["dynamixel", "feetech"]
"""Packets on the wire: Dynamixel Protocol 2.0, or those of Feetech's STS and SMS."""

Row = TypeVar("Row")
_TEMPERATURE = "present_temperature"
_ERRORS: dict[Protocol, dict[int, str]] = {
    "dynamixel": {
        0: "input voltage out of its limits",
        1: "motor hall sensor",
        2: "overheating",
        3: "motor encoder",
        4: "electrical shock or too little power",
        5: "overload",
    },
    "feetech": {
        0: "input voltage out of its limits",
        1: "magnetic encoder",
        2: "overheating",
        3: "overcurrent",
        5: "overload",
    },
}
"""Bits of `hardware_error_status` (ROBOTIS e-manual; Feetech's memory table)."""
OVERLOAD = 1 << 5
"""Bit of an overload, in both protocols."""


@dataclass(frozen=True)
class Register:
    """Entry of a control table. Numbers are little endian.

    Negative numbers are in two's complement, or a magnitude with a bit for the sign.
    """

    address: int
    size: int
    name: str
    is_writable: bool
    memory: Literal["EEPROM", "RAM"]
    initial: int
    is_signed: bool
    sign_bit: int | None = None
    """Number of the bit that is set for a negative value; None for two's complement."""

    @property
    def end(self) -> int:
        """First address after the register."""
        return self.address + self.size

    def encode(self, value: int) -> bytes:
        """Encode a value as the servo stores it.

        Raises:
            HardwareError: The value does not fit.
        """
        stored = value
        if self.sign_bit is not None and abs(value) < 1 << self.sign_bit:
            stored = abs(value) | (value < 0) << self.sign_bit
        try:
            return stored.to_bytes(self.size, "little", signed=self.is_signed)
        except OverflowError:
            raise HardwareError(
                f"register {self.name!r} has {self.size} bytes, which {value} does not fit"
            ) from None

    def decode(self, stored: bytes | bytearray) -> int:
        """Decode stored bytes."""
        value = int.from_bytes(stored, "little", signed=self.is_signed)
        if self.sign_bit is None:
            return value
        magnitude = value & ((1 << self.sign_bit) - 1)
        return -magnitude if value >> self.sign_bit & 1 else magnitude


class ControlTable(dict[str, Register]):
    """Registers by name, in the order of their addresses."""

    def __missing__(self, name: str) -> NoReturn:
        raise unknown_name("register", name, self)

    def find(self, address: int) -> Register | None:
        """Register at an address, or None."""
        return self._by_address.get(address)

    @functools.cached_property
    def _by_address(self) -> dict[int, Register]:
        return {at: row for row in self.values() for at in range(row.address, row.end)}

    @property
    def size(self) -> int:
        """First address after the last register."""
        return max(register.end for register in self.values())


@dataclass(frozen=True)
class ServoModel:
    """A servo type: its registers, and the unit of one count of each quantity."""

    number: int
    name: str
    protocol: Protocol
    registers: str
    """File of its control table."""
    counts_per_turn: int
    zero_count: int
    """Count at the angle zero: the middle of a servo that counts one turn from 0."""
    velocity_unit_rpm: float
    """One count of velocity [rpm]."""
    load_register: str
    """Register of the current, or of the load if there is none of the current."""
    current_unit_ma: float
    """One count of that register as a current [mA]."""
    torque_per_ampere: float
    loss: float
    """Line from current to torque at the output: slope [N·m/A], and lost torque [N·m]."""
    largest_torque: float
    """Torque that the servo may give for long [N·m]."""
    current_limit: str = ""
    """Register that limits the current, "" if no current damages the gear."""
    effort_register: str = ""
    """Register in RAM that limits the torque at once, "" if there is none."""
    effort_maximum: str = ""
    """Register in EEPROM that bounds that limit."""

    @functools.cached_property
    def table(self) -> ControlTable:
        """Control table of the servo."""
        return _read_table(self.registers)

    @property
    def velocity_unit(self) -> float:
        """One count of velocity [rad/s]."""
        return self.velocity_unit_rpm * (2.0 * math.pi / 60.0)

    @property
    def current_unit(self) -> float:
        """One count of `load_register` as a current [A]."""
        return 1e-3 * self.current_unit_ma

    @property
    def position_unit(self) -> float:
        """One count of position [rad]."""
        return 2.0 * math.pi / self.counts_per_turn

    def angle(self, count: int) -> float:
        """Angle of a count of position [rad]."""
        return (count - self.zero_count) * self.position_unit

    def count(self, angle: float) -> int:
        """Count of position of an angle [rad]."""
        return round(angle / self.position_unit) + self.zero_count

    def current(self, torque: float) -> float:
        """Signed current [A] for a torque at the output [N·m]."""
        effort = abs(torque) + self.loss
        return float(np.sign(torque) * effort / self.torque_per_ampere)

    def explain_errors(self, status: int) -> str:
        """Text for a hardware error status, "" if there is no error."""
        errors = _ERRORS[self.protocol].items()
        known = ", ".join(text for bit, text in errors if status >> bit & 1)
        return known or (f"error {status}" if status else "")

    @property
    def has_watchdog(self) -> bool:
        """True if the servo stops by itself when the bus is silent."""
        return "bus_watchdog" in self.table

    @functools.cached_property
    def blocks(self) -> tuple[range, ...]:
        """Addresses of the blocks that contain motion and current, each longer than the last.

        A block contains whole registers. Only its length shows which request a reply answers: the
        protocol has no other mark.
        """
        registers = self.table.values()
        first = min(self.table[name].address for name in self._motion)
        last = max(self.table[name].end for name in self._motion)
        starts = [entry.address for entry in registers if entry.address <= first]
        ends = [entry.end for entry in registers if entry.end >= last]
        by_length = {end - start: range(start, end) for start in starts for end in ends}
        return tuple(by_length[length] for length in sorted(by_length)[:NUM_BLOCKS])

    def has_temperature(self, block: range) -> bool:
        """Return True if a block also contains the temperature."""
        register = self.table[_TEMPERATURE]
        return block.start <= register.address and register.end <= block.stop

    def decode_block(self, block: range, data: bytes) -> list[float]:
        """Decode position [rad], velocity [rad/s], current [A] and temperature [°C] of a block.

        The temperature is nan if the block contains none.
        """
        position, velocity, load = (self._decode(n, block, data) for n in self._motion)
        degrees = math.nan
        if self.has_temperature(block):
            degrees = self._decode(_TEMPERATURE, block, data)
        motion = [velocity * self.velocity_unit, load * self.current_unit]
        return [self.angle(position), *motion, degrees]

    @property
    def _motion(self) -> tuple[str, str, str]:
        """Registers of position, velocity and load."""
        return "present_position", "present_velocity", self.load_register

    def _decode(self, name: str, block: range, data: bytes) -> int:
        """Value of a register [count], from the data of a block."""
        register = self.table[name]
        start = register.address - block.start
        return register.decode(data[start : start + register.size])


def torque_of_current(current: Array, per_ampere: Parameter, loss: Parameter) -> Array:
    r"""Torque at the output, by the line from current to torque.

    .. math:: \tau = \mathrm{sign}(I) \max(k |I| - \tau_0, 0)

    Args:
        current: I, (..., n) [A].
        per_ampere: k, broadcast against the current [N·m/A].
        loss: τ₀, torque that does not reach the output, broadcast likewise [N·m].

    Returns:
        τ, (..., n) [N·m].
    """
    return np.sign(current) * np.maximum(per_ampere * np.abs(current) - loss, 0.0)


def servo_model(number: int) -> ServoModel:
    """Servo type of a model number.

    Raises:
        HardwareError: No control table is known for it.
    """
    models = servo_models()
    if number not in models:
        names = ", ".join(f"{model.number} ({model.name})" for model in models.values())
        raise HardwareError(
            f"no control table for model number {number}; known are {names}. Writing registers of "
            "another model could move it: add its table to elastic_env/hardware/buses"
        )
    return models[number]


def model_number(name: str) -> int:
    """Model number of a servo by its name.

    Raises:
        ConfigurationError: There is no such servo.
    """
    numbers = {model.name: number for number, model in servo_models().items()}
    if name not in numbers:
        problem = f"no servo {name!r}, as the mounting has it"
        raise ConfigurationError(f"{problem}; choose from {', '.join(numbers)}")
    return numbers[name]


@functools.cache
def servo_models() -> dict[int, ServoModel]:
    """All known servo types by model number."""
    return {model.number: model for model in _read_rows(ServoModel, "models.csv")}


@functools.cache
def _read_table(file: str) -> ControlTable:
    """Read a control table from its file."""
    return ControlTable({row.name: row for row in _read_rows(Register, file)})


def _read_rows(kind: type[Row], file: str) -> list[Row]:
    """Read a table in this folder as objects of a class; empty cells take its defaults."""
    parse = TypeAdapter(kind).validate_python
    rows = read_rows(Path(__file__).with_name(file))
    return [parse({name: cell for name, cell in row.items() if cell}) for row in rows]
