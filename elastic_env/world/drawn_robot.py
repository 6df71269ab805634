"""The joints of drawn robots in the physics."""

import copy
from collections.abc import Callable, Sequence

import mujoco
import numpy as np

from elastic_env.core.robot_ranges import DrawnRobot
from elastic_env.core.signals import Array, IntArray
from elastic_env.joint.joint_names import spring_name
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
