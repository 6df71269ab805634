"""Parameters of a task of elastic joints, for any robot."""

from typing import Any, Literal

import numpy as np
from pydantic import Field

from elastic_env.core.config import Model, Title, quantity
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.joint.elastic_joint import ElasticJoint
from elastic_env.motion.references import Hold, Reference
from elastic_env.world.joint_signals import ACTION_BOUND_RAD
from elastic_env.world.robot_ranges import WALKER_FIELDS
from elastic_env.world.scenario import Scenario, make_scenario

FRICTIONS = ("coulomb_friction", "viscous_friction", "load_friction", "static_friction")
"""Parameters of an `ElasticJoint` that are friction."""


class RewardWeights(Model):
    """Weights of the reward terms; every term is a penalty that never saturates."""

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
    """Elastic joints, or rigid joints of an inelastic robot."""
    sensors: tuple[Title, ...] = Field(default=(), max_length=16)
    """Sensors in addition to the standard set, see `elastic_env.world.further_sensors`."""
    control_period_s: float = quantity("s", 0.004, gt=0)
    """Time between commands [s]."""

    def plant_joint(self, joint: ElasticJoint) -> ElasticJoint:
        """Return an assumed joint as it is in the plant of the scenario.

        Raises:
            ConfigurationError: The joint transmits no torque because of its friction.
        """
        scenario = self.scenario
        return self.with_ground_friction(joint).replace(
            stiffness=joint.stiffness * scenario.fixed_value("stiffness"),
            backlash=joint.backlash + scenario.fixed_value("backlash_rad"),
        )

    def with_ground_friction(self, joint: ElasticJoint) -> ElasticJoint:
        """Return an assumed joint with the share of friction that acts in the scenario's ground."""
        scale = self.scenario.friction_scale
        friction = {name: scale * getattr(joint, name) for name in FRICTIONS}
        return joint.replace(**friction)


class JointConfig(TaskConfig):
    """Parameters of all tasks of elastic joints on a fixed base."""

    reference: Reference = Hold()
    timestep_s: float = quantity("s", 5e-4, gt=0)
    """Physics step [s]."""
    reward: RewardWeights = RewardWeights()
    action_bound_rad: float = quantity("rad", ACTION_BOUND_RAD, gt=0, lt=np.pi)
    """Largest command offset; very soft servos need more than the default [rad]."""

    def _check(self) -> None:
        changes = {name for part in self.scenario.parts for name in part.changes}
        walker_fields = [name for name in WALKER_FIELDS if name in changes]
        if walker_fields:
            problem = f"scenario {self.scenario.name!r} sets {', '.join(walker_fields)}"
            cure = "leave it out, or make a named scenario by make_scenario(name, walks=False)"
            raise ValueError(f"{problem}, which only a walker knows; {cure}")

    def plant(self) -> Any:
        """Make the plant with the true and the assumed robot: a `joint_task.JointPlant`.

        Raises:
            ConfigurationError: Its servos are too weak for the reference, or a sensor has no place.
        """
        raise NotImplementedError


def require_torque(reference: Reference, needed: Array, limits: Array) -> None:
    """Refuse a reference that the servos cannot follow, which would give a poor result later.

    Args:
        reference: The reference.
        needed: Torque that each servo can need, (..., n) [N·m].
        limits: Largest torque of the servos at that moment, (..., n) [N·m].

    Raises:
        ConfigurationError: A servo is too weak.
    """
    if np.any(needed > limits):
        weakest = np.unravel_index(np.argmax(needed - limits), needed.shape)
        extent = reference.extent()
        raise ConfigurationError(
            f"the reference {reference.kind!r} can need {needed[weakest]:.4g} N·m of a"
            f" servo limited to {limits[weakest]:.4g} N·m (|q| up to {extent.q:.2f} rad,"
            f" |q̈| up to {extent.q_ddot:.2f} rad/s²); lower its amplitude or its rate"
        )
