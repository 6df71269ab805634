r"""Posture feedback: the hips turn the pelvis back to level, by its IMU.

The same offset on both hip rolls, and on both hip pitches, turns the pelvis against legs that
stand:

.. math:: u = k_p \hat\varphi + k_i \int \hat\varphi \, dt + k_d \hat\omega

The hip roll of a leg in the air is turned as well, so that on a slope it lands where the ground is.
Its hip pitch keeps the turn with which it left the ground, and follows u slowly: what the standing
leg needs while it carries the robot alone would move the other foot forth and back.

φ is the attitude of the IMU behind a first-order filter, ω its rate. The integral leaks, as it
winds up against homing errors and the integrator of the foot force control else. Walking robots do
this widely, also the published controller of this one [Kajita2010, section V].

With the leak's time constant T, 1/(1 + k_p + k_i T) is left of what tilts the pelvis all the time:
a slope, a load, homing errors. A second integral takes that off. It does not leak, and it is slow:
with its gain k_t, `trim`, the rest falls with the time constant (1 + k_p + k_i T)/k_t. It begins
when the ramp has ended, as the tilt before that is not the one of the walk.

[Kajita2010] S. Kajita et al., "Biped Walking Stabilization Based on Linear Inverted Pendulum
Tracking", IROS.
"""

from typing import Any

import numpy as np
from typing_extensions import override

from baselines.compensation import policy as policies
from baselines.compensation.policy import Step
from baselines.compensation.startup import Ramp
from elastic_env.core.compiled import compiled, compiled_part, record_type
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array
from elastic_env.motion.trajectory import STAND_S

# of six joints of a leg
_HIP_ROLL = 1
_HIP_PITCH = 2


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
    kept=(2,),  # hip pitch that either leg keeps [rad]
)
"""Memory of the posture feedback."""


class PostureFeedback(policies.PolicyAround):
    """Any policy of a walker with its posture held by the hips, see the module.

    Attributes:
        gains: Gains for the kernel, a row, (1,).
        ramp: Share of the feedback after 0, 1, ... control steps, up to the last one [1].

    Args:
        policy: What commands the robot.
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
        self._walk_view = policies.WalkView(model.observation_table)
        self.ramp = Ramp(model, ramp_s).table
        period_s = model.control_period_s
        integral_limit = np.inf
        if gains.integral > 0.0:
            integral_limit = gains.limit_rad / gains.integral
        self.gains = policies.record_row(
            period_s=period_s,
            integral_limit=integral_limit,
            filter_share=policies.filter_share(period_s, gains.filter_s),
            swing_share=period_s / max(gains.swing_s, period_s),
            **gains.model_dump(exclude={"filter_s", "swing_s"}),
        )

    @override
    def act(self, rows: Array, memory: policies.MemoryAround, inputs: Any) -> Step:
        """It takes the input `posture_gain`."""
        change = _NO_CHANGE
        if inputs.posture_gain is not None:
            change = np.ascontiguousarray(inputs.posture_gain)
            inputs = inputs._replace(posture_gain=None)
        action, inner = self.policy.act(rows, memory.inner, inputs)
        total = action.astype(np.float64)
        feedback = np.empty(len(rows), FEEDBACK)
        observed = self._walk_view.fields(rows)
        memories = (memory.own, feedback)
        hold_posture(self.gains, observed, self.ramp, change, *memories, total)
        return total.astype(np.float32), policies.MemoryAround(feedback, inner)


_NO_CHANGE: Array = np.empty((0, 1))
"""No change of the gains."""


def hip_offsets(turn: Array) -> Array:
    """Offsets of the joints, (n, 12) [rad], that turn a standing pelvis by −roll and −pitch.

    Args:
        turn: Roll and pitch of both hips, (n, 2) [rad].
    """
    offsets = np.zeros((len(turn), 2, 6))
    offsets[:, :, [_HIP_ROLL, _HIP_PITCH]] = turn[:, None]
    return offsets.reshape(len(turn), 12)


@compiled
def hold_posture(
    gains: Any, observed: Any, ramp: Array, change: Array, before: Any, now: Any, out: Array
) -> None:
    """Add the turn of the hips against the pelvis' tilt, and keep the memory after a control step.

    Args:
        gains: Gains, a row, (1,).
        observed: Observations, rows with fields.
        ramp: Share of the feedback after 0, 1, ... control steps, up to the last one [1].
        change: Relative change of all gains, (n, 1) [1], or none, (0, 1); the integral itself goes
            on as it is.
        before: Rows of `FEEDBACK`, (n,).
        now: The same after the control step, to be filled.
        out: Offsets of the joints, (n, 12) [rad].
    """
    own = gains[0]
    for world in range(len(out)):
        shown = observed[world]
        last = before[world]
        kept = now[world]
        kept.steps = last.steps + 1.0
        share = ramp[int(min(kept.steps, len(ramp) - 1.0))]
        learned = own.period_s * own.trim if share >= 1.0 else 0.0
        further = change[world, 0] if len(change) > 0 else 0.0
        for i in range(2):
            missing = shown.imu_attitude[i] - last.tilt[i]
            tilt = last.tilt[i] + own.filter_share * missing
            gained = tilt - last.integral[i] / own.leak_s
            integral = last.integral[i] + own.period_s * gained
            kept.tilt[i] = tilt
            kept.integral[i] = within(integral, own.integral_limit)
            turn = own.proportional * tilt + own.integral * kept.integral[i]
            turn += own.derivative * shown.imu_rate[i]
            kept.trim[i] = within(last.trim[i] + learned * tilt, own.limit_rad)
            turn += kept.trim[i]
            turn = share * within((1.0 + further) * turn, own.limit_rad)
            for leg in range(2):
                if i == 0:
                    out[world, 6 * leg + 1] += turn
                else:
                    pitch = pitch_of_leg(own, shown.load_share, leg, turn, last, kept)
                    out[world, 6 * leg + 2] += pitch


@compiled_part
def pitch_of_leg(own: Any, right: Any, leg: int, turn: float, last: Any, kept: Any) -> Any:
    """Hip pitch of a leg [rad].

    A leg that carries half of the weight stands and turns, one in the air follows slowly.
    """
    share = right if leg == 1 else 1.0 - right
    standing = min(2.0 * share, 1.0)
    following = own.swing_share if standing < 1.0 else 1.0
    kept.kept[leg] = last.kept[leg] + following * (turn - last.kept[leg])
    return last.kept[leg] + standing * (turn - last.kept[leg])


@compiled_part
def within(value: float, limit: float) -> float:
    """A value within ±limit; what is no number stays so."""
    if value > limit:
        return limit
    return -limit if value < -limit else value
