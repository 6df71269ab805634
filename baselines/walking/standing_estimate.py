r"""Standing estimate: what the robot shows at rest before a walk tells the walk's mean ZMP error.

An episode begins at rest on both feet, uncompensated. There the ZMP is under the center of mass. A
load in a place that nobody knows, a slope and homing errors move it, and they go on to do so in the
walk. What the springs bend goes, as compensation and posture feedback level the pelvis: its pitch
β and roll α move the center of mass by h β and −h α. So the mean error of the ZMP in the walk is

.. math:: \bar e_x = a_x e_x + b_x \beta + d, \qquad \bar e_y = a_y e_y + b_y \alpha

with the means e, α and β over the first moments, in which the policy has hardly moved. Before the
walk begins the planned ZMP is shifted by −ē (input `zmp` of the policy inside). The five numbers
were fitted to robots of bank 1 in `drawn`, at 3, 1.6 and 1.1 s. They hardly depend on the gait.
"""

from typing import Any, NamedTuple

import numpy as np
from typing_extensions import override

from baselines.compensation.policy import PolicyAround, PolicyInputs, Step
from baselines.walking.flat_feet import LEAST_LOAD, FlatFeet
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, IntArray
from elastic_env.motion.trajectory import STAND_S, minimum_jerk
from elastic_env.world.robot_model import WalkerModel


class StandingGains(Model):
    """How the mean ZMP error of a walk follows from what the robot shows at rest."""

    duration_s: float = quantity("s", 0.06, gt=0, lt=STAND_S)
    """Time of the mean at rest [s]."""
    zmp_x: float = quantity("1", 1.17)
    """Error of the walk per error at rest, forward [1]."""
    zmp_y: float = quantity("1", 1.21)
    """The same to the left [1]."""
    pitch_m_rad: float = quantity("m/rad", -0.38)
    """Forward error of the walk per pitch at rest [m/rad]."""
    roll_m_rad: float = quantity("m/rad", 0.285)
    """Error of the walk to the left per roll at rest [m/rad]."""
    constant_m: float = quantity("m", 0.0055)
    """Forward error of the walk of a robot that rests level under its ZMP [m]."""
    limit_m: float = quantity("m", 0.03, gt=0, lt=0.05)
    """Largest shift forward and sideways [m]."""


class StandingMemory(NamedTuple):
    """Memory of a policy with a standing estimate.

    Attributes:
        steps: Control steps since the start of the episode, (num_worlds,).
        total: Sum of the errors of the ZMP, and of roll and pitch at rest, (num_worlds, 4) [m],
            [rad].
        inner: Memory of the policy.
    """

    steps: IntArray
    total: Array
    inner: Any


class StandingEstimate(PolicyAround):
    """A policy of a walker whose planned ZMP is shifted by what standing tells, see the module.

    Args:
        policy: What commands the robot; it has the input `zmp`.
        model: Assumed walker.
        gains: Gains.
    """

    def __init__(self, policy: Any, model: WalkerModel, gains: StandingGains) -> None:
        super().__init__(policy, model)
        table = model.observation_table
        self._feet = FlatFeet(model, LEAST_LOAD * model.biped.weight)
        self._attitude = table.group("imu_attitude")
        self._samples = max(round(gains.duration_s / model.control_period_s), 1)
        steps = round(STAND_S / model.control_period_s) - self._samples
        waiting = np.zeros(self._samples)
        self._ramp = np.concatenate([waiting, minimum_jerk(np.arange(steps + 1) / steps)])
        per_mean = np.array(
            [
                [gains.zmp_x, 0.0],
                [0.0, gains.zmp_y],
                [0.0, gains.roll_m_rad],
                [gains.pitch_m_rad, 0.0],
            ]
        )
        self._per_total = per_mean / self._samples
        self._constant = np.array([gains.constant_m, 0.0])
        self._limit = gains.limit_m

    @override
    def begin(self, rows: Array) -> StandingMemory:
        total = np.zeros((len(rows), 4))
        return StandingMemory(np.zeros(len(rows), np.int64), total, self.policy.begin(rows))

    @override
    def act(self, rows: Array, memory: StandingMemory, inputs: PolicyInputs) -> Step:
        """Its shift adds to the input `zmp`."""
        total = memory.total
        steps = memory.steps + 1
        rests = steps <= self._samples
        if np.count_nonzero(rests) > 0:
            zmp = np.nan_to_num(self._feet.zmp_error(rows), nan=0.0)
            shown = np.hstack([zmp, rows[:, self._attitude]])
            total = total + rests[:, None] * shown
        error = total @ self._per_total + self._constant
        shift = np.minimum(np.maximum(-error, -self._limit), self._limit)
        shift *= self._ramp.take(steps, mode="clip")[:, None]
        zmp = shift if inputs.zmp is None else inputs.zmp + shift
        action, inner = self.policy.act(rows, memory.inner, inputs._replace(zmp=zmp))
        return action, StandingMemory(steps, total, inner)
