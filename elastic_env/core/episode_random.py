"""Random generators of an episode: one of the robot, which can walk again, and one of the trial.

A robot is what lasts: its joints, the offsets of its sensors, the ground under it, and where a
motion is drawn, the motion. A trial is what does not: noise, pushes. `reset(options={"robot_seed":
s})` begins a trial of the robot that `reset(seed=s)` draws, under noise of its own.
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
        robot: Draws the robot; and the trial too where there is no other.
        trial: Draws the trial of a robot that was drawn before; None for one that is new.
    """

    robot: np.random.Generator
    trial: np.random.Generator | None = None

    def draw_trial(self, draw: Callable[[np.random.Generator], T]) -> T:
        """Something that differs from trial to trial.

        It is drawn of both, so that what is drawn of the robot afterwards is the same in all its
        trials.
        """
        drawn = draw(self.robot)
        return drawn if self.trial is None else draw(self.trial)

    def fork(self) -> np.random.Generator:
        """A generator of its own for more of the robot, which leaves all other draws as they are.

        A robot's is the same in all its trials.
        """
        ahead = copy.deepcopy(self.robot)
        return np.random.default_rng([int(ahead.integers(2**63)), 1])

    def noise(self) -> np.random.Generator:
        """A generator of its own for noise."""
        return np.random.default_rng(
            self.draw_trial(lambda generator: int(generator.integers(2**63)))
        )
