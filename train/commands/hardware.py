"""`elastic hardware`: scan, check, run, emulate."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from elastic_env.core.errors import ConfigurationError
from train.commands.options import CONSOLE, OnHardware, motion


@dataclass
class Scan:
    """List the servos at a port, with model and firmware; nothing moves.

    Example: elastic hardware scan /dev/ttyUSB0
    """

    port: Annotated[str, tyro.conf.Positional]
    """Port, such as /dev/ttyUSB0."""
    baudrate: int | None = None
    """Bits per second; default: the usual rates, one after the other."""

    def run(self) -> None:
        """Scan."""
        from train.hardware import scan

        if not scan(self.port, self.baudrate, CONSOLE):
            sys.exit(3)


@dataclass
class Check:
    """Look at port, servos and IMU before anything moves, and say what to do; exit code 3 if there is anything to do.

    Example: elastic hardware check /dev/ttyUSB0 --ids 1 --imu-port /dev/ttyACM0
    """

    port: Annotated[str, tyro.conf.Positional]
    """Port, such as /dev/ttyUSB0."""
    ids: list[int] = field(default_factory=lambda: [1])
    """Ids of the servos."""
    baudrate: int = 3_000_000
    """Bits per second."""
    imu_port: str | None = None
    """Port of the IMU, another one than the servos'."""
    imu_baudrate: int = 115_200
    """Bits per second of the IMU's port; an IMU on USB has none."""

    def run(self) -> None:
        """Check."""
        from train.hardware import check

        if not check(self.port, self.ids, self.baudrate, self.imu_port, self.imu_baudrate, CONSOLE):
            sys.exit(3)


@dataclass
class Run:
    """Play one episode on the real testbed, show it as it goes, and keep every step.

    Example: elastic hardware run --port /dev/ttyUSB0 --imu-port /dev/ttyACM0 --policy input --reference sine
    A short one: --reference '{kind: sine, amplitude: 0.2, duration_s: 5}'
    """

    policy: str = "uncompensated"
    """Baseline, residual:PATH, or "FILE.py:function" or "module:function" for one's own."""
    reference: str | None = None
    """Motion, as in elastic evaluate: sine takes 17 s, the default, hold, five minutes."""
    output: Path | None = None
    """Folder for log.csv and metrics.json, new or empty; default runs/hardware, numbered if taken."""
    on: OnHardware = field(default_factory=OnHardware)

    def run(self) -> None:
        """Play."""
        from train.evaluate.conditions import PolicySpec
        from train.hardware import run

        if not (arguments := self.on.arguments):
            raise ConfigurationError("--port is needed; see: elastic hardware scan PORT, elastic hardware emulate")
        folder = run(arguments, motion("hardware", self.reference), PolicySpec(name=self.policy), CONSOLE, self.output)
        CONSOLE.print(f"Results in {folder}: log.csv (every step), metrics.json, config.yaml", soft_wrap=True)


@dataclass
class Emulate:
    """Emulate servos and an IMU on pseudo-terminals until Ctrl-C, for trying everything without hardware.

    Behind them moves the simulated joint, in real time. Example, a bad cable: elastic hardware emulate --lost 0.01
    """

    ids: list[int] = field(default_factory=lambda: [1])
    """Ids of the servos; the IMU is on the link of the first."""
    model_number: int = 54024
    """Type of the servos: 54024, 54025 or 2020."""
    baudrate: int = 3_000_000
    """Bits per second; no other rate is heard."""
    scenario: str = "nominal"
    """Scenario of the joint and of the IMU, as in elastic identify."""
    stiffness: float | None = None
    """K of the joint [N·m/rad]; default the paper's 1001."""
    unheard: float = 0.0
    """Share of instructions that reach no servo."""
    lost: float = 0.0
    """Share of replies that do not come; this and the next three are drawn for every reply, each by itself."""
    late: float = 0.0
    """Share of replies that come 6 ms late."""
    corrupted: float = 0.0
    """Share of replies with a flipped bit."""
    truncated: float = 0.0
    """Share of replies that end too early."""
    latency_ms: float = 1.0
    """Latency timer of the emulated USB adapter."""
    fault: list[str] = field(default_factory=list)
    """What breaks after a while: overload, hot, silent, unplugged, imu_silent, imu_nan, imu_inf, imu_out_of_range,
    imu_frozen."""
    fault_after_s: float = 20.0
    """When that happens, after the start [s]."""
    seed: int = 0
    """Seed of noise and faults."""

    def run(self) -> None:
        """Emulate."""
        from elastic_env.hardware.emulator.faults import Faults
        from elastic_env.hardware.emulator.launch import EmulatorConfig
        from elastic_env.robots.testbed.environment import configure_testbed
        from train.hardware import emulate, require_switches

        require_switches(self.fault)
        faults = Faults(
            unheard=self.unheard, lost=self.lost, late=self.late, corrupted=self.corrupted, truncated=self.truncated,
            latency_s=1e-3 * self.latency_ms,
        )  # fmt: skip
        config = EmulatorConfig(
            ids=tuple(self.ids), model_number=self.model_number, baudrate=self.baudrate, faults=faults, seed=self.seed,
            testbed=configure_testbed(scenario=self.scenario, stiffness=self.stiffness),
        )  # fmt: skip
        emulate(config, CONSOLE, dict.fromkeys(self.fault, True), self.fault_after_s)


@dataclass
class Hardware:
    """The testbed on real hardware, or on an emulated bus: scan, check, run, emulate."""

    command: (
        Annotated[Scan, tyro.conf.subcommand("scan")]
        | Annotated[Check, tyro.conf.subcommand("check")]
        | Annotated[Run, tyro.conf.subcommand("run")]
        | Annotated[Emulate, tyro.conf.subcommand("emulate")]
    )

    def run(self) -> None:
        """Do what was asked for."""
        self.command.run()
