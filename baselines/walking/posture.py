r"""Posture feedback: the hips turn the pelvis back to level, by its IMU.

The same offset on both hip rolls, and on both hip pitches, turns the pelvis against legs that stand:

.. math:: u = k_p \hat\varphi + k_i \int \hat\varphi \, dt + k_d \hat\omega

The hip roll of a leg in the air is turned as well, so that on a slope it lands where the ground is. Its hip pitch keeps
the turn with which it left the ground, and follows u slowly: what the standing leg needs while it carries the robot
alone would move the other foot forth and back.

φ is the attitude of the IMU behind a first-order filter, ω its rate. The integral leaks, as it winds up against homing
errors and the integrator of the foot force control else. Walking robots do this widely, also the published controller
of this one [Kajita2010, section V].

[Kajita2010] S. Kajita et al., "Biped Walking Stabilization Based on Linear Inverted Pendulum Tracking", IROS.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from baselines.compensation.inputs import PolicyInputs
from baselines.compensation.policy import Action, ObservationView, PolicyAround, predicted, taken_up
from baselines.compensation.startup import Ramp
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array
from elastic_env.dynamics.contact_force import shares
from elastic_env.motion.trajectory import STAND_S
from elastic_env.runtime.robot_model import WalkerModel

_HIP_ROLL, _HIP_PITCH = 1, 2  # of six joints of a leg


class PostureGains(Model):
    """Gains of the posture feedback."""

    proportional: float = quantity("1", 2.0, ge=0, description="hip angle per tilt")
    integral: float = quantity("1/s", 4.0, ge=0, description="hip angle per tilt and time")
    derivative: float = quantity("s", 0.1, ge=0, description="hip angle per rate of the tilt")
    leak_s: float = quantity("s", 1.0, gt=0, description="time constant with which the integral leaks")
    filter_s: float = quantity("s", 0.02, gt=0, description="time constant of the attitude's filter")
    swing_s: float = quantity(
        "s", 0.5, ge=0, description="time constant with which the pitch of a leg in the air follows"
    )
    limit_rad: float = quantity("rad", 0.08, gt=0, description="largest part of the integral, and of the whole")


class PostureFeedback(PolicyAround):
    """Any policy of a walker with its posture held by the hips, see the module.

    Memory per world: steps, filtered roll and pitch, their integrals, and the hip pitch that either leg keeps.

    Args:
        policy: What commands the robot.
        model: Assumed walker.
        gains: Gains.
        ramp_s: Time in which the feedback grows from zero [s].
    """

    def __init__(
        self, policy: Any, model: WalkerModel, gains: PostureGains | None = None, ramp_s: float = STAND_S
    ) -> None:
        self._policy, self._gains = policy, gains or PostureGains()
        table, self._dt = model.observation_table, model.control_period_s
        self._view = ObservationView(table, self._dt)
        self._attitude, self._rate = table.group("imu_attitude"), table.columns("imu_rate.x", "imu_rate.y")
        self._share_right = table.group("load_share")
        self._filter = 1.0 - float(np.exp(-self._dt / self._gains.filter_s))
        self._ramp = Ramp(model, ramp_s)

    @property
    def inputs(self) -> tuple[str, ...]:
        """See `PolicyWithInputs`."""
        return (*super().inputs, "posture_gain")

    def predict_with(
        self,
        observation: Array,
        inputs: PolicyInputs,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Action, Any]:
        """See `PolicyWithInputs`; it takes `posture_gain`."""
        rows = self._view.rows(observation)
        begun = np.zeros((len(rows), 7))
        memory, inner = taken_up(state, episode_start, rows, self._view, lambda: begun)
        others = replace(inputs, posture_gain=None)
        action, inner = predicted(self._policy, observation, others, inner, episode_start, deterministic)
        turn, tilts = self._turned(rows, memory[:, :5], inputs.posture_gain)
        pitch, kept = self._pitch_of_legs(rows, turn[:, 1:], memory[:, 5:])
        offsets = hip_offsets(np.stack([np.repeat(turn[:, :1], 2, axis=1), pitch], axis=-1))
        total = np.asarray(action, dtype=np.float64) + offsets.reshape(np.shape(action))
        return total.astype(np.float32), (np.hstack([tilts, kept]), inner)

    def _turned(self, rows: Array, memory: Array, change: Array | None) -> tuple[Array, Array]:
        """Turn of both hips against roll and pitch, (num_worlds, 2) [rad], and the new memory.

        Args:
            rows: Observations.
            memory: That of the last step.
            change: Relative change of all gains, (num_worlds, 1) [1]; the integral itself goes on as it is.
        """
        gains = self._gains
        steps, tilt, integral = memory[:, :1] + 1.0, memory[:, 1:3], memory[:, 3:5]
        tilt = tilt + self._filter * (rows[:, self._attitude] - tilt)
        integral = integral + self._dt * (tilt - integral / gains.leak_s)
        most = gains.limit_rad / gains.integral if gains.integral > 0.0 else np.inf
        integral = np.clip(integral, -most, most)
        turn = gains.proportional * tilt + gains.integral * integral + gains.derivative * rows[:, self._rate]
        if change is not None:
            turn = (1.0 + change) * turn
        turn = self._ramp.share(steps) * np.clip(turn, -gains.limit_rad, gains.limit_rad)
        return turn, np.hstack([steps, tilt, integral])

    def _pitch_of_legs(self, rows: Array, turn: Array, kept: Array) -> tuple[Array, Array]:
        """Hip pitch of left and right leg, and what a leg in the air would keep, both (num_worlds, 2) [rad].

        Args:
            rows: Observations.
            turn: That of standing legs, (num_worlds, 1) [rad].
            kept: As returned before.
        """
        # a leg that carries half of the weight stands
        standing = np.minimum(2.0 * shares(rows[:, self._share_right][:, 0]), 1.0)
        pitch = kept + standing * (turn - kept)
        following = np.where(standing < 1.0, self._dt / max(self._gains.swing_s, self._dt), 1.0)
        return pitch, kept + following * (turn - kept)


def hip_offsets(turn: Array) -> Array:
    """Offsets of the joints, (n, 12) [rad], that turn the pelvis of standing legs by −roll and −pitch.

    Args:
        turn: Roll and pitch of both hips, (n, 2), or of either, (n, 2, 2) [rad].
    """
    offsets = np.zeros((len(turn), 2, 6))
    of_legs = turn if turn.ndim == 3 else turn[:, None]
    offsets[:, :, _HIP_ROLL], offsets[:, :, _HIP_PITCH] = of_legs[..., 0], of_legs[..., 1]
    return offsets.reshape(len(turn), 12)
