"""What a task is: the rules of one environment on (num_worlds, ...) arrays, without any loop over worlds."""

from collections.abc import Sequence
from typing import Any, Protocol

import mujoco
import numpy as np

from elastic_env.metrics import Metric
from elastic_env.robots.robot_model import RobotModel
from elastic_env.signals import Array, BoolArray, Signals, SignalTable
from elastic_env.simulation import Simulation


class Task(Protocol):
    """Rules of an environment, driven by `elastic_env.worlds.Worlds` in this order every control step.

    command → disturb → (physics) → sense → sample, reward_terms, failures, finished → observe

    What a step is scored by is kept in a sample, of which signals and masks are made when they are needed: together for
    many steps, whose samples are joined.
    """

    name: str
    model: mujoco.MjModel
    num_worlds: int
    num_substeps: int
    observation_table: SignalTable
    action_table: SignalTable
    metrics: Sequence[Metric]
    assumed_model: RobotModel

    @property
    def num_steps(self) -> int:
        """Control steps of an episode that does not fail."""
        ...

    def restart(self, simulation: Simulation, worlds: BoolArray, generators: Sequence[np.random.Generator]) -> None:
        """Begin new episodes in some worlds, a (num_worlds,) mask; one generator for every world of the batch."""
        ...

    def command(self, offset: Array) -> Array:
        """Servo inputs for command offsets, (num_worlds, n) [rad], already within bounds; ctrl, (num_worlds, nu)."""
        ...

    def disturb(self, simulation: Simulation) -> None:
        """Apply what acts on the robot from outside during the coming control period."""
        ...

    def sense(self, simulation: Simulation, healthy: BoolArray) -> None:
        """Take truth and measurements of the new state; worlds that are not healthy, having diverged, keep theirs."""
        ...

    def observe(self) -> Array:
        """A fresh observation, (num_worlds, len(observation_table))."""
        ...

    def sample(self) -> Any:
        """What signals and masks need of this step, `elastic_env.rows.Rows` that nothing changes later."""
        ...

    def signals(self, sample: Any) -> Signals:
        """Truth and scores of samples by name, one value per row."""
        ...

    def masks(self, sample: Any) -> dict[str, BoolArray]:
        """Samples that count in the metrics, "scored", and the parts of them that the metrics name, by row."""
        ...

    def reward_terms(self, sample: Any, diverged: BoolArray) -> dict[str, Array]:
        """Weighted terms whose sum is the reward, (num_worlds,) each."""
        ...

    def finished(self) -> BoolArray:
        """Worlds whose plan has come to its end."""
        ...

    def failures(self) -> dict[str, BoolArray]:
        """Worlds that failed, by reason."""
        ...

    def truth(self) -> Any:
        """Noise-free state and true parameters, for rewards, metrics and the oracle."""
        ...
