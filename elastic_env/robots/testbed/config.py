"""Parameters of the testbed task, and the joint that they make."""

from functools import partial

import numpy as np

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, Parameter
from elastic_env.joint.dynamixel import H54_200_S500_R
from elastic_env.joint.elasticity import ElasticJoint, static_link_angle
from elastic_env.motion.references import AboutHome
from elastic_env.robots.testbed import NAME
from elastic_env.robots.testbed.model import JOINT, Pendulum, elastic_spec, imu_arm, rigid_spec
from elastic_env.world.further_sensors import ACCELEROMETER, add_accelerometer
from elastic_env.world.joint_config import JointConfig, require_torque
from elastic_env.world.joint_task import JointPlant
from elastic_env.world.robot_model import RobotModel


class TestbedConfig(JointConfig):
    """All of the testbed environment."""

    __test__ = False  # not a test class, although its name says so

    joint: ElasticJoint = H54_200_S500_R
    """The joint as it is known; the scenario says in what the true one differs."""
    pendulum: Pendulum = Pendulum()
    observe_link: bool = False
    """True if the link's IMU is part of the observation."""

    @property
    def true_joint(self) -> ElasticJoint:
        """The joint as the plant has it."""
        return self.as_built(self.joint)

    @property
    def true_pendulum(self) -> Pendulum:
        """The pendulum as the plant has it."""
        return self.pendulum.with_mass_scaled(self.scenario.pendulum_mass_scale)


def plant(config: TestbedConfig) -> JointPlant:
    """The testbed as it is built, and as it is known."""
    joint = config.true_joint
    pendulum = config.true_pendulum

    def robot_model(joint: ElasticJoint, pendulum: Pendulum) -> RobotModel:
        return RobotModel({JOINT: joint}, rigid_spec(pendulum).compile(), config.control_period_s)

    spec = elastic_spec(pendulum, joint, config.form, config.timestep_s)
    if ACCELEROMETER in config.sensors:
        add_accelerometer(spec, "imu")
    true = robot_model(joint, pendulum)
    return JointPlant(
        name=NAME,
        model=spec.compile(),
        assumed=robot_model(config.joint, config.pendulum),
        true=true,
        static_torque=pendulum.torque,
        rest_angle=partial(_rest_angle, form=config.form, true=true, pendulum=pendulum),
        motion=AboutHome(config.reference, np.zeros(1)),
        imu_arm_m=imu_arm(pendulum),
    )


def require_feasible(config: TestbedConfig) -> None:
    """Refuse a joint without a servo, and a reference that its servo cannot follow.

    Raises:
        ConfigurationError: They are such.
    """
    joint = config.true_joint
    pendulum = config.true_pendulum
    extent = config.reference.extent()
    if joint.servo is None:
        raise ConfigurationError(
            "the testbed's joint needs a servo, got None; see elastic_env.joint.elasticity.Servo"
        )
    worst_angle = min(extent.q, np.pi / 2)
    needed = (
        abs(float(pendulum.torque(np.array(worst_angle))))
        + (pendulum.inertia + joint.rotor_inertia) * extent.q_ddot
        + joint.viscous_friction * extent.q_dot
    )
    robot = RobotModel({JOINT: joint}, rigid_spec(pendulum).compile(), config.control_period_s)
    require_torque(
        config.reference,
        robot.largest_passed_torque(np.array([needed])),
        robot.largest_torque(np.array([extent.q_dot])),
    )


def _rest_angle(
    theta: Array,
    factor: Parameter = 1.0,
    backlash: Array | None = None,
    *,
    form: str,
    true: RobotModel,
    pendulum: Pendulum,
) -> Array:
    """Link angle at rest without friction.

    Within the dead band the pendulum hangs straight down.
    """
    stiffness = true.rest_stiffness(form, factor)
    if np.isinf(stiffness).all():
        return theta
    half = np.sign(theta) * (true.backlash if backlash is None else backlash) / 2.0
    engaged = np.where(np.abs(theta) > np.abs(half), theta - half, 0.0)
    return static_link_angle(
        engaged, stiffness, pendulum.torque, pendulum.torque_gradient, unique=False
    )
