r"""Disturbance observer of a walker, for what keeps its DCM from the plan.

The model is the linear inverted pendulum with a plan. Its divergent component of motion (DCM)
:math:`\xi = c + \dot c / \omega`, with the center of mass c and the ZMP p, obeys [Takenaka2009]

.. math:: \dot \xi = \omega (\xi - p), \qquad \xi = \xi_{ref} + u + d

Without a disturbance ξ is that of the plan, whose ZMP is shifted by u (input `zmp` of the policy
inside). Under a constant shift the controller's center of mass follows so that ξ moves by u. The
disturbance d is how far the robot is ahead of its plan: by a load at an unknown place, a slope, or
homing errors. The ZMP is measured, and the rate of ξ follows from joint angles and IMU. The mean of
ξ is not used: homing errors and the offset of the IMU move it by more than loads do. All signals
pass one first-order filter, and the estimate passes a second one, as in the observer of a joint
[Ohnishi1996]:

.. math:: \dot{\hat d} = \frac{1}{T} \big( (p - p_{ref}) + (\dot \xi - \dot \xi_{ref}) / \omega
          - u - \hat d \big), \qquad u = -\hat d

u cancels d̂ within bounds. Where the robot responds like the model, u does not change d̂, and there
is no loop: T can be much shorter than for an integral of p − p_ref. Real legs respond so to slow
shifts. They sway under shifts within a second, which the filters suppress.

[Takenaka2009] T. Takenaka et al., "Real Time Motion Generation and Control for Biped Robot", IROS.
[Ohnishi1996] see `baselines.adaptation.disturbance_observer`.
"""

from typing import Any

import numpy as np
from typing_extensions import override

from baselines.compensation.compiled_rows import record_row, record_rows
from baselines.compensation.filters import filter_share
from baselines.compensation.policy import PolicyInputs, Step, WalkView
from baselines.compensation.policy_around import MemoryAround, PolicyAround
from baselines.compensation.ramp import feedback_ramp
from baselines.walking.flat_feet import LEAST_LOAD, FlatFeet
from elastic_env.core.compiled import compiled, record_type
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array
from elastic_env.motion.trajectory import STAND_S
from elastic_env.world.robot_model import WalkerModel


class DcmObserverGains(Model):
    """Time constants and bound of the disturbance observer of a walker."""

    time_constant_s: float = quantity("s", 6.0, gt=0)
    """T, with which the estimate follows [s]."""
    filter_s: float = quantity("s", 0.3, gt=0)
    """Time constant of the filter that all signals pass [s]."""
    limit_m: float = quantity("m", 0.03, gt=0, lt=0.05)
    """Largest disturbance that is compensated, forward and sideways [m]."""


OBSERVED = record_type(
    steps=(),
    com=(2,),  # less that of the plan, filtered [m]
    dcm=(2,),  # the same of the DCM [m]
    zmp=(2,),  # the same of the ZMP, less its shift [m]
    disturbance=(2,),  # d̂ [m]
)
"""Memory of the observer."""


class DcmObserver(PolicyAround):
    """A policy of a walker with its observed disturbance compensated, see the module.

    Args:
        policy: Commands the robot; it has the input `zmp`, and estimates the link angles.
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
        self._ramp = feedback_ramp(ramp_s, period_s)

    @override
    def act(self, rows: Array, memory: MemoryAround, inputs: PolicyInputs) -> Step:
        """Add the shift by the measurements up to the last control step to the input `zmp`."""
        estimate = memory.own.copy()
        shift = np.empty((len(rows), 2))
        cancel_disturbance(self._constants, self._ramp, estimate, shift)
        zmp = shift if inputs.zmp is None else inputs.zmp + shift
        action, inner = self.policy.act(rows, memory.inner, inputs._replace(zmp=zmp))
        links = self.policy.link_angles(rows, inner)
        points = self._chains.com_and_feet(links, self._sole, rows[:, self._attitude])
        error = np.nan_to_num(self._feet.zmp_error(rows), nan=0.0) - shift
        observations = self._walk_view.fields(rows)
        observe(self._constants, observations, self._plan, *points, error, estimate)
        return action, MemoryAround(estimate, inner)


@compiled
def cancel_disturbance(constants: Any, ramp: Array, memory: Any, shift: Array) -> None:
    """Fill in the shift of the planned ZMP against the disturbance.

    Args:
        constants: Assumptions and gains, a row, (1,).
        ramp: Share of the shift after 0, 1, ... control steps, up to the last one [1].
        memory: Rows of `OBSERVED`, (n,).
        shift: To be filled, (n, 2) [m].
    """
    limit = constants[0].limit_m
    for world in range(len(memory)):
        state = memory[world]
        share = ramp[int(min(state.steps, len(ramp) - 1.0))]
        for i in range(2):
            shift[world, i] = -share * min(max(state.disturbance[i], -limit), limit)


@compiled
def observe(
    constants: Any,
    observations: Any,
    plan: Any,
    com: Array,
    soles: Array,
    zmp_error: Array,
    memory: Any,
) -> None:
    """Update the estimate of the disturbance.

    Args:
        constants: Assumptions and gains, a row, (1,).
        observations: Rows with fields, (n,).
        plan: Center of mass and soles in the plan's local frame [m], one row per control step.
        com: Center of mass in a level frame, (n, 3) [m].
        soles: Middles of the soles in the same, (n, 2, 3) [m].
        zmp_error: Measured ZMP less the planned one and the shift, (n, 2) [m].
        memory: Rows of `OBSERVED`, to be updated, (n,).
    """
    known = constants[0]
    for world in range(len(memory)):
        state = memory[world]
        obs = observations[world]
        right = obs.load_share
        periods = np.rint(obs.clock[0] / known.period_s)
        planned = plan[int(min(max(periods - 1.0, 0.0), len(plan) - 1.0))]
        for i in range(2):
            on_left = com[world, i] - soles[world, 0, i] + planned.soles[0, i]
            on_right = com[world, i] - soles[world, 1, i] + planned.soles[1, i]
            ahead = (1.0 - right) * on_left + right * on_right - planned.com[i]
            if state.steps == 0.0:
                state.com[i] = ahead
                state.dcm[i] = ahead
                state.zmp[i] = zmp_error[world, i]
            step = known.smooth_share * (ahead - state.com[i])
            state.com[i] += step
            state.zmp[i] += known.smooth_share * (zmp_error[world, i] - state.zmp[i])
            dcm = state.com[i] + step / (known.period_s * known.omega)
            rate = (dcm - state.dcm[i]) / known.period_s
            state.dcm[i] = dcm
            missing = state.zmp[i] + rate / known.omega - state.disturbance[i]
            state.disturbance[i] += known.follow_share * missing
        state.steps += 1.0
