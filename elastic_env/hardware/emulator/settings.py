"""Settings of an emulator: servos, joints, IMU, and the faults that can be switched on."""

import termios
from typing import Self

from pydantic import model_validator

from elastic_env.core.config import Model, quantity
from elastic_env.hardware.buses.packets import HIGHEST_RATE, LOWEST_RATE, RATES, require_ids
from elastic_env.hardware.buses.servo_models import servo_model
from elastic_env.robots.testbed.config import TestbedConfig

_SHARE = {"ge": 0, "le": 1}


class Faults(Model):
    """Faults of an emulated bus; all of them off by default. Shares are drawn per reply, or per instruction."""

    unheard: float = quantity("1", 0.0, **_SHARE, description="share of instructions that reach no servo")
    lost: float = quantity("1", 0.0, **_SHARE, description="share of replies that do not come")
    late: float = quantity("1", 0.0, **_SHARE, description="share of replies that come late")
    late_s: float = quantity("s", 0.006, ge=0, le=1, description="how late")
    corrupted: float = quantity("1", 0.0, **_SHARE, description="share of replies with a flipped bit")
    truncated: float = quantity("1", 0.0, **_SHARE, description="share of replies that end too early")
    latency_s: float = quantity("s", 0.0, ge=0, le=1, description="delay of every reply: the adapter's latency timer")
    overload: bool = False
    """Whether the servos report an overload and let go."""
    hot: bool = False
    """Whether the servos are at 95 °C, and report no error."""
    silent: bool = False
    """Whether the servos hear but do not answer."""
    unplugged: bool = False
    """Whether the port is gone."""
    imu_silent: bool = False
    """Whether the IMU sends nothing."""
    imu_late_s: float = quantity("s", 0.0, ge=0, le=1, description="delay of the IMU's packets")
    imu_nan: bool = False
    """Whether the IMU sends nan for the roll, as valid."""
    imu_inf: bool = False
    """Whether it sends an infinite roll, as valid."""
    imu_out_of_range: bool = False
    """Whether it sends a roll that no angle has, as valid."""
    imu_frozen: bool = False
    """Whether its packets go on, with the angles of the last one before."""
    imu_corrupted: float = quantity("1", 0.0, **_SHARE, description="share of IMU packets with a flipped bit")


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
