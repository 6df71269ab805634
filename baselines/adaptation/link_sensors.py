r"""By how much the joints of a robot on a fixed base bend more than its model says, r, from encoders on the links.

Motor and link encoders show the deflection :math:`\theta - q`. The model expects
:math:`h = K^{-1} (\tau + \tau_F)`, with the torque of the motion and the Coulomb friction of
`baselines.estimation.joint_stiffness`, whose regression says r, joint by joint. Joints without load take after the
others.
"""

from typing_extensions import override

from baselines.adaptation.estimators import Estimator
from baselines.compensation.compensators import GravityCompensator
from baselines.compensation.gravity_torque import make_dynamics
from baselines.compensation.measured import DeflectionSensors
from baselines.compensation.policy import ObservationView
from baselines.estimation.joint_stiffness import RegressionMemory, StiffnessPrior, StiffnessRegression
from elastic_env.core.signals import Array
from elastic_env.runtime.robot_model import RobotModel

PRIOR = StiffnessPrior(own=0.3, noise_rad=0.005)
"""Joints of an arm are less alike than those of two legs, and no foot sensors add errors of their own."""


class LinkEncoderEstimator(Estimator):
    """r of each joint by encoders on all links, see the module.

    Args:
        model: Assumed robot on a fixed base.
        sensors: Its link encoders.
        prior: What is known of r before it is measured.
    """

    def __init__(self, model: RobotModel, sensors: DeflectionSensors, prior: StiffnessPrior = PRIOR) -> None:
        self._sensors = sensors
        self._regression = StiffnessRegression(model, prior)
        self._view = ObservationView(model.observation_table, model.control_period_s)
        self._body = make_dynamics(model, GravityCompensator(model).gravity)
        self._stiffness = model.stiffness
        self._viscous = model.viscous_friction

    @override
    def begin(self, num_worlds: int) -> RegressionMemory:
        return self._regression.begin(num_worlds)

    @override
    def estimate(self, rows: Array, memory: RegressionMemory) -> tuple[Array, RegressionMemory]:
        deflection = self._sensors.deflection(rows)
        motion = self._view.motion(rows)
        q = self._view.theta(rows) - deflection
        friction = self._regression.friction(q, memory)
        torque = self._body.inverse_dynamics(q, motion.q_dot, motion.q_ddot) + self._viscous * motion.q_dot
        h = (torque + friction) / self._stiffness
        return self._regression.add(h, deflection, friction, q, memory, measured=self._sensors.has)
