r"""Foot tare: foot sensors are set to zero in every swing, when a foot weighs only itself.

Six-axis sensors of feet drift by some newtons while a robot walks. In practice they are zeroed
under a known load. With the foot in the air, the sensor at the ankle carries the foot alone,
f = m (g − a) with the planned acceleration a, and its moment c × f about the ankle. The tare is the
mean measured wrench beyond that, over the middle of a swing. It is subtracted until the next swing
of the same foot.
"""

from typing import Any

import numpy as np
from typing_extensions import override

from baselines.compensation.compiled_rows import record_row
from baselines.compensation.policy import PolicyInputs, Step, WalkView
from baselines.compensation.policy_around import MemoryAround, PolicyAround
from elastic_env.core.compiled import compiled, record_type
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array
from elastic_env.motion.walk_plan import derivatives
from elastic_env.rigid.leg_kinematics import turn
from elastic_env.world.foot_sensors import FootSensors
from elastic_env.world.robot_model import WalkerModel


class FootTareGains(Model):
    """Gains of the tare, and the part of the swing that it uses."""

    begin: float = quantity("1", 0.3, gt=0, lt=0.5)
    """Progress of the swing at which the mean begins; it ends as long before landing [1]."""
    first_gain: float = quantity("1", 1.0, ge=0, le=1)
    """Share of the first mean that is subtracted [1]."""
    gain: float = quantity("1", 0.5, ge=0, le=1)
    """Share of the rest that is subtracted in every further swing [1]."""


TARE = record_type(
    bias=(2, 2, 3),  # feet, force and moment, axes [N], [N·m]
    total=(2, 3),  # of the samples of this swing
    samples=(),
    swings=(2,),  # of both feet so far
)
"""Memory of the tare."""


class FootTare(PolicyAround):
    """A policy of a walker with tared foot sensors, see the module.

    Args:
        policy: Commands the robot.
        model: Assumed walker.
        gains: Gains.
    """

    memory_type = TARE

    def __init__(self, policy: Any, model: WalkerModel, gains: FootTareGains) -> None:
        super().__init__(policy, model)
        self._walk_view = WalkView(model.observation_table)
        self._gains = record_row(period_s=model.control_period_s, **gains.model_dump())
        self._unloaded = unloaded_wrench(model)

    @override
    def act(self, rows: Array, memory: MemoryAround, inputs: PolicyInputs) -> Step:
        rows = rows.copy()
        tare = memory.own.copy()
        tare_feet(self._gains, self._unloaded, self._walk_view.fields(rows), tare)
        action, inner = self.policy.act(rows, memory.inner, inputs)
        return action, MemoryAround(tare, inner)


def unloaded_wrench(model: WalkerModel) -> Array:
    """Planned wrench of feet in the air at level ankles, (T, 2, 2, 3).

    Axes of the array: time, feet, force [N] and moment [N·m], axes in the frames of the feet.
    """
    biped = model.biped
    sensors = FootSensors.of_biped(biped)
    _, acceleration = derivatives(model.plan.ankles, model.control_period_s)
    mass = biped.rigid.body_mass[biped.feet]
    force = sensors.weight - mass[:, None] * turn(acceleration, -model.plan.foot_yaw)
    return np.stack([force, np.cross(sensors.com, force)], axis=2)


@compiled
def tare_feet(settings: Any, unloaded: Array, observations: Any, memory: Any) -> None:
    """Subtract the bias from the wrenches of observations, in place, and update the memory.

    Args:
        settings: Gains and the control period, a row, (1,).
        unloaded: Result of `unloaded_wrench`.
        observations: Rows with fields, (n,).
        memory: Rows of `TARE`, to be updated, (n,).
    """
    gains = settings[0]
    for world in range(len(memory)):
        obs = observations[world]
        tare = memory[world]
        foot = 1 - int(obs.clock[2])
        progress = obs.clock[1]
        if gains.begin < progress < 1.0 - gains.begin:
            # measured at the end of the last period
            row = int(np.rint(obs.clock[0] / gains.period_s)) - 1
            expected = unloaded[min(max(row, 0), len(unloaded) - 1), foot]
            for part in range(2):
                for i in range(3):
                    tare.total[part, i] += obs.wrench[foot, part, i] - expected[part, i]
            tare.samples += 1.0
        elif tare.samples > 0.0:
            gain = gains.gain if tare.swings[foot] > 0.0 else gains.first_gain
            tare.swings[foot] += 1.0
            for part in range(2):
                for i in range(3):
                    mean = tare.total[part, i] / tare.samples
                    tare.bias[foot, part, i] += gain * (mean - tare.bias[foot, part, i])
                    tare.total[part, i] = 0.0
            tare.samples = 0.0
        for side in range(2):
            for part in range(2):
                for i in range(3):
                    obs.wrench[side, part, i] -= tare.bias[side, part, i]
