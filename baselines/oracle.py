"""The upper bound: a policy that reads the truth."""

from typing import Any

import numpy as np

from baselines.compensators import DynamicCompensator
from baselines.policy import Action, ObservationView, resume
from baselines.startup import Ramp
from elastic_env.errors import ElasticError
from elastic_env.plan import STAND_S
from elastic_env.signals import Array


class Oracle:
    """What perfect sensing and a perfect model give: the only policy that may read the truth.

    The dynamic compensator with the true parameters, friction and backlash included, and an integrator on the true link
    error for what is left. Its gain stays below the damping of the link's resonance.

    Args:
        env: The environment itself, scalar or vector.
        ramp_s: Time in which the compensation grows from zero [s].
    """

    integral_gain = 1.0
    """Gain on the true link error [1/s]."""
    integral_limit = 0.05
    """Largest correction of the integrator [rad]."""

    def __init__(self, env: Any, ramp_s: float = STAND_S) -> None:
        self._env = env.unwrapped
        model = self._env.truth().model
        self._view = ObservationView(self._env.task.observation_table)
        self._compensator = DynamicCompensator(model, friction=True)
        self._dt = model.control_period_s
        self._ramp = Ramp(model, ramp_s)

    def predict(
        self,
        observation: Array,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,  # noqa: ARG002  the interface's
    ) -> tuple[Action, Any]:
        """Action and new state; the observation must be the environment's present one."""
        rows = self._view.rows(observation)
        if not np.array_equal(rows, np.atleast_2d(self._env.task.observe())):
            raise ElasticError(
                "the oracle reads the truth of the environment that it was made for, and this is not its present "
                'observation; make one with baselines.make("oracle", env) for the environment that it is to run in'
            )
        motion = self._view.motion(rows)
        n = motion.q.shape[-1]
        memory, _ = resume(
            state, episode_start, rows, self._view,
            lambda: np.hstack([np.zeros((len(rows), 1 + n)), motion.q, self._compensator.begin(motion)]),
        )  # fmt: skip
        steps, correction, target, kept = np.split(memory, [1, 1 + n, 1 + 2 * n], axis=1)
        steps = steps + 1.0
        error = np.where(self._ramp.is_over(steps - 1.0), target - self._env.truth().q, 0.0)
        correction = np.clip(
            correction + self.integral_gain * self._dt * error, -self.integral_limit, self.integral_limit
        )
        offset, kept = self._compensator.offset(motion, kept)
        action = (self._ramp.share(steps) * offset + correction).astype(np.float32)
        new_state = np.hstack([steps, correction, motion.q, kept]), None
        return action.reshape((*observation.shape[:-1], n)), new_state

    def link_estimate(self, observation: Array, state: Any) -> Array:  # noqa: ARG002  the interface's
        """The true link angle, (..., n) [rad]."""
        return self._env.truth().q.reshape((*observation.shape[:-1], -1))
