"""Servo types as data: control tables, units, and the torque that a current stands for.

`models.csv` lists the servos by the model number that they report, with the units of position,
velocity and current. The other files beside this module are the maker's tables of registers. A new
servo of the same protocol needs a row there and, if its registers differ, a table.
"""

import csv
import functools
import math
from dataclasses import dataclass
from importlib import resources
from typing import Literal, NoReturn

import numpy as np
import numpy.typing as npt

from elastic_env.core.errors import unknown_name
from elastic_env.core.signals import Array
from elastic_env.hardware.errors import HardwareError
from elastic_env.joint.dynamixel import LOSS_NM, SERVO, TORQUE_PER_CURRENT

NUM_BLOCKS = 24
"""Ways to read a servo's state.

One is known as old for so many requests: 96 ms, over twice the longest patience.
"""

LARGEST_TORQUE_NM = SERVO.torque_limit
"""Limit of the leg's servos of THORMANG3 [N·m], which is 20 A on the measured line.

More hurts the gear.
"""

_RPM = 2.0 * math.pi / 60.0
_MOTION = ("present_position", "present_velocity", "present_current")
_TEMPERATURE = "present_temperature"
_HARDWARE_ERRORS = {
    0: "input voltage out of its limits",
    1: "motor hall sensor",
    2: "overheating",
    3: "motor encoder",
    4: "electrical shock or too little power",
    5: "overload",
}
"""Bits of `hardware_error_status` (ROBOTIS e-manual)."""


@dataclass(frozen=True)
class Register:
    """An entry of a control table. Numbers are little endian, negative ones in two's complement."""

    address: int
    size: int
    name: str
    is_writable: bool
    memory: Literal["EEPROM", "RAM"]
    initial: int
    is_signed: bool

    @property
    def end(self) -> int:
        """First address behind it."""
        return self.address + self.size

    def encode(self, value: int) -> bytes:
        """A value as the servo stores it.

        Raises:
            HardwareError: It does not fit.
        """
        try:
            return value.to_bytes(self.size, "little", signed=self.is_signed)
        except OverflowError:
            raise HardwareError(
                f"register {self.name!r} has {self.size} bytes, which {value} does not fit"
            ) from None

    def decode(self, stored: bytes | bytearray) -> int:
        """The value of stored bytes."""
        return int.from_bytes(stored, "little", signed=self.is_signed)


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
    table: ControlTable
    counts_per_turn: int
    velocity_unit: float
    """One count of velocity [rad/s]."""
    current_unit: float
    """One count of current [A]."""
    current_limit: str
    """Name of the register that limits the current."""

    @property
    def position_unit(self) -> float:
        """One count of position [rad]."""
        return 2.0 * math.pi / self.counts_per_turn

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
        first = min(self.table[name].address for name in _MOTION)
        last = max(self.table[name].end for name in _MOTION)
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
        units = (self.position_unit, self.velocity_unit, self.current_unit)
        counts = [self._decode(name, block, data) for name in _MOTION]
        degrees = math.nan
        if self.has_temperature(block):
            degrees = self._decode(_TEMPERATURE, block, data)
        motion = [unit * count for unit, count in zip(units, counts, strict=True)]
        return [*motion, degrees]

    def _decode(self, name: str, block: range, data: bytes) -> int:
        register = self.table[name]
        start = register.address - block.start
        return register.decode(data[start : start + register.size])


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


@functools.cache
def servo_models() -> dict[int, ServoModel]:
    """All known servo types by model number."""
    models = (
        ServoModel(
            number=int(row["model_number"]),
            name=row["name"],
            table=_read_table(row["table"]),
            counts_per_turn=int(row["counts_per_turn"]),
            velocity_unit=float(row["velocity_unit_rpm"]) * _RPM,
            current_unit=1e-3 * float(row["current_unit_ma"]),
            current_limit=row["current_limit"],
        )
        for row in _read_rows("models.csv")
    )
    return {model.number: model for model in models}


@functools.cache
def _read_table(file: str) -> ControlTable:
    registers = (
        Register(
            address=int(row["address"]),
            size=int(row["size"]),
            name=row["name"],
            is_writable="W" in row["access"],
            memory="EEPROM" if row["memory"] == "EEPROM" else "RAM",
            initial=int(row["initial"] or 0),
            is_signed=row["signed"] == "Y",
        )
        for row in _read_rows(file)
    )
    in_order = sorted(registers, key=lambda register: register.address)
    return ControlTable({register.name: register for register in in_order})


def _read_rows(file: str) -> list[dict[str, str]]:
    path = resources.files("elastic_env.hardware.buses") / file
    lines = path.read_text(encoding="utf-8").splitlines()
    return list(csv.DictReader(line for line in lines if not line.startswith("#")))


def explain_errors(status: int) -> str:
    """Words for a hardware error status, "" where there is none."""
    errors = _HARDWARE_ERRORS.items()
    known = ", ".join(text for bit, text in errors if status >> bit & 1)
    return known or (f"error {status}" if status else "")


def torque_of_current(current: npt.ArrayLike) -> Array:
    """Torque at the output for signed currents, by the line that was measured at an H54-200-S500-R.

    |τ| = 4.338 N·m/A |I| − 2.694 N·m, and zero where the current only meets the losses. The line is
    rough: gear and temperature change it. Source: a public ROS configuration, see
    `elastic_env/joint/dynamixel.py`.

    Args:
        current: (...) [A].

    Returns:
        (...) [N·m].
    """
    amperes = np.asarray(current, dtype=np.float64)
    torque = TORQUE_PER_CURRENT * np.abs(amperes) - LOSS_NM
    return np.sign(amperes) * np.maximum(torque, 0.0)


def current_of_torque(torque: float) -> float:
    """Signed current [A] for a torque at the output [N·m]."""
    return float(np.sign(torque) * (abs(torque) + LOSS_NM) / TORQUE_PER_CURRENT)
