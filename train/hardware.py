"""The testbed on real hardware: list servos, check them, run an episode, emulate a bus."""

import contextlib
import csv
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

import gymnasium
import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

import elastic_env  # noqa: F401  registers the environments
from elastic_env.core.config import Model, load_yaml
from elastic_env.core.errors import ConfigurationError, require_known, shown
from elastic_env.hardware.buses.dynamixel_bus import DynamixelBus
from elastic_env.hardware.buses.packets import RATES, require_ids
from elastic_env.hardware.buses.servo_models import servo_models
from elastic_env.hardware.emulator.faults import Faults
from elastic_env.hardware.emulator.launch import EmulatorConfig, RunningEmulator
from elastic_env.hardware.imu import AttitudeStream
from elastic_env.hardware.safety.checks import Check, check_bus
from elastic_env.hardware.settings import HardwareSettings
from elastic_env.robots.testbed.model import Pendulum
from train.evaluate.conditions import PolicySpec
from train.evaluate.environments import environment
from train.evaluate.rollout import make_policy
from train.runs.folders import run_folder

_SHOWN_S = 1.0
_LATEST_FAULT_S = 86_400.0
_PATIENT_IMU_S = 0.2
PATIENT_LIMITS = {"patience_cycles": 10, "hang_s": 0.09}
"""The most patient limits there are, for emulators: a busy computer delays pseudo-terminals."""


class Mounting(HardwareSettings):
    """The file of `--mounting`: wiring and mounting of the testbed, and its pendulum."""

    pendulum: Pendulum = Pendulum()


def hardware_arguments(
    port: str | None,
    imu_port: str | None,
    settings: Path | None,
    *,
    yes: bool,
    patient: bool = False,
) -> dict[str, Any]:
    """Arguments of `elastic_env/HardwareTestbed-v0` from the options of a command.

    Empty without hardware.

    Args:
        port: Port of the servo, or None for that of the settings.
        imu_port: Port of the IMU, likewise.
        settings: YAML file of a `Mounting`, or None.
        yes: Whether nobody need agree before the first motion.
        patient: Whether a motion goes on for as long as it can where replies, commands or attitudes
            are missing.

    Raises:
        ConfigurationError: There are options of hardware, but no port.
    """
    if port is None and settings is None:
        for option, is_given in {
            "--imu-port": imu_port is not None,
            "--yes": yes,
            "--patient": patient,
        }.items():
            if is_given:
                raise ConfigurationError(f"{option} is for a real testbed: name its servo's port too, with --port")
        return {}
    options = {"port": port, "imu_port": imu_port, "confirm": False if yes else None}
    changes = {name: value for name, value in options.items() if value is not None}
    mounting = Mounting(**changes) if settings is None else load_yaml(settings, Mounting, changes)
    names = mounting.model_fields_set | options.keys() | {"limits"}
    values = {name: getattr(mounting, name) for name in names}
    if patient:
        values["limits"] = mounting.limits.replace(**PATIENT_LIMITS)
        values["imu_oldest_s"] = max(mounting.imu_oldest_s, _PATIENT_IMU_S)
    return {name: value.model_dump() if isinstance(value, Model) else value for name, value in values.items()}


def scan(port: str, baudrate: int | None, console: Console) -> int:
    """List the servos of a port; how many there are.

    Args:
        port: The port.
        baudrate: Bits per second, or None to try the usual rates.
        console: Where the table goes.
    """
    if baudrate is not None:
        HardwareSettings(port=port, baudrate=baudrate)  # checks it
    table = Table("bit/s", "id", "model number", "model", "firmware", title=f"servos at {port}")
    for rate in RATES if baudrate is None else (baudrate,):
        with DynamixelBus(port, rate) as bus:
            for servo in bus.scan():
                model = servo_models().get(servo.model_number)
                name = model.name if model is not None else "not known here"
                table.add_row(
                    str(rate),
                    str(servo.servo_id),
                    str(servo.model_number),
                    name,
                    str(servo.firmware),
                )
    if table.row_count:
        console.print(table)
    else:
        console.print(
            f"no servo answers at {port}; check power, wiring and baud rate, and whether it is the IMU's port",
            soft_wrap=True,
        )
    return table.row_count


def check(
    port: str,
    ids: list[int],
    baudrate: int,
    imu_port: str | None,
    imu_baudrate: int,
    console: Console,
) -> bool:
    """Look at port, servos and IMU; whether all is well. Nothing moves, nothing is written."""
    HardwareSettings(port=port, baudrate=baudrate, imu_port=imu_port, imu_baudrate=imu_baudrate)  # checks them
    require_ids(ids)
    with DynamixelBus(port, baudrate) as bus:
        checks = check_bus(bus, ids)
    if imu_port is not None:
        with AttitudeStream(imu_port, imu_baudrate) as stream:
            sample = stream.latest()
        angles = ", ".join(f"{name} {getattr(sample, name):+.4f}" for name in ("roll", "pitch", "yaw"))
        checks.append(Check("IMU", f"{angles} rad"))
    table = Table("", "", "what to do", title=f"check of {port}", show_header=True)
    for one in checks:
        style = "" if one.is_good else "bold yellow"
        table.add_row(one.what, one.value, escape(one.cure) or "fine", style=style)
    console.print(table)
    return all(one.is_good for one in checks)


def run(
    arguments: dict[str, Any],
    reference: Any,
    policy: PolicySpec,
    console: Console,
    output: Path | None = None,
) -> Path:
    """Play one episode, show it as it goes, and keep every step in log.csv, also if cut short.

    Args:
        arguments: Of the environment.
        reference: The motion.
        policy: Who commands.
        console: Where the progress goes.
        output: Folder for the results; default runs/hardware, numbered if taken.

    Returns:
        Folder of log.csv and metrics.json.
    """
    env: Any = gymnasium.make(environment("hardware").id, disable_env_checker=True, reference=reference, **arguments)
    with contextlib.closing(env):
        player = make_policy(policy, env)
        configuration = {
            "policy": policy.model_dump(mode="json"),
            "reference": reference,
            **arguments,
        }
        with run_folder("hardware", configuration, None, output) as folder:
            metrics: dict[str, Any] = {}
            with _open_log(folder / "log.csv", console) as log:
                for info in _play(env, player):
                    log.write(info)
                    metrics = info.get("episode_metrics", metrics)
            (folder / "metrics.json").write_text(json.dumps(metrics, indent=2) + "\n")
            return folder


def _play(env: Any, policy: Any) -> Iterator[dict[str, Any]]:
    """The `info` of every step of an episode."""
    observation, _ = env.reset()
    state = None
    start = np.array(True)
    truncated = False
    while not truncated:
        action, state = policy.predict(observation, state=state, episode_start=start, deterministic=True)
        observation, _, _, truncated, info = env.step(action)
        start = np.array(False)
        yield info


class _Log:
    """The rows of log.csv, and a line on the console once a second.

    Then all rows are on the disk.
    """

    _SHOWN = (
        ("t", "s", "time_s", 1.0, "7.1f"),
        ("q_ref", "rad", "reference_angle", 1.0, "+8.4f"),
        ("link", "rad", "link_angle", 1.0, "+8.4f"),
        ("torque", "N·m", "joint_torque", 1.0, "+8.1f"),
        ("jitter", "ms", "jitter", 1e3, "+8.2f"),
        ("overruns", "", "overruns", 1, "9d"),
        ("missed", "", "missed_replies", 1, "7d"),
        ("limited", "", "limited", 1, "8d"),
    )

    def __init__(self, file: TextIO, console: Console) -> None:
        self.num_rows = 0
        self._file = file
        self._console = console
        self._writer: csv.DictWriter[str] | None = None
        self._next_s = _SHOWN_S

    def write(self, info: dict[str, Any]) -> None:
        row = {key: value for key, value in info.items() if not isinstance(value, dict)}
        if self._writer is None:
            self._writer = csv.DictWriter(self._file, list(row))
            self._writer.writeheader()
            for heading in (0, 1):
                self._print([f"{shown[heading]:>{len(format(0, shown[4]))}}" for shown in self._SHOWN])
        self._writer.writerow(row)
        self.num_rows += 1
        if row["time_s"] >= self._next_s:
            self._next_s += _SHOWN_S
            self._file.flush()
            self._print([format(row[key] * factor, spec) for _, _, key, factor, spec in self._SHOWN])

    def _print(self, cells: list[str]) -> None:
        self._console.print("".join(cells), soft_wrap=True, highlight=False)


@contextlib.contextmanager
def _open_log(path: Path, console: Console) -> Iterator[_Log]:
    """A log that stays whatever ends the episode."""
    with path.open("w", newline="") as file:
        log = _Log(file, console)
        try:
            yield log
        except BaseException:
            if log.num_rows:
                console.print(f"cut short; the {log.num_rows} steps until then are in {path}", soft_wrap=True)
            else:
                path.unlink()
            raise


def require_switches(names: Sequence[str]) -> None:
    """Check the names of faults that are there or not.

    Raises:
        ConfigurationError: There is no such one.
    """
    switches = [name for name, field in Faults.model_fields.items() if field.annotation is bool]
    require_known("fault", names, switches)


def emulate(
    config: EmulatorConfig,
    console: Console,
    later: Mapping[str, bool] | None = None,
    after_s: float = 0.0,
) -> None:
    """Emulate until Ctrl-C.

    Args:
        config: What is emulated.
        console: Where the ports are said.
        later: Faults that come after a while, see `Faults`.
        after_s: When [s].

    Raises:
        ConfigurationError: That is no time that somebody can wait for.
    """
    if not 0.0 <= after_s <= _LATEST_FAULT_S:
        raise ConfigurationError(f"--fault-after-s must be from 0 to {_LATEST_FAULT_S:g} s, got {shown(after_s)}")
    with RunningEmulator(config) as emulator, contextlib.suppress(KeyboardInterrupt):
        console.print(f"servos {', '.join(map(str, config.ids))} at {emulator.port}", soft_wrap=True)
        console.print(f"IMU at {emulator.imu_port}", soft_wrap=True)
        console.print(
            f"for example: elastic hardware check {emulator.port}, or\n"
            f"elastic identify --port {emulator.port} --imu-port {emulator.imu_port} --yes "
            "--patient\nCtrl-C ends it.",
            soft_wrap=True,
        )
        if later:
            time.sleep(after_s)
            emulator.faults(**later)
            console.print(f"from now on: {', '.join(later)}", soft_wrap=True)
        emulator.wait()
