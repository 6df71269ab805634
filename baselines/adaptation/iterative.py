"""Policies whose offsets are learned from trial to trial on the robot itself.

Learning needs no simulation, no model except that of the base, and no truth. The trials are
episodes of the given environment, which may be hardware. The result is a table of offsets over the
time of an episode. `baselines.adaptation.learning_law` has the equation, and
`baselines.adaptation.learned_signals` the errors and offsets.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from typing_extensions import override

from baselines.adaptation.learned_signals import LearnedSignals
from baselines.adaptation.learning_law import limit_surprise, update
from baselines.compensation.policy import Policy, PolicyInputs, Step
from baselines.compensation.policy_around import MemoryAround, PolicyAround
from baselines.compensation.ramp import Ramp
from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array, BoolArray
from elastic_env.world.robot_model import RobotModel

_SHARE_AFTER_FAILURE = 0.5
"""Share of the offsets that remains after a failed trial, such as a fall."""


class LearnedOffsets(PolicyAround):
    """Any policy with a table of offsets added, row by row from the start of an episode.

    Args:
        policy: Commands the robot.
        model: Assumed robot.
        signals: Signals of the columns of the table.
        ramp_s: Time in which the offsets grow from zero [s].

    Attributes:
        tables: Learned offsets, one table per world or one for all, (num_worlds or 1, T, k).
    """

    memory_type = np.int64
    """Control steps since the start of the episode."""

    def __init__(
        self, policy: Policy, model: RobotModel, signals: LearnedSignals, ramp_s: float
    ) -> None:
        super().__init__(policy, model)
        self._signals = signals
        self.names = signals.names
        """Names of the columns, with their unit."""
        self._ramp = Ramp(model, ramp_s)
        self._period_s = model.control_period_s
        self.tables = np.zeros((1, 1, len(signals.names)))
        self._offsets = np.zeros((1, 1, len(model.joint_names)))

    def play(self, tables: Array) -> None:
        """Use other offsets, (num_worlds or 1, T, k).

        Row t acts in the period that ends t periods after the start.
        """
        share = self._ramp.share(np.arange(tables.shape[1], dtype=np.float64))[:, None]
        self._offsets = np.stack([self._signals.offsets(share * t) for t in tables])
        self.tables = tables

    @override
    def act(self, rows: Array, memory: MemoryAround, inputs: PolicyInputs) -> Step:
        """Act with the offsets of this control step; after the last row they stay."""
        action, inner = self.policy.act(rows, memory.inner, inputs)
        steps = memory.own + 1
        tables = len(self._offsets)
        if tables not in (1, len(rows)):
            raise ElasticError(
                f"the offsets were learned in {tables} worlds, one each, and are"
                f" played in {len(rows)}"
            )
        row = np.minimum(steps, self._offsets.shape[1] - 1)
        offsets = self._offsets[np.arange(len(rows)) if tables > 1 else 0, row]
        return (action + offsets).astype(np.float32), MemoryAround(steps, inner)


@dataclass(frozen=True)
class Trial:
    """Result of a trial.

    Attributes:
        number: Number of the trial, 0 for the first, which has no offsets yet.
        error: Measured errors, (num_worlds, T, k); nan where there is none.
        failed: Worlds whose trial ended before its time, (num_worlds,).
        metrics: Metrics of every world's episode, for people; learning does not use them.
    """

    number: int
    error: Array
    failed: BoolArray
    metrics: Sequence[Mapping[str, float]]

    @property
    def error_rms(self) -> Array:
        """Root mean squares over the time, (num_worlds, k)."""
        return np.sqrt(np.nanmean(np.square(self.error), axis=1))


class IterativeLearner(LearnedOffsets):
    """`LearnedOffsets` that are learned before scoring; each world learns on its own robot.

    Args:
        policy: Commands the robot.
        model: Assumed robot.
        signals: Errors, offsets and gains.
        ramp_s: Time in which the offsets grow from zero [s].
    """

    trials = 10
    """Number of trials that it learns from."""

    def rehearse(self, env: Any, seed: int, report: Any = None) -> None:
        """Learn on the robots that `env.reset(seed=seed)` draws, from the beginning.

        Args:
            env: The environment that the policy was made for, scalar or vector.
            seed: World i has the robot of seed + i, in every trial with other noise.
            report: Called with each `Trial`.
        """
        trials = Trials(env, seed)
        shape = (trials.num_worlds, trials.num_steps + 1, len(self.names))
        tables = np.zeros(shape)
        before = np.full(shape, np.inf)
        for number in range(self.trials):
            self.play(tables)
            trial = trials.play(self, self._signals, number)
            tables, before = self._learn(tables, before, trial)
            if report is not None:
                report(trial)
        self.play(tables)

    def _learn(self, tables: Array, before: Array, trial: Trial) -> tuple[Array, Array]:
        """Tables of the next trial, and the limited errors of this one."""
        gains = self._signals.gains
        surprise = np.array([channel.surprise for channel in gains])
        # the first error of a world has no limit
        last = np.where(np.isfinite(before), before, np.nan_to_num(trial.error))
        errors = limit_surprise(trial.error, last, surprise)
        updated = np.empty_like(tables)
        for world, (table, error) in enumerate(zip(tables, errors, strict=True)):
            updated[world] = update(table, error, gains, self._period_s, trial.number)
        failed = trial.failed[:, None, None]
        tables = np.where(failed, _SHARE_AFTER_FAILURE * tables, updated)
        return tables, np.where(failed, before, errors)


class Trials:
    """Trials of the same robots, one after another.

    Args:
        env: The environment, scalar or vector.
        seed: World i has the robot of seed + i.
    """

    def __init__(self, env: Any, seed: int) -> None:
        count = getattr(env.unwrapped, "num_envs", None)
        self._env = env
        self._is_scalar = count is None
        self.num_worlds = count or 1
        self.num_steps: int = env.unwrapped.task.num_steps
        self._robots = [seed + world for world in range(self.num_worlds)]

    def play(self, policy: Policy, signals: LearnedSignals, number: int) -> Trial:
        """Play an episode in every world.

        Its noise depends on the robot's seed and the number of the trial only.
        """
        n = self.num_worlds
        is_scalar = self._is_scalar
        seeds = [_noise_seed(robot, number) for robot in self._robots]
        options = {"robot_seed": self._robots[0] if is_scalar else self._robots}
        after, _ = self._env.reset(seed=seeds[0] if is_scalar else seeds, options=options)
        after = np.atleast_2d(after)
        error = np.full((n, self.num_steps + 1, len(signals.names)), np.nan)
        over = np.zeros(n, dtype=np.bool_)
        failed = np.zeros(n, dtype=np.bool_)
        metrics: list[Mapping[str, float]] = [{}] * n
        state = None
        start = np.ones(n, dtype=np.bool_)
        for step in range(1, self.num_steps + 1):
            before = after
            action, state = policy.predict(before, state, start, deterministic=True)
            command = action[0] if is_scalar else action
            after, _, terminated, truncated, info = self._env.step(command)
            after = np.atleast_2d(after)
            terminated = np.atleast_1d(terminated)
            start = terminated | truncated
            is_running = ~over & ~terminated
            error[is_running, step] = signals.error(before, after, info)[is_running]
            for world in np.flatnonzero(start & ~over).tolist():
                values = info.get("final_info", info)["episode_metrics"].items()
                metrics[world] = {k: float(v if is_scalar else v[world]) for k, v in values}
            failed = failed | (terminated & ~over)
            over = over | start
            if over.all():
                break
        return Trial(number, error, failed, metrics)


def _noise_seed(robot: int, number: int) -> int:
    """Seed of a trial's noise, different for every trial, and from the seed of the robot."""
    sequence = np.random.SeedSequence([robot, number])
    return int(sequence.generate_state(1, np.uint64)[0] >> 1)
