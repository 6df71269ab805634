"""`elastic hardware`: scan, check, log, compensate, run, emulate."""

import contextlib
import csv
import json
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import gymnasium
import tyro
from rich.console import Console
from rich.markup import escape

import elastic_env  # noqa: F401  registers the environments
from elastic_env.core.config import Locator, Model, quantity
from elastic_env.core.errors import ConfigurationError, list_names, require_known
from elastic_env.hardware.buses.packets import RANGE_OF_RATES, require_ids
from elastic_env.hardware.buses.protocols import BUSES
from elastic_env.hardware.buses.servo_models import Protocol, servo_model, servo_models
from elastic_env.hardware.emulator.launch import EmulatorConfig, Faults, RunningEmulator
from elastic_env.hardware.imu import AttitudeStream
from elastic_env.hardware.safety.checks import Check as BusCheck
from elastic_env.hardware.safety.checks import check_bus
from elastic_env.hardware.settings import HardwareSettings
from elastic_env.robots.testbed.environment import configure_testbed
from train.commands.hardware_arm import ArmOptions, ArmSetup
from train.commands.hardware_arm_dry_run import emulator_config
from train.commands.hardware_compensate import Compensate, LogPoses
from train.commands.options import HardwareOptions, MotionOrDefault, given_options
from train.evaluate.conditions import Condition, PolicySpec
from train.evaluate.rollout import ControlStep, control_steps, make_policy
from train.runs.console import make_table
from train.runs.folders import run_folder

_PRINT_PERIOD_S = 1.0
"""Time of the episode between two lines on the console [s]."""


class Scan(Model):
    """List the servos at a port, with model and firmware; nothing moves.

    Example: elastic hardware scan /dev/ttyUSB0
    """

    port: Annotated[str, tyro.conf.Positional]
    """Port, such as /dev/ttyUSB0."""
    baudrate: int | None = quantity("bit/s", None, **RANGE_OF_RATES)
    """Bits per second; default: the usual rates, one after the other."""
    protocol: Protocol | None = None
    """Protocol of the servos; default: one after the other."""

    def run(self, console: Console) -> None:
        """Scan; exit code 3 where no servo answers."""
        rows = []
        for protocol, kind in BUSES.items():
            if self.protocol not in (None, protocol):
                continue
            for rate in kind.rates if self.baudrate is None else (self.baudrate,):
                with kind(self.port, rate) as bus:
                    for servo in bus.scan():
                        number = servo.model_number
                        model = servo_models().get(number)
                        name = model.name if model is not None else "not known here"
                        cells = (protocol, rate, servo.servo_id, number, name, servo.firmware)
                        rows.append([str(cell) for cell in cells])
        if not rows:
            console.print(
                f"no servo answers at {self.port}; check power, wiring and baud rate,"
                " and whether it is the IMU's port"
            )
            sys.exit(3)
        head = ["protocol", "bit/s", "id", "model number", "model", "firmware"]
        console.print(make_table(f"servos at {self.port}", head, rows, left=6))


class Check(Model):
    """Check port, servos and IMU before anything moves, and list what to do.

    The exit code is 3 if there is anything to do.

    Example: elastic hardware check /dev/ttyUSB0 --ids 1 --imu-port /dev/ttyACM0
    """

    port: Annotated[str, tyro.conf.Positional]
    """Port, such as /dev/ttyUSB0."""
    ids: list[int] = [1]
    """Ids of the servos."""
    baudrate: int | None = quantity("bit/s", None, **RANGE_OF_RATES)
    """Bits per second; default the usual rate of the protocol."""
    protocol: Protocol = "dynamixel"
    """Protocol of the servos."""
    imu_port: str | None = None
    """Port of the IMU, different from that of the servos."""
    imu_baudrate: int = 115_200
    """Bits per second of the IMU's port; without effect for an IMU on USB."""

    def run(self, console: Console) -> None:
        """Check; nothing moves, nothing is written."""
        HardwareSettings(port=self.port, imu_port=self.imu_port, imu_baudrate=self.imu_baudrate)
        require_ids(self.ids)
        with BUSES[self.protocol](self.port, self.baudrate) as bus:
            checks = check_bus(bus, self.ids)
        if self.imu_port is not None:
            with AttitudeStream(self.imu_port, self.imu_baudrate) as stream:
                sample = stream.latest()
            names = ("roll", "pitch", "yaw")
            angles = ", ".join(f"{name} {getattr(sample, name):+.4f}" for name in names)
            checks.append(BusCheck("IMU", f"{angles} rad"))
        table = make_table(f"check of {self.port}", ["", "", "what to do"], [], left=3)
        for check in checks:
            cells = (check.name, check.value, "fine" if check.is_good else check.cure)
            style = "" if check.is_good else "bold yellow"
            table.add_row(*map(escape, cells), style=style)
        console.print(table)
        if not all(check.is_good for check in checks):
            sys.exit(3)


class Run(Model):
    """Play one episode on the real testbed, show it as it runs, and log every step.

    Example: elastic hardware run --port /dev/ttyUSB0 --imu-port /dev/ttyACM0 --policy input
        --reference sine

    A short motion is --reference '{kind: sine, amplitude: 0.2, duration_s: 5}'.
    """

    policy: str = "uncompensated"
    """Baseline, residual:PATH, or "FILE.py:function" or "module:function" for your own."""
    reference: MotionOrDefault = None
    """Motion, as in elastic evaluate: sine takes 17 s, the default, hold, five minutes."""
    output: Path | None = None
    """Folder for log.csv and metrics.json, new or empty; default runs/hardware, numbered if
    taken.
    """
    hardware: HardwareOptions = HardwareOptions()

    def run(self, console: Console) -> None:
        """Play one episode and show it; log.csv has every step, also if it is cut short."""
        if not (arguments := self.hardware.arguments):
            problem = "--port is needed; see: elastic hardware scan PORT, elastic hardware emulate"
            raise ConfigurationError(problem)
        spec = PolicySpec(name=self.policy)
        condition = Condition(env="hardware", policy=spec, reference=self.reference)
        arguments = {"reference": condition.reference, **arguments}
        env_id = condition.environment.id
        env: Any = gymnasium.make(env_id, disable_env_checker=True, **arguments)
        recorded = {"policy": spec.model_dump(mode="json"), **arguments}
        with contextlib.closing(env):
            policy = make_policy(spec, env)
            with run_folder("hardware", recorded, None, self.output) as folder:
                steps = control_steps(env, policy, None)
                metrics = _log_steps(steps, folder / "log.csv", console)
                text = json.dumps(metrics, indent=2)
                (folder / "metrics.json").write_text(f"{text}\n")
        console.print(f"Results in {folder}: log.csv (every step), metrics.json, config.yaml")


_COLUMNS = (
    ("t", "s", "time_s", 1.0, "7.1f"),
    ("q_ref", "rad", "reference_angle", 1.0, "+8.4f"),
    ("link", "rad", "link_angle", 1.0, "+8.4f"),
    ("torque", "N·m", "joint_torque", 1.0, "+8.1f"),
    ("jitter", "ms", "jitter", 1e3, "+8.2f"),
    ("overruns", "", "overruns", 1, "9d"),
    ("missed", "", "missed_replies", 1, "7d"),
    ("limited", "", "limited", 1, "8d"),
)
"""Columns on the console: title, unit, signal, factor and format."""


def _log_steps(steps: Iterable[ControlStep], path: Path, console: Console) -> dict[str, Any]:
    """Write every step, also of an episode cut short, and print a line once a second.

    Returns:
        Metrics of the episode.
    """
    metrics: dict[str, Any] = {}
    rows = 0
    next_s = _PRINT_PERIOD_S
    with path.open("w", newline="") as file:
        log: Any = None
        try:
            for step in steps:
                row = {k: v for k, v in step.info.items() if not isinstance(v, dict)}
                if not rows:
                    log = csv.DictWriter(file, list(row))
                    log.writeheader()
                    widths = [len(format(0, form)) for *_, form in _COLUMNS]
                    for titles in list(zip(*_COLUMNS, strict=True))[:2]:
                        console.print("".join(map(str.rjust, titles, widths)))
                log.writerow(row)
                rows += 1
                metrics = step.info.get("episode_metrics", metrics)
                if row["time_s"] >= next_s:
                    next_s += _PRINT_PERIOD_S
                    file.flush()
                    cells = [format(row[key] * by, form) for *_, key, by, form in _COLUMNS]
                    console.print("".join(cells))
        except BaseException:
            if rows:
                console.print(f"cut short; the {rows} steps until then are in {path}")
            else:
                path.unlink()
            raise
    return metrics


class Emulate(Model):
    """Emulate servos and an IMU on pseudo-terminals until Ctrl-C, to try all without hardware.

    They move a simulated joint in real time. Example, a bad cable: elastic hardware emulate --lost
    0.01

    A simulated arm: elastic hardware emulate --robot docs/hardware/so101.xml --joints
    docs/hardware/so101_joints.yaml --mounting docs/hardware/so101_mounting.yaml
    """

    robot: Locator | None = None
    """Model of an arm, MJCF or URDF, which the servos of --mounting move."""
    joints: Path | None = None
    """YAML file of its joints."""
    mounting: Path | None = None
    """YAML file of its ids, signs and zeros."""
    ids: list[int] = [1]
    """Ids of the servos; the IMU is on the link of the first."""
    model_number: int = 54024
    """Type of the servos, as docs/hardware.md lists them, such as 54024 or 777."""
    baudrate: int | None = None
    """Bits per second; the servos hear no other rate. Default the usual rate of the protocol."""
    scenario: str = "nominal"
    """Scenario of the joint and of the IMU, as in elastic identify."""
    stiffness: float | None = None
    """K of the joint [N·m/rad]; default the paper's 1001."""
    unheard: float = 0.0
    """Share of instructions that reach no servo."""
    lost: float = 0.0
    """Share of replies that do not come; this and the next three are drawn independently for every
    reply.
    """
    late: float = 0.0
    """Share of replies that come 6 ms late."""
    corrupted: float = 0.0
    """Share of replies with a flipped bit."""
    truncated: float = 0.0
    """Share of replies that end too early."""
    latency_ms: float = quantity("ms", 1.0, ge=0, le=1000)
    """Latency timer of the emulated USB adapter [ms]."""
    fault: list[str] = []
    """Faults that begin later: overload, hot, silent, same_id, unplugged, imu_silent, imu_nan,
    imu_inf, imu_out_of_range, imu_frozen."""
    fault_after_s: float = quantity("s", 20.0, ge=0, le=86_400)
    """When these faults begin, after the start [s]."""
    seed: int = 0
    """Seed of noise and faults."""

    def run(self, console: Console) -> None:
        """Emulate until Ctrl-C."""
        fields = Faults.model_fields
        switches = [name for name in fields if fields[name].annotation is bool]
        require_known("fault", self.fault, switches)
        shares = self.model_dump(include=set(fields))
        config = self._arm_emulator() or EmulatorConfig(
            ids=tuple(self.ids),
            model_number=self.model_number,
            baudrate=self.baudrate,
            testbed=configure_testbed(scenario=self.scenario, stiffness=self.stiffness),
        )
        faults = Faults(**shares, latency_s=1e-3 * self.latency_ms)
        config = config.replace(faults=faults, seed=self.seed)
        with RunningEmulator(config) as emulator, contextlib.suppress(KeyboardInterrupt):
            ids = " ".join(map(str, config.ids))
            console.print(f"servos {ids} at {emulator.port}")
            check = f"elastic hardware check {emulator.port} --ids {ids}"
            protocol = servo_model(config.model_number).protocol
            if protocol != "dynamixel":
                check += f" --protocol {protocol}"
            console.print(f"for example: {check}")
            if config.arm is None:
                console.print(f"IMU at {emulator.imu_port}")
                console.print(
                    f"or: elastic identify --port {emulator.port} --imu-port"
                    f" {emulator.imu_port} --yes --patient"
                )
            else:
                console.print(
                    f"or: elastic hardware compensate --port {emulator.port} --patient ..."
                )
            console.print("Ctrl-C ends it.")
            if self.fault:
                time.sleep(self.fault_after_s)
                emulator.faults(**dict.fromkeys(self.fault, True))
                console.print(f"from now on: {', '.join(self.fault)}")
            emulator.wait()

    def _arm_emulator(self) -> EmulatorConfig | None:
        """Emulator of an arm; None if no file of one is given.

        Raises:
            ConfigurationError: A file is missing, or cannot be used.
        """
        if (self.robot, self.joints, self.mounting) == (None, None, None):
            return None
        if self.robot is None or self.joints is None or self.mounting is None:
            raise ConfigurationError("an emulated arm needs --robot, --joints and --mounting")
        servo_options = ["ids", "model_number", "baudrate", "scenario", "stiffness"]
        if unused := given_options(self, servo_options):
            raise ConfigurationError(
                "an emulated arm has the joints of --joints and the servos of"
                f" --mounting; leave out {list_names(unused)}"
            )
        options = ArmOptions(robot=self.robot, mounting=self.mounting, dry_run=True)
        return emulator_config(ArmSetup(options, self.joints))


class Hardware(Model):
    """Real servos or an emulated bus: scan, check, compensate an arm, run the testbed, emulate."""

    command: (
        Scan
        | Check
        | Compensate
        | Annotated[LogPoses, tyro.conf.subcommand(name="log")]
        | Run
        | Emulate
    )

    def run(self, console: Console) -> None:
        """Run the chosen command."""
        self.command.run(console)
