r"""Disturbance observer of a joint with an IMU on its link.

It finds the torque that the model lacks; the command leads by the deflection under it.

The link obeys :math:`I \ddot q + \tau_g(q) + d = \tau_J`. Encoder and IMU show the deflection δ, so
the model says how much torque reaches the link and how much its motion needs. What is missing is
the disturbance d, behind a first-order filter of time constant T [Nakao1987], [Ohnishi1996]:

.. math:: \dot{\hat d} = \frac{1}{T} \big(K \delta + D \dot\delta - \tau_g(q) - I \ddot q - \hat d\big)

I q̈ is the change of the momentum over a control period. It needs q̇ alone, and the filter sums it
up [DeLuca2003]. Deflection and link angle, their rates and the friction pass one and the same
further filter. What is behind it obeys the same equation, so that a motion without disturbance
leaves nothing. The command leads by d̂/K more.

d is what another K, another load and what is left of friction do. In motion the friction of the
model is taken as known. At rest it may be anything up to F: else the estimate winds up against a
link that sticks. Where K and load are as assumed, d does not depend on the command, and there is no
loop. For a K that is wrong by ΔK there is one, which is strongest at the resonance ω of link and
spring. Its gain there is

.. math:: \frac{1}{\omega T} \frac{K}{D \omega} \frac{\Delta K}{K}, \quad
          \text{below 1 for} \quad T > \frac{I}{D} \frac{\Delta K}{K}

The bound is 0.12 s on the testbed for a K that is 0.3 below the assumed one. The default T is 0.3
s: thirty samples of an IMU at 100 Hz, and 75 control periods.

The IMU has an offset. Where the model says that the joint starts without load, encoder and IMU must
agree, and their difference is averaged before the observer begins. What disturbs the joint there
from the start is not seen.

[Nakao1987] M. Nakao, K. Ohnishi, K. Miyachi, "A Robust Decentralized Joint Control Based on
Interference Estimation", IEEE Int. Conf. Robotics and Automation. [Ohnishi1996] K. Ohnishi, M.
Shibata, T. Murakami, "Motion Control for Advanced Mechatronics", IEEE/ASME Trans. Mechatronics
1(1). [DeLuca2003] A. De Luca, R. Mattone, "Actuator Failure Detection and Isolation Using
Generalized Momenta", IEEE Int. Conf. Robotics and Automation.
"""  # noqa: E501

from typing import Any, NamedTuple

import numpy as np
from typing_extensions import override

from baselines.compensation.compensators import GravityCompensator
from baselines.compensation.dry_friction import presliding_friction
from baselines.compensation.measured import require_sensor
from baselines.compensation.policy import PolicyAround, PolicyInputs, Step, filter_share
from baselines.compensation.startup import Ramp
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, IntArray
from elastic_env.joint.elasticity import joint_torque
from elastic_env.motion.trajectory import STAND_S
from elastic_env.world.robot_model import RobotModel

LINK_IMU = "link_imu"
_LINK_ANGLE = "link_angle_imu"
"""Sensor, and its column."""
_UNLOADED_RAD = 1e-3
"""Largest deflection of a joint that counts as unloaded [rad]."""


class ObserverGains(Model):
    """How fast a disturbance is observed, and how much of it."""

    time_constant_s: float = quantity("s", 0.3, gt=0)
    """T, with which the estimate follows [s]."""
    rate_filter_s: float = quantity("s", 0.03, gt=0)
    """Time constant of the filter that all measurements pass [s]."""
    limit_nm: float = quantity("N·m", 30.0, gt=0)
    """Largest disturbance that is compensated [N·m]."""
    friction: bool = True
    """The model's Coulomb friction is known, and no disturbance.

    It must be as in the policy inside.
    """
    zero_s: float = quantity("s", 0.5, ge=0)
    """Time in which the IMU is zeroed at the start, 0 for never [s]."""


class JointObservation(NamedTuple):
    """Memory of the observer for every joint, (num_worlds, n) each.

    Attributes:
        offset: By how much the IMU shows too little [rad].
        imu: Its last angle [rad].
        deflection: δ where encoder and IMU were new [rad].
        friction: Coulomb friction that holds the link back [N·m].
        smooth_deflection: δ behind the filter of all measurements [rad].
        smooth_q: The link angle behind it [rad].
        smooth_friction: The friction behind it [N·m].
        rate: The rate of the link behind it [rad/s].
        disturbance: Torque that the model lacks; positive holds the link back [N·m].
    """

    offset: Array
    imu: Array
    deflection: Array
    friction: Array
    smooth_deflection: Array
    smooth_q: Array
    smooth_friction: Array
    rate: Array
    disturbance: Array


class ObserverMemory(NamedTuple):
    """Memory of the policy.

    Control steps since the start of the episode, (num_worlds, 1), what is kept of the joints, and
    the memory of the policy inside it.
    """

    steps: IntArray
    joints: JointObservation
    inner: Any


class DisturbanceObserver(PolicyAround):
    """Any policy of a joint with the observed disturbance compensated, see the module.

    Args:
        policy: What commands the robot.
        model: Assumed robot, whose observation has the IMU of the link.
        gains: Filters and bound.
        ramp_s: Time in which the compensation grows from zero [s].

    Raises:
        ConfigurationError: The observation does not have the IMU, or friction changes with load or
            speed.
    """

    def __init__(
        self, policy: Any, model: RobotModel, gains: ObserverGains, ramp_s: float = STAND_S
    ) -> None:
        super().__init__(policy, model)
        self.inputs = ()
        table = model.observation_table
        require_sensor(table, LINK_IMU, _LINK_ANGLE)
        self._gains = gains
        self._dt = model.control_period_s
        self._imu = table.group(_LINK_ANGLE)
        self._static = GravityCompensator(model)
        self._follow_share = filter_share(self._dt, gains.time_constant_s)
        self._smooth_share = filter_share(self._dt, gains.rate_filter_s)
        self._zero_steps = round(gains.zero_s / self._dt)
        model.require_constant_friction("the disturbance observer")
        self._coulomb = gains.friction * model.coulomb_friction
        self._ramp = Ramp(model, ramp_s).table

    @override
    def begin(self, rows: Array) -> ObserverMemory:
        imu = rows[:, self._imu].copy()
        delta = self.view.theta(rows) - imu
        zero = np.zeros_like(imu)
        joints = JointObservation(zero, imu, delta, zero, delta, imu, zero, zero, zero)
        steps = np.zeros((len(rows), 1), dtype=np.int64)
        return ObserverMemory(steps, joints, self.policy.begin(rows))

    @override
    def act(self, rows: Array, memory: ObserverMemory, inputs: PolicyInputs) -> Step:
        action, inner = self.policy.act(rows, memory.inner, inputs)
        steps = memory.steps + 1
        joints = self._observe(rows, steps, memory.joints)
        share = self._ramp.take(steps, mode="clip")
        lead = share * joints.disturbance / self.model.stiffness
        memory = ObserverMemory(steps, joints, inner)
        return (action + lead).astype(np.float32), memory

    @override
    def link_angles(self, rows: Array, memory: ObserverMemory) -> Array:
        """The IMU's angle without its offset, (num_worlds, n) [rad]."""
        return rows[:, self._imu] + memory.joints.offset

    def _observe(self, rows: Array, steps: IntArray, was: Any) -> JointObservation:
        """`JointObservation` after a control step."""
        gains = self._gains
        model = self.model
        dt = self._dt
        theta = self.view.theta(rows)
        imu = rows[:, self._imu].copy()
        q_ref_dot = self.view.motion(rows).q_dot
        is_zeroing = steps <= self._zero_steps
        # by how much the IMU shows too little in a joint without load
        q = self._static.link_angle(theta)
        unloaded = np.where(np.abs(theta - q) < _UNLOADED_RAD, q - imu, 0.0)
        missing = unloaded - was.offset
        offset = was.offset + is_zeroing * missing / steps
        # between two samples of the IMU the encoder goes on: the deflection is known where both are
        # new
        is_new = (imu != was.imu) | is_zeroing
        deflection = np.where(is_new, theta - imu - offset, was.deflection)
        friction = presliding_friction(was.friction, q_ref_dot * dt, self._coulomb)

        def smooth(value: Array, before: Array) -> Array:
            """A value behind the filter that all have in common."""
            filtered = before + self._smooth_share * (value - before)
            return np.where(is_zeroing, value, filtered)

        delta = smooth(deflection, was.smooth_deflection)
        delta_dot = (deflection - delta) / gains.rate_filter_s
        q = smooth(theta - deflection, was.smooth_q)
        q_dot = (theta - deflection - q) / gains.rate_filter_s
        known = smooth(friction, was.smooth_friction)
        joints = (model.stiffness, model.damping, model.backlash)
        passed = joint_torque(delta, delta_dot, *joints)
        needed = self._static.gravity.inverse_dynamics(q, q_dot, (q_dot - was.rate) / dt)
        # at rest dry friction takes any value up to F: only what is beyond is a disturbance
        left = passed - needed - was.disturbance
        stuck = np.clip(left, -self._coulomb, self._coulomb)
        rubs = np.where(q_ref_dot == 0.0, stuck, known)
        missing = np.where(is_zeroing, 0.0, passed - needed - rubs)
        disturbance = was.disturbance + self._follow_share * (missing - was.disturbance)
        disturbance = np.clip(disturbance, -gains.limit_nm, gains.limit_nm)
        return JointObservation(
            offset, imu, deflection, friction, delta, q, known, q_dot, disturbance
        )
