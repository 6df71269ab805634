"""Control tables of the servos as data: registers by name, chosen by the model number that a servo reports.

The files beside this module hold the maker's tables; units of position, velocity and current stand in `models.csv`.
"""

import csv
import functools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib import resources
from typing import Literal

from elastic_env.core.errors import unknown_name
from elastic_env.hardware.errors import HardwareError

_RPM = 2.0 * math.pi / 60.0
_BLOCK = ("present_position", "present_velocity", "present_current")
NUM_BLOCKS = 24
"""Ways to read a servo's state; one is known as old for so many requests: 96 ms, over twice the longest patience."""


@dataclass(frozen=True)
class Register:
    """One entry of a control table; numbers are little endian, negative ones in two's complement."""

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
            raise HardwareError(f"register {self.name!r} has {self.size} bytes, which {value} does not fit") from None

    def decode(self, stored: bytes | bytearray) -> int:
        """The value of stored bytes."""
        return int.from_bytes(stored, "little", signed=self.is_signed)


class ControlTable(Mapping[str, Register]):
    """Registers by name, in order of their addresses."""

    def __init__(self, registers: list[Register]) -> None:
        self._registers = {register.name: register for register in sorted(registers, key=lambda r: r.address)}
        self._at = {address: r for r in self._registers.values() for address in range(r.address, r.end)}

    def __getitem__(self, name: str) -> Register:
        if name not in self._registers:
            raise unknown_name("register", name, self._registers)
        return self._registers[name]

    def __contains__(self, name: object) -> bool:
        return name in self._registers

    def __iter__(self) -> Iterator[str]:
        return iter(self._registers)

    def __len__(self) -> int:
        return len(self._registers)

    def at(self, address: int) -> Register | None:
        """The register that holds an address, or None."""
        return self._at.get(address)

    @property
    def size(self) -> int:
        """First address behind the last register."""
        return max(register.end for register in self._registers.values())


@dataclass(frozen=True)
class ServoModel:
    """A servo type: its registers, and what a count of each quantity is in SI units."""

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
        """Whether the servo stops by itself when the bus falls silent."""
        return "bus_watchdog" in self.table

    @functools.cached_property
    def blocks(self) -> tuple[range, ...]:
        """Addresses of the blocks that hold position, velocity and current: whole registers, each longer than the last.

        The length of a reply tells which request it answers; the protocol has no other mark of that.
        """
        registers = self.table.values()
        first, last = min(self.table[name].address for name in _BLOCK), max(self.table[name].end for name in _BLOCK)
        starts = [register.address for register in registers if register.address <= first]
        ends = [register.end for register in registers if register.end >= last]
        by_length = {end - start: range(start, end) for start in starts for end in ends}
        return tuple(by_length[length] for length in sorted(by_length)[:NUM_BLOCKS])

    def is_in_block(self, name: str, block: range) -> bool:
        """Whether a block holds a register, whole."""
        register = self.table[name]
        return block.start <= register.address and register.end <= block.stop

    def in_block(self, name: str, block: range, data: bytes) -> int:
        """Value of a register within the data of a block, [count]."""
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
            f"no control table for model number {number}; known are {names}. Writing registers of another model could "
            "move it: add its table to elastic_env/hardware"
        )
    return known[number]


@functools.cache
def servo_models() -> dict[int, ServoModel]:
    """All known servo types by model number."""
    return {
        int(row["model_number"]): ServoModel(
            number=int(row["model_number"]),
            name=row["name"],
            table=_read_table(row["table"]),
            counts_per_turn=int(row["counts_per_turn"]),
            velocity_unit=float(row["velocity_unit_rpm"]) * _RPM,
            current_unit=1e-3 * float(row["current_unit_ma"]),
            current_limit=row["current_limit"],
        )
        for row in _rows("models.csv")
    }


@functools.cache
def _read_table(file: str) -> ControlTable:
    return ControlTable(
        [
            Register(
                address=int(row["address"]),
                size=int(row["size"]),
                name=row["name"],
                is_writable="W" in row["access"],
                memory="EEPROM" if row["memory"] == "EEPROM" else "RAM",
                initial=int(row["initial"] or 0),
                is_signed=row["signed"] == "Y",
            )
            for row in _rows(file)
        ]
    )


def _rows(file: str) -> list[dict[str, str]]:
    lines = resources.files("elastic_env.hardware.servo_bus").joinpath(file).read_text(encoding="utf-8").splitlines()
    return list(csv.DictReader(line for line in lines if not line.startswith("#")))


HARDWARE_ERRORS = {
    0: "input voltage out of its limits", 1: "motor hall sensor", 2: "overheating", 3: "motor encoder",
    4: "electrical shock or too little power", 5: "overload",
}  # fmt: skip
"""Bits of `hardware_error_status` (ROBOTIS e-manual)."""


def explain_errors(status: int) -> str:
    """Words for a hardware error status, "" where there is none."""
    return ", ".join(text for bit, text in HARDWARE_ERRORS.items() if status >> bit & 1)
