r"""By how much the joints of a robot on a fixed base bend more than its model says, r, from encoders on the links.

Motor and link encoders show the deflection :math:`\theta - q`. The model expects
:math:`h = K^{-1} (\tau + \tau_F)`, with the torque of the motion and the Coulomb friction of
`baselines.estimation.joint_stiffness`, whose regression says r, joint by joint. Joints without load take after the
others.
"""

import numpy as np

from baselines.compensation.compensators import GravityCompensator, presliding_friction
from baselines.compensation.gravity_torque import make_dynamics
from baselines.compensation.measured import DeflectionSensors
from baselines.compensation.policy import ObservationView
from baselines.estimation.joint_stiffness import StiffnessPrior, regressed
from elastic_env.core.signals import Array
from elastic_env.runtime.robot_model import RobotModel

PRIOR = StiffnessPrior(own=0.3, noise_rad=0.005)
"""Joints of an arm are less alike than those of two legs, and no foot sensors add errors of their own."""


class LinkEncoderEstimator:
    """r of each joint by encoders on all links; an `Estimator`, see the module.

    Memory per world and joint: friction, last link angle, sums of the regression.

    Args:
        model: Assumed robot on a fixed base.
        sensors: Its link encoders.
        prior: What is known of r before it is measured.
    """

    def __init__(self, model: RobotModel, sensors: DeflectionSensors, prior: StiffnessPrior = PRIOR) -> None:
        self._sensors, self._prior, self._n = sensors, prior, len(model.joint_names)
        self._view = ObservationView(model.observation_table, model.control_period_s)
        self._body = make_dynamics(model, GravityCompensator(model).gravity)
        self._stiffness, self._coulomb = model.stiffness, model.coulomb_friction
        self._viscous = model.viscous_friction
        self.memory_width = 7 * self._n

    def begin(self, num_worlds: int) -> Array:
        """See `Estimator`."""
        return np.zeros((num_worlds, self.memory_width))

    def estimate(self, rows: Array, memory: Array) -> tuple[Array, Array]:
        """See `Estimator`."""
        friction, last, *sums = memory.reshape(len(rows), 7, self._n).swapaxes(0, 1)
        deflection, motion = self._sensors.deflection(rows), self._view.motion(rows)
        q = self._view.theta(rows) - deflection
        moved = np.where(sums[0] > 0.0, q - last, 0.0)
        friction = presliding_friction(friction, moved, self._coulomb)
        torque = self._body.inverse_dynamics(q, motion.q_dot, motion.q_ddot) + self._viscous * motion.q_dot
        h = (torque + friction) / self._stiffness
        y = deflection - h
        new = np.stack(sums) + np.stack([np.ones_like(h), h, h * h, y, h * y])
        kept = np.concatenate([friction[None], q[None], new]).swapaxes(0, 1).reshape(memory.shape)
        return regressed(new, self._prior), kept
