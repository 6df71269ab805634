"""What the commands of `elastic` share: console, options of hardware, and how options are read."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import yaml

from elastic_env.core.config_problems import ModelError, ParameterPath
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.yaml_text import parse_yaml
from train.runs.console import PlainConsole

CONSOLE = PlainConsole()
"""Where the commands say what they do."""

DEFAULT_SCENARIO = "nominal"
"""Scenario of a simulation where none is named."""


@dataclass
class OnHardware:
    """Options of commands that run on the simulated testbed, or with --port on a real one."""

    port: str | None = None
    """Port of a real servo, such as /dev/ttyUSB0, in place of the simulation."""
    imu_port: str | None = None
    """Port of the IMU on its link."""
    mounting: Path | None = None
    """YAML file of signs, zeros, ids and limits of the real testbed, see docs/hardware.md."""
    yes: bool = False
    """Begin to move without asking."""
    patient: bool = False
    """Bear ten missing replies in a row, 90 ms without a command and attitudes 0.2 s old: for emulators, whose
    pseudo-terminals stall where the computer is busy."""

    @property
    def arguments(self) -> dict[str, Any]:
        """Arguments of the environment on hardware; empty for the simulation."""
        if self == OnHardware():
            return {}
        from train.hardware import hardware_arguments

        return hardware_arguments(self.port, self.imu_port, self.mounting, yes=self.yes, patient=self.patient)


@dataclass
class OfArm:
    """Options of `elastic identify` for an arm of which there is a log of static poses."""

    robot: Path | None = None
    """Rigid model of an arm, MJCF or URDF, in place of the testbed."""
    log: Path | None = None
    """CSV file of static poses: motor encoders, and link encoders, end-effector positions, an IMU or joint torques."""
    joints: tuple[str, ...] = ()
    """Names or patterns of the joints whose stiffness is sought; default all in the log. The others are rigid."""
    end_effector: str | None = None
    """Site or body whose position is measured or that carries the IMU; default the outermost body."""
    payload: str | None = None
    """Body or site that carries a payload of unknown mass, which is estimated too."""
    frame: Literal["known", "offset", "pose"] = "offset"
    """Frame of tracker or IMU: known, unknown by an offset, or in pose; for an IMU the last two mean its mounting."""
    measured_by: Literal["link_encoders", "end_effector", "imu", "torques"] | None = None
    """Measurement to use, where the log has several or there is no log."""
    within: float = 0.03
    """A joint is told apart where the 95 % interval of 1/K is as narrow as plus or minus this share."""
    assume: float | None = None
    """K [N·m/rad] to write for joints that the poses do not tell; default the largest that was identified."""
    plan: int = 0
    """Propose so many further poses, within limits and without contacts, that tell the stiffness best."""

    @property
    def given(self) -> dict[str, Any]:
        """Options for an arm; empty where none is given.

        Raises:
            ConfigurationError: The robot is missing.
        """
        if self == OfArm():
            return {}
        if self.robot is None:
            raise ConfigurationError("--robot is missing; name the arm's model, a file of MJCF (.xml) or URDF (.urdf)")
        paths = {"robot": str(self.robot), "log": None if self.log is None else str(self.log)}
        return {**vars(self), **paths}


def place(env: str, arguments: dict[str, Any]) -> dict[str, Any]:
    """Where a comparison plays: the named environment, or with arguments of hardware a real testbed."""
    if not arguments:
        return {"env": env}
    from train.evaluate.environments import environment

    real = environment(env).on_hardware
    if not real:
        raise ConfigurationError(
            f"there is no {env!r} on hardware, only the testbed: leave --env {env} out, or --port and --mounting"
        )
    return {"env": real, "env_options": arguments}


def scenario_played(asked: str | None, arguments: dict[str, Any]) -> str:
    """The scenario that was asked for, or the default; on hardware, which has none, what stands for it in tables."""
    if not arguments:
        return DEFAULT_SCENARIO if asked is None else asked
    if asked is not None:
        raise ConfigurationError(
            f"scenario {asked!r} is of a simulation, hardware is what it is: leave --scenario out, or --port"
        )
    return "hardware"


@contextmanager
def options_named() -> Iterator[None]:
    """Errors of a configuration that is made from options name the options in place of its parameters."""
    try:
        yield
    except ModelError as error:
        raise ConfigurationError(error.named(spelt=_option)) from None


_OF_ONE = {"references": "reference", "scenarios": "scenario", "policies": "policy"}
"""Options that give a list of a configuration its only entry."""


def _option(path: ParameterPath) -> str:
    """A parameter as the option that sets it."""
    return "--" + _OF_ONE.get(str(path[0]), str(path[0])).replace("_", "-") if path else ""


def motion(env: str, text: str | None) -> Any:
    """A reference as it is written: a name, a number, durations or a mapping; the environment's default for None."""
    from train.evaluate.environments import environment

    default = environment(env).default_reference
    if text is None:
        return default
    try:
        value = parse_yaml(text)
    except yaml.YAMLError:
        raise ConfigurationError(
            f"{text!r} is no name, number, list or mapping such as '{{kind: sine, amplitude: 0.3}}' or "
            "'{step_period: 3, num_steps: 2}'"
        ) from None
    return value if isinstance(value, int | float | list | dict) else text


def stiffness_option(text: str) -> float | list[Any] | str:
    """A stiffness as it is written: a number, a list of numbers, or else the path of a file."""
    try:
        value = parse_yaml(text)
    except yaml.YAMLError:
        return text
    return value if isinstance(value, int | float | list) and not isinstance(value, bool) else text
