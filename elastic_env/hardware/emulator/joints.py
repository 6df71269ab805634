"""The joints behind the emulated servos: the testbed's plant, a world per servo, in real time."""

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.joint.joint_names import JointAddresses
from elastic_env.robots.testbed.config import TestbedConfig
from elastic_env.robots.testbed.model import JOINT, elastic_spec
from elastic_env.world.physics import simulate

_LARGEST_LAG_S = 0.25


class Joints:
    """N pendulums on elastic joints, hanging at rest when they begin.

    Args:
        config: Of the testbed: its true joint, true pendulum and physics step.
        num_joints: How many.
        start_s: The clock when they begin.

    Attributes:
        skipped_s: Time that was left out because the emulator was not given the processor.
    """

    def __init__(self, config: TestbedConfig, num_joints: int, start_s: float) -> None:
        joint = config.true_joint
        if joint.servo is None:
            raise ConfigurationError("an emulated joint needs a servo, got None")
        if joint.servo.motor is not None:
            problem = "an emulated servo controls its current, so that it has no motor"
            cure = "leave `motor` of its servo out"
            raise ConfigurationError(f"{problem}; {cure}")
        spec = elastic_spec(config.true_pendulum, joint, config.form, config.timestep_s)
        model = spec.compile()
        self._simulation = simulate(model, num_joints, num_threads=1)
        self._at = JointAddresses.of(model, [JOINT])
        self._force = self._simulation.bind("actuator_force")
        self._range = self._simulation.vary("actuator_forcerange")
        self._torque_limit = joint.servo.torque_limit
        self._timestep_s = config.timestep_s
        self._clock_s = start_s
        self.skipped_s = 0.0
        for index in range(num_joints):
            self.set_torque(index, is_on=False)

    def advance(self, now_s: float) -> None:
        """Let the joints move until the clock says now."""
        excess_s = self.lag(now_s) - _LARGEST_LAG_S
        if excess_s > 0.0:
            self.skipped_s += excess_s
            self._clock_s += excess_s
        steps = int(self.lag(now_s) / self._timestep_s)
        if steps > 0:
            self._simulation.advance(steps)
            self._clock_s += steps * self._timestep_s

    def motion(self, index: int) -> tuple[float, float, float]:
        """Angle, its rate and the torque of a servo [rad], [rad/s], [N·m]."""
        theta_dot = self._simulation.qvel[index, self._at.theta_dot[0]]
        return float(self.theta[index]), float(theta_dot), float(self._force[index, 0])

    def lag(self, now_s: float) -> float:
        """How far the joints are behind the clock [s]."""
        return now_s - self._clock_s

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
