"""Curves of a training for TensorBoard."""

from typing import Any

from stable_baselines3.common.logger import Logger, make_output_format

from train.learn.sb3_env import SB3VecEnv

_REWARD = "rollout/reward_per_decision"
_MISLEADING = "rollout/ep_rew_mean"
"""Sum of rewards of an episode: each is a penalty, so that an episode which ends early would
look better.
"""


class Curves(Logger):
    """SB3's logger with the reward per decision in the place of that per episode.

    It is the mean over the last whole episodes. Those that were cut short to spread the worlds over
    the motion do not count, since their decisions are of its beginning alone.

    Args:
        folder: Of TensorBoard's files.
        model: Whose episodes they are.
        worlds: In which it learns.
    """

    def __init__(self, folder: str, model: Any, worlds: SB3VecEnv) -> None:
        super().__init__(folder, [make_output_format("tensorboard", folder)])
        self._model = model
        self._worlds = worlds

    def dump(self, step: int = 0) -> None:
        """Write what was recorded; see SB3."""
        self.name_to_value.pop(_MISLEADING, None)
        self.name_to_excluded.pop(_MISLEADING, None)
        episodes = self._model.ep_info_buffer
        if episodes:
            decisions = sum(episode["l"] for episode in episodes)
            self.record(_REWARD, sum(episode["r"] for episode in episodes) / decisions)
        super().dump(step)

    def finish(self, step: int) -> None:
        """Write the reward per decision of the present episodes, where no whole one has ended."""
        reward = self._worlds.reward_per_decision
        if not self._model.ep_info_buffer and reward is not None:
            self.record(_REWARD, reward)
            self.dump(step)
