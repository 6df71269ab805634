"""N worlds of one task: the control step that scalar and vector environments share."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import numpy.typing as npt

from elastic_env.core.compiled import compile_now, compiled
from elastic_env.core.draws import Draws
from elastic_env.core.errors import ActionError
from elastic_env.core.rows import Rows
from elastic_env.core.signals import Array, BoolArray, Signals
from elastic_env.runtime.metrics import EpisodeMetrics
from elastic_env.runtime.physics import Simulation, simulate
from elastic_env.runtime.step_info import StepInfo
from elastic_env.runtime.task import DIVERGED_ROW, TERMINATED_ROW, TRUNCATED_ROW, Task

DIVERGED = "diverged"
"""Reason of termination where the simulation produced a bad number; MuJoCo alone would restart it silently."""


class Transition(NamedTuple):
    """Result of a control step, one row per world."""

    observation: Array
    reward: Array
    terminated: BoolArray
    truncated: BoolArray
    info: dict[str, Any]

    @property
    def done(self) -> BoolArray:
        """Worlds whose episode is over."""
        return self.terminated | self.truncated


_SCORED_ROWS, _FEWEST_STEPS, _MOST_STEPS = 4096, 16, 256
"""Rows (steps of all worlds) whose signals are computed together, and how many steps that can be."""


@dataclass(frozen=True, slots=True)
class _Sample(Rows):
    """What the scores of a step need: the task's sample, which actions were out of bounds, and where it diverged."""

    of_task: Rows
    is_clipped: BoolArray
    diverged: BoolArray


class Worlds:
    """Runs a task in many worlds: checks actions, advances physics, adds up metrics, says why episodes end.

    Args:
        task: The rules.
        num_threads: Threads of the physics, 0 for all cores; results do not depend on it.
        is_scalar: Whether errors speak of one world, whose action has no axis of worlds.
        simulation: What moves instead of MuJoCo, such as hardware.
    """

    def __init__(
        self, task: Task, num_threads: int = 0, is_scalar: bool = False, simulation: Simulation | None = None
    ) -> None:
        self.task = task
        self._is_scalar = is_scalar
        self.simulation = simulation or simulate(task.model, task.num_worlds, num_threads)
        self._bound = task.action_table.space(np.float32).high.astype(np.float64)
        self._shape = (task.num_worlds, len(self._bound))
        self._metrics = EpisodeMetrics(task.metrics, task.num_worlds)
        self._begun, self._is_begun = np.zeros(task.num_worlds, dtype=np.bool_), False
        self._samples: list[tuple[Any, ...]] = []  # of `_Sample`s to be
        at_once = min(max(_SCORED_ROWS // task.num_worlds, _FEWEST_STEPS), _MOST_STEPS)
        # many take 2 ms, half a control period of hardware
        self._scored_at_once = at_once if simulation is None else _FEWEST_STEPS
        self._failures = (DIVERGED, *task.failure_names)
        self._no_reason = np.full(task.num_worlds, "", dtype="<U1")
        self._no_reason.flags.writeable = False
        compile_now(self._checked, np.zeros(self._shape))  # the first step of a motion cannot wait

    @property
    def num_worlds(self) -> int:
        """Number of worlds."""
        return self.task.num_worlds

    def restart(self, worlds: BoolArray, draws: Sequence[Draws]) -> None:
        """Begin new episodes in some worlds, a (num_worlds,) mask, each from its own generators."""
        self.score_samples()
        self.simulation.restart(worlds)
        self.task.restart(self.simulation, worlds, draws)
        self._metrics.restart(worlds)
        self._begun = self._begun | worlds
        self._is_begun = bool(self._begun.all())

    def signals(self) -> Signals:
        """Truth and scores of the present state by name, (num_worlds,) each."""
        return self.task.signals(self.task.sample())

    def step(self, action: npt.ArrayLike) -> Transition:
        """One control period under the actions, (num_worlds, n) [rad].

        Raises:
            ActionError: Wrong shape, or a value that is not finite.
            ResetNeeded: A world has not begun an episode yet.
        """
        if not self._is_begun:
            some = f", of the worlds {np.flatnonzero(~self._begun).tolist()} too" if self._begun.any() else ""
            raise gymnasium.error.ResetNeeded(f"reset() comes before the first step(){some}")
        offset, is_clipped = self._checked(action)
        self.task.command(offset, self.simulation.ctrl)
        self.task.disturb(self.simulation)
        self.simulation.advance(self.task.num_substeps)
        observation, of_task, reward, ends, is_over = self.task.sense(self.simulation, self.simulation.diverged())
        sample = of_task, is_clipped, ends[DIVERGED_ROW]
        self._samples.append(sample)
        terminated, truncated = ends[TERMINATED_ROW], ends[TRUNCATED_ROW]
        reason = self._reasons(ends) if is_over else self._no_reason
        info = StepInfo({"termination": reason}, partial(self._rest, sample))
        if is_over:
            self.score_samples()
            info["episode_metrics"] = {**self._metrics.values(), **dict(zip(self._failures, ends, strict=False))}
        elif len(self._samples) >= self._scored_at_once:
            self.score_samples()
        return Transition(observation, reward, terminated, truncated, info)

    def _rest(self, sample: tuple[Any, ...]) -> dict[str, Any]:
        """What a step tells of itself when somebody looks at it."""
        whole = _Sample(*sample)
        return {"reward_terms": self.task.reward_terms(whole.of_task), **self._signals(whole)}

    def _signals(self, sample: "_Sample") -> Signals:
        clipped = sample.is_clipped.astype(np.float64)
        return {**self.task.signals(sample.of_task), "clipped": clipped}

    def score_samples(self) -> None:
        """Take into the metrics what the last steps have left; when that happens makes no difference to them."""
        if not self._samples:
            return
        shape = (len(self._samples), self.num_worlds)
        joined = _Sample.joined([_Sample(*sample) for sample in self._samples])
        self._samples = []
        masks = self.task.masks(joined.of_task)
        if joined.diverged.any():
            masks = {name: mask & ~joined.diverged for name, mask in masks.items()}
        masks["all"] = np.ones(shape, dtype=np.bool_)
        signals = {name: signal.reshape(shape) for name, signal in self._signals(joined).items()}
        self._metrics.update(signals, {name: mask.reshape(shape) for name, mask in masks.items()})

    def _checked(self, action: npt.ArrayLike) -> tuple[Array, BoolArray]:
        """Offsets within the bounds, and where an action was beyond them, (num_worlds,)."""
        given = np.asarray(action)
        if given.dtype.kind not in "fiub" or given.shape != self._shape:
            raise self._refused(given)
        offset, is_clipped = given.astype(np.float64, order="C"), np.empty(len(given), dtype=np.bool_)
        if not _clip(offset, self._bound, is_clipped):
            raise self._refused(given.astype(np.float64))
        return offset, is_clipped

    def _reasons(self, ends: BoolArray) -> npt.NDArray[np.str_]:
        """Reason of termination of every world, the first that applies, "" where there is none."""
        reasons = np.full(self.num_worlds, "", dtype=f"<U{max(map(len, self._failures))}")
        for reason, failed in reversed([*zip(self._failures, ends, strict=False)]):
            reasons[failed] = reason
        return reasons

    def _refused(self, given: npt.NDArray[Any]) -> ActionError:
        """What is wrong with an action."""
        shape, bounds = self._shape, f"within ±{self._bound.max():g} rad"
        if given.dtype.kind not in "fiub":
            return ActionError(f"an action must be real numbers, {bounds}, got an array of {given.dtype}")
        if given.shape != shape:
            # a scalar environment adds the axis of worlds itself
            expected, found = (shape[1:], given.shape[1:]) if self._is_scalar else (shape, given.shape)
            return ActionError(f"an action must have shape {expected} [rad], {bounds}; got shape {found}")
        world = np.flatnonzero(~np.isfinite(given).all(axis=1))[0]
        return ActionError(
            f"an action must be finite, {bounds}, shape {shape[1:]} a world; got {given[world]} in world {world}"
        )


@compiled
def _clip(action: Array, bound: Array, is_clipped: BoolArray) -> bool:
    """Bring actions within their bounds, and mark the rows that were beyond; False where a number is not finite."""
    for row in range(len(action)):
        is_clipped[row] = False
        for i in range(len(bound)):
            value = action[row, i]
            if not np.isfinite(value):
                return False
            action[row, i] = min(max(value, -bound[i]), bound[i])
            if action[row, i] != value:
                is_clipped[row] = True
    return True
