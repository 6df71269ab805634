"""A robot of one's own: a rigid model on a fixed base and its elastic joints, as an environment.

    ARM = JointRobot("arm", rigid_arm, {"shoulder": JOINT, "elbow": JOINT})
    ARM.register()
    env = gymnasium.make("elastic_env/Arm-v0", scenario="soft", reference="multisine")

`rigid_arm` is a function without arguments that returns a `mujoco.MjSpec`, whose hinges are all
named here. Every joint follows the reference about its home, under the scenarios of robots that do
not walk.
"""

import warnings
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
from elastic_env.core.signals import Array
from elastic_env.joint.elasticity import ElasticJoint
from elastic_env.joint.friction import passed_torque
from elastic_env.joint.make_elastic import transform_hinges
from elastic_env.motion import arm_references
from elastic_env.motion.arm_references import AnyArmReference, ArmReference, Workspace
from elastic_env.motion.references import Multisine
from elastic_env.motion.trajectory import Motion
from elastic_env.registration import Robot, as_model
from elastic_env.rendering.picture import CAMERA, set_stage
from elastic_env.rendering.side_by_side import DisplayRobot, Sides
from elastic_env.rigid.rigid_body import RigidBody
from elastic_env.rigid.tree.end_effector import EndEffector
from elastic_env.robots import deviations
from elastic_env.world import joint_config, robot_model
from elastic_env.world.further_sensors import ACCELEROMETER, add_accelerometer
from elastic_env.world.joint_config import JointConfig, RewardWeights
from elastic_env.world.joint_signals import ACTION_BOUND_RAD
from elastic_env.world.joint_task import JointPlant, JointTask
from elastic_env.world.robot_model import RobotModel, joint_ranges
from elastic_env.world.scenario import Scenario, make_scenario

_REFERENCE = "elastic_env_reference_"
"""Prefix of the names of the robot that is the reference."""
_SPARE = 0.8
"""Share of the servos' torque that poses may need at rest."""
_HALVINGS = 12
"""How often the extent of poses is halved until servos can follow them."""
_POINT = 1e-4
"""Moment of inertia of a point mass over its mass: that of a ball of 16 mm [m²]."""


class RobotOptions(Model):
    """Values of a `JointRobot` that are numbers and names."""

    home: list[float] | None
    imu: str | None
    end_effector: str | None
    load_kg: float | None


@dataclass(frozen=True)
class JointRobot:
    """A robot of elastic joints on a fixed base.

    Attributes:
        name: Short name; the id is elastic_env/<Name>-v0.
        rigid: Makes the rigid model, all of whose joints are hinges.
        joints: Elastic joint of every hinge, with servo, in the order of all arrays.
        home: Angle about which each joint follows the reference, (n,) [rad]; None for zeros.
        imu: Site of the accelerometer; None for a robot without one.
        end_effector: Site or body whose place and tilt are scored; None to score the joints alone.
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
        """Of Gymnasium."""
        return f"elastic_env/{self.name.title().replace('_', '')}-v0"

    @property
    def robot(self) -> Robot:
        """The environment that it is."""
        return Robot(self.name, self.id, self.configure, JointTask, JointPicture)

    def register(self) -> None:
        """Make its id known to Gymnasium."""
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
        """The configuration from the arguments of `gymnasium.make`.

        Args:
            reference: "poses", "moves", "line", "circle", "sine", "multisine", "steps", "hold", a
                mapping with `kind` and parameters, such as {"kind": "csv", "file": "angles.csv"},
                or a reference model.
            scenario: Name as in `elastic_env.world.scenario`, or a `Scenario`.
            stiffness: K of the joints [N·m/rad], one number or one per joint; default that of the
                joints.
            form: "tendon" for elastic joints, "rigid" for what an inelastic robot would do.
            sensors: What is observed beside the standard set, see
                `elastic_env.world.further_sensors`.
            reward: Weights of the reward terms, or a mapping of what differs from the default.
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
        """The robot as it is built, and as it is known.

        Raises:
            ConfigurationError: The reference needs more torque than the servos have, or a sensor
                has no place.
        """
        true, body, workspace = self._built(config)
        motion, q = _followed(config, true, body, workspace)
        rigid = self.rigid().compile()
        assumed = RobotModel(config.known_joints, rigid, config.control_period_s)
        _warn_of_action_bound(config, assumed, body.gravity_torque(q))
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

    def within_torque(self, config: "JointRobotConfig", moves_home: bool) -> "JointRobotConfig":
        """The configuration, with poses closer to home where its servos cannot follow others.

        Only where neither the extent of the poses nor the duration of the moves is chosen.

        Args:
            config: Its reference may be poses or moves.
            moves_home: Home may be moved to where the servos hold it.

        Raises:
            ConfigurationError: The servos do not hold the robot's weight anywhere near its home.

        Warns:
            UserWarning: Something is changed.
        """
        reference = config.reference
        if not isinstance(reference, arm_references.Poses | arm_references.Moves):
            return config
        default = type(reference)()
        if (reference.move_s, reference.within_rad) != (default.move_s, default.within_rad):
            return config
        true, body, workspace = self._built(config)
        try:
            _followed(config, true, body, workspace)
        except arm_references.WeakServosError as error:
            weak = error
        else:
            return config
        home = workspace.held_home() if moves_home else workspace.home
        if home is None:
            raise _unheld(true, body, workspace.home)
        workspace = replace(workspace, home=home)
        for halvings in range(_HALVINGS):
            near = reference.replace(within_rad=default.within_rad / 2**halvings)
            changed = config.replace(
                reference=near, robot=replace(config.robot, home=home.tolist())
            )
            try:
                _followed(changed, true, body, workspace)
            except arm_references.WeakServosError:
                continue
            _warn_of_near_poses(true.joint_names, near, config.robot.home, home)
            return changed
        raise weak

    def _built(self, config: "JointRobotConfig") -> tuple[RobotModel, RigidBody, Workspace]:
        """The robot as it is built, its links, and what its references know of it."""
        loaded = self._loaded(config).compile()
        true = RobotModel(config.true_joints, loaded, config.control_period_s)
        names = true.joint_names
        n = len(names)
        body = RigidBody(loaded, names)
        own = [0.0] * n if self.home is None else self.home
        home = np.array(own, dtype=np.float64)
        if home.shape != (n,):
            needed = f"must have one angle per joint, {n}"
            raise ConfigurationError(f"home {needed}, got {len(home)}")
        tool = None
        if self.end_effector is not None:
            tool = EndEffector(loaded, names, self.end_effector)
        lowest, highest = joint_ranges(true.rigid, names)
        lack = partial(_lack, true, body)
        workspace = Workspace(tuple(names), lowest, highest, home, lack, tool)
        return true, body, workspace

    def elastic(self, config: "JointRobotConfig") -> MjSpec:
        """The plant: the model with the scenario's load, with elastic joints, and with sensors.

        Raises:
            ConfigurationError: A sensor has no place.
        """
        spec = transform_hinges(self._loaded(config), config.true_joints, config.form)
        spec.option.timestep = config.timestep_s
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
        # a NaN must end the episode, not restart the world behind the task's back
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        if ACCELEROMETER in config.sensors:
            if self.imu is None:
                cure = "name its site, JointRobot(..., imu=SITE)"
                raise ConfigurationError(f"{self.name} has no IMU: {cure}")
            require_known("site for the IMU", [self.imu], [site.name for site in spec.sites])
            add_accelerometer(spec, self.imu)
        return spec

    def _loaded(self, config: "JointRobotConfig") -> MjSpec:
        """The model with its load scaled, or with the share of a mass at its end effector."""
        spec = self.rigid()
        scale = config.scenario.pendulum_mass_scale
        if scale == 1.0:
            return spec
        if self.load_kg is not None:
            return _carrying(spec, self.end_effector, (scale - 1.0) * self.load_kg)
        last = spec.copy().compile().joint(list(self.joints)[-1])
        return _scaled(spec, int(last.bodyid[0]), scale)


class JointRobotConfig(JointConfig):
    """All of the environment of a robot of one's own."""

    reference: ArmReference = Multisine()  # pyright: ignore[reportIncompatibleVariableOverride]
    robot: JointRobot
    joints: dict[str, ElasticJoint]
    """The joints as they are known; the scenario says in what the true ones differ."""

    @property
    def true_joints(self) -> dict[str, ElasticJoint]:
        """The joints as the plant has them."""
        return {name: self.as_built(joint) for name, joint in self.joints.items()}

    @property
    def known_joints(self) -> dict[str, ElasticJoint]:
        """Joints as a compensator knows them: without friction where the scenario has none."""
        if self.scenario.friction_scale > 0.0:
            return self.joints
        none = dict.fromkeys(joint_config.FRICTIONS, 0.0)
        return {name: one.replace(**none) for name, one in self.joints.items()}

    def plant(self) -> JointPlant:
        """The robot as it is built, and as it is known."""
        return self.robot.plant(self)


class JointPicture(deviations.DeviationPicture):
    """The robot with its deviations enlarged, and the reference as a translucent robot.

    Args:
        task: Rules of the worlds whose true state is drawn.
    """

    def __init__(self, task: JointTask) -> None:
        assert isinstance(task.config, JointRobotConfig)
        robot = task.config.robot
        spec = robot.rigid()
        set_stage(spec, deviations.WIDTH, deviations.HEIGHT)
        look = spec.copy().compile().stat
        x, y, z = look.center
        eye = [x, y - 2.4 * look.extent, z + 0.25 * look.extent]
        spec.worldbody.add_camera(name=CAMERA, pos=eye, xyaxes=[1, 0, 0, 0, 0.1, 1])
        light = spec.worldbody.add_light(dir=[-0.2, 0.7, -0.7], castshadow=False)
        light.pos = [x + look.extent, y - 3.0 * look.extent, z + 3.0 * look.extent]
        light.diffuse = [0.5] * 3
        light.specular = [0.0] * 3
        reference = robot.rigid()
        for geom in reference.geoms:
            geom.rgba = deviations.REFERENCE_RGBA
        spec.attach(reference, prefix=_REFERENCE, frame=spec.worldbody.add_frame())
        legend = [("translucent: reference", deviations.REFERENCE_WORD_RGBA)]
        super().__init__(spec, legend)
        self._robot = robot
        self._task = task
        self._joints = list(robot.joints)

    def display_robot(self) -> DisplayRobot:
        """The robot of a side-by-side picture."""
        extent = self._robot.rigid().compile().stat.extent
        return DisplayRobot(self._robot.rigid(), self._joints, (1.5 * extent, 0.0, 0.0))

    def sides(self, now: Mapping[str, float], world: int = 0) -> Sides:  # noqa: ARG002
        """Reference, motor side and link side of a world."""
        joints = self._task.sample().joints["truth"][world]
        return Sides(*(joints[name].copy() for name in ("q_ref", "theta", "q")))

    def _pose(self, now: dict[str, float], world: int) -> None:  # noqa: ARG002
        joints = self._task.sample().joints["truth"][world]
        q_ref = joints["q_ref"]
        drawn = deviations.enlarge_deviation(joints["q"], q_ref)
        for name, angle, reference in zip(self._joints, drawn, q_ref, strict=True):
            self._data.joint(name).qpos = angle
            self._data.joint(_REFERENCE + name).qpos = reference


def _scaled(spec: MjSpec, body: int, scale: float) -> MjSpec:
    """A model with the mass of a body scaled, where it is."""
    compiled = spec.copy().compile().body(body)
    carrier = spec.body(compiled.name)
    carrier.mass = float(compiled.mass[0]) * scale
    carrier.inertia = compiled.inertia * scale
    carrier.ipos = compiled.ipos
    carrier.iquat = compiled.iquat
    carrier.explicitinertial = True
    return spec


def _carrying(spec: MjSpec, end_effector: Any, mass: float) -> MjSpec:
    """A model with one point mass more at its end effector."""
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
    load.inertia = [_POINT * mass] * 3
    load.explicitinertial = True
    return spec


def _lack(robot: RobotModel, body: RigidBody, q: Array) -> Array:
    """What servos lack to hold poses (..., n) with a fifth to spare, over their torque, (...)."""
    limits = robot.largest_torque(np.zeros_like(q))
    needed = robot.largest_passed_torque(body.gravity_torque(q))
    return np.maximum(needed / limits - _SPARE, 0.0).sum(axis=-1)


def _unheld(robot: RobotModel, body: RigidBody, home: Array) -> ConfigurationError:
    """Servos that do not hold the robot at its home."""
    limits = robot.largest_torque(np.zeros_like(home))
    needed = robot.largest_passed_torque(body.gravity_torque(home))
    weakest = int((needed / limits).argmax())
    return arm_references.WeakServosError(
        f"at home the weight takes {needed[weakest]:.4g} N·m of the servo of joint"
        f" {robot.joint_names[weakest]!r}, which is limited to {limits[weakest]:.4g} N·m, and no"
        " pose near home was found that is held with a fifth to spare: a simulated robot would"
        " sink; raise its torque_limit, or choose another home"
    )


def _warn_of_near_poses(
    names: Sequence[str],
    near: arm_references.Poses | arm_references.Moves,
    before: Sequence[float] | None,
    home: Array,
) -> None:
    """Say which poses are played, where the servos are too weak for the usual ones."""
    changes = []
    moved = np.abs(home - (0.0 if before is None else np.array(before)))
    most = int(moved.argmax())
    if moved[most] > 0.0:
        where = "to where the servos hold it"
        changes.append(
            f"home is moved {where}, by up to {moved[most]:.3g} rad (joint {names[most]!r})"
        )
    if near.within_rad < type(near)().within_rad:
        changes.append(f"poses are drawn within {near.within_rad:.3g} rad of home")
    warnings.warn(
        f"the servos are too weak for the usual {near.kind!r}; {' and '.join(changes)}. To choose"
        " them, give within_rad, move_s or home",
        stacklevel=4,
    )


def _followed(
    config: "JointRobotConfig", robot: RobotModel, body: RigidBody, workspace: Workspace
) -> tuple[Motion, Array]:
    """The motion of a robot, and angles along it, (T, n) [rad].

    Raises:
        ConfigurationError: It leaves the joint ranges, or needs more torque than the servos have.
    """
    motion = arm_references.motion_of(config.reference, workspace)
    plan = motion.plan(np.random.default_rng(0), config.control_period_s)
    rows = slice(None, None, max(plan.num_steps // 500, 1))
    q = np.ascontiguousarray(plan.q[rows])
    _require_in_range(config, robot, q)
    _require_torque(config, robot, body, (q, plan.q_dot[rows], plan.q_ddot[rows]))
    return motion, q


def _require_torque(
    config: "JointRobotConfig",
    robot: RobotModel,
    body: RigidBody,
    motion: tuple[Array, Array, Array],
) -> None:
    """Refuse a reference that the servos cannot follow.

    `motion` has its angles, rates and accelerations.
    """
    q, q_dot, q_ddot = motion
    torque = body.inverse_dynamics(*motion) + robot.rotor_inertia * q_ddot
    # other draws have their largest torque at other speeds
    if config.reference.is_random:
        torque = np.abs(torque).max(axis=0)
        q_dot = np.abs(q_dot).max(axis=0)
    needed, limits = robot.demand(torque, q_dot)
    if not isinstance(config.reference, arm_references.OfArm):
        joint_config.require_torque(config.reference, needed, limits)
    elif np.any(needed > limits):
        weakest = np.unravel_index(np.argmax(needed - limits), needed.shape)
        resting, enough = robot.demand(body.gravity_torque(q), np.zeros_like(q))
        cure = "make its moves slower"
        if np.any((resting > enough)[:, weakest[-1]]):
            cure = "the weight alone is too much: raise its torque_limit, or choose other poses"
        raise arm_references.WeakServosError(
            f"the reference {config.reference.kind!r} can need {needed[weakest]:.4g} N·m of the"
            f" servo of joint {robot.joint_names[weakest[-1]]!r}, which is limited to"
            f" {limits[weakest]:.4g} N·m; {cure}"
        )


def _warn_of_action_bound(config: "JointRobotConfig", known: RobotModel, torque: Array) -> None:
    """Warn where the weight along a reference bends joints by more than an action can take back.

    Args:
        config: With the reference.
        known: Joints as a compensator knows them.
        torque: Gravity torque along the reference, (T, n) [N·m].
    """
    stiffness = known.rest_stiffness(config.form)
    most = passed_torque(np.abs(torque).max(axis=0), 1.0, 0.0, known.load_friction)
    needed = most / stiffness
    worst = int(needed.argmax())
    bound = config.action_bound_rad
    if needed[worst] > bound:
        enough = most[worst] / bound
        warnings.warn(
            f"the weight along the reference {config.reference.kind!r} bends joint"
            f" {known.joint_names[worst]!r} by up to {needed[worst]:.3g} rad, and actions are cut"
            f" at ±{bound:g} rad: no policy can take all of it back. Spring and servo together"
            f" need {enough:.3g} N·m/rad and have {stiffness[worst]:.3g}; give them more, raise"
            " action_bound_rad, or choose poses with less load",
            stacklevel=4,
        )


def _require_in_range(config: "JointRobotConfig", robot: RobotModel, q: Array) -> None:
    """Refuse a reference that presses a joint against its limit."""
    ranges = joint_ranges(robot.rigid, robot.joint_names)
    for name, lowest, highest, own in zip(robot.joint_names, *ranges, q.T, strict=True):
        if own.min() < lowest or own.max() > highest:
            raise ConfigurationError(
                f"the reference {config.reference.kind!r} moves joint {name!r} from"
                f" {own.min():.3f} to {own.max():.3f} rad, and its range is {lowest:.3f} to"
                f" {highest:.3f} rad; lower the amplitude, or choose another home"
            )
