"""Random generators of an episode: one for the robot, which can walk again, one for the trial.

A robot is everything that stays: its joints, the offsets of its sensors, the ground under it, and
its motion where motions are drawn. A trial is everything that changes: noise, pushes.
`reset(options={"robot_seed": s})` begins a new trial of the robot that `reset(seed=s)` draws.
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

T = TypeVar("T")


@dataclass(frozen=True)
class EpisodeRandom:
    """Generators of one world's new episode.

    Attributes:
        robot: Draws the robot, and the trial of a new robot.
        trial: Draws the trial of a robot that was drawn before; None for a new robot.
    """

    robot: np.random.Generator
    trial: np.random.Generator | None = None

    def draw_trial(self, draw: Callable[[np.random.Generator], T]) -> T:
        """Draw something that differs from trial to trial.

        Both generators draw, so that later draws of the robot are the same in all its trials.
        """
        drawn = draw(self.robot)
        return drawn if self.trial is None else draw(self.trial)

    def fork(self) -> np.random.Generator:
        """Return a further generator for the robot, which leaves all other draws as they are.

        It is the same in all trials of a robot.
        """
        ahead = copy.deepcopy(self.robot)
        return np.random.default_rng([int(ahead.integers(2**63)), 1])

    def noise(self) -> np.random.Generator:
        """Return a generator for noise."""
        return np.random.default_rng(
            self.draw_trial(lambda generator: int(generator.integers(2**63)))
        )
