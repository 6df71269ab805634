r"""Growth of a compensation from zero while the robot stands, over the option `ramp_s`.

The robot begins in static equilibrium without compensation. With compensation its equilibrium is
elsewhere. A walker that moves there within the second of standing would go on swinging on its
springs, so its ramp is shaped [Singer1990]: two equal halves, half a period of its slowest sway
apart. Their swings cancel.

[Singer1990] N. C. Singer, W. P. Seering, "Preshaping Command Inputs to Reduce System Vibration", J.
Dyn. Sys., Meas., Control 112(1).
"""

import numpy as np

from elastic_env.core.signals import Array, BoolArray, IntArray
from elastic_env.motion.sway import sway_frequencies
from elastic_env.motion.trajectory import minimum_jerk
from elastic_env.world.robot_model import RobotModel, WalkerModel

_SHORTEST_HALF = 0.2
"""Shortest duration of a half of a shaped ramp, over that of the ramp [1]."""


class Ramp:
    """Share of the compensation, growing from 0 to 1.

    Args:
        model: Assumed robot; a walker gets a shaped ramp where half a period of its sway fits.
        duration_s: Duration of the ramp [s].

    Attributes:
        table: Share after 0, 1, ... control steps, to the first whose compensation is complete.
    """

    def __init__(self, model: RobotModel, duration_s: float) -> None:
        self._duration = max(duration_s, model.control_period_s)
        self._period_s = model.control_period_s
        self._delay = 0.0
        if isinstance(model, WalkerModel):
            # springs in series with the servos that hold their motor side [N·m/rad]
            servo = np.array([servo.position_gain for servo in model.servos])
            series = 1.0 / (1.0 / model.stiffness + 1.0 / servo)
            plan = model.plan
            sway = sway_frequencies(model.biped, plan.pelvis[0], series, plan.ankles[0])
            half_period = np.pi / sway[0]
            if half_period <= (1.0 - _SHORTEST_HALF) * duration_s:  # false for nan
                self._delay = float(half_period)
        steps = np.arange(np.ceil(self._duration / self._period_s) + 2.0)
        self.table = self.share(steps[: int(np.argmax(self.is_over(steps))) + 1])

    def share(self, steps: Array) -> Array:
        """Share after a number of control steps, elementwise."""
        time = steps * self._period_s
        half = self._duration - self._delay
        second = minimum_jerk((time - self._delay) / half)
        return 0.5 * (minimum_jerk(time / half) + second)

    def is_over(self, steps: Array | IntArray) -> BoolArray:
        """True where the compensation is complete."""
        return steps * self._period_s >= self._duration


def feedback_ramp(ramp_s: float, period_s: float) -> Array:
    """Share of a feedback after 0, 1, ... control steps, growing from 0 to 1 within `ramp_s`."""
    steps = max(round(ramp_s / period_s), 1)
    return minimum_jerk(np.arange(steps + 1) / steps)
