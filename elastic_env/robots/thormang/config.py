"""Parameters of the walking task, and the true robots of its scenarios."""

import copy
from functools import lru_cache, partial

import numpy as np
from mujoco import MjModel

from elastic_env.core.config import Model, quantity
from elastic_env.core.errors import ConfigurationError, ElasticError
from elastic_env.core.signals import Array
from elastic_env.joint.elastic_joint import ElasticJoint
from elastic_env.joint.joint_names import JointAddresses
from elastic_env.joint.mujoco_friction import varies
from elastic_env.joint.time_step import require_stable
from elastic_env.motion.gait import Gait
from elastic_env.motion.walk_plan import plan_walk
from elastic_env.robots.thormang import model as thormang
from elastic_env.robots.thormang.model import DRAWN_LOAD, LEG_JOINTS, Thormang
from elastic_env.robots.thormang.standing import Equilibrium, equilibrium
from elastic_env.world.drawn_robot import set_joints, spring_ids, stiffest_plant
from elastic_env.world.further_sensors import ACCELEROMETER, add_accelerometer
from elastic_env.world.joint_config import TaskConfig
from elastic_env.world.robot_ranges import DrawnRobot, draw_robots
from elastic_env.world.scenario import Scenario

FALL_HEIGHT_SHARE = 0.75
"""A pelvis below this share of its planned height has fallen."""
FALL_TILT_RAD = 0.4
"""A pelvis tilted by more than this has fallen [rad]."""


class WalkRewardWeights(Model):
    """Weights of the reward terms; every term is a penalty that never saturates."""

    tilt: float = quantity("1/rad", 100.0, ge=0, le=1e6)
    """Per rad of pelvis error: 1 at 0.01 rad [1/rad]."""
    zmp: float = quantity("1/m", 1.0 / 0.03, ge=0, le=1e6)
    """Per m of ZMP deviation in the plan's world frame: 1 at 0.03 m [1/m]."""
    zmp_in_feet: float = quantity("1/m", 0.0, ge=0, le=1e6)
    """Per m of ZMP deviation for feet at their planned places [1/m]."""
    foot_drift: float = quantity("1/m", 0.0, ge=0, le=1e6)
    """Per m of displacement of the standing feet from the plan [1/m]."""
    effort: float = quantity("1/(N·m)", 0.001, ge=0, le=1e6)
    """Per N·m of servo torque, rms over the joints [1/(N·m)]."""
    smoothness: float = quantity("s/rad", 0.1, ge=0, le=1e6)
    """Per rad/s of change of the offsets, rms over the joints [s/rad]."""
    fall: float = quantity("1", 200.0, ge=0, le=1e6)
    """Once, at a fall or where the simulation diverges [1]."""
    standing: float = quantity("1", 1.0, ge=0, le=1e6)
    """Factor of tilt, ZMP and drift before and after the walk, which is not scored [1]."""


class WalkConfig(TaskConfig):
    """All parameters of the walking environment."""

    gait: Gait = Gait()
    scenarios: tuple[Scenario, ...] = ()
    """Scenario of every world of a vector environment, if they differ; the first one is `scenario`.
    All have the same friction scale and the same rate of the IMU.
    """
    robot: Thormang = Thormang()
    joints: tuple[ElasticJoint, ...] = tuple(Thormang().joints.values())
    """The assumed leg joints in order; the scenario defines how the true ones differ."""
    timestep_s: float = quantity("s", 1e-3, gt=0)
    """Physics step [s]."""
    reward: WalkRewardWeights = WalkRewardWeights()
    bank: int = quantity("1", 0, ge=0)
    """Number of the bank of robots that a scenario draws from [1]."""
    fewest_steps: int | None = quantity("1", None, ge=4)
    """Fewest steps of a walk in place [1]; the number of steps is then drawn per episode. None for
    the number of the gait."""
    spare_bodies: int = quantity("1", 0, ge=0)
    """Massless bodies on the torso, so that all robots have the same number of bodies [1]."""

    def _check(self) -> None:
        if any(varies(j) or (j.servo and j.servo.motor) for j in self.joints):
            raise ValueError(
                "joints of the walker must have neither load_friction nor static_friction nor a"
                " motor, which its plan and policies do not know; the testbed and Robot-v0 do"
            )
        most = self.gait.num_steps
        fewest = self.fewest_steps or most
        if self.fewest_steps and not self.gait.is_in_place:
            raise ValueError("fewest_steps is for walks in place, whose strides are all alike")
        if fewest > most or (most - fewest) % 2:
            raise ValueError(
                f"fewest_steps must be num_steps = {most} less whole strides of two"
                f" steps, got {fewest}"
            )
        frictions = {part.friction_scale: part.name for part in self.scenarios}
        rates = {part.pelvis_imu.rate_hz: part.name for part in self.scenarios}
        common = {"friction_scale": frictions, "rate_hz of pelvis_imu": rates}
        for field, names in common.items():
            if len(names) > 1:
                got = [f"{value:g} of {name!r}" for value, name in names.items()]
                needed = f"the scenarios of all worlds must have the same {field}"
                raise ValueError(f"{needed}, got {' and '.join(got)}")

    @property
    def numbers_of_steps(self) -> range:
        """Possible numbers of steps of a walk."""
        most = self.gait.num_steps
        return range(self.fewest_steps or most, most + 1, 2)

    def scenario_configs(self) -> "list[WalkConfig]":
        """Configurations of the scenarios, in the order of their first occurrence."""
        if not self.scenarios:
            return [self]
        parts = dict.fromkeys(self.scenarios)
        configs = [self.replace(scenario=part, scenarios=()) for part in parts]
        most = max(config.num_loads for config in configs)
        return [each.replace(spare_bodies=most - each.num_loads) for each in configs]

    @property
    def num_loads(self) -> int:
        """Number of bodies for loads on the torso."""
        return (self.true_robot.torso_load_kg > 0.0) + self.scenario.places_loads

    @property
    def assumed_joints(self) -> dict[str, ElasticJoint]:
        """The joints as a policy may know them, with the friction of the scenario's ground."""
        each = zip(LEG_JOINTS, self.joints, strict=True)
        return {name: self.with_ground_friction(joint) for name, joint in each}

    @property
    def true_joints(self) -> dict[str, ElasticJoint]:
        """The joints in the plant, without drawn parameters."""
        each = zip(LEG_JOINTS, self.joints, strict=True)
        return {name: self.plant_joint(joint) for name, joint in each}

    @property
    def true_robot(self) -> Thormang:
        """The robot in the plant, without drawn parameters."""
        load_kg = self.robot.torso_load_kg + self.scenario.shoulder_load_kg
        return self.robot.replace(torso_load_kg=load_kg)

    def true_model(self) -> MjModel:
        """Compile the plant without drawn parameters; a load to be drawn has no mass."""
        joints = self.true_joints
        spec = thormang.elastic_spec(self.true_robot, joints, self.form, self.timestep_s)
        if self.scenario.places_loads:
            thormang.add_load(spec, DRAWN_LOAD, 0.0, np.zeros(3))
        for number in range(self.spare_bodies):
            thormang.add_load(spec, f"spare_{number}", 0.0, np.zeros(3))
        if ACCELEROMETER in self.sensors:
            add_accelerometer(spec, "imu")
        return spec.compile()


BANK_SIZE = 256
"""Robots in the bank of a scenario whose robots differ."""
_SETTLED_ROBOTS = 2048
"""Cached robots with their state at rest, 50 kB each."""


@lru_cache(maxsize=64)
def require_stable_walker(config: WalkConfig) -> None:
    """Refuse joints that are unstable with the physics step; a configuration is checked once."""
    model = stiffest_plant(undrawn_model(config), config.scenario)  # pyright: ignore[reportArgumentType]  frozen models can be hashed
    require_stable(model, config.control_period_s)


@lru_cache(maxsize=_SETTLED_ROBOTS)
def placed_robot(config: WalkConfig, robot: DrawnRobot) -> tuple[MjModel, Equilibrium]:
    """Plant of a robot of the bank, and its equilibrium under zero offset; computed once.

    Raises:
        ElasticError: The robot does not stand.
    """
    plan = plan_walk(config.gait, thormang.biped(config.robot), config.control_period_s)  # pyright: ignore[reportArgumentType]
    model = drawn_model(config, robot)
    q = plan.q[0] - np.array(robot.homing_rad)
    try:
        return model, equilibrium(model, LEG_JOINTS, plan.pelvis[0], q, q)
    except ElasticError as error:
        if config.scenario.has_one_robot:
            raise
        problem = f"the drawn robot {robot} cannot walk: {error}"
        raise ConfigurationError(f"{problem}; narrow the ranges") from None


def drawn_model(config: WalkConfig, robot: DrawnRobot) -> MjModel:
    """Plant of a robot of the bank."""
    undrawn = undrawn_model(config)  # pyright: ignore[reportArgumentType]  frozen models can be hashed
    springs = spring_ids(undrawn, LEG_JOINTS, config.form)
    links = JointAddresses.of(undrawn, LEG_JOINTS).q_dot
    model = copy.copy(undrawn)
    set_joints(partial(getattr, model), undrawn, springs, links, robot, config.scenario)
    for side in thormang.SIDES:
        model.geom(f"{side}_sole").friction[0] *= robot.floor_friction
    model.body("floor").quat[:] = floor_tilt(robot.slope_rad, robot.slope_direction_rad)
    if config.scenario.places_loads:
        place = np.array([robot.load_x_m, robot.load_y_m, robot.load_z_m])
        thormang.place_load(model, robot.load_kg, place)
    return model


@lru_cache(maxsize=64)
def undrawn_model(config: WalkConfig) -> MjModel:
    """Plant without drawn parameters, compiled once."""
    return config.true_model()


def floor_tilt(angle: float, direction: float) -> Array:
    """Quaternion of a floor that rises by an angle in a direction, both [rad], (4,)."""
    half = angle / 2.0
    x = np.sin(half) * np.sin(direction)
    return np.array([np.cos(half), x, -np.sin(half) * np.cos(direction), 0.0])


def robot_bank(scenario: Scenario, number: int = 0) -> list[DrawnRobot]:
    """Draw the robots of a scenario: one, or a bank, the same in every process.

    Banks with different numbers have different robots.
    """
    size = 1 if scenario.has_one_robot else BANK_SIZE
    return draw_robots(scenario.parts, size, len(LEG_JOINTS), (_BANK_SEED, number))


_BANK_SEED = 20150
