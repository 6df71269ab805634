"""Options that several commands share, and how the text of an option becomes a value."""

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
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.yaml_text import parse_yaml
from elastic_env.hardware.settings import PATIENT_LIMITS, HardwareSettings
from elastic_env.robots.testbed.model import Pendulum
from train.evaluate.conditions import GivenReference
from train.evaluate.environments import environment

DEFAULT_SCENARIO = "nominal"
"""Scenario of a simulation where none is named."""

_TEXT = PrimitiveConstructorSpec(
    nargs=1,
    metavar="STR",
    instance_from_str=lambda words: words[0],
    is_instance=lambda _: True,
    str_from_instance=lambda value: [str(value)],
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


Motion = Annotated[GivenReference, BeforeValidator(_read_reference), _TEXT]
"""A reference: a name, a number, durations or a mapping, or one of these as text in YAML."""
MotionOrDefault = Annotated[Any, BeforeValidator(_read_reference), _TEXT]
"""The same, which the cell checks that is made of it; or None, for the environment's default."""
Stiffness = Annotated[Any, BeforeValidator(_read_stiffness), _TEXT]
"""A stiffness: a number, a list of numbers, one of these as text, or the path of a file."""
StiffnessOrFile = Annotated[Locator | float | None, BeforeValidator(_read_stiffness), _TEXT]
"""One stiffness, as a number or as text, or the path of a file."""


_PATIENT_IMU_S = 0.2


class Mounting(HardwareSettings):
    """Content of the file of `--mounting`: wiring and mounting of the testbed, and its pendulum."""

    pendulum: Pendulum = Pendulum()


class OnHardware(Model):
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
    """Bear ten missing replies in a row, 90 ms without a command and attitudes 0.2 s old: for
    emulators, whose pseudo-terminals stall where the computer is busy."""

    @cached_property
    def arguments(self) -> dict[str, Any]:
        """Arguments of `elastic_env/HardwareTestbed-v0`; empty for the simulation.

        Raises:
            ConfigurationError: There are options of hardware, but no port.
        """
        if self.port is None and self.mounting is None:
            for name in ("imu_port", "yes", "patient"):
                if getattr(self, name):
                    wanted = "is for a real testbed: name its servo's port too, with --port"
                    raise ConfigurationError(f"{_option(name)} {wanted}")
            return {}
        confirm = False if self.yes else None
        options = {"port": self.port, "imu_port": self.imu_port, "confirm": confirm}
        given = {name: value for name, value in options.items() if value is not None}
        if self.mounting is None:
            chosen = Mounting(**given)
        else:
            chosen = load_yaml(self.mounting, Mounting, given)
        named = {*chosen.model_fields_set, *options, "limits"}
        values = chosen.model_dump(include=named)
        if self.patient:
            values["limits"] |= PATIENT_LIMITS
            values["imu_oldest_s"] = max(chosen.imu_oldest_s, _PATIENT_IMU_S)
        return values

    def environment(self, env: str) -> dict[str, Any]:
        """The environment of a comparison: the named one, or a real testbed with its arguments.

        Raises:
            ConfigurationError: The named one is not there on hardware.
        """
        if not (arguments := self.arguments):
            return {"env": env}
        real = environment(env).on_hardware
        if not real:
            problem = f"there is no {env!r} on hardware, only the testbed: leave --env {env} out"
            raise ConfigurationError(f"{problem}, or --port and --mounting")
        return {"env": real, "env_options": arguments}

    def scenario(self, named: str | None) -> str:
        """The named scenario, or the default; on hardware the word for it in tables.

        Raises:
            ConfigurationError: A scenario is named for hardware.
        """
        if not self.arguments:
            return DEFAULT_SCENARIO if named is None else named
        if named is not None:
            problem = f"scenario {named!r} is of a simulation, hardware is what it is"
            raise ConfigurationError(f"{problem}: leave --scenario out, or --port")
        return "hardware"


def given_options(options: Model, names: Iterable[str]) -> list[str]:
    """Options that differ from their defaults, as they are spelt."""
    fields = type(options).model_fields
    given = [name for name in names if getattr(options, name) != fields[name].default]
    return list(map(_option, given))


@contextmanager
def name_options(**of_one: str) -> Iterator[None]:
    """Let errors of a configuration that is made from options name the options.

    Args:
        **of_one: Options that give a list of the configuration its only entry, by its name.
    """

    def spelt(path: ParameterPath) -> str:
        name = str(path[0]) if path else ""
        return _option(of_one.get(name, name)) if path else ""

    try:
        yield
    except ModelError as error:
        raise ConfigurationError(error.describe(spelling=spelt)) from None


def _option(name: str) -> str:
    """A field as the option that sets it."""
    return f"--{name.replace('_', '-')}"
