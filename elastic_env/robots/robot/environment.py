"""`elastic_env/Robot-v0`: any robot on a fixed base, from files of its model and its joints.

env = gymnasium.make("elastic_env/Robot-v0", model="arm.xml", joints="arm.yaml",
end_effector="tool")
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import mujoco

from elastic_env.core.config import read_mapping
from elastic_env.core.errors import ConfigurationError, require_known
from elastic_env.joint.held_joints import hold_other_joints
from elastic_env.joint.joint_settings import HELD, GivenJoints, JointSettings, key_of
from elastic_env.joint.model_file import GivenModel, compiled_spec
from elastic_env.joint.supported_models import (
    has_nameless_hinge,
    hinges_of,
    nameless_hinge,
    require_robot,
    without_fingers,
)
from elastic_env.joint.time_step import stable_timestep
from elastic_env.motion.arm_references import AnyArmReference
from elastic_env.registration import Robot
from elastic_env.rigid.tree.end_effector import outermost_body
from elastic_env.robots.joint_robot import JointPicture, JointRobot, JointRobotConfig
from elastic_env.robots.robot import ID, NAME
from elastic_env.robots.robot.joints import elastic_joints, elastic_settings, home_of_joints
from elastic_env.robots.robot.model import RigidModel, read_robot
from elastic_env.world.drawn_robot import stiffest_plant
from elastic_env.world.joint_config import RewardWeights
from elastic_env.world.joint_task import JointTask
from elastic_env.world.physics import MOST_SUBSTEPS
from elastic_env.world.scenario import Scenario
from elastic_env.world.task import ACTION_BOUND_RAD

EXAMPLE = Path(__file__).with_name("example.xml")
"""The made-up arm that is played where no model is named; its joints are in the YAML file beside
it.
"""

LOAD_SHARE = 0.2
"""Share of the mass of the joints' links that servos of unknown limits can carry: what the
scenario `payload` adds.
"""


class RobotConfig(JointRobotConfig):
    """All of the environment of any robot."""

    robot: JointRobot
    """The robot as its files describe it."""


def configure_robot(
    model: GivenModel | None = None,
    joints: GivenJoints | None = None,
    reference: str | dict[str, Any] | AnyArmReference = "poses",
    scenario: str | Scenario = "nominal",
    end_effector: str | None = None,
    home: Mapping[str, float] | Sequence[float] | None = None,
    load_kg: float | None = None,
    imu: str | None = None,
    stiffness: float | str | Path | list[float] | None = None,
    form: Literal["tendon", "rigid"] = "tendon",
    sensors: Sequence[str] = (),
    reward: RewardWeights | dict[str, float] | None = None,
    timestep_s: float | None = None,
    action_bound_rad: float = ACTION_BOUND_RAD,
) -> RobotConfig:
    """The configuration from the arguments of `gymnasium.make("elastic_env/Robot-v0", ...)`.

    Args:
        model: File of MJCF (.xml) or URDF (.urdf), the text of one, or a `mujoco.MjSpec`; without
            it and joints a made-up arm of four joints.
        joints: YAML file or mapping of the elastic joints by name or pattern, see
            `elastic_env.joint.joint_settings`. All other joints are held where the model's first
            keyframe has them, or at its reference.
        reference: "poses", "moves", "line", "circle", "sine", "multisine", "steps", "hold", a
            mapping with `kind` and parameters, such as {"kind": "csv", "file": "angles.csv"}, or a
            reference model.
        scenario: Name as in `elastic_env.world.scenario`, or a `Scenario`.
        end_effector: Site or body whose place and tilt are scored; default the outermost body.
        home: Angle about which each joint follows the reference, by name or in order [rad]; default
            the model's first keyframe, or its reference, within the joint ranges.
        load_kg: The scenario `payload` adds a fifth of this mass at the end effector [kg]; default
            the mass that the joints carry.
        imu: Site of the accelerometer.
        stiffness: K in place of that in `joints` [N·m/rad], one number or one per joint.
        form: "tendon" for elastic joints, "rigid" for what an inelastic robot would do.
        sensors: What is observed beside the standard set, see `elastic_env.world.further_sensors`.
        reward: Weights of the reward terms, or a mapping of what differs from the default.
        timestep_s: Physics step, which divides the control period of 4 ms; default 0.5 ms, or where
            the joints explode with it the largest stable one [s].
        action_bound_rad: Largest command offset [rad].

    Raises:
        ConfigurationError: A file, a name, a parameter or a combination that does not exist, or a
            model that floats.
    """
    if model is None and joints is None:
        model = EXAMPLE
        joints = EXAMPLE.with_suffix(".yaml")
        end_effector = end_effector or "tool"
    if model is None:
        raise ConfigurationError(f"{ID} needs a model beside joints, such as model='arm.xml'")
    robot = joint_robot(model, {} if joints is None else joints, end_effector)
    robot = replace(
        robot, home=_home(robot, home), imu=imu, **({} if load_kg is None else {"load_kg": load_kg})
    )
    settings = robot.configure(
        reference=reference,
        scenario=scenario,
        stiffness=stiffness,
        form=form,
        sensors=sensors,
        reward=reward,
        timestep_s=timestep_s,
        action_bound_rad=action_bound_rad,
    )
    if timestep_s is None:
        played = stiffest_plant(
            compiled_spec(robot.elastic(settings), "the model with elastic joints"),
            settings.scenario,
        )
        timestep_s = stable_timestep(played, settings.control_period_s)
        _require_step(timestep_s, settings.control_period_s)
        settings = settings.replace(timestep_s=timestep_s)
    return RobotConfig(
        robot=robot, **{name: getattr(settings, name) for name in type(settings).model_fields}
    )


def _require_step(timestep_s: float, control_period_s: float) -> None:
    """Refuse joints that only a physics step follows which is too short to be played."""
    shortest_s = control_period_s / MOST_SUBSTEPS
    if timestep_s < shortest_s:
        raise ConfigurationError(
            "the joints are too stiff, or their links or rotors too light: they explode with a"
            f" physics step of {shortest_s:g} s, the shortest that is played; give them less"
            " stiffness, or more rotor_inertia"
        )


def joint_robot(
    model: GivenModel, joints: GivenJoints, end_effector: str | None = None
) -> JointRobot:
    """A robot from its model and its elastic joints; arguments and errors as `configure_robot`."""
    spec = read_robot(model)
    whole = compiled_spec(spec, "the model")
    require_robot(whole)
    settings = _elastic_hinges(whole, joints)
    names = list(settings)
    moving = hold_other_joints(spec, settings)
    rigid = compiled_spec(moving.copy(), "the model with held joints")
    mass = float(rigid.body_subtreemass[0])
    elastic = elastic_joints(moving, settings, LOAD_SHARE * mass)
    if len({joint.encoder_counts_per_turn for joint in elastic.values()}) > 1:
        raise ConfigurationError(
            "encoder_counts_per_turn must be the same for all joints; give it under '*'"
        )
    return JointRobot(
        NAME,
        RigidModel(model, tuple(names)),
        elastic,
        home=home_of_joints(whole, names).tolist(),
        end_effector=end_effector or outermost_body(rigid),
        load_kg=mass,
    )


def _elastic_hinges(model: mujoco.MjModel, joints: GivenJoints) -> dict[str, JointSettings]:
    """Settings of the elastic hinges: of those that a pattern fits all but coupled fingers."""
    hinges = hinges_of(model)
    given = joints if isinstance(joints, Mapping) else read_mapping(Path(joints))
    others = [name for j in range(model.njnt) if (name := model.joint(j).name) not in hinges]
    settings = elastic_settings(given, hinges, others)
    key_of_nameless = key_of(given, "")
    if has_nameless_hinge(model) and key_of_nameless is not None and given[key_of_nameless] != HELD:
        raise nameless_hinge()
    return {name: settings[name] for name in without_fingers(model, settings, given)}


def _home(
    robot: JointRobot, given: Mapping[str, float] | Sequence[float] | None
) -> Sequence[float] | None:
    """Angles by name, of which those that are not given are the robot's own."""
    if not isinstance(given, Mapping):
        return robot.home if given is None else given
    require_known("joint of home", given, robot.joints)
    own: Sequence[float] = robot.home or [0.0] * len(robot.joints)
    return [given.get(name, angle) for name, angle in zip(robot.joints, own, strict=True)]


def _task(config: RobotConfig, num_worlds: int) -> JointTask:
    return JointTask(config, config.robot.plant(config), num_worlds)


def _picture(task: JointTask) -> JointPicture:
    assert isinstance(task.config, RobotConfig)
    return JointPicture(task.config.robot, task)


ROBOT = Robot(NAME, ID, configure_robot, _task, _picture)  # pyright: ignore[reportArgumentType]
make = ROBOT.make
make_vector = ROBOT.make_vector
