"""Joint elasticity compensated around any policy (Fig. 2 of the paper)."""

from typing import Any

import numpy as np

from baselines.compensators import Compensator
from baselines.policy import Action, ObservationView, Policy, resume
from baselines.startup import Ramp
from elastic_env.plan import STAND_S
from elastic_env.signals import Array


class Compensated:
    """Any policy with joint elasticity compensated around it (Fig. 2 of the paper).

    The wrapped policy's action is the offset of the link angle it wants, q_d = q_ref + a. It sees the estimated link
    angle and rate where the observation has the encoder's; the compensator's offset for q_d is added to its action.
    The compensation grows from zero in the first `ramp_s` of an episode, while the reference stands.

    Args:
        policy: Anything with `predict`; its state may be anything.
        compensator: Where the motor has to lead, and where the link is.
        ramp_s: Duration of the ramp.
    """

    def __init__(
        self,
        policy: Policy,
        compensator: Compensator,
        ramp_s: float = STAND_S,
    ) -> None:
        self.policy, self.compensator = policy, compensator
        model = compensator.model
        self._view = ObservationView(model.observation_table)
        self._ramp = Ramp(model, ramp_s)

    def predict(
        self, observation: Array, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Action, Any]:
        """Compensated action and new state.

        Raises:
            ElasticError: Called in the middle of an episode without the state of the last call.
        """
        rows = self._view.rows(observation)
        desired, compensator = self._view.motion(rows), self.compensator.at(rows)
        memory, inner_state = resume(
            state, episode_start, rows, self._view, lambda: np.pad(compensator.begin(desired), ((0, 0), (1, 0)))
        )
        action, inner_state = self._inner(compensator, rows, inner_state, episode_start, deterministic, observation.ndim, memory)
        offset, kept = compensator.offset(desired.shifted(action), memory[:, 1:])
        steps = memory[:, :1] + 1.0
        total = (action + self._ramp.share(steps) * offset).astype(np.float32)
        return total.reshape((*observation.shape[:-1], total.shape[-1])), (np.hstack([steps, kept]), inner_state)

    def link_estimate(self, observation: Array, state: Any) -> Array:
        """Estimated link angle for an observation and the state that `predict` returned for it, (..., n) [rad]."""
        memory, _ = state
        rows = self._view.rows(observation)
        estimate = self.compensator.at(rows).link_angle(self._view.theta(rows), memory[:, 1:])
        return estimate.reshape((*observation.shape[:-1], estimate.shape[-1]))

    def _inner(
        self,
        compensator: Compensator,
        rows: Array,
        state: Any,
        episode_start: Any,
        deterministic: bool,
        ndim: int,
        memory: Array,
    ) -> tuple[Array, Any]:
        """The wrapped policy's action on an observation whose encoder columns are those of the links."""
        theta, theta_dot = self._view.theta(rows), self._view.theta_dot(rows)
        q = compensator.link_angle(theta, memory[:, 1:])
        if state is not None and getattr(compensator, "_output", "") in ("taylor", "newton") and hasattr(self.policy, "windup"):
            q = q - self.policy.windup(state)
        seen = self._view.with_links(rows, q, compensator.link_rate(theta, theta_dot))
        action, state = self.policy.predict(seen if ndim > 1 else seen[0], state, episode_start, deterministic)
        return np.atleast_2d(np.asarray(action, dtype=np.float64)), state
