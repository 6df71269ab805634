r"""A policy whose offsets are learned from trial to trial on the robot itself.

It needs no simulation, no model beside that of its base, and no truth: the trials are episodes of
the environment that it is given, which may be hardware. What it has learned is a table of offsets
over the time of an episode.

The errors of a trial correct the offsets of the next one by iterative learning control:

.. math:: u_{j+1}(t) = Q \, [\, (1 - \lambda) \, u_j(t) + \gamma \, e_j(t + \ell) \,]

u is a table of offsets over the time of a trial and e the error that the sensors showed in trial j.
γ is the learning gain. It may fall as 1 / (1 + j/n), which averages the noise of later trials
[Saab2001]. A share λ is forgotten, so that noise does not add up where the plant hardly answers.
The lead ℓ makes up for the delay from an offset to its effect. Q is a low-pass filter without phase
shift, which stops learning where the delay is not known well enough [Longman2000, Elci2002]. With a
plant e = d − P u the error shrinks from trial to trial where, at all frequencies,

.. math:: | Q \, (1 - \lambda - \gamma \, e^{i \omega \ell} P) | < 1

[Bristow2006]; the wrong sign of γ diverges. With Q = 1, λ = 0 and P = p it is e_j = (1 − γ p)^j
e_0.

A push in one trial is no error of the robot. So an error may shrink by any amount from one trial to
the next, but it counts as grown, or as turned over, by no more than a surprise.

[Bristow2006] D. A. Bristow, M. Tharayil, A. G. Alleyne, "A Survey of Iterative Learning Control",
IEEE Control Systems Magazine 26(3). [Longman2000] R. W. Longman, "Iterative Learning Control and
Repetitive Control for Engineering Practice", International Journal of Control 73(10). [Saab2001] S.
S. Saab, "A Discrete-Time Stochastic Learning Control Algorithm", IEEE Trans. Automatic Control
46(6). [Elci2002] H. Elci, R. W. Longman, M. Q. Phan, J.-N. Juang, R. Ugoletti, "Simple Learning
Control Made Practical by Zero-Phase Filtering: Applications to Robotics", IEEE Trans. Circuits and
Systems I 49(6).

Signals are learned from trial to trial: errors, and the offsets that correct them.

| robot | error, by sensors alone | correction |
|---|---|---|
| walker | roll and pitch of the IMU | the same offset on both hip rolls, or on both hip pitches |
| walker | planned less measured ZMP | another ZMP of the plan, see `baselines.walking.zmp_shift` |
| joints | q_ref − q by link encoders, or by the IMU of the only link | the offset of the joint |

A positive offset of both hip rolls turns the pelvis to a negative roll, so the error is the roll
itself. The ZMP and the links follow their offsets, so their error is what was asked less what was
measured.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from typing_extensions import override

from baselines.adaptation.learned_signals import LearnedSignals
from baselines.adaptation.learning_law import limit_surprise, update
from baselines.compensation.policy import MemoryAround, Policy, PolicyAround, PolicyInputs, Step
from baselines.compensation.startup import Ramp
from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array, BoolArray
from elastic_env.world.robot_model import RobotModel

_RETREAT = 0.5
"""Share of the offsets that is kept after a trial that failed, such as by a fall."""


class LearnedOffsets(PolicyAround):
    """Any policy with a table of offsets added, row by row from the start of an episode.

    Args:
        policy: What commands the robot.
        model: Assumed robot.
        signals: What the columns of the table are.
        ramp_s: Time in which the offsets grow from zero [s].

    Attributes:
        tables: What was learned, for every world or for all of them alike, (num_worlds or 1, T, k).
    """

    memory_type = np.int64
    """Control steps since the start of the episode."""

    def __init__(
        self, policy: Policy, model: RobotModel, signals: LearnedSignals, ramp_s: float
    ) -> None:
        super().__init__(policy, model)
        self._signals = signals
        self._ramp = Ramp(model, ramp_s)
        self._period_s = model.control_period_s
        self.tables = np.zeros((1, 1, len(signals.names)))
        self._offsets = np.zeros((1, 1, len(model.joint_names)))

    @property
    def names(self) -> tuple[str, ...]:
        """Of the columns, with their unit."""
        return self._signals.names

    def play(self, tables: Array) -> None:
        """Take other offsets, (num_worlds or 1, T, k).

        Row t acts in the period that ends t periods after the start.
        """
        share = self._ramp.share(np.arange(tables.shape[1], dtype=np.float64))[:, None]
        offsets = [self._signals.offsets(share * table) for table in tables]
        self._offsets = np.stack(offsets)
        self.tables = tables

    @override
    def act(self, rows: Array, memory: MemoryAround, inputs: PolicyInputs) -> Step:
        """After the last row of the table its offsets stay."""
        action, inner = self.policy.act(rows, memory.inner, inputs)
        steps = memory.own + 1
        tables = len(self._offsets)
        if tables not in (1, len(rows)):
            learned = f"learned in {tables} worlds, one each"
            raise ElasticError(f"the offsets were {learned}, and are played in {len(rows)}")
        row = np.minimum(steps, self._offsets.shape[1] - 1)
        offsets = self._offsets[np.arange(len(rows)) if tables > 1 else 0, row]
        return (action + offsets).astype(np.float32), MemoryAround(steps, inner)


@dataclass(frozen=True)
class Trial:
    """Result of a trial.

    Attributes:
        number: Of the trial, 0 for the first, which has no offsets yet.
        error: Measured errors, (num_worlds, T, k); nan where there is none.
        failed: Worlds whose trial ended before its time, (num_worlds,).
        metrics: Metrics of every world's episode, for people: nothing is learned of them.
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
    """`LearnedOffsets` that learns them before it is scored; each world learns on its own robot.

    Args:
        policy: What commands the robot.
        model: Assumed robot.
        signals: Errors, offsets, gains.
        ramp_s: Time in which the offsets grow from zero [s].
    """

    trials = 10
    """Number of trials that it learns from."""

    def rehearse(self, env: Any, seed: int, told: Any = None) -> None:
        """Learn on the robots that `env.reset(seed=seed)` draws; earlier learning is dropped.

        Args:
            env: The environment that the policy was made for, scalar or vector.
            seed: World i has the robot of seed + i, in every trial with other noise.
            told: Called with each `Trial`.
        """
        stage = Stage(env, seed)
        shape = (stage.num_worlds, stage.num_steps + 1, len(self.names))
        tables = np.zeros(shape)
        before = np.full(shape, np.inf)
        for number in range(self.trials):
            self.play(tables)
            trial = stage.trial(self, self._signals, number)
            tables, before = self._learn(tables, before, trial)
            if told is not None:
                told(trial)
        self.play(tables)

    def _learn(self, tables: Array, before: Array, trial: Trial) -> tuple[Array, Array]:
        """Tables of the next trial, and what was credible of the errors."""
        gains = self._signals.gains
        surprise = np.array([own.surprise for own in gains])
        # where nothing came before, all is credible
        known = np.where(np.isfinite(before), before, np.nan_to_num(trial.error))
        errors = limit_surprise(trial.error, known, surprise)
        following = np.empty_like(tables)
        for world, table in enumerate(tables):
            following[world] = update(table, errors[world], gains, self._period_s, trial.number)
        failed = trial.failed[:, None, None]
        tables = np.where(failed, _RETREAT * tables, following)
        return tables, np.where(failed, before, errors)


class Stage:
    """An environment in which the same robots do trial after trial.

    Args:
        env: It, scalar or vector.
        seed: World i has the robot of seed + i.
    """

    def __init__(self, env: Any, seed: int) -> None:
        count = getattr(env.unwrapped, "num_envs", None)
        self._env = env
        self._is_scalar = count is None
        self.num_worlds = count or 1
        self.num_steps: int = env.unwrapped.task.num_steps
        self._robots = [seed + world for world in range(self.num_worlds)]

    def trial(self, policy: Policy, signals: LearnedSignals, number: int) -> Trial:
        """Play an episode in every world.

        Its noise depends on the robot's seed and the number of the trial alone.
        """
        n = self.num_worlds
        is_scalar = self._is_scalar
        seeds: Any = [_seed_of_noise(robot, number) for robot in self._robots]
        robots: Any = self._robots
        if is_scalar:
            seeds = seeds[0]
            robots = robots[0]
        seen, _ = self._env.reset(seed=seeds, options={"robot_seed": robots})
        seen = np.atleast_2d(seen)
        error = np.full((n, self.num_steps + 1, len(signals.names)), np.nan)
        over = np.zeros(n, dtype=np.bool_)
        failed = np.zeros(n, dtype=np.bool_)
        metrics: list[Mapping[str, float]] = [{}] * n
        state = None
        start = np.ones(n, dtype=np.bool_)
        for step in range(1, self.num_steps + 1):
            action, state = policy.predict(seen, state, start, deterministic=True)
            asked = seen
            command = action[0] if is_scalar else action
            seen, _, terminated, truncated, info = self._env.step(command)
            seen = np.atleast_2d(seen)
            terminated = np.atleast_1d(terminated)
            start = terminated | truncated
            running = ~over & ~terminated
            error[running, step] = signals.error(asked, seen, info)[running]
            for world in np.flatnonzero(start & ~over).tolist():
                found = info.get("final_info", info)["episode_metrics"].items()
                own = {k: v if is_scalar else v[world] for k, v in found}
                metrics[world] = {name: float(value) for name, value in own.items()}
            failed = failed | (terminated & ~over)
            over = over | start
            if over.all():
                break
        return Trial(number, error, failed, metrics)


def _seed_of_noise(robot: int, number: int) -> int:
    """Seed of a trial's noise, unlike that of any other trial and of the robot's own episode."""
    sequence = np.random.SeedSequence([robot, number])
    return int(sequence.generate_state(1, np.uint64)[0] >> 1)
