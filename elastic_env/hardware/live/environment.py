"""Entry points of the registered environment on hardware."""

import inspect
from functools import partial
from typing import Any

from gymnasium.vector import AutoresetMode

from elastic_env.core.errors import ConfigurationError, quote, require_known
from elastic_env.hardware.errors import HardwareError
from elastic_env.hardware.live import ID
from elastic_env.hardware.live.task import HardwareTestbedTask
from elastic_env.hardware.settings import HardwareSettings
from elastic_env.robots.testbed.environment import configure_testbed
from elastic_env.robots.testbed.picture import TestbedPicture
from elastic_env.world.envs import ElasticEnv, ElasticVectorEnv

SCENARIO = "hardware"
"""Name in the place of the scenario in tables of results."""
_OF_A_SIMULATION = ("form", "timestep_s")


def configure_hardware(port: Any = None, **arguments: Any) -> HardwareTestbedTask:
    """The task of `gymnasium.make("elastic_env/HardwareTestbed-v0", port=..., ...)`.

    Args:
        port: Port of the servo.
        **arguments: Those of `HardwareSettings`, and of `configure_testbed` of
            `elastic_env.robots.testbed.environment` but for `form` and `timestep_s`; `scenario` can
            only be "hardware" or "nominal", and changes nothing.

    Raises:
        ConfigurationError: A name, a parameter or a combination that does not exist.
    """
    if port is None:
        cure = "such as /dev/ttyUSB0; see: elastic hardware scan PORT"
        raise ConfigurationError(f"{ID} needs port, {cure}")
    of_settings = list(HardwareSettings.model_fields)
    parameters = inspect.signature(configure_testbed).parameters
    of_testbed = [name for name in parameters if name not in _OF_A_SIMULATION]
    require_known(f"argument of {ID}", arguments, [*of_settings, *of_testbed])
    scenario = arguments.pop("scenario", SCENARIO)
    if scenario not in (SCENARIO, "nominal"):
        raise HardwareError(
            f"a scenario is of a simulation; on hardware it is what it is, got {quote(scenario)}"
        )
    settings = {name: arguments.pop(name) for name in of_settings if name in arguments}
    config = configure_testbed(scenario="ideal", **arguments)
    return HardwareTestbedTask(config, HardwareSettings(port=port, **settings))


def make(render_mode: str | None = None, **arguments: Any) -> ElasticEnv:
    """Entry point; arguments as in `configure_hardware`."""
    task = configure_hardware(**arguments)
    picture = partial(TestbedPicture, task.config.pendulum)
    return ElasticEnv(task, render_mode, picture, task.plant)


def make_vector(
    num_envs: int = 1,
    num_threads: int = 0,  # noqa: ARG001  the same arguments as the other environments
    autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    render_mode: str | None = None,
    **arguments: Any,
) -> ElasticVectorEnv:
    """Vector entry point, for the same programs to run on hardware: of one world.

    Raises:
        ConfigurationError: More than one world.
    """
    if num_envs != 1:
        raise ConfigurationError(
            f"there is one testbed at a port: num_envs must be 1, got {quote(num_envs)}"
        )
    task = configure_hardware(**arguments)
    picture = partial(TestbedPicture, task.config.pendulum)
    return ElasticVectorEnv(task, 1, autoreset_mode, task.plant, render_mode, picture)
