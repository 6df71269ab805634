"""What an emulator emulates."""

import termios
from typing import Self

from pydantic import model_validator

from elastic_env.core.config import Model, quantity
from elastic_env.hardware.emulator.faults import Faults
from elastic_env.hardware.servo_bus.control_table import servo_model
from elastic_env.hardware.servo_bus.protocol import HIGHEST_RATE, LOWEST_RATE, RATES, require_ids
from elastic_env.robots.testbed.config import TestbedConfig


class EmulatorConfig(Model):
    """An emulated bus with its servos, and the IMU on the link of the first."""

    model_number: int = 54024
    """Type of the servos."""
    claimed_model_number: int | None = None
    """Model number that they report, if it is to be a wrong one."""
    ids: tuple[int, ...] = (1,)
    """Their ids."""
    testbed: TestbedConfig = TestbedConfig()
    """The joints behind them, and through its scenario the quality of the IMU."""
    imu_rate_hz: float = quantity("Hz", 100.0, ge=1, le=1000, description="packets of the IMU per second")
    baudrate: int = quantity(
        "bit/s", 3_000_000, ge=LOWEST_RATE, le=HIGHEST_RATE, description="rate of the bus; no other is heard"
    )
    faults: Faults = Faults()
    seed: int = quantity("1", 0, ge=0, description="seed of faults and noise")

    @model_validator(mode="after")
    def _servos_exist(self) -> Self:
        servo_model(self.model_number)
        if not hasattr(termios, f"B{self.baudrate}"):
            raise ValueError(f"a pseudo-terminal has no rate of {self.baudrate} bit/s; it has {RATES}")
        require_ids(self.ids)
        return self
