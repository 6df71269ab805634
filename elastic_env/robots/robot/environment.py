"""`elastic_env/Robot-v0`: any robot on a fixed base, from a model file and a joint file.

env = gymnasium.make("elastic_env/Robot-v0", model="arm.xml", joints="arm.yaml",
end_effector="tool")
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from mujoco import MjModel

from elastic_env.core.errors import ConfigurationError, require_known
from elastic_env.joint import joint_settings, model_joints
from elastic_env.joint.compile_model import compile_spec
from elastic_env.joint.default_hinges import without_fingers
from elastic_env.joint.held_joints import hold_other_joints
from elastic_env.joint.joint_settings import GivenJoints, JointSettings
from elastic_env.joint.model_file import GivenModel
from elastic_env.joint.supported_models import require_robot
from elastic_env.joint.time_step import stable_timestep
from elastic_env.motion.arm_references import AnyArmReference
from elastic_env.registration import Robot
from elastic_env.rigid.tree.end_effector import outermost_body
from elastic_env.robots.joint_robot import JointPicture, JointRobot, JointRobotConfig
from elastic_env.robots.robot import ID, NAME
from elastic_env.robots.robot import joints as assumptions
from elastic_env.robots.robot.model import RigidModel, read_robot
from elastic_env.world.drawn_robot import stiffest_plant
from elastic_env.world.joint_config import RewardWeights
from elastic_env.world.joint_signals import ACTION_BOUND_RAD
from elastic_env.world.joint_task import JointTask
from elastic_env.world.physics import MOST_SUBSTEPS
from elastic_env.world.scenario import Scenario

EXAMPLE = Path(__file__).with_name("example.xml")
"""Example arm, the default model; its joints are in the YAML file of the same name."""

LOAD_SHARE = 0.2
"""Load that servos of unknown limits can carry, over the mass of the model: the load of the
scenario `payload` [1].
"""


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
) -> JointRobotConfig:
    """Make the configuration from the arguments of `gymnasium.make("elastic_env/Robot-v0", ...)`.

    Args:
        model: File of MJCF (.xml) or URDF (.urdf), its text, or a `mujoco.MjSpec`; without model
            and joints an example arm of four joints.
        joints: YAML file or mapping of the elastic joints by name or pattern, see
            `elastic_env.joint.joint_settings`. All other joints are fixed at the model's first
            keyframe, or at its reference.
        reference: "poses", "moves", "line", "circle", "sine", "multisine", "steps", "hold", a
            mapping with `kind` and parameters, such as {"kind": "csv", "file": "angles.csv"}, or a
            reference model.
        scenario: Name as in `elastic_env.world.scenario`, or a `Scenario`.
        end_effector: Site or body whose place and tilt are scored; default the outermost body.
        home: Angle about which each joint follows the reference, by name or in order [rad]. The
            default is the model's first keyframe, or its reference, within the joint ranges, or a
            near pose that the servos hold.
        load_kg: The scenario `payload` adds a fifth of this mass at the end effector [kg]; default
            the mass of the model including its base.
        imu: Site of the accelerometer.
        stiffness: K that replaces the one in `joints` [N·m/rad], one number or one per joint.
        form: "tendon" for elastic joints, "rigid" for an inelastic robot.
        sensors: Sensors in addition to the standard set, see `elastic_env.world.further_sensors`.
        reward: Weights of the reward terms, or a mapping of changes to the default.
        timestep_s: Physics step, which divides the control period of 4 ms [s]. The default is 0.5
            ms, or the largest stable step if the joints are unstable with it.
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
        problem = "needs a model beside joints, such as model='arm.xml'"
        raise ConfigurationError(f"{ID} {problem}")
    robot = joint_robot(model, {} if joints is None else joints, end_effector)
    load_kg = robot.load_kg if load_kg is None else load_kg
    robot = replace(robot, home=_home_angles(robot, home), imu=imu, load_kg=load_kg)
    config = robot.configure(
        reference=reference,
        scenario=scenario,
        stiffness=stiffness,
        form=form,
        sensors=sensors,
        reward=reward,
        timestep_s=timestep_s,
        action_bound_rad=action_bound_rad,
    )
    config = robot.with_near_poses(config, moves_home=home is None)
    if timestep_s is None:
        period_s = config.control_period_s
        model = compile_spec(robot.elastic(config), "the model with elastic joints")
        timestep_s = stable_timestep(stiffest_plant(model, config.scenario), period_s)
        if timestep_s < (shortest_s := period_s / MOST_SUBSTEPS):
            rigid = robot.rigid().compile()
            name, inertia = assumptions.lightest_links(rigid, config.joints)
            raise ConfigurationError(
                "the joints are too stiff, or their links or rotors too light: in"
                f" simulation they explode with a physics step of {shortest_s:g} s, the"
                " shortest that is played; give them less stiffness, or more rotor_inertia."
                f" Of the links the fastest are those of joint {name!r}: {inertia:.3g}"
                f" kg·m² on a spring of {config.joints[name].stiffness:g} N·m/rad"
            )
        config = config.replace(timestep_s=timestep_s)
    return config


def joint_robot(
    model: GivenModel, joints: GivenJoints, end_effector: str | None = None
) -> JointRobot:
    """Make a robot from its model and its elastic joints, see `configure_robot`."""
    spec = read_robot(model)
    whole = compile_spec(spec, "the model")
    require_robot(whole)
    settings = _elastic_hinges(whole, joints)
    names = list(settings)
    moving = hold_other_joints(spec, settings)
    rigid = compile_spec(moving.copy(), "the model with held joints")
    mass = float(rigid.body_subtreemass[0])
    elastic = assumptions.elastic_joints(moving, settings, LOAD_SHARE * mass)
    if len({joint.encoder_counts_per_turn for joint in elastic.values()}) > 1:
        needed = "encoder_counts_per_turn must be the same for all joints"
        raise ConfigurationError(f"{needed}; give it under '*'")
    return JointRobot(
        NAME,
        RigidModel(model, tuple(names)),
        elastic,
        home=assumptions.home_of_joints(whole, names).tolist(),
        end_effector=end_effector or outermost_body(rigid),
        load_kg=mass,
    )


def _elastic_hinges(model: MjModel, joints: GivenJoints) -> dict[str, JointSettings]:
    """Settings of the elastic hinges; a pattern does not match coupled fingers."""
    hinges = model_joints.hinges_of(model)
    mapping = joint_settings.joint_mapping(joints)
    names = [model.joint(j).name for j in range(model.njnt)]
    others = [name for name in names if name not in hinges]
    settings = assumptions.elastic_settings(mapping, hinges, others)
    nameless = joint_settings.key_of(mapping, "")
    is_meant = nameless is not None and mapping[nameless] != joint_settings.HELD
    if is_meant and model_joints.has_nameless_hinge(model):
        raise model_joints.nameless_hinge()
    return {name: settings[name] for name in without_fingers(model, settings, mapping)}


def _home_angles(
    robot: JointRobot, home: Mapping[str, float] | Sequence[float] | None
) -> Sequence[float] | None:
    """Home in order; joints that a mapping leaves out keep the robot's home."""
    if not isinstance(home, Mapping):
        return robot.home if home is None else home
    require_known("joint of home", home, robot.joints)
    angles: Sequence[float] = robot.home or [0.0] * len(robot.joints)
    pairs = zip(robot.joints, angles, strict=True)
    return [home.get(name, angle) for name, angle in pairs]


ROBOT = Robot(NAME, ID, configure_robot, JointTask, JointPicture)
make = ROBOT.make
make_vector = ROBOT.make_vector
