r"""Disturbance observer of a walker: what keeps its divergent component of motion from the plan.

The model is the linear inverted pendulum with a plan. Its divergent component of motion :math:`\xi
= c + \dot c / \omega`, with the center of mass c and the ZMP p, obeys [Takenaka2009]

.. math:: \dot \xi = \omega (\xi - p), \qquad \xi = \xi_{ref} + u + d

Without a disturbance ξ is that of the plan, whose ZMP is shifted by u (input `zmp` of the policy
inside); under a shift that stays, the controller's center of mass follows so that ξ moves by u. The
disturbance d is a load in a place that nobody knows, a slope, or homing errors: by how much the
robot is ahead of its plan. The ZMP is measured, and the rate of ξ follows from joint angles and
IMU. Their mean does not: homing errors and the offset of the IMU move it by more than loads do. All
signals pass one first-order filter, and a second one says what is not noise, as in the observer of
a joint [Ohnishi1996]:

.. math:: \dot{\hat d} = \frac{1}{T} \big( (p - p_{ref}) + (\dot \xi - \dot \xi_{ref}) / \omega
          - u - \hat d \big), \qquad u = -\hat d

u takes d̂ off within bounds. Where the robot answers as the model says, d̂ does not see u, and there
is no loop: T can be much shorter than for an integral of p − p_ref. Real legs
answer slow shifts so. They sway under those of a second, which the filters keep off.

[Takenaka2009] T. Takenaka et al., "Real Time Motion Generation and Control for Biped Robot", IROS.
[Ohnishi1996] see `baselines.adaptation.disturbance_observer`.
"""

from typing import Any

import numpy as np
from typing_extensions import override

from baselines.compensation.policy import (
    MemoryAround,
    PolicyAround,
    PolicyInputs,
    Step,
    WalkView,
    filter_share,
    record_row,
    record_rows,
)
from baselines.walking.mean_zmp import LEAST_LOAD, FlatFeet
from elastic_env.core.compiled import compiled, record_type
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array
from elastic_env.motion.trajectory import STAND_S, minimum_jerk
from elastic_env.world.robot_model import WalkerModel


class DcmObserverGains(Model):
    """How fast a disturbance of a walker is observed, and how much of it is met."""

    time_constant_s: float = quantity("s", 6.0, gt=0)
    """T, with which the estimate follows [s]."""
    filter_s: float = quantity("s", 0.3, gt=0)
    """Time constant of the filter that all signals pass [s]."""
    limit_m: float = quantity("m", 0.03, gt=0, lt=0.05)
    """Largest disturbance that is met, forward and sideways [m]."""


OBSERVED = record_type(
    steps=(),
    com=(2,),  # less that of the plan, behind the filter of all signals [m]
    dcm=(2,),  # likewise
    zmp=(2,),  # likewise, and less the shift
    disturbance=(2,),  # d̂ [m]
)
"""Memory of the observer."""


class DcmObserver(PolicyAround):
    """A policy of a walker whose observed disturbance is met, see the module.

    Args:
        policy: What commands the robot; it has the input `zmp`, and says where the links are.
        model: Assumed walker.
        gains: Filters and bound.
        ramp_s: Time in which the shift grows from zero [s].
    """

    memory_type = OBSERVED

    def __init__(
        self, policy: Any, model: WalkerModel, gains: DcmObserverGains, ramp_s: float = STAND_S
    ) -> None:
        super().__init__(policy, model)
        table = model.observation_table
        self._walk_view = WalkView(table)
        self._attitude = table.group("imu_attitude")
        self._feet = FlatFeet(model, LEAST_LOAD * model.biped.weight)
        self._chains = model.biped.chains
        self._sole = np.array([0.0, 0.0, -model.biped.ankle_height])
        period_s = model.control_period_s
        self._constants = record_row(
            period_s=period_s,
            omega=model.plan.omega,  # of the pendulum [rad/s]
            smooth_share=filter_share(period_s, gains.filter_s),
            follow_share=filter_share(period_s, gains.time_constant_s),
            limit_m=gains.limit_m,
        )
        local = model.plan.local
        self._plan = record_rows(com=local.com, soles=local.ankles[..., :2])
        steps = max(round(ramp_s / period_s), 1)
        self._ramp = minimum_jerk(np.arange(steps + 1) / steps)

    @override
    def act(self, rows: Array, memory: MemoryAround, inputs: PolicyInputs) -> Step:
        """Its shift, by what was seen up to the last control step, adds to the input `zmp`."""
        now = memory.own.copy()
        shift = np.empty((len(rows), 2))
        meet_disturbance(self._constants, self._ramp, now, shift)
        zmp = shift if inputs.zmp is None else inputs.zmp + shift
        action, inner = self.policy.act(rows, memory.inner, inputs._replace(zmp=zmp))
        links = self.policy.link_angles(rows, inner)
        seen = self._chains.com_and_feet(links, self._sole, rows[:, self._attitude])
        error = np.nan_to_num(self._feet.zmp_error(rows), nan=0.0) - shift
        observe(self._constants, self._walk_view.fields(rows), self._plan, *seen, error, now)
        return action, MemoryAround(now, inner)


@compiled
def meet_disturbance(constants: Any, ramp: Array, memory: Any, shift: Array) -> None:
    """Shift of the planned ZMP against the disturbance.

    Args:
        constants: Assumptions and gains, a row, (1,).
        ramp: Share of it after 0, 1, ... control steps, up to the last one [1].
        memory: Rows of `OBSERVED`, (n,).
        shift: To be filled, (n, 2) [m].
    """
    limit = constants[0].limit_m
    for world in range(len(memory)):
        own = memory[world]
        share = ramp[int(min(own.steps, len(ramp) - 1.0))]
        for i in range(2):
            shift[world, i] = -share * min(max(own.disturbance[i], -limit), limit)


@compiled
def observe(
    constants: Any,
    observed: Any,
    plan: Any,
    com: Array,
    soles: Array,
    zmp_error: Array,
    memory: Any,
) -> None:
    """Bring the estimate of the disturbance up to date.

    Args:
        constants: Assumptions and gains, a row, (1,).
        observed: Observations, rows with fields, (n,).
        plan: Center of mass and soles in the plan's local frame [m], one row per control step.
        com: Center of mass in a level frame, (n, 3) [m].
        soles: Middles of the soles in the same, (n, 2, 3) [m].
        zmp_error: Measured ZMP less the planned one and the shift, (n, 2) [m].
        memory: Rows of `OBSERVED`, brought up to date, (n,).
    """
    own = constants[0]
    for world in range(len(memory)):
        now = memory[world]
        shown = observed[world]
        right = shown.load_share
        periods = np.rint(shown.clock[0] / own.period_s)
        row = int(min(max(periods - 1.0, 0.0), len(plan) - 1.0))
        planned = plan[row]
        for i in range(2):
            on_left = com[world, i] - soles[world, 0, i] + planned.soles[0, i]
            on_right = com[world, i] - soles[world, 1, i] + planned.soles[1, i]
            ahead = (1.0 - right) * on_left + right * on_right - planned.com[i]
            if now.steps == 0.0:
                now.com[i] = ahead
                now.dcm[i] = ahead
                now.zmp[i] = zmp_error[world, i]
            moved = own.smooth_share * (ahead - now.com[i])
            now.com[i] += moved
            now.zmp[i] += own.smooth_share * (zmp_error[world, i] - now.zmp[i])
            dcm = now.com[i] + moved / (own.period_s * own.omega)
            rate = (dcm - now.dcm[i]) / own.period_s
            now.dcm[i] = dcm
            missing = now.zmp[i] + rate / own.omega - now.disturbance[i]
            now.disturbance[i] += own.follow_share * missing
        now.steps += 1.0
