"""A policy with a compensator of joint elasticity around it (Fig. 2 of the paper)."""

from typing import Any, NamedTuple

import numpy as np
from typing_extensions import override

from baselines.compensation.compensators import Compensator
from baselines.compensation.contact_torque import planned_feet, shift_plan
from baselines.compensation.inputs import DEFLECTION
from baselines.compensation.memory import put_rows, select_rows
from baselines.compensation.observation_view import Motion, WalkView
from baselines.compensation.policy import Policy, PolicyAround, PolicyInputs, Step
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
    """Any policy with a compensator of joint elasticity around it (Fig. 2 of the paper).

    The action a of the policy inside is the offset of its desired link angle, q_d = q_ref + a. It
    sees the estimated link angle and rate instead of the encoder's. The compensator's offset for
    q_d is added to its action. The compensation grows from zero in the first `ramp_s` of an
    episode, while the reference is at rest.

    Attributes:
        ramp: Share of the compensation after 0, 1, ... control steps, up to 1.

    Args:
        policy: Anything with `predict`; its state may be anything. An attribute `reads_rates =
            False` saves the estimate of joint rates for a policy that does not read them.
        compensator: Offsets of commands and estimates of link angles: an object with the
            attributes and methods of `baselines.compensation.compensators.Compensator`.
        ramp_s: Duration of the ramp [s].
        corrects_policy: True to hand the input `deflection` on to the policy, as a policy that
            winds springs needs it.
    """

    def __init__(
        self,
        policy: Policy,
        compensator: Compensator,
        ramp_s: float = STAND_S,
        corrects_policy: bool = False,
    ) -> None:
        model = compensator.model
        super().__init__(policy, model)
        self.inputs = (DEFLECTION, *self.policy.inputs)
        self.compensator = compensator
        self._theta = model.observation_table.group("encoder_angle")
        self._theta_dot = model.observation_table.group("encoder_rate")
        self._corrects_policy = corrects_policy
        self.ramp = Ramp(model, ramp_s).table
        self._plan: tuple[WalkView, Any] | None = None
        if isinstance(model, WalkerModel):
            self._plan = WalkView(model.observation_table), planned_feet(model.plan)

    @override
    def begin(self, rows: Array) -> CompensatedMemory:
        motion = self.view.motion(rows)
        steps = np.zeros((len(rows), 1), dtype=np.int64)
        state = self.compensator.at(rows).begin(motion)
        return CompensatedMemory(steps, motion.q.copy(), state, self.policy.begin(rows))

    @override
    def act(self, rows: Array, memory: CompensatedMemory, inputs: PolicyInputs) -> Step:
        """Act for a control step; the input `deflection` r makes every deflection (1 + r) δ.

        Link angles by torque sensors or foot wrenches already show an unknown load: for them r is
        without its part. The contact forces that load the joints act where the inputs shift the
        ZMP.
        """
        correction = inputs.deflection
        state = memory.compensator
        if self._plan is not None and (shift := inputs.zmp_shift) is not None:
            view, feet = self._plan
            rows = rows.copy()
            shift = np.ascontiguousarray(shift)
            shift_plan(view.fields(rows), shift, feet, self.model.control_period_s)
            state = self._begin_shifted(rows, memory)
        compensator = self.compensator.at(rows)
        theta = rows[:, self._theta]
        links = compensator.link_angle(theta, state)
        if correction is not None:
            without_load = correction
            if inputs.load is not None and compensator.weighs:
                without_load = (1.0 + correction) / (1.0 + inputs.load) - 1.0
            links = links - compensator.modelled * without_load * (theta - links)
            if not self._corrects_policy:
                inputs = inputs._replace(deflection=None)
        compensated = rows.copy()
        compensated[:, self._theta] = links
        if self.policy.reads_rates:
            rates = compensator.link_rate(theta, rows[:, self._theta_dot])
            compensated[:, self._theta_dot] = rates
        action, inner = self.policy.act(compensated, memory.inner, inputs)
        action = action.astype(np.float64)
        motion = self.view.motion(rows)
        desired = Motion(motion.q + action, motion.q_dot, motion.q_ddot)
        offset, state = compensator.offset(desired, state)
        if correction is not None:
            offset = offset + correction * compensator.deflection(offset, state)
        steps = memory.steps + 1
        total = action + self.ramp.take(steps, mode="clip") * offset
        memory = CompensatedMemory(steps, links.copy(), state, inner)
        return total.astype(np.float32), memory

    @override
    def link_angles(self, rows: Array, memory: CompensatedMemory) -> Array:
        return memory.links

    def _begin_shifted(self, rows: Array, memory: CompensatedMemory) -> Any:
        """Memory of the compensator, begun under the shifted plan where an episode begins."""
        if np.count_nonzero(memory.steps) == len(rows):
            return memory.compensator
        is_new = memory.steps[:, 0] == 0
        start = self.compensator.at(rows).begin(self.view.motion(rows))
        return put_rows(memory.compensator, is_new, select_rows(start, is_new))
