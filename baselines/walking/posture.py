r"""Posture feedback: the hips turn the pelvis back to level, by the IMU in it.

The same offset on both hip rolls, and on both hip pitches, turns the pelvis against legs that
stand:

.. math:: u = k_p \hat\varphi + k_i \int \hat\varphi \, dt + k_d \hat\omega

The hip roll of a leg in the air turns as well, so that on a slope it lands where the ground is. Its
hip pitch keeps the turn with which it left the ground, and follows u slowly. The turn of a leg that
carries the robot alone would move the other foot back and forth.

φ is the attitude of the IMU behind a first-order filter, ω its rate. Without a leak the integral
would wind up against homing errors and the integrator of the foot force control. Posture feedback
is common on walking robots, as in [Kajita2010, section V].

A slope, a load or homing errors tilt the pelvis all the time. With the leak's time constant T,
1/(1 + k_p + k_i T) of this tilt remains. A second integral removes it. It does not leak, and it is
slow: with its gain k_t, `trim`, the rest falls with the time constant (1 + k_p + k_i T)/k_t. It
begins when the ramp has ended, as the tilt before that is not the one of the walk.

[Kajita2010] S. Kajita et al., "Biped Walking Stabilization Based on Linear Inverted Pendulum
Tracking", IROS.
"""

from typing import Any

import numpy as np
from typing_extensions import override

from baselines.compensation.compiled_rows import record_row
from baselines.compensation.filters import filter_share, within
from baselines.compensation.policy import PolicyInputs, Step, WalkView
from baselines.compensation.policy_around import MemoryAround, PolicyAround
from baselines.compensation.ramp import Ramp
from elastic_env.core.compiled import compiled, compiled_part, record_type
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array
from elastic_env.motion.trajectory import STAND_S

_HIP_ROLL = 1
_HIP_PITCH = 2
"""Numbers of the hips among the six joints of a leg."""


class PostureGains(Model):
    """Gains of the posture feedback."""

    proportional: float = quantity("1", 2.0, ge=0)
    """Hip angle per tilt [1]."""
    integral: float = quantity("1/s", 4.0, ge=0)
    """Hip angle per tilt and time [1/s]."""
    derivative: float = quantity("s", 0.1, ge=0)
    """Hip angle per rate of the tilt [s]."""
    leak_s: float = quantity("s", 1.0, gt=0)
    """Time constant with which the integral leaks [s]."""
    trim: float = quantity("1/s", 0.0, ge=0)
    """Hip angle per tilt and time, of an integral that does not leak [1/s]."""
    filter_s: float = quantity("s", 0.02, gt=0)
    """Time constant of the attitude's filter [s]."""
    swing_s: float = quantity("s", 0.5, ge=0)
    """Time constant with which the pitch of a leg in the air follows [s]."""
    limit_rad: float = quantity("rad", 0.08, gt=0)
    """Largest part of either integral, and of the whole [rad]."""


FEEDBACK = record_type(
    steps=(),
    tilt=(2,),  # filtered roll and pitch [rad]
    integral=(2,),  # of them [rad·s]
    trim=(2,),  # hip angle against a tilt that stays [rad]
    leg_pitch=(2,),  # hip pitch that a leg in the air keeps, legs [rad]
)
"""Memory of the posture feedback."""


class PostureFeedback(PolicyAround):
    """Any policy of a walker with posture feedback to the hips, see the module.

    Attributes:
        gains: Gains for the kernel, a row, (1,).
        ramp: Share of the feedback after 0, 1, ... control steps, up to the last one [1].

    Args:
        policy: Commands the robot.
        model: Assumed walker.
        gains: Gains.
        ramp_s: Time in which the feedback grows from zero [s].
    """

    memory_type = FEEDBACK

    def __init__(
        self, policy: Any, model: Any, gains: PostureGains, ramp_s: float = STAND_S
    ) -> None:
        super().__init__(policy, model)
        self.inputs = (*self.policy.inputs, "posture_gain")
        self._walk_view = WalkView(model.observation_table)
        self.ramp = Ramp(model, ramp_s).table
        period_s = model.control_period_s
        self.gains = record_row(
            period_s=period_s,
            integral_limit=gains.limit_rad / gains.integral if gains.integral > 0.0 else np.inf,
            filter_share=filter_share(period_s, gains.filter_s),
            swing_share=period_s / max(gains.swing_s, period_s),
            **gains.model_dump(exclude={"filter_s", "swing_s"}),
        )

    @override
    def act(self, rows: Array, memory: MemoryAround, inputs: PolicyInputs) -> Step:
        change = _NO_CHANGE
        if inputs.posture_gain is not None:
            change = np.ascontiguousarray(inputs.posture_gain)
            inputs = inputs._replace(posture_gain=None)
        action, inner = self.policy.act(rows, memory.inner, inputs)
        total = action.astype(np.float64)
        after = np.empty(len(rows), FEEDBACK)
        fields = self._walk_view.fields(rows)
        add_feedback(self.gains, fields, self.ramp, change, memory.own, after, total)
        return total.astype(np.float32), MemoryAround(after, inner)


_NO_CHANGE: Array = np.empty((0, 1))
"""Stands for no change of the gains."""


def hip_offsets(turn: Array) -> Array:
    """Offsets of the joints, (n, 12) [rad], that turn a standing pelvis by −roll and −pitch.

    Args:
        turn: Roll and pitch of both hips, (n, 2) [rad].
    """
    offsets = np.zeros((len(turn), 2, 6))
    offsets[:, :, [_HIP_ROLL, _HIP_PITCH]] = turn[:, None]
    return offsets.reshape(len(turn), 12)


@compiled
def add_feedback(
    params: Any, observations: Any, ramp: Array, change: Array, before: Any, after: Any, out: Array
) -> None:
    """Add the turn of the hips against the pelvis' tilt, and fill in the memory after the step.

    Args:
        params: Gains, a row, (1,).
        observations: Rows with fields.
        ramp: Share of the feedback after 0, 1, ... control steps, up to the last one [1].
        change: Relative change of all gains, (n, 1) [1], or none, (0, 1); the integral itself does
            not change with it.
        before: Rows of `FEEDBACK`, (n,).
        after: The same after the control step, to be filled.
        out: Offsets of the joints, to be added to, (n, 12) [rad].
    """
    gains = params[0]
    for world in range(len(out)):
        obs = observations[world]
        last = before[world]
        memory = after[world]
        memory.steps = last.steps + 1.0
        share = ramp[int(min(memory.steps, len(ramp) - 1.0))]
        trim_share = gains.period_s * gains.trim if share >= 1.0 else 0.0
        extra = change[world, 0] if len(change) > 0 else 0.0
        for i in range(2):
            missing = obs.imu_attitude[i] - last.tilt[i]
            tilt = last.tilt[i] + gains.filter_share * missing
            leaky_tilt = tilt - last.integral[i] / gains.leak_s
            integral = last.integral[i] + gains.period_s * leaky_tilt
            memory.tilt[i] = tilt
            memory.integral[i] = within(integral, gains.integral_limit)
            turn = gains.proportional * tilt + gains.integral * memory.integral[i]
            turn += gains.derivative * obs.imu_rate[i]
            memory.trim[i] = within(last.trim[i] + trim_share * tilt, gains.limit_rad)
            turn += memory.trim[i]
            turn = share * within((1.0 + extra) * turn, gains.limit_rad)
            for leg in range(2):
                if i == 0:
                    out[world, 6 * leg + _HIP_ROLL] += turn
                else:
                    pitch = pitch_of_leg(gains, obs.load_share, leg, turn, last, memory)
                    out[world, 6 * leg + _HIP_PITCH] += pitch


@compiled_part
def pitch_of_leg(gains: Any, right: Any, leg: int, turn: float, last: Any, memory: Any) -> Any:
    """Hip pitch of a leg [rad]; `right` is the load share of the right foot.

    A leg that carries half of the weight turns at once, a leg in the air follows slowly.
    """
    standing = min(2.0 * (right if leg == 1 else 1.0 - right), 1.0)
    following = gains.swing_share if standing < 1.0 else 1.0
    before = last.leg_pitch[leg]
    memory.leg_pitch[leg] = before + following * (turn - before)
    return before + standing * (turn - before)
