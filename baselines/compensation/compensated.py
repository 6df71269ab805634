"""Joint elasticity compensated around any policy (Fig. 2 of the paper)."""

from typing import Any, NamedTuple

import numpy as np
from typing_extensions import override

from baselines.compensation.compensators import Compensator
from baselines.compensation.contact_torque import shift_plan
from baselines.compensation.inputs import DEFLECTION
from baselines.compensation.policy import (
    Motion,
    Policy,
    PolicyAround,
    PolicyInputs,
    WalkView,
    put_rows,
    select_rows,
)
from baselines.compensation.startup import Ramp
from elastic_env.core.signals import Array, IntArray
from elastic_env.motion.trajectory import STAND_S
from elastic_env.world.robot_model import WalkerModel


class CompensatedMemory(NamedTuple):
    """Memory of a compensated policy.

    Attributes:
        steps: Control steps since the start of the episode, (num_worlds, 1).
        links: Link angles that the policy saw, (num_worlds, n) [rad].
        compensator: Memory of the compensator.
        inner: Memory of the policy.
    """

    steps: IntArray
    links: Array
    compensator: Any
    inner: Any


class Compensated(PolicyAround):
    """Any policy with joint elasticity compensated around it (Fig. 2 of the paper).

    The wrapped policy's action is the offset of the link angle it wants, q_d = q_ref + a. It sees
    the estimated link angle and rate where the observation has the encoder's; the compensator's
    offset for q_d is added to its action. The compensation grows from zero in the first `ramp_s` of
    an episode, while the reference stands.

    Args:
        policy: Anything with `predict`; its state may be anything. One that does not read joint
            rates can say so by an attribute `reads_rates = False`, which saves their estimate.
        compensator: Where the motor has to lead, and where the link is: an object with the
            attributes and methods of `baselines.compensation.compensators.Compensator`.
        ramp_s: Duration of the ramp.
        corrects_policy: Whether the input `deflection` also reaches the policy, as one that winds
            springs needs it.
    """

    def __init__(
        self,
        policy: Policy,
        compensator: Compensator,
        ramp_s: float = STAND_S,
        corrects_policy: bool = False,
    ) -> None:
        model = compensator.model
        super().__init__(policy, model.observation_table, model.control_period_s)
        self.compensator = compensator
        self._theta = model.observation_table.group("encoder_angle")
        self._corrects_policy = corrects_policy
        self._ramp = Ramp(model, ramp_s).table
        self._plan: tuple[WalkView, float] | None = None
        if isinstance(model, WalkerModel):
            self._plan = WalkView(model.observation_table), model.biped.foot_spacing

    @property
    @override
    def inputs(self) -> tuple[str, ...]:
        return (DEFLECTION, *self.policy.inputs)

    @override
    def begin(self, rows: Array) -> CompensatedMemory:
        motion = self.view.motion(rows)
        memory = self.compensator.at(rows).begin(motion)
        steps = np.zeros((len(rows), 1), dtype=np.int64)
        return CompensatedMemory(steps, motion.q.copy(), memory, self.policy.begin(rows))

    @override
    def act(
        self, rows: Array, memory: CompensatedMemory, inputs: PolicyInputs
    ) -> tuple[Array, CompensatedMemory]:
        """It takes the input `deflection`, r: what is compensated, and seen, is (1 + r) δ.

        The contact forces that load the joints act where the inputs shift the ZMP.
        """
        correction = inputs.deflection
        own = memory.compensator
        if self._plan is not None and (shift := inputs.zmp_shift) is not None:
            rows = _shift_rows(*self._plan, rows, shift)
            own = self._begin_shifted(rows, memory)
        compensator = self.compensator.at(rows)
        theta = rows[:, self._theta]
        links = compensator.link_angle(theta, own)
        if correction is not None:
            links = links - compensator.modelled * correction * (theta - links)
            if not self._corrects_policy:
                inputs = inputs._replace(deflection=None)
        rates = (
            compensator.link_rate(theta, self.view.theta_dot(rows))
            if self.policy.reads_rates
            else None
        )
        action, inner = self.policy.act(
            self.view.with_links(rows, links, rates), memory.inner, inputs
        )
        wanted = action.astype(np.float64)
        motion = self.view.motion(rows)
        offset, own = compensator.offset(
            Motion(motion.q + wanted, motion.q_dot, motion.q_ddot), own
        )
        if correction is not None:
            offset = offset + correction * compensator.deflection(offset, own)
        steps = memory.steps + 1
        total = (wanted + self._ramp.take(steps, mode="clip") * offset).astype(np.float32)
        return total, CompensatedMemory(steps, links.copy(), own, inner)

    @override
    def link_angles(self, rows: Array, memory: CompensatedMemory) -> Array:
        return memory.links

    def _begin_shifted(self, rows: Array, memory: CompensatedMemory) -> Any:
        """Memory of the compensator, begun under the shifted plan where an episode begins."""
        if np.count_nonzero(memory.steps) == len(rows):
            return memory.compensator
        fresh = memory.steps[:, 0] == 0
        begun = self.compensator.at(rows).begin(self.view.motion(rows))
        return put_rows(memory.compensator, fresh, select_rows(begun, fresh))


def _shift_rows(view: WalkView, spacing: float, rows: Array, shift: Array) -> Array:
    """The observations with ZMP and load share of the plan shifted."""
    rows = rows.copy()
    shift_plan(view.fields(rows), shift=np.ascontiguousarray(shift), spacing=spacing)
    return rows
