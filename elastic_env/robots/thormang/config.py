"""Parameters of the walking task, and the true robot that a scenario makes of the assumed one."""

import copy
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, Self

import mujoco
import numpy as np
from pydantic import Field, model_validator

from elastic_env.core.config import Model, Title, quantity
from elastic_env.core.errors import ConfigurationError, ElasticError
from elastic_env.core.robot_ranges import RobotDraw, RobotRanges, draw_robots
from elastic_env.core.signals import Array, IntArray
from elastic_env.joint.elasticity import ElasticJoint
from elastic_env.joint.joint_names import spring_name
from elastic_env.joint.time_step import require_stable
from elastic_env.motion.gait import Gait
from elastic_env.motion.walk_plan import plan_walk
from elastic_env.robots.thormang.model import (
    DRAWN_LOAD,
    LEG_JOINTS,
    Thormang,
    add_load,
    biped,
    elastic_spec,
    place_load,
)
from elastic_env.robots.thormang.standing import Equilibrium, settle
from elastic_env.world.further_sensors import ACCELEROMETER, add_accelerometer
from elastic_env.world.scenario import Scenario, make_scenario

FALL_HEIGHT_SHARE = 0.75
"""A pelvis below this share of its planned height has fallen."""
FALL_TILT_RAD = 0.4
"""A pelvis tilted by more than this has fallen [rad]."""


class WalkRewardWeights(Model):
    """Weights of the reward terms; every term is a penalty that grows without saturating."""

    tilt: float = quantity("1/rad", 100.0, ge=0, le=1e6)
    """Per rad of pelvis error: 1 at 0.01 rad [1/rad]."""
    zmp: float = quantity("1/m", 1.0 / 0.03, ge=0, le=1e6)
    """Per m of ZMP deviation: 1 at 0.03 m [1/m]."""
    effort: float = quantity("1/(N·m)", 0.001, ge=0, le=1e6)
    """Per N·m of servo torque, rms over the joints [1/(N·m)]."""
    smoothness: float = quantity("s/rad", 0.1, ge=0, le=1e6)
    """Per rad/s of the offsets, rms over joints [s/rad]."""
    fall: float = quantity("1", 200.0, ge=0, le=1e6)
    """Once, at a fall or where the simulation diverges [1]."""
    standing: float = quantity("1", 1.0, ge=0, le=1e6)
    """Factor of tilt and zmp before and after the walk, which is not scored [1]."""


class WalkConfig(Model):
    """All of the walking environment."""

    gait: Gait = Gait()
    scenario: Scenario = make_scenario("nominal")
    """Of all worlds, or of the first one where each has its own."""
    scenarios: tuple[Scenario, ...] = ()
    """Of every world of a vector environment, where they differ; with the same friction and rate
    of the IMU.
    """
    robot: Thormang = Thormang()
    joints: tuple[ElasticJoint, ...] = tuple(Thormang().joints.values())
    """The leg joints in order, as they are known; the scenario says in what the true ones
    differ.
    """
    form: Literal["tendon", "rigid"] = "tendon"
    """Elastic, or rigid for what an inelastic robot would do."""
    sensors: tuple[Title, ...] = Field(default=(), max_length=16)
    """What is observed beside the standard set, see `elastic_env.world.further_sensors`."""
    control_period_s: float = quantity("s", 0.004, gt=0)
    """Time between commands [s]."""
    timestep_s: float = quantity("s", 1e-3, gt=0)
    """Physics step [s]."""
    reward: WalkRewardWeights = WalkRewardWeights()
    bank: int = quantity("1", 0, ge=0)
    """Bank of robots that a scenario draws from [1]."""
    spare_bodies: int = quantity("1", 0, ge=0)
    """Massless bodies on the torso, which give robots with other loads as many bodies [1]."""

    @model_validator(mode="after")
    def _worlds_know_the_same(self) -> Self:
        for name, known in (
            ("friction_scale", lambda scenario: scenario.friction_scale),
            ("rate_hz of pelvis_imu", lambda scenario: scenario.pelvis_imu.rate_hz),
        ):
            values = {known(scenario): scenario.name for scenario in self.scenarios}
            if len(values) > 1:
                raise ValueError(
                    f"the scenarios of all worlds must have the same {name}, got "
                    + " and ".join(
                        f"{value:g} of {scenario!r}" for value, scenario in values.items()
                    )
                )
        return self

    def of_each_scenario(self) -> "list[WalkConfig]":
        """The configuration of the worlds of each scenario, in the order in which these first
        occur.
        """
        if not self.scenarios:
            return [self]
        alone = [
            self.replace(scenario=scenario, scenarios=())
            for scenario in dict.fromkeys(self.scenarios)
        ]
        most = max(config.loads for config in alone)
        return [config.replace(spare_bodies=most - config.loads) for config in alone]

    @property
    def loads(self) -> int:
        """Bodies that loads on the torso are."""
        return (self.true_robot.torso_load_kg > 0.0) + bool(self.scenario.ranges)

    @property
    def assumed_joints(self) -> dict[str, ElasticJoint]:
        """The joints as a policy may know them: the ground's friction is known, from an
        identification.
        """
        return {
            name: joint.replace(
                coulomb_friction=joint.coulomb_friction * self.scenario.friction_scale,
                viscous_friction=joint.viscous_friction * self.scenario.friction_scale,
            )
            for name, joint in zip(LEG_JOINTS, self.joints, strict=True)
        }

    @property
    def true_joints(self) -> dict[str, ElasticJoint]:
        """The joints as the plant has them, a spread of their stiffness aside."""
        scenario = self.scenario
        return {
            name: joint.replace(
                stiffness=joint.stiffness * scenario.stiffness_scale,
                backlash=joint.backlash + scenario.backlash_rad,
            )
            for name, joint in self.assumed_joints.items()
        }

    @property
    def true_robot(self) -> Thormang:
        """The robot as the plant has it."""
        return self.robot.replace(
            torso_load_kg=self.robot.torso_load_kg + self.scenario.torso_load_kg
        )

    def true_model(self) -> mujoco.MjModel:
        """The plant, what is drawn aside; where loads are drawn, with a load of no mass."""
        spec = elastic_spec(self.true_robot, self.true_joints, self.form, self.timestep_s)
        if self.scenario.ranges:
            add_load(spec, DRAWN_LOAD, 0.0, np.zeros(3))
        for number in range(self.spare_bodies):
            add_load(spec, f"spare_{number}", 0.0, np.zeros(3))
        if ACCELEROMETER in self.sensors:
            add_accelerometer(spec, "imu")
        return spec.compile()


BANK_SIZE = 64
RANGES_BANK_SIZE = 256
"""Robots in the bank of a scenario that draws them: of a named one, and of one with ranges."""
_SETTLED = 2048
"""Robots that are kept with their state at rest, of 50 kB each."""


@lru_cache(maxsize=64)
def require_stable_walker(config: WalkConfig) -> None:
    """Refuse joints that explode with the physics step, see `elastic_env.joint.time_step`; looked
    at once.

    Of ranges the robot with the stiffest springs, and with the strongest dampers.
    """
    for ranges in config.scenario.ranges or (RobotRanges(),):
        factor = ranges.stiffness[1] * ranges.joint_stiffness[1]
        joints = {
            name: joint.replace(
                stiffness=joint.stiffness * factor, damping=joint.damping * ranges.damping[1]
            )
            for name, joint in config.true_joints.items()
        }
        spec = elastic_spec(config.true_robot, joints, config.form, config.timestep_s)
        require_stable(spec.compile(), config.control_period_s)


@dataclass(frozen=True)
class PlacedRobot:
    """A robot of the bank at rest.

    Attributes:
        model: Its plant.
        rest: Where it stands under zero offset.
    """

    model: mujoco.MjModel
    rest: Equilibrium


@lru_cache(maxsize=_SETTLED)
def placed_robot(config: WalkConfig, draw: RobotDraw) -> PlacedRobot:
    """A robot of the bank at rest under zero offset, found once.

    Raises:
        ElasticError: It does not stand.
    """
    plan = plan_walk(config.gait, biped(config.robot), config.control_period_s)  # pyright: ignore[reportArgumentType]
    model = drawn_model(config, draw)
    q = plan.q[0] - np.array(draw.encoder_bias_rad)
    try:
        rest = settle(model, LEG_JOINTS, plan.pelvis[0], q, q)
    except ElasticError as error:
        if not config.scenario.ranges:
            raise
        raise ConfigurationError(
            f"the drawn robot {draw} cannot walk: {error}; narrow the ranges"
        ) from None
    return PlacedRobot(model, rest)


def drawn_model(config: WalkConfig, draw: RobotDraw) -> mujoco.MjModel:
    """The plant of a robot of the bank."""
    model = copy.copy(_undrawn_model(config))  # pyright: ignore[reportArgumentType]  frozen models can be hashed
    if config.form == "tendon":
        springs = spring_ids(model)
        model.tendon_stiffness[springs] *= np.array(draw.stiffness_factor)
        model.tendon_damping[springs] *= draw.damping_factor
        model.tendon_lengthspring[springs] += draw.backlash_rad * np.array([-0.5, 0.5])
    links = [model.joint(name).dofadr[0] for name in LEG_JOINTS]
    model.dof_frictionloss[links] *= draw.friction_factor
    model.dof_damping[links] *= draw.friction_factor
    model.body("floor").quat[:] = floor_tilt(draw.slope_rad, draw.slope_direction_rad)
    if config.scenario.ranges:
        place_load(model, draw.load_kg, np.array(draw.load_place_m))
    return model


@lru_cache(maxsize=64)
def _undrawn_model(config: WalkConfig) -> mujoco.MjModel:
    return config.true_model()


def spring_ids(model: mujoco.MjModel) -> IntArray:
    """The springs of the leg joints among the tendons of an elastic model, (12,)."""
    return np.array([model.tendon(spring_name(joint)).id for joint in LEG_JOINTS])


def floor_tilt(angle: float, direction: float) -> Array:
    """Quaternion of a floor that rises by an angle in a direction, both [rad], (4,)."""
    half = angle / 2.0
    return np.array(
        [np.cos(half), np.sin(half) * np.sin(direction), -np.sin(half) * np.cos(direction), 0.0]
    )


def robot_bank(scenario: Scenario, number: int = 0) -> list[RobotDraw]:
    """The robots of a scenario: one, or a bank, the same in every process; banks of other
    numbers have other robots.
    """
    n = len(LEG_JOINTS)
    if scenario.ranges:
        return draw_robots(scenario.ranges, RANGES_BANK_SIZE, n, (_BANK_SEED, number))
    conditions: dict[str, Any] = {
        "push_n": scenario.push_n,
        "slope_rad": scenario.slope_rad,
        "is_delayed": scenario.delay_steps > 0,
        "is_inertial": scenario.inertial is not None,
    }
    if scenario.stiffness_spread == scenario.encoder_bias_rad == scenario.slope_rad == 0.0:
        return [RobotDraw(stiffness_factor=(1.0,) * n, encoder_bias_rad=(0.0,) * n, **conditions)]
    generator = np.random.default_rng(_BANK_SEED + number)
    return [
        RobotDraw(
            stiffness_factor=tuple(
                (1.0 + scenario.stiffness_spread * generator.uniform(-1.0, 1.0, n)).tolist()
            ),
            encoder_bias_rad=tuple(
                (scenario.encoder_bias_rad * generator.uniform(-1.0, 1.0, n)).tolist()
            ),
            slope_direction_rad=float(generator.uniform(0.0, 2.0 * np.pi)),
            **conditions,
        )
        for _ in range(BANK_SIZE)
    ]


_BANK_SEED = 20150
