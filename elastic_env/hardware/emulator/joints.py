"""The joints behind the emulated servos: the testbed's own plant in MuJoCo, one world per servo, in real time."""

from dataclasses import dataclass

import numpy as np

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.joint.joint_names import JointAddresses
from elastic_env.robots.testbed.config import TestbedConfig
from elastic_env.robots.testbed.model import JOINT, elastic_spec
from elastic_env.runtime.physics import simulate

_LARGEST_LAG_S = 0.25


class Joints:
    """N pendulums on elastic joints, hanging at rest when they begin.

    Args:
        config: Of the testbed: its true joint, true pendulum and physics step.
        num_joints: How many.
        start_s: The clock when they begin.
    """

    def __init__(self, config: TestbedConfig, num_joints: int, start_s: float) -> None:
        joint = config.true_joint
        if joint.servo is None:
            raise ConfigurationError("an emulated servo needs a joint with a servo, got None")
        model = elastic_spec(config.true_pendulum, joint, config.form, config.timestep_s).compile()
        self._simulation = simulate(model, num_joints, num_threads=1)
        self._at = JointAddresses.of(model, [JOINT])
        self._force = self._simulation.bind("actuator_force")
        self._range = self._simulation.vary("actuator_forcerange")
        self._torque_limit = joint.servo.torque_limit
        self._timestep = config.timestep_s
        self._clock = start_s
        self.skipped_s = 0.0
        """Time that was left out because the emulator was not given the processor."""
        for index in range(num_joints):
            self.set_torque(index, is_on=False)

    def advance(self, now_s: float) -> None:
        """Let the joints move until the clock says now."""
        excess = self.lag(now_s) - _LARGEST_LAG_S
        if excess > 0.0:
            self.skipped_s += excess
            self._clock += excess
        steps = int(self.lag(now_s) / self._timestep)
        if steps > 0:
            self._simulation.advance(steps)
            self._clock += steps * self._timestep

    def lag(self, now_s: float) -> float:
        """How far the joints are behind the clock [s]."""
        return now_s - self._clock

    def command(self, index: int, angle: float) -> None:
        """Goal of a servo [rad]."""
        self._simulation.ctrl[index] = angle

    def set_torque(self, index: int, is_on: bool) -> None:
        """Switch a servo's torque; it begins without what its integrator held before."""
        limit = self._torque_limit if is_on else 0.0
        self._range[index, :] = [[-limit, limit]]
        self._simulation.act[index] = 0.0

    @property
    def theta(self) -> Array:
        """Motor side, (num_joints,) [rad]."""
        return self._simulation.qpos[:, self._at.theta[0]]

    @property
    def q(self) -> Array:
        """Link side, (num_joints,) [rad]."""
        return self._simulation.qpos[:, self._at.q[0]]

    @property
    def motors(self) -> list["MotorSide"]:
        """What the servos measure, now and later."""
        theta, theta_dot = self.theta, self._simulation.qvel[:, self._at.theta_dot[0]]
        columns = theta, theta_dot, np.asarray(self._force)[:, 0]
        return [MotorSide(*(column[i : i + 1] for column in columns)) for i in range(len(theta))]


@dataclass(frozen=True)
class MotorSide:
    """Live views of one joint's motor side, (1,) each."""

    theta: Array
    theta_dot: Array
    force: Array

    @property
    def position(self) -> float:
        """Angle of the motor side [rad]."""
        return float(self.theta[0])

    @property
    def velocity(self) -> float:
        """Its rate [rad/s]."""
        return float(self.theta_dot[0])

    @property
    def torque(self) -> float:
        """Torque of the servo [N·m]."""
        return float(self.force[0])
