"""The joints of drawn robots in the physics."""

import copy
from collections.abc import Callable, Sequence

import mujoco
import numpy as np

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.robot_ranges import DrawnRobot
from elastic_env.core.signals import Array, IntArray
from elastic_env.joint.joint_names import spring_name
from elastic_env.joint.varying_friction import VaryingFriction
from elastic_env.world.robot_model import RobotModel
from elastic_env.world.scenario import Scenario


def spring_ids(model: mujoco.MjModel, joints: Sequence[str], form: str) -> IntArray:
    """The springs of joints among the tendons of a model, (n,); none in the form "rigid"."""
    names = [spring_name(joint) for joint in joints if form == "tendon"]
    return np.array([model.tendon(name).id for name in names], dtype=np.int64)


def set_joints(
    field: Callable[[str], Array],
    model: mujoco.MjModel,
    springs: IntArray,
    links: IntArray,
    robot: DrawnRobot,
) -> None:
    """Give a plant the joints of a drawn robot.

    Args:
        field: The plant's own array of a field of its model.
        model: The plant, what is drawn aside.
        springs: As of `spring_ids`.
        links: Degrees of freedom of the links, (n,).
        robot: As it was drawn.
    """
    if len(springs):
        ends = robot.backlash_rad * np.array([-0.5, 0.5])
        K = model.tendon_stiffness[springs] * robot.stiffness
        field("tendon_lengthspring")[springs] = model.tendon_lengthspring[springs] + ends
        field("tendon_stiffness")[springs] = K
        field("tendon_damping")[springs] = model.tendon_damping[springs] * robot.damping
    for name in ("dof_frictionloss", "dof_damping"):
        field(name)[links] = getattr(model, name)[links] * robot.friction
    if (varying := VaryingFriction.of(model)) is not None:
        terms = varying.numbers[:-1]  # all but the speed
        field("numeric_data")[terms] = model.numeric_data[terms] * robot.friction


def require_passing(robot: RobotModel, scenario: Scenario) -> None:
    """Refuse a scenario whose draws let a joint pass no torque at all.

    Raises:
        ConfigurationError: Friction takes the whole load of a joint.
    """
    factor = max((own.friction[1] for own in scenario.ranges), default=1.0)
    worst = int(robot.load_friction.argmax())
    share = float(robot.load_friction[worst])
    if factor * share >= 1.0:
        raise ConfigurationError(
            f"the scenario {scenario.name!r} draws up to {factor:g} times the friction, and joint"
            f" {robot.joint_names[worst]!r} has load_friction = {share:g}: its friction would take"
            f" the whole load; draw less than {1.0 / share:.3g} times, or choose another scenario"
        )


def stiffest_plant(model: mujoco.MjModel, scenario: Scenario) -> mujoco.MjModel:
    """A plant with the stiffest springs and strongest dampers that a scenario draws."""
    stiffest = 1.0 + scenario.stiffness_spread
    strongest = 1.0
    for own in scenario.ranges:
        stiffest = max(stiffest, own.stiffness[1] * own.joint_stiffness[1])
        strongest = max(strongest, own.damping[1])
    plant = copy.copy(model)
    plant.tendon_stiffness[:] *= stiffest
    plant.tendon_damping[:] *= strongest
    return plant
