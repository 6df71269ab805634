"""Parameters of the testbed task, and the plant that follows from them."""

from functools import partial

import numpy as np

from elastic_env.core.errors import ConfigurationError
from elastic_env.joint.dynamixel import H54_200_S500_R
from elastic_env.joint.elastic_joint import ElasticJoint
from elastic_env.motion.trajectory import Motion
from elastic_env.robots.testbed import NAME
from elastic_env.robots.testbed import model as testbed
from elastic_env.robots.testbed.model import JOINT, Pendulum
from elastic_env.world.further_sensors import ACCELEROMETER, add_accelerometer
from elastic_env.world.joint_config import JointConfig, require_torque
from elastic_env.world.joint_plant import JointPlant
from elastic_env.world.robot_model import RobotModel


class TestbedConfig(JointConfig):
    """All parameters of the testbed environment."""

    __test__ = False  # pytest takes it for a test class by its name

    joint: ElasticJoint = H54_200_S500_R
    """The joint as it is assumed; the scenario defines how the true one differs."""
    pendulum: Pendulum = Pendulum()

    @property
    def true_joint(self) -> ElasticJoint:
        """The joint in the plant."""
        return self.plant_joint(self.joint)

    @property
    def true_pendulum(self) -> Pendulum:
        """The pendulum in the plant."""
        return self.pendulum.with_mass_scaled(self.scenario.pendulum_mass_scale)

    def plant(self) -> JointPlant:
        """Make the plant, with the true and the assumed testbed.

        Raises:
            ConfigurationError: The joint has no servo, or one too weak for the reference.
        """
        reference = self.reference
        joint = self.true_joint
        pendulum = self.true_pendulum
        self._require_feasible(joint, pendulum)
        spec = testbed.elastic_spec(pendulum, joint, self.form, self.timestep_s)
        if ACCELEROMETER in self.sensors:
            add_accelerometer(spec, "imu")
        plan = partial(reference.plan_about, np.zeros(1))
        return JointPlant(
            name=NAME,
            model=spec.compile(),
            assumed=self._robot_model(self.joint, self.pendulum),
            true=self._robot_model(joint, pendulum),
            form=self.form,
            static_torque=pendulum.torque,
            torque_gradient=pendulum.torque_gradient,
            motion=Motion(plan, reference.is_random),
            imu_arm_m=testbed.imu_arm(pendulum),
        )

    def _robot_model(self, joint: ElasticJoint, pendulum: Pendulum) -> RobotModel:
        rigid = testbed.rigid_spec(pendulum).compile()
        return RobotModel({JOINT: joint}, rigid, self.control_period_s)

    def _require_feasible(self, joint: ElasticJoint, pendulum: Pendulum) -> None:
        if joint.servo is None:
            problem = "the testbed's joint needs a servo, got None"
            raise ConfigurationError(f"{problem}; see elastic_env.joint.elastic_joint.Servo")
        robot = self._robot_model(joint, pendulum)
        if not self.reference.is_random:
            plan = self.reference.plan(np.random.default_rng(0), self.control_period_s)
            inertia = pendulum.inertia + joint.rotor_inertia
            torque = pendulum.torque(plan.q) + inertia * plan.q_ddot
            demand = robot.demand(torque[:, None], plan.q_dot[:, None])
            require_torque(self.reference, *demand)
            return
        extent = self.reference.extent()
        worst_angle = min(extent.q, np.pi / 2)
        needed = (
            abs(float(pendulum.torque(np.array(worst_angle))))
            + (pendulum.inertia + joint.rotor_inertia) * extent.q_ddot
            + joint.viscous_friction * extent.q_dot
        )
        passed = robot.needed_torque(np.array([needed]))
        limits = robot.largest_torque(np.array([extent.q_dot]))
        require_torque(self.reference, passed, limits)
