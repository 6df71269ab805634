"""Start of an emulator in its own process, its configuration and its faults."""

import json
import os
import subprocess
import termios
from contextlib import AbstractContextManager, suppress
from typing import Any

import numpy as np

from elastic_env.core.config import Model, quantity
from elastic_env.core.errors import ConfigurationError
from elastic_env.hardware.buses import packets
from elastic_env.hardware.buses.protocols import BUSES
from elastic_env.hardware.buses.servo_models import servo_model
from elastic_env.hardware.emulator.joints import EmulatedArm
from elastic_env.hardware.errors import HardwareError
from elastic_env.hardware.safety.processes import end_child, start_child
from elastic_env.robots.testbed.config import TestbedConfig

_SHARE: dict[str, Any] = {"ge": 0, "le": 1}


class Faults(Model):
    """Faults of an emulated bus; all of them are off by default.

    Shares are probabilities per reply, or per instruction.
    """

    unheard: float = quantity("1", 0.0, **_SHARE)
    """Share of instructions that reach no servo [1]."""
    lost: float = quantity("1", 0.0, **_SHARE)
    """Share of replies that do not come [1]."""
    late: float = quantity("1", 0.0, **_SHARE)
    """Share of replies that come late [1]."""
    late_s: float = quantity("s", 0.006, ge=0, le=1)
    """Delay of late replies [s]."""
    corrupted: float = quantity("1", 0.0, **_SHARE)
    """Share of replies with a flipped bit [1]."""
    truncated: float = quantity("1", 0.0, **_SHARE)
    """Share of replies that end too early [1]."""
    latency_s: float = quantity("s", 0.0, ge=0, le=1)
    """Delay of every reply: the adapter's latency timer [s]."""
    overload: bool = False
    """The servos report an overload and switch their torque off."""
    hot: bool = False
    """The servos are at 95 °C, and report no error."""
    silent: bool = False
    """The servos obey but do not answer."""
    same_id: bool = False
    """A second servo answers with the first id, at the same time."""
    unplugged: bool = False
    """The port is gone."""
    imu_silent: bool = False
    """The IMU sends nothing."""
    imu_late_s: float = quantity("s", 0.0, ge=0, le=1)
    """Delay of the IMU's packets [s]."""
    imu_nan: bool = False
    """The IMU sends nan as a valid roll."""
    imu_inf: bool = False
    """The IMU sends infinity as a valid roll."""
    imu_out_of_range: bool = False
    """The IMU sends a number out of range as a valid roll."""
    imu_frozen: bool = False
    """The IMU goes on sending packets with the same angles."""
    imu_corrupted: float = quantity("1", 0.0, **_SHARE)
    """Share of IMU packets with a flipped bit [1]."""


def damage(faults: Faults, reply: bytes, generator: Any) -> tuple[bytes, float]:
    """Apply faults to a reply; return its bytes, none if it is lost, and its delay [s]."""
    delay = faults.latency_s
    chance = generator.random(4)
    if faults.silent or chance[0] < faults.lost:
        return b"", 0.0
    if chance[1] < faults.late:
        delay += faults.late_s
    if chance[2] < faults.corrupted:
        reply = flip_bit(reply, generator)
    if chance[3] < faults.truncated:
        reply = reply[: int(generator.integers(1, len(reply)))]
    return reply, delay


def flip_bit(data: bytes, generator: np.random.Generator) -> bytes:
    """Bytes with one random bit inverted."""
    changed = bytearray(data)
    bit = int(generator.integers(8 * len(data)))
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


_END_S = 10.0
_PROCESS = "elastic_env.hardware.emulator.process"


class EmulatorConfig(Model):
    """An emulated bus with its servos, and the IMU on the link of the first."""

    model_number: int = 54024
    """Type of the servos."""
    ids: tuple[int, ...] = (1,)
    """Their ids."""
    registers: dict[str, int] = {}
    """Registers of all servos that differ from the factory settings [count]."""
    testbed: TestbedConfig = TestbedConfig()
    """Joints of the servos, and through its scenario the quality of the IMU."""
    arm: EmulatedArm | None = None
    """Arm that the servos move, instead of the testbed's joints."""
    imu_rate_hz: float = quantity("Hz", 100.0, ge=1, le=1000)
    """Packets of the IMU per second [Hz]."""
    baudrate: int | None = quantity("bit/s", None, **packets.RANGE_OF_RATES)
    """Rate of the bus; others are ignored. Default the usual one of the protocol [bit/s]."""
    faults: Faults = Faults()
    seed: int = quantity("1", 0, ge=0)
    """Seed of faults and noise [1]."""

    def _check(self) -> None:
        model = servo_model(self.model_number)
        for name in self.registers:
            _ = model.table[name]
        if self.arm is not None and len(self.arm.order) != len(self.ids):
            raise ValueError(
                "an emulated arm needs one id for each of its joints, got"
                f" {len(self.ids)} ids for {len(self.arm.order)} joints"
            )
        if not hasattr(termios, f"B{self.rate}"):
            raise ValueError(
                f"a pseudo-terminal has no rate of {self.rate} bit/s; it has {packets.RATES}"
            )
        packets.require_ids(self.ids)

    @property
    def rate(self) -> int:
        """Rate of the bus [bit/s]."""
        return self.baudrate or BUSES[servo_model(self.model_number).protocol].rates[0]


class RunningEmulator(AbstractContextManager["RunningEmulator"]):
    """Starts an emulator; a context manager that ends it.

    Args:
        config: Configuration of the emulator.

    Attributes:
        port: Port of the servos.
        imu_port: Port of the IMU.
    """

    def __init__(self, config: EmulatorConfig | None = None) -> None:
        text = (config or EmulatorConfig()).model_dump_json()
        pipes: Any = dict.fromkeys(("stdin", "stdout"), subprocess.PIPE)
        self._process = start_child(_PROCESS, text, **pipes)
        self._take_ports(self._receive())

    def faults(self, **changes: Any) -> None:
        """Switch faults on and off, see `Faults`.

        A bus that is plugged in again gets another port.
        """
        self._take_ports(self._request({"faults": changes}))

    def events(self) -> list[tuple[float, int, str, int]]:
        """Switches, goals and requests for states since the last call.

        Each is monotonic time [s], id, register and value [count]; `present_position` marks a
        request of states, with the position in the reply.
        """
        return [tuple(event) for event in self._request({"events": True})]

    def state(self) -> dict[str, Any]:
        """True state: time_s, theta and q [rad], torque_on, skipped_s."""
        return self._request({"state": True})

    def wait(self) -> None:
        """Wait for an interrupt.

        Raises:
            ElasticError: The emulator has ended by itself.
        """
        self._receive()

    def close(self) -> None:
        """End the emulator."""
        end_child(self._process, _END_S)

    def __exit__(self, *_: object) -> None:
        self.close()

    def _request(self, request: dict[str, Any]) -> Any:
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):  # the last answer gives the reason
            os.write(self._process.stdin.fileno(), json.dumps(request).encode() + b"\n")
        return self._receive()

    def _receive(self) -> Any:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            code = self._process.wait()
            raise HardwareError(f"the emulator ended with exit code {code}")
        answer = json.loads(line)
        if "error" in answer:
            raise ConfigurationError(answer["error"])
        return answer

    def _take_ports(self, ports: dict[str, str]) -> None:
        self.port = ports["port"]
        self.imu_port = ports["imu_port"]
