"""The plant of a robot of elastic joints on a fixed base, its truth, and its rest."""

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from elastic_env.core.signals import Array, BoolArray, Parameter
from elastic_env.joint.static_equilibrium import static_link_angle
from elastic_env.motion.trajectory import Motion
from elastic_env.rigid.tree.end_effector import EndEffector
from elastic_env.world.further_sensors import SensorInputs
from elastic_env.world.physics import Simulation
from elastic_env.world.records import Records
from elastic_env.world.robot_model import RobotModel

_RIGID_NM_PER_RAD = 1e15
"""Finite stiffness of a joint without a spring, on a robot whose other servos give way."""


@dataclass(frozen=True)
class JointPlant:
    """The plant, and the robot as it is assumed and as it really is.

    Attributes:
        name: Name of the robot.
        model: Compiled model with elastic joints.
        assumed, true: Robot as a compensator may know it, and true robot; both without a table of
            observations.
        form: "rigid" for a robot without springs.
        static_torque: τ_g that holds the true links, from (..., n) [rad] to (..., n) [N·m].
        torque_gradient: ∂τ_g/∂q, from (..., n) to (..., n, n) [N·m/rad].
        motion: Reference motion of all joints.
        imu_arm_m: Distance of the link's IMU from the only joint [m]; the joint's axis is
            horizontal, and its link hangs at q = 0. None for a robot without such an IMU.
        end_effector: End effector whose place and tilt are scored; None to score joints only.
    """

    name: str
    model: mujoco.MjModel
    assumed: RobotModel
    true: RobotModel
    form: str
    static_torque: Callable[[Array], Array]
    torque_gradient: Callable[[Array], Array]
    motion: Motion
    imu_arm_m: float | None = None
    end_effector: EndEffector | None = None

    @property
    def joint_names(self) -> list[str]:
        """Names of the joints, in order."""
        return self.true.joint_names

    def rest_angle(
        self, command: Array, factor: Parameter = 1.0, backlash: Array | None = None
    ) -> Array:
        """Link angles at rest without friction.

        The load pulls a link to one side of its dead band. A link that hangs at q = 0 stays there
        within its dead band.

        Args:
            command: Commands of the servos, (..., n) [rad].
            factor: Factor on K, one number or (..., n) [1].
            backlash: Dead bands, (..., n) [rad]; None for the true joints' dead bands.

        Returns:
            (..., n) [rad].
        """
        stiffness = self.true.rest_stiffness(self.form, factor)
        if np.isinf(stiffness).all():
            return command
        band = self.true.backlash if backlash is None else backlash
        half = np.sign(self.static_torque(command)) * band / 2.0
        engaged = command - half
        if self.imu_arm_m is not None:
            engaged = np.where(np.abs(command) > np.abs(half), engaged, 0.0)
        finite = np.minimum(stiffness, _RIGID_NM_PER_RAD)
        return static_link_angle(
            engaged, finite, self.static_torque, self.torque_gradient, unique=False
        )


@dataclass(frozen=True)
class JointTruth(SensorInputs):
    """Noise-free state of the joints and their true parameters, one row per world.

    For scoring and the oracle.

    Attributes:
        theta, theta_dot, q_dot: Motor and link side, (num_worlds, n) [rad], [rad/s].
        deflection: θ − q, (num_worlds, n) [rad].
        stiffness: True K, (num_worlds, n) [N·m/rad].
        model: The true joints and links.
    """

    theta: Array
    theta_dot: Array
    q_dot: Array
    deflection: Array
    stiffness: Array
    model: RobotModel


def place_at_rest(
    plant: JointPlant,
    simulation: Simulation,
    addresses: Records,
    worlds: BoolArray,
    q_ref: Array,
    truth: Records,
) -> None:
    """Put the springs of some worlds at their static deflection while the servos hold q_ref.

    Args:
        plant: The plant of all worlds.
        simulation: Its physics, whose state is written.
        addresses: Records of `ADDRESS`, (n,).
        worlds: Mask of the k worlds.
        q_ref: Reference, (k, n) [rad].
        truth: True parameters of the joints in these worlds, (k, n).
    """
    command = q_ref - truth["homing"]
    factor = truth["stiffness"] / plant.true.stiffness
    q = plant.rest_angle(command, factor, truth["backlash"])
    torque = plant.static_torque(q)
    theta = command - plant.true.servo_compliance * torque
    simulation.qpos[np.ix_(worlds, addresses["theta"])] = theta
    simulation.qpos[np.ix_(worlds, addresses["q"])] = q
    simulation.ctrl[np.ix_(worlds, addresses["servo"])] = command
    for column, servo in enumerate(plant.true.servos):
        if servo.integral_gain > 0.0:
            integrator = plant.model.actuator_actadr[addresses["servo"][column]]
            windup = torque[:, column] / servo.integral_gain
            simulation.act[worlds, integrator] = windup
