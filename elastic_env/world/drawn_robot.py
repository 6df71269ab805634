"""Joints of drawn robots in the physics."""

import copy
from collections.abc import Callable, Sequence

import mujoco
import numpy as np

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, IntArray
from elastic_env.joint.joint_names import spring_name
from elastic_env.joint.mujoco_friction import VaryingFriction
from elastic_env.world.robot_model import RobotModel
from elastic_env.world.robot_ranges import DrawnRobot
from elastic_env.world.scenario import Scenario


def spring_ids(model: mujoco.MjModel, joints: Sequence[str], form: str) -> IntArray:
    """Indices of the joints' springs among the tendons, (n,); empty in the form "rigid"."""
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
        field: Returns the plant's array of a field of its model.
        model: The plant with the scenario's fixed values.
        springs: Indices by `spring_ids`.
        links: Degrees of freedom of the links, (n,).
        robot: The drawn robot.
        scenario: Its scenario.
    """
    if len(springs):
        more_backlash = robot.backlash_rad - scenario.fixed_value("backlash_rad")
        ends = more_backlash * np.array([-0.5, 0.5])
        factor = np.array(robot.stiffness) / scenario.fixed_value("stiffness")
        lengths = model.tendon_lengthspring[springs] + ends
        field("tendon_lengthspring")[springs] = lengths
        field("tendon_stiffness")[springs] = model.tendon_stiffness[springs] * factor
        field("tendon_damping")[springs] = model.tendon_damping[springs] * robot.damping
    for name in ("dof_frictionloss", "dof_damping"):
        field(name)[links] = getattr(model, name)[links] * robot.friction
    if (varying := VaryingFriction.of(model)) is not None:
        terms = varying.numbers[:-1]  # all except the speed
        field("numeric_data")[terms] = model.numeric_data[terms] * robot.friction


def draws_joints(scenario: Scenario) -> bool:
    """Return True if robots have other joints than the plant with the scenario's fixed values."""
    factors = (scenario.joint_stiffness, scenario.damping, scenario.friction)
    is_wide = scenario.draws("stiffness") or scenario.draws("backlash_rad")
    is_scaled = any(factor != (1.0, 1.0) for factor in factors)
    return is_wide or is_scaled or bool(scenario.mixture)


def require_bearable_friction(robot: RobotModel, scenario: Scenario) -> None:
    """Refuse a scenario that can draw so much friction that a joint transmits no torque.

    Raises:
        ConfigurationError: Friction takes the whole load of a joint.
    """
    factor = max(part.friction[1] for part in scenario.parts)
    worst = int(robot.load_friction.argmax())
    share = float(robot.load_friction[worst])
    if factor * share >= 1.0:
        raise ConfigurationError(
            f"the scenario {scenario.name!r} draws up to {factor:g} times the friction, and joint"
            f" {robot.joint_names[worst]!r} has load_friction = {share:g}: its friction would take"
            f" the whole load; draw less than {1.0 / share:.3g} times, or choose another scenario"
        )


def stiffest_plant(model: mujoco.MjModel, scenario: Scenario) -> mujoco.MjModel:
    """Copy of a plant with the stiffest springs and strongest dampers that a scenario draws."""
    stiffest = max(p.stiffness[1] * p.joint_stiffness[1] for p in scenario.parts)
    plant = copy.copy(model)
    plant.tendon_stiffness[:] *= stiffest / scenario.fixed_value("stiffness")
    plant.tendon_damping[:] *= max(part.damping[1] for part in scenario.parts)
    return plant
