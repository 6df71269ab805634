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

from typing import Any

import numpy as np

from baselines.compensation.inputs import PolicyInputs
from baselines.compensation.observed import ObservedWalk
from baselines.compensation.policy import Action, ObservationView, PolicyAround, predicted, taken_up
from baselines.compensation.startup import Ramp
from baselines.walking.walking_kernels import POSTURE, POSTURE_MEMORY, hold_posture
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array
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
        self._policy, gains, period_s = policy, gains or PostureGains(), model.control_period_s
        self._view, self._observed = (
            ObservationView(model.observation_table, period_s),
            ObservedWalk(model.observation_table),
        )
        self._ramp = Ramp(model, ramp_s)
        values = {
            **gains.model_dump(),
            "period_s": period_s,
            "integral_limit": gains.limit_rad / gains.integral if gains.integral > 0.0 else np.inf,
            "filter_share": 1.0 - float(np.exp(-period_s / gains.filter_s)),
            "swing_share": period_s / max(gains.swing_s, period_s),
        }
        self._gains: Any = np.array([tuple(values[name] for name in POSTURE.names or ())], POSTURE)

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
        memory, inner = taken_up(
            state, episode_start, rows, self._view, lambda: np.zeros((len(rows), POSTURE_MEMORY.itemsize // 8))
        )
        others = inputs if inputs.posture_gain is None else inputs._replace(posture_gain=None)
        action, inner = predicted(self._policy, observation, others, inner, episode_start, deterministic)
        total, kept = np.array(action, dtype=np.float64, ndmin=2), np.empty(memory.shape)
        change = _NO_CHANGE if inputs.posture_gain is None else np.ascontiguousarray(inputs.posture_gain)
        before = np.ndarray(len(rows), POSTURE_MEMORY, np.ascontiguousarray(memory))
        now = np.ndarray(len(rows), POSTURE_MEMORY, kept)
        hold_posture(self._gains, self._observed.fields(rows), self._ramp.table, change, (before, now), total)
        return total.astype(np.float32).reshape(np.shape(action)), (kept, inner)


_NO_CHANGE: Array = np.empty((0, 1))
"""No change of the gains."""


def hip_offsets(turn: Array) -> Array:
    """Offsets of the joints, (n, 12) [rad], that turn the pelvis of standing legs by −roll and −pitch.

    Args:
        turn: Roll and pitch of both hips, (n, 2), or of either, (n, 2, 2) [rad].
    """
    offsets = np.zeros((len(turn), 2, 6))
    of_legs = turn if turn.ndim == 3 else turn[:, None]
    offsets[:, :, _HIP_ROLL], offsets[:, :, _HIP_PITCH] = of_legs[..., 0], of_legs[..., 1]
    return offsets.reshape(len(turn), 12)
