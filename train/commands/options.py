"""Options that several commands share, and conversion of their texts to values."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import BeforeValidator
from tyro.constructors import PrimitiveConstructorSpec

from elastic_env.core.config import Locator, Model, load_yaml
from elastic_env.core.config_problems import ModelError, ParameterPath
from elastic_env.core.errors import ConfigurationError, quote
from elastic_env.core.yaml_text import parse_yaml
from elastic_env.hardware.settings import PATIENT_LIMITS, HardwareSettings
from elastic_env.robots.testbed.model import Pendulum
from train.evaluate.conditions import GivenReference
from train.evaluate.environments import environment

DEFAULT_SCENARIO = "nominal"
"""Scenario of a simulation, if the user names none."""


def _write_yaml(value: Any) -> str:
    """Return a default as a user types it."""
    if not isinstance(value, dict | list):
        return str(value)
    return yaml.safe_dump(value, default_flow_style=True, sort_keys=False).strip()


_TEXT = PrimitiveConstructorSpec(
    nargs=1,
    metavar="STR",
    instance_from_str=lambda words: words[0],
    is_instance=lambda _: True,
    str_from_instance=lambda value: [_write_yaml(value)],
)


def _read_yaml(text: Any) -> Any:
    return parse_yaml(text) if isinstance(text, str) else text


def _read_reference(text: Any) -> Any:
    try:
        value = _read_yaml(text)
    except yaml.YAMLError:
        raise ConfigurationError(
            f"{text!r} is no name, number, list or mapping such as '{{kind: sine, amplitude: 0.3}}'"
            " or '{step_period: 3, num_steps: 2}'"
        ) from None
    return value if isinstance(value, int | float | list | dict) else text


def _read_stiffness(text: Any) -> Any:
    with suppress(yaml.YAMLError):
        value = _read_yaml(text)
        if isinstance(value, int | float | list) and not isinstance(value, bool):
            return value
    return text


def _read_one_stiffness(text: Any) -> Any:
    value = _read_stiffness(text)
    if isinstance(value, list):
        needed = "one number for all joints [N·m/rad], or a YAML file with one for each"
        raise ValueError(f"give {needed}, got {quote(value)}")
    return value


Motion = Annotated[GivenReference, BeforeValidator(_read_reference), _TEXT]
"""A reference: a name, a number, durations or a mapping, or one of these as YAML text."""
MotionOrDefault = Annotated[Any, BeforeValidator(_read_reference), _TEXT]
"""A reference that its cell checks; or None, for the environment's default."""
Stiffness = Annotated[Any, BeforeValidator(_read_stiffness), _TEXT]
"""A stiffness: a number, a list of numbers, one of these as text, or the path of a file."""
StiffnessOrFile = Annotated[Locator | float | None, BeforeValidator(_read_one_stiffness), _TEXT]
"""One stiffness, as a number or as text, or the path of a file."""


_PATIENT_IMU_S = 0.2
"""Oldest accepted attitude with `--patient` [s]."""


class Mounting(HardwareSettings):
    """The file of `--mounting`: wiring and mounting of the testbed, and its pendulum."""

    pendulum: Pendulum = Pendulum()


class HardwareOptions(Model):
    """Options of commands that run on the simulated testbed, or with --port on a real one."""

    port: str | None = None
    """Port of a real servo, such as /dev/ttyUSB0, instead of the simulation."""
    imu_port: str | None = None
    """Port of the IMU on its link."""
    mounting: Path | None = None
    """YAML file of signs, zeros, ids and limits of the real testbed, see docs/hardware.md."""
    yes: bool = False
    """Begin to move without asking."""
    patient: bool = False
    """Tolerate ten missing replies in a row, 90 ms without a command and attitudes 0.2 s old: for
    emulators, whose pseudo-terminals stall while the computer is busy."""

    @cached_property
    def arguments(self) -> dict[str, Any]:
        """Arguments of `elastic_env/HardwareTestbed-v0`; empty for the simulation.

        Raises:
            ConfigurationError: Options for hardware are given without a port.
        """
        if self.port is None and self.mounting is None:
            for name in ("imu_port", "yes", "patient"):
                if getattr(self, name):
                    cure = "is for a real testbed: name its servo's port too, with --port"
                    raise ConfigurationError(f"{_option(name)} {cure}")
            return {}
        confirm = False if self.yes else None
        options = {"port": self.port, "imu_port": self.imu_port, "confirm": confirm}
        given = {name: value for name, value in options.items() if value is not None}
        if self.mounting is None:
            mounting = Mounting(**given)
        else:
            mounting = load_yaml(self.mounting, Mounting, given)
        names = {*mounting.model_fields_set, *options, "limits"}
        values = mounting.model_dump(include=names)
        if self.patient:
            values["limits"] |= PATIENT_LIMITS
            values["imu_oldest_s"] = max(mounting.imu_oldest_s, _PATIENT_IMU_S)
        return values

    def environment(self, env: str) -> dict[str, Any]:
        """Return the environment of a comparison: the named one, or a real testbed and arguments.

        Raises:
            ConfigurationError: The named environment does not exist on hardware.
        """
        if not (arguments := self.arguments):
            return {"env": env}
        real = environment(env).on_hardware
        if not real:
            problem = f"there is no {env!r} on hardware, only the testbed: leave --env {env} out"
            raise ConfigurationError(f"{problem}, or --port and --mounting")
        return {"env": real, "env_options": arguments}

    def scenario(self, named: str | None) -> str:
        """Return the named scenario, or the default; on hardware the label in tables.

        Raises:
            ConfigurationError: A scenario is named for hardware.
        """
        if not self.arguments:
            return DEFAULT_SCENARIO if named is None else named
        if named is not None:
            problem = f"scenario {named!r} is for a simulation, not for hardware"
            raise ConfigurationError(f"{problem}: leave --scenario out, or --port")
        return "hardware"


def given_options(options: Model, names: Iterable[str]) -> list[str]:
    """Return the options that differ from their defaults, as users write them."""
    fields = type(options).model_fields
    return [_option(n) for n in names if getattr(options, n) != fields[n].default]


@contextmanager
def name_options(**list_options: str) -> Iterator[None]:
    """Name the options in errors of a configuration that is made from options.

    Args:
        **list_options: Options that set the only entry of a list, by the list's name in the
            configuration.
    """

    def spelt(path: ParameterPath) -> str:
        name = str(path[0]) if path else ""
        return _option(list_options.get(name, name)) if path else ""

    try:
        yield
    except ModelError as error:
        raise ConfigurationError(error.describe(spelling=spelt)) from None


def _option(name: str) -> str:
    """Return the option that sets a field."""
    return f"--{name.replace('_', '-')}"
