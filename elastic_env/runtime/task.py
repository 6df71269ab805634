"""What a task is: the rules of one environment on (num_worlds, ...) arrays."""

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import mujoco

from elastic_env.core.draws import Draws
from elastic_env.core.signals import Array, BoolArray, Signals, SignalTable
from elastic_env.runtime.metrics import Metric
from elastic_env.runtime.physics import Simulation
from elastic_env.runtime.robot_model import RobotModel

DIVERGED_ROW, TERMINATED_ROW, TRUNCATED_ROW = 0, -2, -1
"""Rows of `Outcome.ends`; behind the first stands one for each of `Task.failure_names`."""


class Outcome(NamedTuple):
    """What a control step came to, one column or row per world.

    Attributes:
        observation: (num_worlds, len(observation_table)).
        sample: What signals and masks need of this step, `elastic_env.core.rows.Rows` that nothing changes later.
        reward: (num_worlds,).
        ends: Whether the world diverged, failed, is terminated and is truncated, see `DIVERGED_ROW`.
        is_over: Whether any world is.
    """

    observation: Array
    sample: Any
    reward: Array
    ends: BoolArray
    is_over: bool


class Task(Protocol):
    """Rules of an environment, driven by `elastic_env.runtime.worlds.Worlds` in this order every control step.

    command → disturb → (physics) → sense

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
    failure_names: tuple[str, ...]
    assumed_model: RobotModel

    @property
    def num_steps(self) -> int:
        """Control steps of an episode that does not fail."""
        ...

    def restart(self, simulation: Simulation, worlds: BoolArray, draws: Sequence[Draws]) -> None:
        """Begin new episodes in some worlds, a (num_worlds,) mask; one of `draws` for every world of the batch."""
        ...

    def command(self, offset: Array, inputs: Array) -> None:
        """Command offsets, (num_worlds, n) [rad], already within bounds, as inputs of the servos, (num_worlds, nu)."""
        ...

    def disturb(self, simulation: Simulation) -> None:
        """Apply what acts on the robot from outside during the coming control period."""
        ...

    def sense(self, simulation: Simulation, diverged: BoolArray) -> Outcome:
        """Take truth and measurements of the new state, which worlds that diverged do not have; score it."""
        ...

    def observe(self) -> Array:
        """A fresh observation of the present state, (num_worlds, len(observation_table))."""
        ...

    def sample(self) -> Any:
        """As `Outcome.sample`, of the present state."""
        ...

    def signals(self, sample: Any) -> Signals:
        """Truth and scores of samples by name, one value per row."""
        ...

    def reward_terms(self, sample: Any) -> dict[str, Array]:
        """Weighted terms whose sum is the reward, one value per row."""
        ...

    def masks(self, sample: Any) -> dict[str, BoolArray]:
        """Samples that count in the metrics, "scored", and the parts of them that the metrics name, by row."""
        ...

    def truth(self) -> Any:
        """Noise-free state and true parameters, for rewards, metrics and the oracle."""
        ...
