r"""Foot sensors set to zero in every swing: a foot in the air weighs only itself.

Six-axis sensors of feet drift by some newtons while a robot walks. Practice zeroes them where the
load is known: with the foot in the air, the sensor at the ankle carries the foot alone, f = m (g −
a) with the planned acceleration a, and its moment c × f about the ankle. The mean of what it shows
beyond that, over the middle of a swing, is taken off until the next swing of the same foot.
"""

from typing import Any, NamedTuple

import numpy as np
from typing_extensions import override

from baselines.compensation.policy import PolicyAround, PolicyInputs, Records, Step, WalkView
from elastic_env.core.compiled import compiled, record_type
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array
from elastic_env.motion.walk_plan import derivatives
from elastic_env.rigid.leg_kinematics import turn
from elastic_env.world.foot_sensors import FootSensors
from elastic_env.world.robot_model import WalkerModel


class FootTareGains(Model):
    """When and how far the foot sensors are set to zero."""

    begin: float = quantity("1", 0.3, gt=0, lt=0.5)
    """Progress of the swing at which the mean begins; it ends as long before landing [1]."""
    first_gain: float = quantity("1", 1.0, ge=0, le=1)
    """Share of the first mean that is taken off [1]."""
    gain: float = quantity("1", 0.5, ge=0, le=1)
    """Share of what is left in every further swing [1]."""


TARE = record_type(
    bias=(2, 2, 3),  # feet, force and moment, axes [N], [N·m]
    total=(2, 3),  # of the samples of this swing
    samples=(),
    swings=(2,),  # of both feet so far
)
"""Memory of the tare."""


class FootTareMemory(NamedTuple):
    """Memory of a policy with tared feet: rows of `TARE`, and that of the policy."""

    tare: Records
    inner: Any


class FootTare(PolicyAround):
    """A policy of a walker that sees its foot sensors set to zero, see the module.

    Args:
        policy: What commands the robot.
        model: Assumed walker.
        gains: When and how far.
    """

    def __init__(self, policy: Any, model: WalkerModel, gains: FootTareGains) -> None:
        super().__init__(policy, model)
        self._walk_view = WalkView(model.observation_table)
        self._gains = (gains.begin, gains.first_gain, gains.gain)
        self._period_s = model.control_period_s
        self._unloaded = unloaded_wrench(model)

    @override
    def begin(self, rows: Array) -> FootTareMemory:
        return FootTareMemory(np.zeros(len(rows), TARE), self.policy.begin(rows))

    @override
    def act(self, rows: Array, memory: FootTareMemory, inputs: PolicyInputs) -> Step:
        rows = rows.copy()
        tare = memory.tare.copy()
        observed = self._walk_view.fields(rows)
        tare_feet(self._gains, self._period_s, self._unloaded, observed, tare)
        action, inner = self.policy.act(rows, memory.inner, inputs)
        return action, FootTareMemory(tare, inner)


def unloaded_wrench(model: WalkerModel) -> Array:
    """Force and moment that feet in the air leave at level ankles by plan, (T, 2, 2, 3).

    Feet, force [N] and moment [N·m], axes in the frames of the feet.
    """
    biped = model.biped
    sensors = FootSensors.of_biped(biped)
    _, acceleration = derivatives(model.plan.ankles, model.control_period_s)
    mass = biped.rigid.body_mass[biped.feet]
    in_feet = turn(acceleration, -model.plan.foot_yaw)
    force = sensors.weight - mass[:, None] * in_feet
    return np.stack([force, np.cross(sensors.com, force)], axis=2)


@compiled
def tare_feet(gains: Any, period_s: float, unloaded: Array, observed: Any, memory: Any) -> None:
    """Take the bias off the wrenches of observations, in place, and keep the memory.

    Args:
        gains: Begin, first gain and gain of `FootTareGains`.
        period_s: Control period [s].
        unloaded: As of `unloaded_wrench`.
        observed: Observations, rows with fields, (n,).
        memory: Rows of `TARE`, brought up to date, (n,).
    """
    begin, first_gain, gain = gains
    for world in range(len(memory)):
        shown = observed[world]
        own = memory[world]
        foot = 1 - int(shown.clock[2])
        progress = shown.clock[1]
        if begin < progress < 1.0 - begin:
            # measured at the end of the last period
            row = int(np.rint(shown.clock[0] / period_s)) - 1
            expected = unloaded[min(max(row, 0), len(unloaded) - 1), foot]
            for part in range(2):
                for i in range(3):
                    beyond = shown.wrench[foot, part, i] - expected[part, i]
                    own.total[part, i] += beyond
            own.samples += 1.0
        elif own.samples > 0.0:
            share = gain if own.swings[foot] > 0.0 else first_gain
            own.swings[foot] += 1.0
            for part in range(2):
                for i in range(3):
                    mean = own.total[part, i] / own.samples
                    own.bias[foot, part, i] += share * (mean - own.bias[foot, part, i])
                    own.total[part, i] = 0.0
            own.samples = 0.0
        for side in range(2):
            for part in range(2):
                for i in range(3):
                    shown.wrench[side, part, i] -= own.bias[side, part, i]
