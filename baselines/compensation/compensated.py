"""Joint elasticity compensated around any policy (Fig. 2 of the paper)."""

from typing import Any

import numpy as np

from baselines.compensation.compensation_kernels import shift_seen
from baselines.compensation.compensators import Compensator
from baselines.compensation.inputs import DEFLECTION, PolicyInputs, inputs_of
from baselines.compensation.observed import ObservedWalk
from baselines.compensation.policy import Action, ObservationView, Policy, PolicyWithInputs, predicted, taken_up
from baselines.compensation.startup import Ramp
from elastic_env.core.signals import Array
from elastic_env.motion.trajectory import STAND_S
from elastic_env.runtime.robot_model import WalkerModel


class Compensated(PolicyWithInputs):
    """Any policy with joint elasticity compensated around it (Fig. 2 of the paper).

    The wrapped policy's action is the offset of the link angle it wants, q_d = q_ref + a. It sees the estimated link
    angle and rate where the observation has the encoder's; the compensator's offset for q_d is added to its action.
    The compensation grows from zero in the first `ramp_s` of an episode, while the reference stands.

    Args:
        policy: Anything with `predict`; its state may be anything. One that does not read joint rates can say so by an
            attribute `reads_rates = False`, which saves their estimate.
        compensator: Where the motor has to lead, and where the link is: an object with the attributes and methods of
            `baselines.compensation.compensators.Compensator`.
        ramp_s: Duration of the ramp.
        corrects_policy: Whether the input `deflection` also reaches the policy, as one that winds springs needs it.
    """

    def __init__(
        self,
        policy: Policy,
        compensator: Compensator,
        ramp_s: float = STAND_S,
        corrects_policy: bool = False,
    ) -> None:
        self.policy, self.compensator, self._corrects_policy = policy, compensator, corrects_policy
        model = compensator.model
        self._num_joints = len(model.joint_names)
        self._shows_rates = getattr(policy, "reads_rates", True)
        self._view = ObservationView(model.observation_table, model.control_period_s)
        self._ramp = Ramp(model, ramp_s)
        self._plan = None
        if isinstance(model, WalkerModel):
            self._plan = ObservedWalk(model.observation_table), model.biped.foot_spacing

    @property
    def inputs(self) -> tuple[str, ...]:
        """See `PolicyWithInputs`."""
        return (DEFLECTION, *inputs_of(self.policy)[1:])

    def predict_with(
        self,
        observation: Array,
        inputs: PolicyInputs,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Action, Any]:
        """See `PolicyWithInputs`; it takes `deflection`, r: what is compensated, and seen, is (1 + r) δ.

        The contact forces that load the joints act where the policy shifts the ZMP.
        """
        rows, n, correction = self._shifted(self._view.rows(observation), inputs), self._num_joints, inputs.deflection
        desired, compensator = self._view.motion(rows), self.compensator.at(rows)
        memory, inner_state = taken_up(
            state, episode_start, rows, self._view, lambda: np.pad(compensator.begin(desired), ((0, 0), (1 + n, 0)))
        )
        own = memory[:, 1 + n :]
        links = self._links(compensator, rows, own, correction)
        seen = self._seen(compensator, rows, links)
        shown = seen if observation.ndim > 1 else seen[0]
        others = inputs if self._corrects_policy else inputs.with_deflection(None)
        action, inner_state = predicted(self.policy, shown, others, inner_state, episode_start, deterministic)
        action = np.atleast_2d(np.asarray(action, dtype=np.float64))
        offset, kept = compensator.offset(desired.shifted(action), own)
        if correction is not None:
            offset = offset + correction * compensator.deflection(offset, kept)
        steps = memory[:, :1] + 1.0
        total = (action + self._ramp.after(steps) * offset).astype(np.float32)
        return total.reshape((*observation.shape[:-1], n)), (np.concatenate((steps, links, kept), axis=1), inner_state)

    def link_estimate(self, observation: Array, state: Any) -> Array:
        """See `PolicyWithInputs`."""
        memory, _ = state
        return memory[:, 1 : 1 + self._num_joints].reshape((*observation.shape[:-1], self._num_joints))

    def _shifted(self, rows: Array, inputs: PolicyInputs) -> Array:
        """The observations with ZMP and load share of the plan as the inputs shift them."""
        shift = inputs.zmp_shift
        if shift is None or self._plan is None:
            return rows
        rows, (observed, spacing) = rows.copy(), self._plan
        shift_seen(observed.fields(rows), np.ascontiguousarray(shift), spacing)
        return rows

    def _links(self, compensator: Compensator, rows: Array, memory: Array, correction: Array | None) -> Array:
        """The links' angles by the encoders."""
        theta = self._view.theta(rows)
        q = compensator.link_angle(theta, memory)
        return q if correction is None else q - compensator.modelled * correction * (theta - q)

    def _seen(self, compensator: Compensator, rows: Array, links: Array) -> Array:
        """The observations with the links' angles and rates where they have the encoders'."""
        theta_dot = self._view.theta_dot(rows)
        rate = compensator.link_rate(self._view.theta(rows), theta_dot) if self._shows_rates else theta_dot
        return self._view.with_links(rows, links, rate)
