"""Servo types as data: control tables, units, and the torque that a current stands for.

`models.csv` lists the servos by the model number that they report, with their protocol and units.
The other files beside this module are the makers' tables of registers. A new servo of a known
protocol needs a row there and, if its registers differ, a table. Names of registers that the
driver uses are the same in all tables.
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
"""Ways to read a servo's state.

One is known as old for so many requests: 96 ms, over twice the longest patience.
"""

LARGEST_TORQUE_NM = SERVO.torque_limit
"""Limit of the leg's servos of THORMANG3 [N·m], which is 20 A on the measured line.

More hurts the gear.
"""

Protocol = Literal["dynamixel", "feetech"]
"""Packets on the wire: Dynamixel Protocol 2.0, or that of Feetech's STS and SMS."""

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
"""Bit of an overload in both."""


@dataclass(frozen=True)
class Register:
    """An entry of a control table. Numbers are little endian.

    Negative ones are in two's complement, or a magnitude with a bit for the sign.
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
        """First address behind it."""
        return self.address + self.size

    def encode(self, value: int) -> bytes:
        """A value as the servo stores it.

        Raises:
            HardwareError: It does not fit.
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
        """The value of stored bytes."""
        value = int.from_bytes(stored, "little", signed=self.is_signed)
        if self.sign_bit is None:
            return value
        size = value & ((1 << self.sign_bit) - 1)
        return -size if value >> self.sign_bit & 1 else size


class ControlTable(dict[str, Register]):
    """Registers by name, in the order of their addresses."""

    def __missing__(self, name: str) -> NoReturn:
        raise unknown_name("register", name, self)

    def find(self, address: int) -> Register | None:
        """The register that holds an address, or None."""
        return self._by_address.get(address)

    @functools.cached_property
    def _by_address(self) -> dict[int, Register]:
        return {at: one for one in self.values() for at in range(one.address, one.end)}

    @property
    def size(self) -> int:
        """First address behind the last register."""
        return max(register.end for register in self.values())


@dataclass(frozen=True)
class ServoModel:
    """A servo type: its registers, and a count of each quantity in SI units."""

    number: int
    name: str
    protocol: Protocol
    registers: str
    """File of its control table."""

    counts_per_turn: int
    zero_count: int
    """Count that is the angle zero: the middle of a servo that counts one turn from 0."""
    velocity_unit_rpm: float
    """One count of velocity [rpm]."""
    load_register: str
    """Register of the current, or of the load where there is no current."""
    current_unit_ma: float
    """One count of it as a current [mA]."""
    torque_per_ampere: float
    loss: float
    """Line from current to torque at the output: slope [N·m/A], and what is lost [N·m]."""
    largest_torque: float
    """Torque that the servo may give for long [N·m]."""
    current_limit: str = ""
    """Name of the register that limits the current, "" where nothing hurts the gear."""
    effort_register: str = ""
    """Register that limits the torque at once, in RAM; "" where there is none."""
    effort_maximum: str = ""
    """Register that bounds it, in EEPROM."""

    @functools.cached_property
    def table(self) -> ControlTable:
        """Its registers."""
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
        """Words for a hardware error status, "" where there is none."""
        errors = _ERRORS[self.protocol].items()
        known = ", ".join(text for bit, text in errors if status >> bit & 1)
        return known or (f"error {status}" if status else "")

    @property
    def has_watchdog(self) -> bool:
        """True if the servo stops by itself when the bus falls silent."""
        return "bus_watchdog" in self.table

    @functools.cached_property
    def blocks(self) -> tuple[range, ...]:
        """Addresses of the blocks that hold the motion and the current, each longer than the last.

        A block holds whole registers. The length of a reply tells which request it answers; the
        protocol has no other mark of that.
        """
        registers = self.table.values()
        first = min(self.table[name].address for name in self._motion)
        last = max(self.table[name].end for name in self._motion)
        starts = [own.address for own in registers if own.address <= first]
        ends = [own.end for own in registers if own.end >= last]
        by_length = {end - start: range(start, end) for start in starts for end in ends}
        return tuple(by_length[length] for length in sorted(by_length)[:NUM_BLOCKS])

    def has_temperature(self, block: range) -> bool:
        """True if a block holds the temperature too."""
        register = self.table[_TEMPERATURE]
        return block.start <= register.address and register.end <= block.stop

    def decode_block(self, block: range, data: bytes) -> list[float]:
        """Position [rad], velocity [rad/s], current [A] and temperature [°C] of a block.

        Nan where it has none.
        """
        counts = [self._decode(name, block, data) for name in self._motion]
        position, velocity, load = counts
        degrees = math.nan
        if self.has_temperature(block):
            degrees = self._decode(_TEMPERATURE, block, data)
        motion = [velocity * self.velocity_unit, load * self.current_unit]
        return [self.angle(position), *motion, degrees]

    @property
    def _motion(self) -> tuple[str, str, str]:
        return "present_position", "present_velocity", self.load_register

    def _decode(self, name: str, block: range, data: bytes) -> int:
        register = self.table[name]
        start = register.address - block.start
        return register.decode(data[start : start + register.size])


def torque_of_current(current: Array, per_ampere: Parameter, loss: Parameter) -> Array:
    r"""Torque at the output by a servo's line.

    .. math:: \tau = \mathrm{sign}(I) \max(k |I| - \tau_0, 0)

    Args:
        current: I, (..., n) [A].
        per_ampere: k, broadcast against it [N·m/A].
        loss: τ₀, what does not reach the output, likewise [N·m].

    Returns:
        τ, (..., n) [N·m].
    """
    return np.sign(current) * np.maximum(per_ampere * np.abs(current) - loss, 0.0)


def servo_model(number: int) -> ServoModel:
    """The servo type of a model number.

    Raises:
        HardwareError: No control table is known for it.
    """
    known = servo_models()
    if number not in known:
        names = ", ".join(f"{model.number} ({model.name})" for model in known.values())
        raise HardwareError(
            f"no control table for model number {number}; known are {names}. Writing registers of "
            "another model could move it: add its table to elastic_env/hardware/buses"
        )
    return known[number]


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
    return {model.number: model for model in _read(ServoModel, "models.csv")}


@functools.cache
def _read_table(file: str) -> ControlTable:
    return ControlTable({register.name: register for register in _read(Register, file)})


def _read(kind: type[Row], file: str) -> list[Row]:
    """Rows of a table beside this file as what they describe; empty cells are not given."""
    rows = read_rows(Path(__file__).with_name(file))
    given = [{column: cell for column, cell in row.items() if cell} for row in rows]
    read = TypeAdapter(kind).validate_python
    return [read(row) for row in given]
