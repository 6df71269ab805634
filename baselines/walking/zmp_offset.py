r"""ZMP offset: the plan's ZMP is shifted against the mean error of the measured one.

A slope, or a load at an unknown place, moves the center of mass for the whole walk, and the ZMP
with it. On a slope α this is h α, with the height h of the center of mass. The foot sensors measure
it, and an integral removes it:

.. math:: \dot s = -\frac{1}{T} (p - p_{ref}), \quad |s_x|, |s_y| \le s_{max}

s is the shift of the planned ZMP (input `zmp` of the policy inside). p is the ZMP by the foot
sensors of flat feet (`baselines.walking.flat_feet`). Both are in the plan's local frame. T lasts
several steps: the controller handles errors within a step.
"""

from typing import Any

import numpy as np
from typing_extensions import override

from baselines.compensation.policy import PolicyInputs, Step
from baselines.compensation.policy_around import MemoryAround, PolicyAround
from baselines.walking.flat_feet import LEAST_LOAD, FlatFeet
from elastic_env.core.compiled import compiled
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, Mirrored, SignalGroup
from elastic_env.world.robot_model import WalkerModel


class ZmpOffsetGains(Model):
    """Time constant and limit of the shift of the planned ZMP."""

    time_constant_s: float = quantity("s", 6.0, gt=0)
    """Time constant T of the integral [s]."""
    limit_m: float = quantity("m", 0.03, gt=0, lt=0.05)
    """Largest shift forward and sideways [m]."""


IN_PLANE: dict[str, Mirrored | None] = {"x": "same", "y": "opposite"}
"""Axes of a vector in the plane, and their signs in the mirror."""
_SHIFT = SignalGroup.of(
    "zmp_offset",
    "m",
    "shift of the planned ZMP along {part} against its mean error",
    IN_PLANE,
    None,
).signals


class ZmpOffset(PolicyAround):
    """A policy of a walker with its planned ZMP shifted against the mean error, see the module.

    Args:
        policy: Commands the robot; it has the input `zmp`.
        model: Assumed walker.
        gains: Gains.
    """

    memory_type = (np.float64, 2)
    """Shift of the ZMP forward and left [m]."""

    def __init__(self, policy: Any, model: WalkerModel, gains: ZmpOffsetGains) -> None:
        super().__init__(policy, model)
        self._feet = FlatFeet(model, LEAST_LOAD * model.biped.weight)
        self._rate = model.control_period_s / gains.time_constant_s
        self._limit = gains.limit_m
        self.estimates = {**self.policy.estimates, "zmp_offset": _SHIFT}

    @override
    def estimate(self, name: str, rows: Array, memory: MemoryAround) -> Array:
        if name == "zmp_offset":
            return memory.own
        return super().estimate(name, rows, memory)

    @override
    def act(self, rows: Array, memory: MemoryAround, inputs: PolicyInputs) -> Step:
        """Add the shift to the input `zmp`."""
        shift = memory.own.copy()
        zmp = np.zeros_like(shift) if inputs.zmp is None else inputs.zmp.copy()
        integrate(self._feet.zmp_error(rows), self._rate, self._limit, shift, zmp)
        action, inner = self.policy.act(rows, memory.inner, inputs._replace(zmp=zmp))
        return action, MemoryAround(shift, inner)


@compiled
def integrate(error: Array, rate: float, limit: float, shift: Array, zmp: Array) -> None:
    """Integrate ZMP errors into the shifts, in place, and add these to the planned ZMP.

    Args:
        error: Measured less planned ZMP, (n, 2) [m]; nan where the feet carry too little.
        rate: Share of the error that the shift removes in a control period [1].
        limit: Largest shift forward and sideways [m].
        shift: Shift of the planned ZMP, (n, 2) [m].
        zmp: To be added to, (n, 2) [m].
    """
    for world in range(len(shift)):
        for axis in range(2):
            if not np.isnan(error[world, axis]):
                integral = shift[world, axis] - rate * error[world, axis]
                shift[world, axis] = min(max(integral, -limit), limit)
            zmp[world, axis] += shift[world, axis]
