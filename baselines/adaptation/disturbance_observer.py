r"""Disturbance observer of a joint with an IMU on its link.

It estimates the torque that the model lacks; the command leads by the deflection under it.

The link obeys :math:`I \ddot q + \tau_g(q) + d = \tau_J`. Encoder and IMU measure the deflection δ.
By the model follow the torque that reaches the link, and the torque that its motion needs. The
difference is the disturbance d, behind a first-order filter of time constant T [Nakao1987],
[Ohnishi1996]:

.. math:: \dot{\hat d} = \frac{1}{T} \big(K \delta + D \dot\delta - \tau_g(q) - I \ddot q - \hat d\big)

I q̈ is the change of the momentum over a control period. It needs q̇ only, and the filter sums it
up [DeLuca2003]. Deflection and link angle, their rates and the friction pass one common further
filter. Filtered signals obey the same equation, so that a motion without disturbance gives d̂ = 0.
The command leads by d̂/K more.

d contains the effects of another K, another load and unmodelled friction. In motion the friction of
the model counts as known. At rest it may be anything up to F: otherwise the estimate winds up
against a link that sticks. Where K and load are as assumed, d does not depend on the command, and
there is no loop. For a K that is wrong by ΔK there is a loop, which is strongest at the resonance ω
of link and spring. Its gain there is

.. math:: \frac{1}{\omega T} \frac{K}{D \omega} \frac{\Delta K}{K}, \quad
          \text{below 1 for} \quad T > \frac{I}{D} \frac{\Delta K}{K}

The bound is 0.12 s on the testbed for a K that is 30 % below the assumed one. The default T is 0.3
s: thirty samples of an IMU at 100 Hz, and 75 control periods.

The IMU has an offset. Where the joint starts without load by the model, encoder and IMU must agree,
and their difference is averaged before the observer begins. So a disturbance that acts from
the start is not observed.

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
from baselines.compensation.filters import filter_share
from baselines.compensation.measured import require_sensor
from baselines.compensation.policy import PolicyInputs, Step
from baselines.compensation.policy_around import PolicyAround
from baselines.compensation.ramp import Ramp
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
    """Filters and bound of the disturbance observer of a joint."""

    time_constant_s: float = quantity("s", 0.3, gt=0)
    """T, with which the estimate follows [s]."""
    rate_filter_s: float = quantity("s", 0.03, gt=0)
    """Time constant of the filter that all measurements pass [s]."""
    limit_nm: float = quantity("N·m", 30.0, gt=0)
    """Largest disturbance that is compensated [N·m]."""
    friction: bool = True
    """True to take the model's Coulomb friction as known, as the policy inside must do."""
    zero_s: float = quantity("s", 0.5, ge=0)
    """Time in which the IMU is zeroed at the start, 0 for never [s]."""


class JointObservation(NamedTuple):
    """Memory of the observer for every joint, (num_worlds, n) each.

    Attributes:
        offset: Angle to be added to the one of the IMU [rad].
        imu: Its last angle [rad].
        deflection: δ when encoder and IMU were new [rad].
        friction: Coulomb friction that holds the link back [N·m].
        smooth_deflection: δ behind the filter of all measurements [rad].
        smooth_q: Link angle behind it [rad].
        smooth_friction: Friction behind it [N·m].
        rate: Rate of the link behind it [rad/s].
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

    Attributes:
        steps: Control steps since the start of the episode, (num_worlds, 1).
        joints: Memory of the observer.
        inner: Memory of the policy inside it.
    """

    steps: IntArray
    joints: JointObservation
    inner: Any


class DisturbanceObserver(PolicyAround):
    """Any policy of a joint with the observed disturbance compensated, see the module.

    Args:
        policy: Commands the robot.
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

    def _observe(self, rows: Array, steps: IntArray, last: Any) -> JointObservation:
        """`JointObservation` after a control step."""
        gains = self._gains
        model = self.model
        dt = self._dt
        theta = self.view.theta(rows)
        imu = rows[:, self._imu].copy()
        q_ref_dot = self.view.motion(rows).q_dot
        is_zeroing = steps <= self._zero_steps
        # in a joint without load encoder and IMU must agree
        q = self._static.link_angle(theta)
        unloaded = np.where(np.abs(theta - q) < _UNLOADED_RAD, q - imu, 0.0)
        missing = unloaded - last.offset
        offset = last.offset + is_zeroing * missing / steps
        # between two samples of the IMU the encoder changes: the deflection is known when both are
        # new
        is_new = (imu != last.imu) | is_zeroing
        deflection = np.where(is_new, theta - imu - offset, last.deflection)
        friction = presliding_friction(last.friction, q_ref_dot * dt, self._coulomb)

        def smooth(value: Array, before: Array) -> Array:
            """Value behind the common filter."""
            filtered = before + self._smooth_share * (value - before)
            return np.where(is_zeroing, value, filtered)

        delta = smooth(deflection, last.smooth_deflection)
        delta_dot = (deflection - delta) / gains.rate_filter_s
        q = smooth(theta - deflection, last.smooth_q)
        q_dot = (theta - deflection - q) / gains.rate_filter_s
        known_friction = smooth(friction, last.smooth_friction)
        passed = joint_torque(delta, delta_dot, model.stiffness, model.damping, model.backlash)
        q_ddot = (q_dot - last.rate) / dt
        needed = self._static.gravity.inverse_dynamics(q, q_dot, q_ddot)
        # at rest dry friction takes any value up to F: only torque beyond is a disturbance
        excess = passed - needed - last.disturbance
        static = np.clip(excess, -self._coulomb, self._coulomb)
        friction_torque = np.where(q_ref_dot == 0.0, static, known_friction)
        missing = np.where(is_zeroing, 0.0, passed - needed - friction_torque)
        estimate = last.disturbance + self._follow_share * (missing - last.disturbance)
        estimate = np.clip(estimate, -gains.limit_nm, gains.limit_nm)
        return JointObservation(
            offset, imu, deflection, friction, delta, q, known_friction, q_dot, estimate
        )
