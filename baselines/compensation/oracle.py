"""The upper bound: a policy that reads the truth."""

from typing import Any

import numpy as np

from baselines.compensation.compensators import DynamicCompensator
from baselines.compensation.policy import Action, ObservationView, Policy, taken_up
from baselines.compensation.startup import Ramp
from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array
from elastic_env.motion.trajectory import STAND_S


class Oracle:
    """What perfect sensing and a perfect model give: the only policy that may read the truth.

    The dynamic compensator with the true parameters around a policy that sees the true link angles; on the testbed also
    an integrator on the true link error for what is left, with a gain below the damping of the link's resonance.

    Args:
        env: The environment itself, scalar or vector.
        policy: What is compensated: on the walker its controller.
        ramp_s: Time in which the compensation grows from zero [s].
        friction: Whether the compensator knows the friction; not where the policy does.
        integral_gain: Gain on the true link error [1/s]; 0 where the policy moves links off the reference on purpose.
    """

    integral_limit = 0.05
    """Largest correction of the integrator [rad]."""

    def __init__(
        self,
        env: Any,
        policy: Policy,
        ramp_s: float = STAND_S,
        friction: bool = True,
        integral_gain: float = 1.0,
    ) -> None:
        self.policy, self.integral_gain = policy, integral_gain
        self._env = env.unwrapped
        model = self._env.truth().model
        self._view = ObservationView(self._env.task.observation_table, model.control_period_s)
        self._compensator = DynamicCompensator(model, friction=friction)
        self._dt = model.control_period_s
        self._ramp = Ramp(model, ramp_s)

    def predict(
        self, observation: Array, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Action, Any]:
        """Action and new state; the observation must be the environment's present one."""
        rows = self._view.rows(observation)
        if not np.array_equal(rows, np.atleast_2d(self._env.task.observe())):
            raise ElasticError(
                "the oracle reads the truth of the environment that it was made for, and this is not its present "
                'observation; make one with baselines.make("oracle", env) for the environment that it is to run in'
            )
        truth, motion = self._env.truth(), self._view.motion(rows)
        n = motion.q.shape[-1]
        compensator = self._compensator.at(rows).with_stiffness(truth.stiffness)
        memory, inner = taken_up(
            state, episode_start, rows, self._view,
            lambda: np.hstack([np.zeros((len(rows), 1 + n)), motion.q, compensator.begin(motion)]),
        )  # fmt: skip
        seen = self._view.with_links(rows, truth.q, truth.q_dot)
        wanted, inner = self.policy.predict(seen, inner, episode_start, deterministic)
        wanted = np.asarray(wanted, dtype=np.float64)
        steps, correction, target, kept = np.split(memory, [1, 1 + n, 1 + 2 * n], axis=1)
        steps = steps + 1.0
        error = np.where(self._ramp.is_over(steps - 1.0), target - truth.q, 0.0)
        correction = np.clip(
            correction + self.integral_gain * self._dt * error, -self.integral_limit, self.integral_limit
        )
        offset, kept = compensator.offset(motion.shifted(wanted), kept)
        action = (wanted + self._ramp.after(steps) * offset + correction).astype(np.float32)
        new_state = np.hstack([steps, correction, motion.q, kept]), inner
        return action.reshape((*observation.shape[:-1], n)), new_state

    def link_estimate(self, observation: Array, state: Any) -> Array:  # noqa: ARG002  the interface's
        """The true link angle, (..., n) [rad]."""
        return self._env.truth().q.reshape((*observation.shape[:-1], -1))
