"""A base policy under a residual: what the residual acts on, and how fast it can change.

The residual is a number in [−1, 1] for every column of the inputs that it acts on, or for every pair of joints. It is
decided from the features of `baselines.residual.features` once in `decision_period` control steps. Times the bound of
its column it passes a first-order low-pass, and becomes an input of the base (`baselines.compensation.inputs`).
"""

from typing import Any

import numpy as np

from baselines.compensation.inputs import inputs_of
from baselines.compensation.policy import Action, ObservationView, Policy, predicted, taken_up
from baselines.residual.channels import Channels
from baselines.residual.settings import ResidualSettings
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.runtime.robot_model import RobotModel, WalkerModel


class Corrected:
    """A base policy under a residual that somebody else decides.

    Memory per world: the values of the inputs behind the low-pass.

    Args:
        base: Any policy that has the inputs; every policy has `command`.
        model: What may be known of the robot.
        settings: How the residual acts.

    Raises:
        ConfigurationError: An input that the base does not have, a joint that the robot has not, or caution without a
            walker.
    """

    def __init__(self, base: Policy, model: RobotModel, settings: ResidualSettings) -> None:
        has = inputs_of(base)
        if lacking := [name for name in settings.acts_on if name not in has]:
            raise ConfigurationError(
                f"the residual acts on {', '.join(lacking)}, which {type(base).__name__} does not have as an input; "
                f"it has: {', '.join(has)}"
            )
        if settings.cautious and not isinstance(model, WalkerModel):
            raise ConfigurationError(
                f"cautious goes by how the legs of a walker bend, got a {type(model).__name__}; set cautious: false"
            )
        self.base, self.settings, self.model = base, settings, model
        self.channels = Channels(model, settings)
        self._share = 1.0 - float(np.exp(-2.0 * np.pi * settings.cutoff_hz * model.control_period_s))
        self._view = ObservationView(model.observation_table, model.control_period_s)

    @property
    def num_residuals(self) -> int:
        """Numbers that make up a residual, k."""
        return len(self.channels.signals)

    def act(
        self, observation: Array, residual: Array, state: Any = None, episode_start: Any = None
    ) -> tuple[Action, Any]:
        """Action and new state under a residual, (num_worlds, k) within [−1, 1].

        A residual that has been zero since the start of the episode gives the base's action to the last bit.
        """
        rows = self._view.rows(observation)
        values, inner = taken_up(
            state, episode_start, rows, self._view, lambda: np.zeros((len(rows), self.channels.width))
        )
        values = self.channels.towards(values, residual, self._share)
        inputs, offset = self.channels.inputs(values)
        action, inner = predicted(self.base, observation, inputs, inner, episode_start, True)
        if offset is not None:
            action = (action + offset.reshape(np.shape(action))).astype(np.float32)
        return action, (values, inner)

    def base_action(self, observation: Array, state: Any, episode_start: Any) -> Action:
        """What the base alone would command now."""
        inner = None if state is None else state[1]
        return self.base.predict(observation, inner, episode_start, True)[0]

    def link_estimate(self, observation: Array, state: Any) -> Array:
        """Estimated link angle for an observation and the state that `act` returned for it, (..., n) [rad]."""
        return self.base.link_estimate(observation, state[1])  # type: ignore[attr-defined]
