r"""ZMP offset: the plan's ZMP is shifted against the mean error of the measured one.

A slope, or a load in a place that nobody knows, moves the center of mass for as long as the robot
walks, and the ZMP with it. On a slope α that is h α, with the height h of the center of mass. The
foot sensors show it, and an integral takes it off:

.. math:: \dot s = -\frac{1}{T} (p - p_{ref}), \quad |s_x|, |s_y| \le s_{max}

s is the shift of the planned ZMP (input `zmp` of the policy inside), p the ZMP by the foot sensors
as if the feet lay flat on their footholds (`baselines.walking.flat_feet`), all in the plan's local
frame. T is several steps long: within a step the ZMP is the controller's matter. The sensors show
the ZMP against the feet, so feet that have drifted from their footholds are not seen.
"""

from typing import Any, NamedTuple

import numpy as np
from typing_extensions import override

from baselines.compensation.policy import PolicyAround, PolicyInputs, Step
from baselines.walking.flat_feet import LEAST_LOAD, FlatFeet
from elastic_env.core.compiled import compiled
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, SignalGroup
from elastic_env.world.robot_model import WalkerModel


class ZmpOffsetGains(Model):
    """How fast and how far the planned ZMP is shifted."""

    time_constant_s: float = quantity("s", 6.0, gt=0)
    """Time constant T of the integral [s]."""
    limit_m: float = quantity("m", 0.03, gt=0, lt=0.05)
    """Largest shift forward and sideways [m]."""


class ZmpOffsetMemory(NamedTuple):
    """Shift of the ZMP forward and left, (num_worlds, 2) [m], and the memory of the policy."""

    shift: Array
    inner: Any


_SHIFT = SignalGroup.of(
    "zmp_offset",
    "m",
    "shift of the planned ZMP along {part} against its mean error",
    {"x": "same", "y": "opposite"},
    kind=None,
).signals


class ZmpOffset(PolicyAround):
    """A policy of a walker with its planned ZMP shifted against the mean error, see the module.

    Args:
        policy: What commands the robot; it has the input `zmp`.
        model: Assumed walker.
        gains: Gains.
    """

    def __init__(self, policy: Any, model: WalkerModel, gains: ZmpOffsetGains) -> None:
        super().__init__(policy, model)
        self._feet = FlatFeet(model, LEAST_LOAD * model.biped.weight)
        self._rate = model.control_period_s / gains.time_constant_s
        self._limit = gains.limit_m
        self.estimates = {**self.policy.estimates, "zmp_offset": _SHIFT}

    @override
    def begin(self, rows: Array) -> ZmpOffsetMemory:
        return ZmpOffsetMemory(np.zeros((len(rows), 2)), self.policy.begin(rows))

    @override
    def estimate(self, name: str, rows: Array, memory: ZmpOffsetMemory) -> Array:
        if name == "zmp_offset":
            return memory.shift
        return super().estimate(name, rows, memory)

    @override
    def act(self, rows: Array, memory: ZmpOffsetMemory, inputs: PolicyInputs) -> Step:
        """Its shift adds to the input `zmp`."""
        shift = memory.shift.copy()
        zmp = np.zeros_like(shift) if inputs.zmp is None else inputs.zmp.copy()
        integrate(self._feet.zmp_error(rows), self._rate, self._limit, shift, zmp)
        action, inner = self.policy.act(rows, memory.inner, inputs._replace(zmp=zmp))
        return action, ZmpOffsetMemory(shift, inner)


@compiled
def integrate(error: Array, rate: float, limit: float, shift: Array, zmp: Array) -> None:
    """Integrate ZMP errors into the shifts, in place, and add these to the planned ZMP.

    Args:
        error: Measured less planned ZMP, (n, 2) [m]; nan where the feet carry too little.
        rate: Share of the error that is taken off in a control period [1].
        limit: Largest shift forward and sideways [m].
        shift: Of `ZmpOffsetMemory`, (n, 2) [m].
        zmp: To be added to, (n, 2) [m].
    """
    for world in range(len(shift)):
        for axis in range(2):
            missed = error[world, axis]
            if not np.isnan(missed):
                moved = shift[world, axis] - rate * missed
                shift[world, axis] = min(max(moved, -limit), limit)
            zmp[world, axis] += shift[world, axis]
