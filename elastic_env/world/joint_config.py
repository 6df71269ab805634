"""Parameters of a task of elastic joints, whatever the robot."""

from typing import Any, Literal

import numpy as np
from pydantic import Field

from elastic_env.core.config import Model, Title, quantity
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.robot_ranges import WALKER_FIELDS
from elastic_env.core.signals import Array
from elastic_env.joint.elasticity import ElasticJoint
from elastic_env.motion.references import Hold, Reference
from elastic_env.world.joint_signals import ACTION_BOUND_RAD
from elastic_env.world.scenario import Scenario, make_scenario

FRICTIONS = ("coulomb_friction", "viscous_friction", "load_friction", "static_friction")
"""Parameters of an `ElasticJoint` that are friction."""


class RewardWeights(Model):
    """Weights of the reward terms; every term is a penalty that grows without saturating."""

    link_error: float = quantity("1/rad", 100.0, ge=0, le=1e6)
    """Per rad of link error: 1 at 0.01 rad [1/rad]."""
    command_rate: float = quantity("s/rad", 0.1, ge=0, le=1e6)
    """Per rad/s of change of the offset [s/rad]."""
    divergence: float = quantity("1", 200.0, ge=0, le=1e6)
    """Once, where the simulation diverges [1]."""


class TaskConfig(Model):
    """Parameters of all tasks."""

    scenario: Scenario = make_scenario("nominal")
    form: Literal["tendon", "rigid"] = "tendon"
    """Elastic, or rigid for what an inelastic robot would do."""
    sensors: tuple[Title, ...] = Field(default=(), max_length=16)
    """Sensors beside the standard set, see `elastic_env.world.further_sensors`."""
    control_period_s: float = quantity("s", 0.004, gt=0)
    """Time between commands [s]."""

    def as_built(self, joint: ElasticJoint) -> ElasticJoint:
        """A known joint as the plant of the scenario has it.

        Raises:
            ConfigurationError: With more friction it passes no torque at all.
        """
        scenario = self.scenario
        return self.with_friction_of_ground(joint).replace(
            stiffness=joint.stiffness * scenario.fixed_value("stiffness"),
            backlash=joint.backlash + scenario.fixed_value("backlash_rad"),
        )

    def with_friction_of_ground(self, joint: ElasticJoint) -> ElasticJoint:
        """A known joint with the share of its friction that acts."""
        scale = self.scenario.friction_scale
        acting = {name: scale * getattr(joint, name) for name in FRICTIONS}
        return joint.replace(**acting)


class JointConfig(TaskConfig):
    """Parameters of all tasks of elastic joints on a fixed base."""

    reference: Reference = Hold()
    timestep_s: float = quantity("s", 5e-4, gt=0)
    """Physics step [s]."""
    reward: RewardWeights = RewardWeights()
    action_bound_rad: float = quantity("rad", ACTION_BOUND_RAD, gt=0, lt=np.pi)
    """Largest command offset; servos that give way far need more than the default [rad]."""

    def _check(self) -> None:
        set_ = {name for own in self.scenario.parts for name in own.changes}
        acting = [name for name in WALKER_FIELDS if name in set_]
        if acting:
            problem = f"scenario {self.scenario.name!r} sets {', '.join(acting)}"
            cure = "leave it out, or make a named scenario by make_scenario(name, walks=False)"
            raise ValueError(f"{problem}, which only a walker knows; {cure}")

    def plant(self) -> Any:
        """The robot as it is built, and as it is known: `elastic_env.world.joint_task.JointPlant`.

        Raises:
            ConfigurationError: Its servos are too weak for the reference, or a sensor has no place.
        """
        raise NotImplementedError


def require_torque(reference: Reference, needed: Array, limits: Array) -> None:
    """A reference that the servos cannot follow is an error now, not a poor result later.

    Args:
        reference: It.
        needed: Torque that it can need of each servo, (..., n) [N·m].
        limits: What the servos have then, (..., n) [N·m].

    Raises:
        ConfigurationError: A servo is too weak.
    """
    if np.any(needed > limits):
        weakest = np.unravel_index(np.argmax(needed - limits), needed.shape)
        extent = reference.extent()
        raise ConfigurationError(
            f"the reference {reference.kind!r} can need {needed[weakest]:.4g} N·m of a servo"
            f" limited to {limits[weakest]:.4g} N·m (|q| up to {extent.q:.2f} rad, |q̈| up to"
            f" {extent.q_ddot:.2f} rad/s²); lower its amplitude or its rate"
        )
