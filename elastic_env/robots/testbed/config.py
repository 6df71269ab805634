"""Parameters of the testbed task, and what they must fulfil together."""

from typing import Literal, Self

import numpy as np
from pydantic import model_validator

from elastic_env.core.config import Model, quantity
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import SignalTable
from elastic_env.joint.dynamixel import H54_200_S500_R
from elastic_env.joint.elasticity import ElasticJoint
from elastic_env.motion.references import Hold, Reference
from elastic_env.robots.testbed.model import JOINT, Pendulum, rigid_spec
from elastic_env.runtime.robot_model import RobotModel
from elastic_env.runtime.scenario import Scenario, make_scenario, scenario_names


class RewardWeights(Model):
    """Weights of the reward terms; every term is a penalty that grows without saturating."""

    link_error: float = quantity("1/rad", 100.0, ge=0, description="per rad of link error: 1 at 0.01 rad")
    command_rate: float = quantity("s/rad", 0.1, ge=0, description="per rad/s of change of the offset")
    divergence: float = quantity("1", 200.0, ge=0, description="once, where the simulation diverges")


class TestbedConfig(Model):
    """All of the testbed environment."""

    __test__ = False  # not a test class, although its name says so

    reference: Reference = Hold()
    scenario: Scenario = make_scenario("nominal")
    joint: ElasticJoint = H54_200_S500_R
    """The joint as it is known; the scenario says in what the true one differs."""
    pendulum: Pendulum = Pendulum()
    form: Literal["tendon", "rigid"] = "tendon"
    """Elastic, or rigid for what an inelastic testbed would do."""
    observe_link: bool = False
    """Whether the link's IMU is part of the observation."""
    control_period_s: float = quantity("s", 0.004, gt=0, description="time between commands")
    timestep_s: float = quantity("s", 5e-4, gt=0, description="physics step")
    reward: RewardWeights = RewardWeights()

    @model_validator(mode="after")
    def _scenario_acts(self) -> Self:
        acting = [name for name in ("stiffness_spread", "push_n", "slope_rad") if getattr(self.scenario, name) > 0.0]
        if acting:
            raise ValueError(
                f"scenario {self.scenario.name!r} sets {', '.join(acting)}, which only a walker knows; on the testbed "
                f"choose from: {', '.join(scenario_names(testbed=True))}"
            )
        return self

    @property
    def true_joint(self) -> ElasticJoint:
        """The joint as the plant has it."""
        return self.joint.replace(
            stiffness=self.joint.stiffness * self.scenario.stiffness_scale,
            coulomb_friction=self.joint.coulomb_friction * self.scenario.friction_scale,
            viscous_friction=self.joint.viscous_friction * self.scenario.friction_scale,
            backlash=self.joint.backlash + self.scenario.backlash_rad,
        )

    @property
    def true_pendulum(self) -> Pendulum:
        """The pendulum as the plant has it."""
        return self.pendulum.with_mass_scaled(self.scenario.pendulum_mass_scale)

    def robot_model(self, joint: ElasticJoint, pendulum: Pendulum, table: SignalTable) -> RobotModel:
        """Rigid model and joint of this testbed with the given parameters."""
        return RobotModel({JOINT: joint}, rigid_spec(pendulum).compile(), self.control_period_s, table)


def require_feasible(config: TestbedConfig) -> None:
    """A reference that the servo cannot follow is an error now, not a poor result later."""
    joint, pendulum, extent = config.true_joint, config.true_pendulum, config.reference.extent()
    if joint.servo is None:
        raise ConfigurationError("the testbed's joint needs a servo, got None; see elastic_env.joint.elasticity.Servo")
    worst_angle = min(extent.q, np.pi / 2)
    needed = (
        abs(float(pendulum.torque(np.array(worst_angle))))
        + (pendulum.inertia + joint.rotor_inertia) * extent.q_ddot
        + joint.coulomb_friction
        + joint.viscous_friction * extent.q_dot
    )
    if needed > joint.servo.torque_limit:
        raise ConfigurationError(
            f"the reference {config.reference.kind!r} can need {needed:.1f} N·m of a servo limited to "
            f"{joint.servo.torque_limit:.1f} N·m (|q| up to {extent.q:.2f} rad, |q̈| up to {extent.q_ddot:.2f} rad/s²); "
            "lower its amplitude or its rate"
        )
