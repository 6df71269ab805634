"""The joints behind emulated servos, in real time: pendulums of the testbed, or an arm."""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from elastic_env.core.config import Model
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, IntArray
from elastic_env.joint.elasticity import ElasticJoint, Servo
from elastic_env.joint.joint_names import JointAddresses, servo_name
from elastic_env.robots.robot.environment import configure_robot
from elastic_env.robots.testbed.config import TestbedConfig
from elastic_env.robots.testbed.model import JOINT, elastic_spec
from elastic_env.world.physics import simulate

_LARGEST_LAG_S = 0.25
_ARM_STEP_S = 1e-3


class ServoJoints:
    """Joints that servos move, from rest.

    Args:
        model: The elastic model.
        joints: Their names in it, one for each servo.
        servos: Their servos.
        worlds: Number of worlds: 1 for an arm, else one for each servo, with its only joint.
        start_s: The clock when they begin.

    Attributes:
        skipped_s: Time that was left out because the emulator was not given the processor.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        joints: Sequence[str],
        servos: Sequence[Servo],
        worlds: int,
        start_s: float,
    ) -> None:
        n = len(joints)
        self._simulation = simulate(model, worlds, num_threads=1)
        self._at = JointAddresses.of(model, joints)
        self._world: IntArray = np.arange(n) * int(worlds > 1)
        actuators = [model.actuator(servo_name(name)).id for name in joints]
        self._actuator = np.array(actuators)
        self._force = self._simulation.bind("actuator_force")
        self._range = self._simulation.vary("actuator_forcerange")
        self._torque_limits = [servo.torque_limit for servo in servos]
        self._timestep_s = model.opt.timestep
        self._clock_s = start_s
        self.skipped_s = 0.0
        for index in range(n):
            self.set_torque(index, 0.0)

    def advance(self, now_s: float) -> None:
        """Let the joints move until the clock says now."""
        excess_s = self.lag(now_s) - _LARGEST_LAG_S
        if excess_s > 0.0:
            self.skipped_s += excess_s
            self._clock_s += excess_s
        steps = int(self.lag(now_s) / self._timestep_s)
        if steps > 0:
            self._step(steps)
            self._clock_s += steps * self._timestep_s

    def motion(self, index: int) -> tuple[float, float, float]:
        """Angle, its rate and the torque of a servo [rad], [rad/s], [N·m]."""
        world = self._world[index]
        theta_dot = self._simulation.qvel[world, self._at.theta_dot[index]]
        torque = self._force[world, self._actuator[index]]
        return float(self.theta[index]), float(theta_dot), float(torque)

    def lag(self, now_s: float) -> float:
        """How far the joints are behind the clock [s]."""
        return now_s - self._clock_s

    def command(self, index: int, angle: float) -> None:
        """Goal of a servo [rad]."""
        self._simulation.ctrl[self._world[index], self._actuator[index]] = angle

    def set_torque(self, index: int, share: float) -> None:
        """Let a servo give a share of its torque, 0 to switch it off.

        Its integrator begins without what it held before.
        """
        limit = share * self._torque_limits[index]
        world = self._world[index]
        self._range[world, self._actuator[index]] = [-limit, limit]
        self._simulation.act[world] = 0.0

    @property
    def theta(self) -> Array:
        """Motor side, (n,) [rad]."""
        return self._simulation.qpos[self._world, self._at.theta]

    @property
    def q(self) -> Array:
        """Link side, (n,) [rad]."""
        return self._simulation.qpos[self._world, self._at.q]

    def _step(self, steps: int) -> None:
        self._simulation.advance(steps)
        if not np.isfinite(self._simulation.qpos).all():
            raise ConfigurationError(
                "the emulated joints diverge: a spring is too stiff for the inertia and the damping"
                " that the joints file gives it; lower its stiffness, or raise its damping or"
                " rotor_inertia"
            )


class Joints(ServoJoints):
    """N pendulums on elastic joints, hanging at rest when they begin.

    Args:
        config: Of the testbed: its true joint, true pendulum and physics step.
        num_joints: How many.
        start_s: The clock when they begin.
    """

    def __init__(self, config: TestbedConfig, num_joints: int, start_s: float) -> None:
        joint = config.true_joint
        if joint.servo is None:
            raise ConfigurationError("an emulated joint needs a servo, got None")
        if joint.servo.motor is not None:
            problem = "an emulated servo controls its current, so that it has no motor"
            cure = "leave `motor` of its servo out, or emulate an arm"
            raise ConfigurationError(f"{problem}; {cure}")
        spec = elastic_spec(config.true_pendulum, joint, config.form, config.timestep_s)
        n = num_joints
        super().__init__(spec.compile(), [JOINT] * n, [joint.servo] * n, n, start_s)


class EmulatedArm(Model):
    """An arm on emulated servos: its model and its joints, and how the servos sit in them."""

    model: str
    """File of MJCF or URDF, or the text of one."""
    joints: dict[str, Any]
    """Settings of the elastic joints, as a file of joints has them."""
    order: tuple[str, ...]
    """Joints in the order of the servos' ids."""
    direction: tuple[int, ...]
    """Sign of each joint's angle against its servo's."""
    zero_rad: tuple[float, ...]
    """Servo angle where the joint is at zero [rad]."""
    home: dict[str, float] = {}
    """Where the arm lies until torque goes on for the first time, by joint [rad]."""

    def _check(self) -> None:
        lengths = {len(self.order), len(self.direction), len(self.zero_rad)}
        if len(lengths) > 1:
            lists = "order, direction and zero_rad"
            raise ValueError(f"{lists} must be equally long, got {lengths}")


class ArmJoints(ServoJoints):
    """An arm that lies where it is until torque goes on for the first time.

    Angles are those of the servos. A servo shows the torque that its duty cycle would give at rest.

    Args:
        arm: The arm.
        start_s: The clock when it begins.

    Raises:
        ConfigurationError: A joint is missing, or not elastic, or has no servo.
    """

    def __init__(self, arm: EmulatedArm, start_s: float) -> None:
        home = arm.home or None
        config = configure_robot(arm.model, arm.joints, "hold", home=home)
        joints: dict[str, ElasticJoint] = config.true_joints
        for name in arm.order:
            if name not in joints or joints[name].servo is None:
                raise ConfigurationError(
                    f"joint {name!r} cannot be emulated: it must be elastic and have a servo; the"
                    f" elastic joints are {', '.join(joints)}"
                )
        found = [joints[name].servo for name in arm.order]
        servos = [servo for servo in found if servo is not None]
        spec = config.robot.elastic(config)
        spec.option.timestep = _ARM_STEP_S
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        self._is_lying = True
        self._braking = [0.0 if one.motor is None else one.motor.damping for one in servos]
        self._direction = np.array(arm.direction, dtype=np.float64)
        self._zero = np.array(arm.zero_rad)
        super().__init__(spec.compile(), arm.order, servos, 1, start_s)
        places = dict(zip(config.robot.joints, config.robot.home or (), strict=False))
        lying = [places.get(name, 0.0) for name in arm.order]
        self._simulation.qpos[0, self._at.q] = lying
        self._simulation.qpos[0, self._at.theta] = lying

    def motion(self, index: int) -> tuple[float, float, float]:
        """See `ServoJoints`."""
        theta, theta_dot, torque = super().motion(index)
        sign = float(self._direction[index])
        effort = sign * (torque + self._braking[index] * theta_dot)
        return sign * theta + float(self._zero[index]), sign * theta_dot, effort

    def command(self, index: int, angle: float) -> None:
        """See `ServoJoints`."""
        turned = angle - self._zero[index]
        super().command(index, float(self._direction[index] * turned))

    def set_torque(self, index: int, share: float) -> None:
        """See `ServoJoints`."""
        super().set_torque(index, share)
        self._is_lying &= share == 0.0

    def _step(self, steps: int) -> None:
        if not self._is_lying:
            super()._step(steps)
