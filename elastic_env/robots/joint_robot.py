"""A user's robot as an environment: a rigid model on a fixed base and its elastic joints.

    ARM = JointRobot("arm", rigid_arm, {"shoulder": JOINT, "elbow": JOINT})
    ARM.register()
    env = gymnasium.make("elastic_env/Arm-v0", scenario="soft", reference="multisine")

`rigid_arm` is a function without arguments that returns a `mujoco.MjSpec`; the mapping names all of
its hinges. Every joint follows the reference about its home, under the scenarios of robots that do
not walk.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np
from mujoco import MjSpec

from elastic_env.core.config import Model
from elastic_env.core.errors import ConfigurationError, require_known
from elastic_env.joint.elastic_joint import ElasticJoint
from elastic_env.joint.make_elastic import transform_hinges
from elastic_env.motion import arm_references
from elastic_env.motion.arm_references import AnyArmReference, ArmReference, Workspace
from elastic_env.motion.references import Multisine
from elastic_env.registration import Robot, as_model
from elastic_env.rendering import deviation_picture
from elastic_env.rendering.picture import CAMERA, set_stage
from elastic_env.rendering.side_by_side import DisplayRobot, Sides
from elastic_env.rigid.rigid_body import RigidBody
from elastic_env.rigid.tree.end_effector import EndEffector
from elastic_env.robots import feasible_reference
from elastic_env.world import robot_model
from elastic_env.world.further_sensors import ACCELEROMETER, add_accelerometer
from elastic_env.world.joint_config import FRICTIONS, JointConfig, RewardWeights
from elastic_env.world.joint_plant import JointPlant
from elastic_env.world.joint_signals import ACTION_BOUND_RAD
from elastic_env.world.joint_task import JointTask
from elastic_env.world.robot_model import RobotModel, joint_ranges
from elastic_env.world.scenario import Scenario, make_scenario

_REFERENCE = "elastic_env_reference_"
"""Prefix of the names of the robot that shows the reference."""
_MOST_HALVINGS = 12
"""Halvings of the extent of poses, to find poses that the servos can follow."""
_POINT_INERTIA_M2 = 1e-4
"""Moment of inertia of a point mass over its mass: that of a ball of 16 mm [m²]."""


class RobotOptions(Model):
    """Numbers and names of a `JointRobot`, whose types are checked."""

    home: list[float] | None
    imu: str | None
    end_effector: str | None
    load_kg: float | None


@dataclass(frozen=True)
class JointRobot:
    """A robot of elastic joints on a fixed base.

    Attributes:
        name: Short name; the id is elastic_env/<Name>-v0.
        rigid: Makes the rigid model; all of its joints are hinges.
        joints: Elastic joint of every hinge, with servo, in the order of all arrays.
        home: Angle about which each joint follows the reference, (n,) [rad]; None for zeros.
        imu: Site of the accelerometer; None for a robot without one.
        end_effector: Site or body whose place and tilt are scored; None to score joints only.
        load_kg: The scenario `payload` adds a fifth of this mass at the end effector [kg]; None to
            scale the mass of the body of the last joint.
    """

    name: str
    rigid: Callable[[], MjSpec]
    joints: Mapping[str, ElasticJoint]
    home: Sequence[float] | None = None
    imu: str | None = None
    end_effector: str | None = None
    load_kg: float | None = None

    def __post_init__(self) -> None:
        RobotOptions(**{name: getattr(self, name) for name in RobotOptions.model_fields})

    @property
    def id(self) -> str:
        """Gymnasium's id of the environment."""
        return f"elastic_env/{self.name.title().replace('_', '')}-v0"

    @property
    def robot(self) -> Robot:
        """The robot as an environment with the task `JointTask`."""
        return Robot(self.name, self.id, self.configure, JointTask, JointPicture)

    def register(self) -> None:
        """Register the environment with Gymnasium."""
        self.robot.register()

    def configure(
        self,
        reference: str | dict[str, Any] | AnyArmReference = "multisine",
        scenario: str | Scenario = "nominal",
        stiffness: float | str | Path | list[float] | None = None,
        form: Literal["tendon", "rigid"] = "tendon",
        sensors: Sequence[str] = (),
        reward: RewardWeights | dict[str, float] | None = None,
        timestep_s: float | None = None,
        action_bound_rad: float = ACTION_BOUND_RAD,
    ) -> "JointRobotConfig":
        """Make the configuration from the arguments of `gymnasium.make`.

        Args:
            reference: "poses", "moves", "line", "circle", "sine", "multisine", "steps", "hold", a
                mapping with `kind` and parameters, such as {"kind": "csv", "file": "angles.csv"},
                or a reference model.
            scenario: Name as in `elastic_env.world.scenario`, or a `Scenario`.
            stiffness: K of the joints [N·m/rad], one number or one per joint; by default K of
                `joints`.
            form: "tendon" for elastic joints, "rigid" for an inelastic robot.
            sensors: Sensors in addition to the standard set, see
                `elastic_env.world.further_sensors`.
            reward: Weights of the reward terms, or a mapping of changes to the default.
            timestep_s: Physics step, which divides the control period of 4 ms; default 0.5 ms [s].
            action_bound_rad: Largest command offset [rad].

        Raises:
            ConfigurationError: A name, a parameter or a combination that does not exist.
        """
        joints = dict(self.joints)
        if stiffness is not None:
            value = robot_model.read_stiffness(stiffness)
            joints = robot_model.with_stiffness(joints, value)
        return JointRobotConfig(
            robot=self,
            reference=arm_references.make_arm_reference(reference),
            scenario=make_scenario(scenario, walks=False),
            joints=joints,
            form=form,
            sensors=sensors,  # pyright: ignore[reportArgumentType]  the model takes any sequence
            reward=as_model("reward", reward, RewardWeights()),
            action_bound_rad=action_bound_rad,
            **({} if timestep_s is None else {"timestep_s": timestep_s}),
        )

    def plant(self, config: "JointRobotConfig") -> JointPlant:
        """Make the plant, with the true and the assumed robot.

        Raises:
            ConfigurationError: The reference needs more torque than the servos have, or a sensor
                has no place.
        """
        true, body, workspace = self._true_robot(config)
        motion, q = feasible_reference.plan_motion(config, true, body, workspace)
        rigid = self.rigid().compile()
        assumed = RobotModel(config.assumed_joints, rigid, config.control_period_s)
        feasible_reference.warn_of_action_bound(config, assumed, body.gravity_torque(q))
        return JointPlant(
            name=self.name,
            model=self.elastic(config).compile(),
            assumed=assumed,
            true=true,
            form=config.form,
            static_torque=body.gravity_torque,
            torque_gradient=body.gravity_gradient,
            motion=motion,
            end_effector=workspace.end_effector,
        )

    def with_near_poses(self, config: "JointRobotConfig", moves_home: bool) -> "JointRobotConfig":
        """Return the configuration with poses closer to home if its servos are too weak for others.

        It is changed only if the user chose neither the extent of the poses nor the duration of the
        moves.

        Args:
            config: Configuration, whose reference may be poses or moves.
            moves_home: True if home may be moved to where the servos hold it.

        Raises:
            ConfigurationError: The servos do not hold the robot's weight anywhere near its home.

        Warns:
            UserWarning: The configuration is changed.
        """
        reference = config.reference
        if not isinstance(reference, arm_references.Poses | arm_references.Moves):
            return config
        default = type(reference)()
        if (reference.move_s, reference.within_rad) != (default.move_s, default.within_rad):
            return config
        true, body, workspace = self._true_robot(config)
        try:
            feasible_reference.plan_motion(config, true, body, workspace)
        except arm_references.WeakServosError as error:
            weak_servos = error
        else:
            return config
        home = workspace.held_home() if moves_home else workspace.home
        if home is None:
            raise feasible_reference.home_error(true, body, workspace.home)
        workspace = replace(workspace, home=home)
        for halvings in range(_MOST_HALVINGS):
            near = reference.replace(within_rad=default.within_rad / 2**halvings)
            changed = config.replace(
                reference=near, robot=replace(config.robot, home=home.tolist())
            )
            try:
                feasible_reference.plan_motion(changed, true, body, workspace)
            except arm_references.WeakServosError:
                continue
            before = config.robot.home
            feasible_reference.warn_of_near_poses(true.joint_names, near, before, home)
            return changed
        raise weak_servos

    def _true_robot(self, config: "JointRobotConfig") -> tuple[RobotModel, RigidBody, Workspace]:
        """The true robot, its links, and its workspace for references."""
        rigid = self._spec_with_load(config).compile()
        true = RobotModel(config.true_joints, rigid, config.control_period_s)
        names = true.joint_names
        n = len(names)
        body = RigidBody(rigid, names)
        home = np.array([0.0] * n if self.home is None else self.home, dtype=np.float64)
        if home.shape != (n,):
            needed = f"must have one angle per joint, {n}"
            raise ConfigurationError(f"home {needed}, got {len(home)}")
        tool = None
        if self.end_effector is not None:
            tool = EndEffector(rigid, names, self.end_effector)
        lowest, highest = joint_ranges(rigid, names)
        shortage = partial(feasible_reference.torque_shortage, true, body)
        workspace = Workspace(tuple(names), lowest, highest, home, shortage, tool)
        return true, body, workspace

    def elastic(self, config: "JointRobotConfig") -> MjSpec:
        """Make the plant: the model with the scenario's load, elastic joints, and sensors.

        Raises:
            ConfigurationError: A sensor has no place.
        """
        spec = self._spec_with_load(config)
        spec = transform_hinges(spec, config.true_joints, config.form)
        spec.option.timestep = config.timestep_s
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
        # a NaN must end the episode; MuJoCo must not restart the world by itself
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        if ACCELEROMETER in config.sensors:
            if self.imu is None:
                cure = "name its site, JointRobot(..., imu=SITE)"
                raise ConfigurationError(f"{self.name} has no IMU: {cure}")
            require_known("site for the IMU", [self.imu], [site.name for site in spec.sites])
            add_accelerometer(spec, self.imu)
        return spec

    def _spec_with_load(self, config: "JointRobotConfig") -> MjSpec:
        """Model with the scenario's load: a point mass at the end effector, or a scaled body."""
        spec = self.rigid()
        scale = config.scenario.pendulum_mass_scale
        if scale == 1.0:
            return spec
        if self.load_kg is not None:
            _add_point_mass(spec, self.end_effector, (scale - 1.0) * self.load_kg)
        else:
            last = spec.copy().compile().joint(list(self.joints)[-1])
            _scale_mass(spec, int(last.bodyid[0]), scale)
        return spec


class JointRobotConfig(JointConfig):
    """All parameters of the environment of a `JointRobot`."""

    reference: ArmReference = Multisine()  # pyright: ignore[reportIncompatibleVariableOverride]
    robot: JointRobot
    joints: dict[str, ElasticJoint]
    """The joints as they are assumed; the scenario defines how the true ones differ."""

    @property
    def true_joints(self) -> dict[str, ElasticJoint]:
        """The joints in the plant."""
        return {name: self.plant_joint(joint) for name, joint in self.joints.items()}

    @property
    def assumed_joints(self) -> dict[str, ElasticJoint]:
        """Joints as a compensator knows them: without friction where the scenario has none."""
        if self.scenario.friction_scale > 0.0:
            return self.joints
        none = dict.fromkeys(FRICTIONS, 0.0)
        return {name: joint.replace(**none) for name, joint in self.joints.items()}

    def plant(self) -> JointPlant:
        """Make the plant, with the true and the assumed robot."""
        return self.robot.plant(self)


class JointPicture(deviation_picture.DeviationPicture):
    """Picture of the robot with enlarged deviations, and of the reference as a translucent robot.

    Args:
        task: Task of the worlds whose true state is drawn.
    """

    def __init__(self, task: JointTask) -> None:
        assert isinstance(task.config, JointRobotConfig)
        robot = task.config.robot
        spec = robot.rigid()
        set_stage(spec, deviation_picture.WIDTH, deviation_picture.HEIGHT)
        view = spec.copy().compile().stat
        x, y, z = view.center
        eye = [x, y - 2.4 * view.extent, z + 0.25 * view.extent]
        spec.worldbody.add_camera(name=CAMERA, pos=eye, xyaxes=[1, 0, 0, 0, 0.1, 1])
        light = spec.worldbody.add_light(dir=[-0.2, 0.7, -0.7], castshadow=False)
        light.pos = [x + view.extent, y - 3.0 * view.extent, z + 3.0 * view.extent]
        light.diffuse = [0.5] * 3
        light.specular = [0.0] * 3
        reference = robot.rigid()
        for geom in reference.geoms:
            geom.rgba = deviation_picture.REFERENCE_RGBA
        spec.attach(reference, prefix=_REFERENCE, frame=spec.worldbody.add_frame())
        legend = [("translucent: reference", deviation_picture.REFERENCE_WORD_RGBA)]
        super().__init__(spec, legend)
        self._robot = robot
        self._task = task
        self._joints = list(robot.joints)

    def display_robot(self) -> DisplayRobot:
        """Return the robot of a side-by-side picture."""
        extent = self._robot.rigid().compile().stat.extent
        return DisplayRobot(self._robot.rigid(), self._joints, (1.5 * extent, 0.0, 0.0))

    def sides(self, now: Mapping[str, float], world: int = 0) -> Sides:  # noqa: ARG002
        """Return reference, motor side and link side of a world."""
        joints = self._task.sample().joints["truth"][world]
        return Sides(*(joints[name].copy() for name in ("q_ref", "theta", "q")))

    def _pose(self, now: dict[str, float], world: int) -> None:  # noqa: ARG002
        joints = self._task.sample().joints["truth"][world]
        q_ref = joints["q_ref"]
        enlarged = deviation_picture.enlarge_deviation(joints["q"], q_ref)
        for name, angle, reference in zip(self._joints, enlarged, q_ref, strict=True):
            self._data.joint(name).qpos = angle
            self._data.joint(_REFERENCE + name).qpos = reference


def _scale_mass(spec: MjSpec, body: int, scale: float) -> None:
    """Scale mass and inertia of a body at its center of mass."""
    compiled = spec.copy().compile().body(body)
    carrier = spec.body(compiled.name)
    carrier.mass = float(compiled.mass[0]) * scale
    carrier.inertia = compiled.inertia * scale
    carrier.ipos = compiled.ipos
    carrier.iquat = compiled.iquat
    carrier.explicitinertial = True


def _add_point_mass(spec: MjSpec, end_effector: Any, mass: float) -> None:
    """Add a point mass to a model at its end effector."""
    names = [part.name for part in (*spec.sites, *spec.bodies[1:]) if part.name]
    require_known("site or body for end_effector", [end_effector], names)
    site = next((site for site in spec.sites if site.name == end_effector), None)
    carrier: Any = spec.body(end_effector) if site is None else site.parent
    if not mass > 0.0:
        raise ConfigurationError(
            f"the load at the end effector {end_effector!r} must be > 0 kg, got {mass:g} kg; give"
            " load_kg and the scenario's pendulum_mass_scale - 1 the same sign"
        )
    load = carrier.add_body(pos=np.zeros(3) if site is None else site.pos, mass=mass)
    load.ipos = [0.0] * 3
    load.inertia = [_POINT_INERTIA_M2 * mass] * 3
    load.explicitinertial = True
