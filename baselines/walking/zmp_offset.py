r"""ZMP offset: the plan's ZMP is shifted against the mean error of the measured one.

A slope, or a load in a place that nobody knows, moves the center of mass for as long as the robot walks, and the ZMP
with it. On a slope α that is h α, with the height h of the center of mass. The foot sensors show it, and an integral
takes it off:

.. math:: \dot s = -\frac{1}{T} (p - p_{ref}), \quad |s_x|, |s_y| \le s_{max}

s is the shift of the planned ZMP (input `zmp` of the policy inside), p the ZMP by the foot sensors as if the feet lay
flat on their footholds. T is several steps long: within a step the ZMP is the controller's matter. The sensors show the
ZMP against the feet, so feet that have drifted from their footholds are not seen.
"""

from typing import Any

import numpy as np

from baselines.compensation.inputs import PolicyInputs
from baselines.compensation.policy import Action, ObservationView, PolicyAround, predicted, taken_up
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array
from elastic_env.runtime.robot_model import WalkerModel

_LEAST_LOAD = 0.05
"""Share of the weight below which the feet show no ZMP."""


class ZmpOffsetGains(Model):
    """How fast and how far the planned ZMP is shifted."""

    time_constant_s: float = quantity("s", 6.0, gt=0, description="time constant T of the integral")
    limit_m: float = quantity("m", 0.03, gt=0, lt=0.05, description="largest shift forward and sideways")


class ZmpOffset(PolicyAround):
    """A policy of a walker with its planned ZMP shifted against the mean error, see the module.

    Memory per world: the shift forward and to the left [m].

    Args:
        policy: What commands the robot; it has the input `zmp`.
        model: Assumed walker.
        gains: Gains.
    """

    def __init__(self, policy: Any, model: WalkerModel, gains: ZmpOffsetGains | None = None) -> None:
        self._policy, self._biped, gains = policy, model.biped, gains or ZmpOffsetGains()
        table = model.observation_table
        self._view = ObservationView(table, model.control_period_s)
        self._wrench, self._zmp = table.group("wrench"), table.group("zmp_reference")
        self._least_n = _LEAST_LOAD * model.biped.weight
        self._rate, self._limit = model.control_period_s / gains.time_constant_s, gains.limit_m

    def predict_with(
        self,
        observation: Array,
        inputs: PolicyInputs,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Action, Any]:
        """See `PolicyWithInputs`; its shift adds to the input `zmp`."""
        rows = self._view.rows(observation)
        shift, inner = taken_up(state, episode_start, rows, self._view, lambda: np.zeros((len(rows), 2)))
        measured = self._biped.zmp_on_footholds(rows[:, self._wrench], self._least_n)
        error = np.nan_to_num(measured - rows[:, self._zmp], nan=0.0)
        shift = np.clip(shift - self._rate * error, -self._limit, self._limit)
        moved = inputs._replace(zmp=shift if inputs.zmp is None else inputs.zmp + shift)
        action, inner = predicted(self._policy, observation, moved, inner, episode_start, deterministic)
        return action, (shift, inner)
