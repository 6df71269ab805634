"""`elastic_env/WalkInPlace-v0`: its configuration from the arguments of `gymnasium.make`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from elastic_env.core.errors import ConfigurationError, quote, require_known
from elastic_env.joint.elastic_joint import ElasticJoint
from elastic_env.motion.gait import Gait, make_gait
from elastic_env.registration import Robot, as_model
from elastic_env.robots.thormang import ID, NAME
from elastic_env.robots.thormang.config import WalkConfig, WalkRewardWeights
from elastic_env.robots.thormang.model import Thormang
from elastic_env.robots.thormang.picture import WalkerPicture
from elastic_env.robots.thormang.task import WalkTask
from elastic_env.world.robot_model import read_stiffness, with_stiffness
from elastic_env.world.scenario import Scenario, make_scenario

_GAIT_FIELDS = list(Gait.model_fields)[4:]
"""Parameters of a gait after the durations and the number of steps."""


def configure_walk(
    step_period: float | list[float] | tuple[float, float, float] | Gait = 3.0,
    num_steps: int | None = None,
    scenario: str | Scenario | list[str | Scenario] = "nominal",
    stiffness: float | str | Path | list[float] | None = None,
    joint: ElasticJoint | dict[str, Any] | None = None,
    robot: Thormang | dict[str, Any] | None = None,
    gait: dict[str, Any] | None = None,
    form: Literal["tendon", "rigid"] = "tendon",
    reward: WalkRewardWeights | dict[str, float] | None = None,
    bank: int = 0,
    timestep_s: float | None = None,
    sensors: Sequence[str] = (),
    fewest_steps: int | None = None,
) -> WalkConfig:
    """Make the walker's configuration from the arguments of `gymnasium.make`.

    Args:
        step_period: 24, 3, 1.6 or 1.1 [s], the three durations of double, single and double support
            [s], or a `Gait`.
        num_steps: Number of steps; default 4, or that of the `Gait`.
        scenario: Name as in `elastic_env.world.scenario`, or a `Scenario`; or in a vector
            environment a list with one of them for each world.
        stiffness: K of the joints [N·m/rad], one number or twelve, or the path of an
            `identification.json`; by default K of the joints.
        joint: Elastic joint for all twelve, or a mapping of changes to the default, which is the
            paper's H54-200-S500-R.
        robot: The robot's options, or a mapping of them: hip_half_spacing, twin_knee, friction.
        gait: Changes to walking in place: step_length_m, step_width_m, turn_rad (per step), lift_m,
            hip_height_m, transfer, settling_steps.
        form: "tendon" for elastic joints, "rigid" for an inelastic robot.
        reward: Weights of the reward terms, or a mapping of changes to the default.
        bank: Number of the bank of random robots, which keeps training and test robots apart.
        timestep_s: Physics step, which divides the control period of 4 ms; default 1 ms [s].
        sensors: Sensors in addition to the standard set: "link_encoder", "joint_torque",
            "accelerometer"; see `elastic_env.world.further_sensors`.
        fewest_steps: Fewest steps of a walk in place, at least 4, for training. The number of steps
            is then drawn per episode, up to `num_steps`, in whole strides of two. A shorter walk
            leaves out strides after its second step, and the clock skips them. Default `num_steps`.

    Raises:
        ConfigurationError: A name, a parameter or a combination that does not exist.
    """
    if not isinstance(gait, dict | None):
        needed = f"gait must be a mapping of {', '.join(_GAIT_FIELDS)}"
        raise ConfigurationError(f"{needed}, got {quote(gait)}; see also step_period")
    kind = "parameter of gait beside step_period and num_steps"
    require_known(kind, gait or {}, _GAIT_FIELDS)
    thormang = as_model("robot", robot, Thormang())
    usual = thormang.joints
    joints = {name: as_model("joint", joint, usual[name]) for name in usual}
    if stiffness is not None:
        joints = with_stiffness(joints, read_stiffness(stiffness))
    steps = {} if num_steps is None else {"num_steps": num_steps}
    is_list = isinstance(scenario, list | tuple)
    scenarios = [make_scenario(name) for name in (scenario if is_list else [scenario])]
    if not scenarios:
        raise ConfigurationError(
            "scenario must be a name, or a list with one for each world, got an empty list"
        )
    return WalkConfig(
        gait=make_gait(step_period, **steps, **(gait or {})),
        scenario=scenarios[0],
        scenarios=tuple(scenarios) if is_list else (),
        robot=thormang,
        joints=tuple(joints.values()),
        form=form,
        sensors=sensors,  # pyright: ignore[reportArgumentType]  the model takes any sequence
        reward=as_model("reward", reward, WalkRewardWeights()),
        bank=bank,
        fewest_steps=fewest_steps,
        **({} if timestep_s is None else dict[str, Any](timestep_s=timestep_s)),
    )


WALKER = Robot(NAME, ID, configure_walk, WalkTask, WalkerPicture)
make = WALKER.make
make_vector = WALKER.make_vector
