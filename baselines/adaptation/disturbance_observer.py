r"""Disturbance observer of a joint with an IMU on its link: what torque the model lacks, led by as a deflection.

The link obeys :math:`I \ddot q + \tau_g(q) + d = \tau_J`. Encoder and IMU show the deflection δ, so the model says how
much torque reaches the link and how much its motion needs. What is missing is the disturbance d, behind a first-order
filter of time constant T [Nakao1987], [Ohnishi1996]:

.. math:: \dot{\hat d} = \frac{1}{T} \big(K \delta + D \dot\delta - \tau_g(q) - I \ddot q - \hat d\big)

I q̈ is the change of the momentum over a control period. It needs q̇ alone, and the filter sums it up [DeLuca2003].
Deflection and link angle, their rates and the friction pass one and the same further filter. What is behind it obeys
the same equation, so that a motion without disturbance leaves nothing. The command leads by d̂/K more.

d is what another K, another load and what is left of friction do. In motion the friction of the model is taken as
known. At rest it may be anything up to F: else the estimate winds up against a link that sticks. Where K and load are
as assumed, d does not depend on the command, and there is no loop. For a K that is wrong by ΔK there is
one, which is strongest at the resonance ω of link and spring. Its gain there is

.. math:: \frac{1}{\omega T} \frac{K}{D \omega} \frac{\Delta K}{K}, \quad
          \text{below 1 for} \quad T > \frac{I}{D} \frac{\Delta K}{K}

The bound is 0.12 s on the testbed for a K that is 0.3 below the assumed one. The default T is 0.3 s: thirty samples of
an IMU at 100 Hz, and 75 control periods.

The IMU has an offset. Where the model says that the joint starts without load, encoder and IMU must agree, and their
difference is averaged before the observer begins. What disturbs the joint there from the start is not seen.

[Nakao1987] M. Nakao, K. Ohnishi, K. Miyachi, "A Robust Decentralized Joint Control Based on Interference Estimation",
IEEE Int. Conf. Robotics and Automation.
[Ohnishi1996] K. Ohnishi, M. Shibata, T. Murakami, "Motion Control for Advanced Mechatronics", IEEE/ASME Trans.
Mechatronics 1(1).
[DeLuca2003] A. De Luca, R. Mattone, "Actuator Failure Detection and Isolation Using Generalized Momenta", IEEE Int.
Conf. Robotics and Automation.
"""

from typing import Any

import numpy as np

from baselines.compensation.compensators import GravityCompensator, presliding_friction
from baselines.compensation.gravity_torque import make_dynamics
from baselines.compensation.measured import require_sensor
from baselines.compensation.policy import Action, ObservationView, Policy, taken_up
from baselines.compensation.startup import Ramp
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array
from elastic_env.joint.elasticity import joint_torque
from elastic_env.motion.trajectory import STAND_S
from elastic_env.runtime.robot_model import RobotModel

LINK_IMU, _LINK_ANGLE = "link_imu", "link_angle_imu"
"""Sensor, and its column."""
_MEMORY: tuple[str, ...] = (
    "offset", "imu", "deflection", "friction", "smooth_deflection", "smooth_q", "smooth_friction", "rate",
    "disturbance",
)  # fmt: skip
"""What is kept of every joint, in order."""
_UNLOADED_RAD = 1e-3
"""Largest deflection of a joint that counts as unloaded [rad]."""


class ObserverGains(Model):
    """How fast a disturbance is observed, and how much of it."""

    time_constant_s: float = quantity("s", 0.3, gt=0, description="T, with which the estimate follows")
    rate_filter_s: float = quantity(
        "s", 0.03, gt=0, description="time constant of the filter that all measurements pass"
    )
    limit_nm: float = quantity("N·m", 30.0, gt=0, description="largest disturbance that is compensated")
    friction: bool = True
    """Whether the model's Coulomb friction is known, and no disturbance. It must be as in the policy inside."""
    zero_s: float = quantity("s", 0.5, ge=0, description="time in which the IMU is zeroed at the start, 0 for never")


class DisturbanceObserver:
    """Any policy of a joint with the observed disturbance compensated, see the module.

    Memory: steps, then per joint what `_MEMORY` names.

    Args:
        policy: What commands the robot.
        model: Assumed robot, whose observation has the IMU of the link.
        gains: Filters and bound.
        ramp_s: Time in which the compensation grows from zero [s].

    Raises:
        ConfigurationError: The observation does not have the IMU.
    """

    def __init__(
        self, policy: Policy, model: RobotModel, gains: ObserverGains | None = None, ramp_s: float = STAND_S
    ) -> None:
        self._policy, self._model, self._gains = policy, model, gains or ObserverGains()
        table, self._dt = model.observation_table, model.control_period_s
        require_sensor(table, LINK_IMU, _LINK_ANGLE)
        self._view, self._imu = ObservationView(table, self._dt), table.group(_LINK_ANGLE)
        self._static = GravityCompensator(model)
        self._body = make_dynamics(model, self._static.gravity)
        self._follows, self._smooths = (
            1.0 - float(np.exp(-self._dt / time)) for time in (self._gains.time_constant_s, self._gains.rate_filter_s)
        )
        self._zero_steps = round(self._gains.zero_s / self._dt)
        self._coulomb = self._gains.friction * model.coulomb_friction
        self._ramp = Ramp(model, ramp_s)

    def predict(
        self, observation: Array, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Action, Any]:
        """Action and new state."""
        rows = self._view.rows(observation)
        memory, inner = taken_up(state, episode_start, rows, self._view, lambda: self._begin(rows))
        action, inner = self._policy.predict(observation, inner, episode_start, deterministic)
        memory = self._observed(rows, memory)
        lead = self._ramp.after(memory[:, :1]) * self.disturbance((memory, inner)) / self._model.stiffness
        total = np.asarray(action, dtype=np.float64) + lead.reshape(np.shape(action))
        return total.astype(np.float32), (memory, inner)

    def disturbance(self, state: Any) -> Array:
        """Torque that the model lacks, of a state, (num_worlds, n) [N·m]; positive holds the link back."""
        n = len(self._model.joint_names)
        return np.asarray(state[0][:, -n:])

    def link_estimate(self, observation: Array, state: Any) -> Array:
        """The IMU's angle without its offset, (..., n) [rad]."""
        n = len(self._model.joint_names)
        return observation[..., self._imu] + state[0][:, 1 : 1 + n].reshape((*observation.shape[:-1], n))

    def _begin(self, rows: Array) -> Array:
        imu, theta = rows[:, self._imu], self._view.theta(rows)
        at_rest = dict(zip(_MEMORY, np.zeros((len(_MEMORY), *imu.shape)), strict=True))
        at_rest |= {"imu": imu, "deflection": theta - imu, "smooth_deflection": theta - imu, "smooth_q": imu}
        return np.hstack([np.zeros((len(rows), 1)), *at_rest.values()])

    def _observed(self, rows: Array, memory: Array) -> Array:
        """Memory after a control step."""
        gains, model = self._gains, self._model
        theta, imu = self._view.theta(rows), rows[:, self._imu]
        steps, was = memory[:, :1] + 1.0, dict(zip(_MEMORY, np.split(memory[:, 1:], len(_MEMORY), axis=1), strict=True))
        is_zeroing = steps <= self._zero_steps
        offset = was["offset"] + is_zeroing * (self._disagreement(theta, imu) - was["offset"]) / steps
        # between two samples of the IMU the encoder goes on: the deflection is known where both are new
        is_new = (imu != was["imu"]) | is_zeroing
        deflection = np.where(is_new, theta - imu - offset, was["deflection"])
        friction = presliding_friction(was["friction"], self._view.motion(rows).q_dot * self._dt, self._coulomb)

        def smooth(name: str, value: Array) -> tuple[Array, Array]:
            """A value behind the filter that all have in common, and its rate."""
            smoothed = np.where(is_zeroing, value, was[name] + self._smooths * (value - was[name]))
            return smoothed, (value - smoothed) / gains.rate_filter_s

        delta, delta_dot = smooth("smooth_deflection", deflection)
        q, q_dot = smooth("smooth_q", theta - deflection)
        known, _ = smooth("smooth_friction", friction)
        passed = joint_torque(delta, delta_dot, model.stiffness, model.damping, model.backlash)
        needed = self._body.inverse_dynamics(q, q_dot, (q_dot - was["rate"]) / self._dt)
        # at rest dry friction takes any value up to F: only what is beyond is a disturbance
        left = passed - needed - was["disturbance"]
        stands = self._view.motion(rows).q_dot == 0.0
        rubs = np.where(stands, np.clip(left, -self._coulomb, self._coulomb), known)
        missing = np.where(is_zeroing, 0.0, passed - needed - rubs)
        disturbance = was["disturbance"] + self._follows * (missing - was["disturbance"])
        disturbance = np.clip(disturbance, -gains.limit_nm, gains.limit_nm)
        return np.hstack([steps, offset, imu, deflection, friction, delta, q, known, q_dot, disturbance])

    def _disagreement(self, theta: Array, imu: Array) -> Array:
        """By how much the IMU shows too little, where there is no load that bends the joint, else 0 [rad]."""
        q = self._static.link_angle(theta, theta)
        return np.where(np.abs(theta - q) < _UNLOADED_RAD, q - imu, 0.0)
