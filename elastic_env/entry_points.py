"""Entry points of the registered environments: arguments of `gymnasium.make` become a task behind a face."""

import inspect
from pathlib import Path
from typing import Any, Literal

from gymnasium.vector import AutoresetMode

from elastic_env.elasticity import ElasticJoint
from elastic_env.envs import ElasticEnv, ElasticVectorEnv
from elastic_env.errors import ConfigurationError, unknown_name
from elastic_env.references import AnyReference, make_reference
from elastic_env.rendering import TestbedPicture
from elastic_env.robots.dynamixel import H54_200_S500_R
from elastic_env.robots.robot_model import read_stiffness
from elastic_env.robots.testbed import Pendulum
from elastic_env.scenario import Scenario, make_scenario
from elastic_env.tasks.testbed import TestbedTask
from elastic_env.tasks.testbed_config import TestbedConfig


def configure_testbed(
    reference: str | dict[str, Any] | AnyReference = "hold",
    scenario: str | Scenario = "nominal",
    stiffness: float | str | Path | None = None,
    joint: ElasticJoint | dict[str, Any] | None = None,
    pendulum: Pendulum | dict[str, Any] | None = None,
    form: Literal["tendon", "rigid"] = "tendon",
    observe_link: bool = False,
) -> TestbedConfig:
    """The testbed's configuration from the arguments of `gymnasium.make("elastic_env/Testbed-v0", ...)`.

    Args:
        reference: "hold", "sine", "multisine", "steps", a mapping with `kind` and parameters, or a reference model.
        scenario: Name as in `elastic_env.scenario`, or a `Scenario`.
        stiffness: K of the joint [N·m/rad], or the path of an `identification.json`; default that of the joint.
        joint: Elastic joint, or a mapping of what differs from the paper's H54-200-S500-R, the default.
        pendulum: The load, or a mapping of what differs from the default of 60 N·m at the horizontal.
        form: "tendon" for the elastic joint, "rigid" for what an inelastic testbed would do.
        observe_link: Whether the link's IMU is part of the observation.

    Raises:
        ConfigurationError: A name, a parameter or a combination that does not exist.
    """
    for name, given, model in (("joint", joint, ElasticJoint), ("pendulum", pendulum, Pendulum)):
        if not isinstance(given, dict | model | None):
            raise ConfigurationError(f"{name} must be a {model.__name__} or a mapping of its parameters, got {given!r}")
    chosen = joint if isinstance(joint, ElasticJoint) else H54_200_S500_R.replace(**(joint or {}))
    if stiffness is not None:
        chosen = chosen.replace(stiffness=read_stiffness(stiffness))
    return TestbedConfig(
        reference=make_reference(reference),
        scenario=make_scenario(scenario),
        joint=chosen,
        pendulum=pendulum if isinstance(pendulum, Pendulum) else Pendulum(**(pendulum or {})),
        form=form,
        observe_link=observe_link,
    )


def make_testbed(render_mode: str | None = None, **arguments: Any) -> ElasticEnv:
    """Entry point of `elastic_env/Testbed-v0`; arguments as in `configure_testbed`."""
    config = _configure(arguments)
    return ElasticEnv(TestbedTask(config, num_worlds=1), render_mode, lambda: TestbedPicture(config.pendulum))


def make_testbed_vector(
    num_envs: int = 1,
    num_threads: int = 0,
    autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    render_mode: str | None = None,
    **arguments: Any,
) -> ElasticVectorEnv:
    """Vector entry point of `elastic_env/Testbed-v0`; arguments as in `configure_testbed`."""
    if render_mode is not None:
        raise ConfigurationError(f"the vector environment does not render, got render_mode {render_mode!r}; use None")
    if not isinstance(num_envs, int) or num_envs < 1:
        raise ConfigurationError(f"num_envs must be a whole number >= 1, got {num_envs!r}")
    if num_threads < 0:
        raise ConfigurationError(f"num_threads must be >= 0, 0 for all cores, got {num_threads}")
    return ElasticVectorEnv(TestbedTask(_configure(arguments), num_envs), num_threads, autoreset_mode)


def _configure(arguments: dict[str, Any]) -> TestbedConfig:
    known = inspect.signature(configure_testbed).parameters
    for name in arguments:
        if name not in known:
            raise unknown_name("argument of elastic_env/Testbed-v0", name, known)
    return configure_testbed(**arguments)
