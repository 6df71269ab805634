"""Simulated joints of emulated servos, in real time: pendulums of the testbed, or an arm."""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from typing_extensions import override

from elastic_env.core.config import Model
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, IntArray
from elastic_env.joint.elastic_joint import ElasticJoint, Servo
from elastic_env.joint.joint_names import JointAddresses, servo_name
from elastic_env.robots.robot.environment import configure_robot
from elastic_env.robots.testbed.config import TestbedConfig
from elastic_env.robots.testbed.model import JOINT, elastic_spec
from elastic_env.world.many_worlds import simulate

_LARGEST_LAG_S = 0.25
_ARM_STEP_S = 1e-3


class ServoJoints:
    """Joints that servos move, from rest.

    Args:
        model: Elastic model.
        joints: Names of the joints in it, one for each servo.
        servos: Servos of the joints.
        worlds: Number of worlds: 1 for an arm, else one for each servo, with a single joint.
        start_s: Time of the clock at the start [s].

    Attributes:
        skipped_s: Time that was left out because the emulator did not get the processor [s].
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
        self._actuator = np.array([model.actuator(servo_name(j)).id for j in joints])
        self._force = self._simulation.bind("actuator_force")
        self._range = self._simulation.vary("actuator_forcerange")
        self._torque_limits = [servo.torque_limit for servo in servos]
        self._timestep_s = model.opt.timestep
        self._clock_s = start_s
        self.skipped_s = 0.0
        for index in range(n):
            self.set_torque(index, 0.0)

    def advance(self, now_s: float) -> None:
        """Simulate the joints up to a time of the clock [s]."""
        excess_s = self.lag(now_s) - _LARGEST_LAG_S
        if excess_s > 0.0:
            self.skipped_s += excess_s
            self._clock_s += excess_s
        steps = int(self.lag(now_s) / self._timestep_s)
        if steps > 0:
            self._step(steps)
            self._clock_s += steps * self._timestep_s

    def motion(self, index: int) -> tuple[float, float, float]:
        """Angle [rad], its rate [rad/s] and the torque [N·m] of a servo."""
        world = self._world[index]
        theta_dot = self._simulation.qvel[world, self._at.theta_dot[index]]
        torque = self._force[world, self._actuator[index]]
        return float(self.theta[index]), float(theta_dot), float(torque)

    def lag(self, now_s: float) -> float:
        """Time by which the joints are behind the clock [s]."""
        return now_s - self._clock_s

    def command(self, index: int, angle: float) -> None:
        """Set the goal of a servo [rad]."""
        self._simulation.ctrl[self._world[index], self._actuator[index]] = angle

    def set_torque(self, index: int, share: float) -> None:
        """Limit a servo to a share of its torque, 0 to switch it off, and reset its integrator."""
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
        """Simulate some steps.

        Raises:
            ConfigurationError: The joints diverge.
        """
        self._simulation.advance(steps)
        if not np.isfinite(self._simulation.qpos).all():
            raise ConfigurationError(
                "the emulated joints diverge: a spring is too stiff for the inertia and"
                " the damping that the joints file gives it; lower its stiffness, or"
                " raise its damping or rotor_inertia"
            )


class Joints(ServoJoints):
    """N pendulums on elastic joints, which hang at rest at the start.

    Args:
        config: Configuration of the testbed: true joint, true pendulum and physics step.
        num_joints: Number of joints.
        start_s: Time of the clock at the start [s].
    """

    def __init__(self, config: TestbedConfig, num_joints: int, start_s: float) -> None:
        joint = config.true_joint
        if joint.servo is None:
            raise ConfigurationError("an emulated joint needs a servo, got None")
        if joint.servo.motor is not None:
            raise ConfigurationError(
                "an emulated servo controls its current, so that it has no motor; leave"
                " `motor` of its servo out, or emulate an arm"
            )
        spec = elastic_spec(config.true_pendulum, joint, config.form, config.timestep_s)
        n = num_joints
        super().__init__(spec.compile(), [JOINT] * n, [joint.servo] * n, n, start_s)


class EmulatedArm(Model):
    """An arm on emulated servos: model, joints, and mounting of the servos."""

    model: str
    """File of MJCF or URDF, or the text of such a file."""
    joints: dict[str, Any]
    """Settings of the elastic joints, as in a file of joints."""
    order: tuple[str, ...]
    """Joints in the order of the servos' ids."""
    direction: tuple[int, ...]
    """Sign of each joint's angle against its servo's."""
    zero_rad: tuple[float, ...]
    """Servo angle where the joint is at zero [rad]."""
    home: dict[str, float] = {}
    """Angles of the resting arm until torque goes on for the first time, by joint [rad]."""

    def _check(self) -> None:
        lengths = {len(self.order), len(self.direction), len(self.zero_rad)}
        if len(lengths) > 1:
            raise ValueError(f"order, direction and zero_rad must be equally long, got {lengths}")


class ArmJoints(ServoJoints):
    """An arm that rests until torque goes on for the first time.

    Angles are those of the servos. A servo measures the torque that its duty cycle would give at
    rest.

    Args:
        arm: The arm.
        start_s: Time of the clock at the start [s].

    Raises:
        ConfigurationError: A joint is missing, or not elastic, or has no servo.
    """

    def __init__(self, arm: EmulatedArm, start_s: float) -> None:
        config = configure_robot(arm.model, arm.joints, "hold", home=arm.home or None)
        joints: dict[str, ElasticJoint] = config.true_joints
        for name in arm.order:
            if name not in joints or joints[name].servo is None:
                raise ConfigurationError(
                    f"joint {name!r} cannot be emulated: it must be elastic and have a"
                    f" servo; the elastic joints are {', '.join(joints)}"
                )
        servos = [s for name in arm.order if (s := joints[name].servo) is not None]
        spec = config.robot.elastic(config)
        spec.option.timestep = _ARM_STEP_S
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        self._is_resting = True
        motors = [servo.motor for servo in servos]
        self._braking = [0.0 if motor is None else motor.damping for motor in motors]
        self._direction = np.array(arm.direction, dtype=np.float64)
        self._zero = np.array(arm.zero_rad)
        super().__init__(spec.compile(), arm.order, servos, 1, start_s)
        angles = dict(zip(config.robot.joints, config.robot.home or (), strict=False))
        rest = [angles.get(name, 0.0) for name in arm.order]
        self._simulation.qpos[0, self._at.q] = rest
        self._simulation.qpos[0, self._at.theta] = rest

    @override
    def motion(self, index: int) -> tuple[float, float, float]:
        theta, theta_dot, torque = super().motion(index)
        sign = float(self._direction[index])
        effort = sign * (torque + self._braking[index] * theta_dot)
        return sign * theta + float(self._zero[index]), sign * theta_dot, effort

    @override
    def command(self, index: int, angle: float) -> None:
        turn = angle - self._zero[index]
        super().command(index, float(self._direction[index] * turn))

    @override
    def set_torque(self, index: int, share: float) -> None:
        super().set_torque(index, share)
        self._is_resting &= share == 0.0

    @override
    def _step(self, steps: int) -> None:
        if not self._is_resting:
            super()._step(steps)
