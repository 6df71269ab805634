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
    scenario: Scenario,
) -> None:
    """Give a plant the joints of a drawn robot.

    Args:
        field: The plant's own array of a field of its model.
        model: The plant with what is fixed in the scenario.
        springs: As of `spring_ids`.
        links: Degrees of freedom of the links, (n,).
        robot: As it was drawn.
        scenario: It.
    """
    if len(springs):
        further = robot.backlash_rad - scenario.fixed_value("backlash_rad")
        ends = further * np.array([-0.5, 0.5])
        factor = np.array(robot.stiffness) / scenario.fixed_value("stiffness")
        K = model.tendon_stiffness[springs] * factor
        lengths = model.tendon_lengthspring[springs] + ends
        field("tendon_lengthspring")[springs] = lengths
        field("tendon_stiffness")[springs] = K
        field("tendon_damping")[springs] = model.tendon_damping[springs] * robot.damping
    for name in ("dof_frictionloss", "dof_damping"):
        field(name)[links] = getattr(model, name)[links] * robot.friction
    if (varying := VaryingFriction.of(model)) is not None:
        terms = varying.numbers[:-1]  # all but the speed
        field("numeric_data")[terms] = model.numeric_data[terms] * robot.friction


def joints_differ(scenario: Scenario) -> bool:
    """True if robots have other joints than the plant with what is fixed in the scenario."""
    factors = (scenario.joint_stiffness, scenario.damping, scenario.friction)
    is_wide = scenario.draws("stiffness") or scenario.draws("backlash_rad")
    is_other = any(own != (1.0, 1.0) for own in factors)
    return is_wide or is_other or bool(scenario.mixture)


def require_passing(robot: RobotModel, scenario: Scenario) -> None:
    """Refuse a scenario whose draws let a joint pass no torque at all.

    Raises:
        ConfigurationError: Friction takes the whole load of a joint.
    """
    factor = max(own.friction[1] for own in scenario.parts)
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
    stiffest = max(own.stiffness[1] * own.joint_stiffness[1] for own in scenario.parts)
    plant = copy.copy(model)
    plant.tendon_stiffness[:] *= stiffest / scenario.fixed_value("stiffness")
    plant.tendon_damping[:] *= max(own.damping[1] for own in scenario.parts)
    return plant
