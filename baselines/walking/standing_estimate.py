r"""Standing estimate: measurements at rest before a walk predict the walk's mean ZMP error.

An episode begins at rest on both feet, uncompensated. There the ZMP is under the center of mass. A
load at an unknown place, a slope and homing errors move it, and go on to do so in the walk. The
bending of the springs does not go on, as compensation and posture feedback level the pelvis: its
pitch β and roll α move the center of mass by h β and −h α. So the mean error of the ZMP in the walk
is

.. math:: \bar e_x = a_x e_x + b_x \beta + d, \qquad \bar e_y = a_y e_y + b_y \alpha

with the means e, α and β over the first moments, in which the policy has hardly moved. Before the
walk begins the planned ZMP is shifted by −ē (input `zmp` of the policy inside). The five numbers
were fitted to robots of bank 1 in `drawn`, at 3, 1.6 and 1.1 s. They hardly depend on the gait.
"""

from typing import Any, NamedTuple

import numpy as np
from typing_extensions import override

from baselines.compensation.policy import PolicyInputs, Step
from baselines.compensation.policy_around import PolicyAround
from baselines.walking.flat_feet import LEAST_LOAD, FlatFeet
from elastic_env.core.compiled import compiled
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, IntArray, Signal
from elastic_env.motion.trajectory import STAND_S, minimum_jerk
from elastic_env.world.robot_model import WalkerModel


class StandingGains(Model):
    """Coefficients of the mean ZMP error of a walk, by measurements at rest."""

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
        load: Sum of the excess of the load over the assumed weight, (num_worlds,) [1].
        inner: Memory of the policy.
    """

    steps: IntArray
    total: Array
    load: Array
    inner: Any


_STANDING = (
    Signal("standing.x", "m", "ZMP at rest less the planned one, forward", mirrored="same"),
    Signal("standing.y", "m", "the same to the left", mirrored="opposite"),
    Signal("standing.roll", "rad", "roll at rest by the IMU", mirrored="opposite"),
    Signal("standing.pitch", "rad", "pitch at rest by the IMU", mirrored="same"),
    Signal("standing.load", "1", "load at rest over the assumed weight, less 1", mirrored="same"),
)


class StandingEstimate(PolicyAround):
    """A policy of a walker whose planned ZMP is shifted by a prediction, see the module.

    Args:
        policy: Commands the robot; it has the input `zmp`.
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
        growth = minimum_jerk(np.arange(steps + 1) / steps)
        self._ramp = np.concatenate([np.zeros(self._samples), growth])
        coefficients = [gains.zmp_x, gains.pitch_m_rad, gains.zmp_y, gains.roll_m_rad]
        self._per_total = np.reshape(coefficients, (2, 2)) / self._samples
        self._constant = np.array([gains.constant_m, 0.0])
        self._limit = gains.limit_m
        self._wrench = table.group("wrench")
        self._weight = model.biped.weight
        self.estimates = {**self.policy.estimates, "standing": _STANDING}

    @override
    def begin(self, rows: Array) -> StandingMemory:
        n = len(rows)
        sums = (np.zeros((n, 4)), np.zeros(n))
        return StandingMemory(np.zeros(n, np.int64), *sums, self.policy.begin(rows))

    @override
    def estimate(self, name: str, rows: Array, memory: StandingMemory) -> Array:
        if name != "standing":
            return super().estimate(name, rows, memory)
        number = np.clip(memory.steps, 1, self._samples)
        return np.column_stack([memory.total, memory.load]) / number[:, None]

    @override
    def act(self, rows: Array, memory: StandingMemory, inputs: PolicyInputs) -> Step:
        """Add the shift to the input `zmp`."""
        total = memory.total
        load = memory.load
        steps = memory.steps + 1
        is_at_rest = steps <= self._samples
        if np.count_nonzero(is_at_rest) > 0:
            force, error = self._feet.ground(rows, rows[:, self._wrench])
            measured = np.hstack([np.nan_to_num(error), rows[:, self._attitude]])
            total = total + is_at_rest[:, None] * measured
            vertical = force[:, 0, 2] + force[:, 1, 2]
            load = load + is_at_rest * (vertical / self._weight - 1.0)
        zmp = np.zeros((len(rows), 2)) if inputs.zmp is None else inputs.zmp.copy()
        gains = (self._per_total, self._constant, self._limit)
        add_prediction(gains, self._ramp, steps, total, zmp)
        action, inner = self.policy.act(rows, memory.inner, inputs._replace(zmp=zmp))
        return action, StandingMemory(steps, total, load, inner)


@compiled
def add_prediction(gains: Any, ramp: Array, steps: IntArray, total: Array, zmp: Array) -> None:
    """Add the shift of the planned ZMP that the measurements at rest predict.

    Args:
        gains: Error of the walk per sum of ZMP errors and of tilts, forward and to the left, (2, 2)
            [1], [m/rad]; its constant part, (2,) [m]; largest shift [m].
        ramp: Share of the shift after 0, 1, ... control steps, up to the last one [1].
        steps: Control steps since the start of the episode, (n,).
        total: Sums of `StandingMemory`, (n, 4).
        zmp: To be added to, (n, 2) [m].
    """
    per_total, constant, limit = gains
    for world in range(len(zmp)):
        share = ramp[min(steps[world], len(ramp) - 1)]
        for axis in range(2):
            tilt = total[world, 3 - axis]  # pitch forward, roll to the left
            error = total[world, axis] * per_total[axis, 0] + tilt * per_total[axis, 1]
            error += constant[axis]
            zmp[world, axis] += share * min(max(-error, -limit), limit)
