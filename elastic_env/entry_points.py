"""Entry points of the registered environments: arguments of `gymnasium.make` become a task behind a face."""

import inspect
from collections.abc import Callable, Sequence
from functools import partial
from numbers import Integral
from pathlib import Path
from typing import Any, Literal, TypeVar

from gymnasium.vector import AutoresetMode

from elastic_env.core.errors import ConfigurationError, shown, unknown_name
from elastic_env.joint.dynamixel import H54_200_S500_R
from elastic_env.joint.elasticity import ElasticJoint
from elastic_env.motion.gait import Gait, make_gait
from elastic_env.motion.references import AnyReference, make_reference
from elastic_env.robots.testbed.config import TestbedConfig
from elastic_env.robots.testbed.model import Pendulum
from elastic_env.robots.testbed.picture import TestbedPicture
from elastic_env.robots.testbed.task import TestbedTask
from elastic_env.robots.thormang.config import WalkConfig, WalkRewardWeights
from elastic_env.robots.thormang.model import Thormang
from elastic_env.robots.thormang.picture import WalkerPicture
from elastic_env.robots.thormang.task import WalkTask
from elastic_env.runtime.envs import ElasticEnv, ElasticVectorEnv
from elastic_env.runtime.joint_config import RewardWeights
from elastic_env.runtime.robot_model import read_stiffness, with_stiffness
from elastic_env.runtime.scenario import Scenario, make_scenario

ConfigT = TypeVar("ConfigT")

_GAIT = ("lift_m", "hip_height_m", "transfer")


def configure_testbed(
    reference: str | dict[str, Any] | AnyReference = "hold",
    scenario: str | Scenario = "nominal",
    stiffness: float | str | Path | None = None,
    joint: ElasticJoint | dict[str, Any] | None = None,
    pendulum: Pendulum | dict[str, Any] | None = None,
    form: Literal["tendon", "rigid"] = "tendon",
    observe_link: bool = False,
    reward: RewardWeights | dict[str, float] | None = None,
    timestep_s: float | None = None,
    sensors: Sequence[str] = (),
) -> TestbedConfig:
    """The testbed's configuration from the arguments of `gymnasium.make("elastic_env/Testbed-v0", ...)`.

    Args:
        reference: "hold", "sine", "multisine", "steps", a mapping with `kind` and parameters, or a reference model.
        scenario: Name as in `elastic_env.runtime.scenario`, or a `Scenario`.
        stiffness: K of the joint [N·m/rad], or the path of an `identification.json`; default that of the joint.
        joint: Elastic joint, or a mapping of what differs from the paper's H54-200-S500-R, the default.
        pendulum: The load, or a mapping of what differs from the default of 60 N·m at the horizontal.
        form: "tendon" for the elastic joint, "rigid" for what an inelastic testbed would do.
        observe_link: Whether the link's IMU is part of the observation.
        reward: Weights of the reward terms, or a mapping of what differs from the default.
        timestep_s: Physics step, which divides the control period of 4 ms; default 0.5 ms [s].
        sensors: What is observed beside the standard set: "link_encoder", "joint_torque", "accelerometer"; see
            `elastic_env.runtime.further_sensors`.

    Raises:
        ConfigurationError: A name, a parameter or a combination that does not exist.
    """
    _require_models(joint=(joint, ElasticJoint), pendulum=(pendulum, Pendulum), reward=(reward, RewardWeights))
    chosen = joint if isinstance(joint, ElasticJoint) else H54_200_S500_R.replace(**(joint or {}))
    if stiffness is not None:
        chosen = chosen.replace(stiffness=read_stiffness(stiffness))
    return TestbedConfig(
        reference=make_reference(reference),
        scenario=make_scenario(scenario, walks=False),
        joint=chosen,
        pendulum=pendulum if isinstance(pendulum, Pendulum) else Pendulum(**(pendulum or {})),
        form=form,
        sensors=tuple(sensors),
        observe_link=observe_link,
        reward=reward if isinstance(reward, RewardWeights) else RewardWeights(**(reward or {})),
        **({} if timestep_s is None else {"timestep_s": timestep_s}),
    )


def configure_walk(
    step_period: float | list[float] | tuple[float, float, float] | Gait = 3.0,
    num_steps: int | None = None,
    scenario: str | Scenario = "nominal",
    stiffness: float | str | Path | list[float] | None = None,
    joint: ElasticJoint | dict[str, Any] | None = None,
    robot: Thormang | dict[str, Any] | None = None,
    gait: dict[str, Any] | None = None,
    form: Literal["tendon", "rigid"] = "tendon",
    reward: WalkRewardWeights | dict[str, float] | None = None,
    bank: int = 0,
    timestep_s: float | None = None,
) -> WalkConfig:
    """The walker's configuration from the arguments of `gymnasium.make("elastic_env/WalkInPlace-v0", ...)`.

    Args:
        step_period: 24, 3, 1.6 or 1.1 [s], the three durations of double, single and double support [s], or a `Gait`.
        num_steps: Number of steps; default 4, or that of the `Gait`.
        scenario: Name as in `elastic_env.runtime.scenario`, or a `Scenario`.
        stiffness: K of the joints [N·m/rad], one number or twelve, or the path of an `identification.json`; default
            that of the joints.
        joint: Elastic joint for all twelve, or a mapping of what differs from the paper's H54-200-S500-R, the default.
        robot: The robot's options, or a mapping of them: hip_half_spacing, twin_knee, friction.
        gait: What differs from the default gait: lift_m, hip_height_m, transfer.
        form: "tendon" for elastic joints, "rigid" for what an inelastic robot would do.
        reward: Weights of the reward terms, or a mapping of what differs from the default.
        bank: Number of the bank that random robots come from, to keep those that are learned from apart.
        timestep_s: Physics step, which divides the control period of 4 ms; default 1 ms [s].

    Raises:
        ConfigurationError: A name, a parameter or a combination that does not exist.
    """
    _require_models(joint=(joint, ElasticJoint), robot=(robot, Thormang), reward=(reward, WalkRewardWeights))
    if not isinstance(gait, dict | None):
        raise ConfigurationError(f"gait must be a mapping of {', '.join(_GAIT)}, got {gait!r}; see also step_period")
    for name in gait or {}:
        if name not in _GAIT:
            raise unknown_name("parameter of gait beside step_period and num_steps", name, _GAIT)
    chosen = robot if isinstance(robot, Thormang) else Thormang(**(robot or {}))
    if isinstance(joint, ElasticJoint):
        joints = dict.fromkeys(chosen.joints, joint)
    else:
        joints = {name: own.replace(**(joint or {})) for name, own in chosen.joints.items()}
    if stiffness is not None:
        joints = with_stiffness(joints, read_stiffness(stiffness))
    steps = {} if num_steps is None else {"num_steps": num_steps}
    return WalkConfig(
        gait=make_gait(step_period, **steps, **(gait or {})),
        scenario=make_scenario(scenario),
        robot=chosen,
        joints=tuple(joints.values()),
        form=form,
        reward=reward if isinstance(reward, WalkRewardWeights) else WalkRewardWeights(**(reward or {})),
        bank=bank,
        **({} if timestep_s is None else {"timestep_s": timestep_s}),
    )


def _require_models(**arguments: tuple[Any, type[Any]]) -> None:
    """Refuse arguments that are neither a model, nor a mapping of its parameters, nor left out."""
    for name, (given, model) in arguments.items():
        if not isinstance(given, dict | model | None):
            raise ConfigurationError(f"{name} must be a {model.__name__} or a mapping of its parameters, got {given!r}")


def make_testbed(render_mode: str | None = None, **arguments: Any) -> ElasticEnv:
    """Entry point of `elastic_env/Testbed-v0`; arguments as in `configure_testbed`."""
    config = _configure(configure_testbed, "elastic_env/Testbed-v0", arguments)
    return ElasticEnv(TestbedTask(config, num_worlds=1), render_mode, partial(TestbedPicture, config.pendulum))


def make_testbed_vector(
    num_envs: int = 1,
    num_threads: int = 0,
    autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    render_mode: str | None = None,
    **arguments: Any,
) -> ElasticVectorEnv:
    """Vector entry point of `elastic_env/Testbed-v0`; arguments as in `configure_testbed`."""
    _require_vector_arguments(num_envs, num_threads)
    config = _configure(configure_testbed, "elastic_env/Testbed-v0", arguments)
    picture = partial(TestbedPicture, config.pendulum)
    return ElasticVectorEnv(
        TestbedTask(config, num_envs), num_threads, autoreset_mode, render_mode=render_mode, picture=picture
    )


def make_walk(render_mode: str | None = None, **arguments: Any) -> ElasticEnv:
    """Entry point of `elastic_env/WalkInPlace-v0`; arguments as in `configure_walk`."""
    config = _configure(configure_walk, "elastic_env/WalkInPlace-v0", arguments)
    task = WalkTask(config, num_worlds=1)
    return ElasticEnv(task, render_mode, partial(WalkerPicture, task))


def make_walk_vector(
    num_envs: int = 1,
    num_threads: int = 0,
    autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    render_mode: str | None = None,
    **arguments: Any,
) -> ElasticVectorEnv:
    """Vector entry point of `elastic_env/WalkInPlace-v0`; arguments as in `configure_walk`."""
    _require_vector_arguments(num_envs, num_threads)
    task = WalkTask(_configure(configure_walk, "elastic_env/WalkInPlace-v0", arguments), num_envs)
    picture = partial(WalkerPicture, task)
    return ElasticVectorEnv(task, num_threads, autoreset_mode, render_mode=render_mode, picture=picture)


def _require_vector_arguments(num_envs: int, num_threads: int) -> None:
    for name, number, least, note in (("num_envs", num_envs, 1, ""), ("num_threads", num_threads, 0, ", 0 for all")):
        if isinstance(number, bool) or not isinstance(number, Integral) or number < least:
            raise ConfigurationError(f"{name} must be a whole number >= {least}{note}, got {shown(number)}")


def _configure(configure: Callable[..., ConfigT], environment: str, arguments: dict[str, Any]) -> ConfigT:
    known = inspect.signature(configure).parameters
    for name in arguments:
        if name not in known:
            raise unknown_name(f"argument of {environment}", name, known)
    return configure(**arguments)
