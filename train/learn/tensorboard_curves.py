"""TensorBoard's curves of a training, with the reward per decision."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from stable_baselines3.common.logger import Logger, make_output_format

from train.learn.sb3_env import SB3VecEnv

_DECISION_REWARD = "rollout/reward_per_decision"
_EPISODE_REWARD = "rollout/ep_rew_mean"
"""SB3's sum of rewards of an episode, which misleads: rewards are penalties, so an early end would
look better."""


class RewardLogger(Logger):
    """SB3's logger with the reward per decision instead of the reward per episode.

    It is the mean over the last complete episodes. Episodes that were cut short to spread the
    worlds over the motion do not count, since they have only its beginning. If every checkpoint
    ends the episodes before one is complete, it is the mean between checkpoints, which have the
    same parts of the motion.

    Args:
        folder: Folder for TensorBoard's files.
        model: Model that learns.
        worlds: Worlds in which it learns.
    """

    def __init__(self, folder: str, model: Any, worlds: SB3VecEnv) -> None:
        super().__init__(folder, [make_output_format("tensorboard", folder)])
        self._model = model
        self._worlds = worlds

    def dump(self, step: int = 0) -> None:
        """Write the recorded values; see SB3."""
        self.name_to_value.pop(_EPISODE_REWARD, None)
        self.name_to_excluded.pop(_EPISODE_REWARD, None)
        episodes = self._model.ep_info_buffer
        if episodes:
            decisions = sum(episode["l"] for episode in episodes)
            reward = sum(episode["r"] for episode in episodes)
            self.record(_DECISION_REWARD, reward / decisions)
        super().dump(step)

    def end_episodes(self, step: int) -> None:
        """Write the reward per decision since the episodes began, if none of them is complete."""
        reward = self._worlds.reward_per_decision
        if not self._model.ep_info_buffer and reward is not None:
            self.record(_DECISION_REWARD, reward)
            self.dump(step)


@contextmanager
def hide_thread_errors() -> Iterator[None]:
    """Keep TensorBoard's thread from printing errors that its next call raises in this thread."""
    before = threading.excepthook

    def print_others(error: threading.ExceptHookArgs) -> None:
        if getattr(error.thread, "exception", None) is not error.exc_value:
            before(error)

    threading.excepthook = print_others
    try:
        yield
    finally:
        threading.excepthook = before
