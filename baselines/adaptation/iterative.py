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

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from typing_extensions import override

from baselines.compensation.measured import LINK_ENCODER
from baselines.compensation.policy import MemoryAround, Policy, PolicyAround, PolicyInputs, Step
from baselines.compensation.startup import Ramp
from baselines.walking.mean_zmp import FlatFeet
from baselines.walking.posture import hip_offsets
from baselines.walking.zmp_shift import zmp_shift_offsets
from elastic_env.core.config import Model, quantity
from elastic_env.core.errors import ConfigurationError, ElasticError
from elastic_env.core.signals import Array, BoolArray
from elastic_env.world.robot_model import RobotModel, WalkerModel

_ORDER = 2  # of the filter, which acts twice


class ChannelGains(Model):
    """How one error, in its own unit, corrects its offset."""

    gain: float = quantity("offset/error", ge=0)
    """Learning gain γ [offset/error]."""
    lead_s: float = quantity("s", ge=0, le=1)
    """Lead ℓ: delay from an offset to its effect [s]."""
    cutoff_hz: float = quantity("Hz", gt=0, le=100)
    """Frequency at which Q halves the amplitude [Hz]."""
    surprise: float = quantity("error", gt=0)
    """By how much an error can grow from trial to trial [error]."""
    limit: float = quantity("offset", gt=0)
    """Largest offset [offset]."""
    forgetting: float = quantity("1", 0.0, ge=0, lt=1)
    """Share λ of the offset that is forgotten [1]."""
    halved_after: float | None = quantity("trials", None, gt=0)
    """Trials n that halve γ; None keeps it [trials]."""

    def gain_of(self, trial: int) -> float:
        """Learning gain of a trial, 0 for the first."""
        if self.halved_after is None:
            return self.gain
        return self.gain / (1.0 + trial / self.halved_after)


def zero_phase(table: Array, cutoff_hz: float, period_s: float) -> Array:
    """Q: a low-pass filter that runs forwards and backwards in time, so that it shifts no phase.

    Args:
        table: Values over time, (T, ...).
        cutoff_hz: Where the amplitude is halved [Hz].
        period_s: Time between rows [s].
    """
    # here: most programs need none of it, and it loads for half a second
    from scipy import signal

    sections = signal.butter(_ORDER, cutoff_hz, fs=1.0 / period_s, output="sos")
    longest = round(1.0 / (cutoff_hz * period_s))  # a period of the cutoff at both ends
    length = min(longest, len(table) - 1)
    return signal.sosfiltfilt(sections, table, axis=0, padlen=length)


def lead_error(error: Array, steps: int) -> Array:
    """Error that comes some steps later, at every step, (T, ...); its last value behind the end."""
    return error[np.minimum(np.arange(len(error)) + steps, len(error) - 1)]


def limit_surprise(error: Array, before: Array, surprise: float | Array) -> Array:
    """An error as far as that of the trial before makes it credible, elementwise.

    Args:
        error: Of this trial, nan where it was not measured, which counts as none.
        before: What was credible in the trial before.
        surprise: By how much an error can grow, in its unit.
    """
    low = np.minimum(before, 0.0) - surprise
    high = np.maximum(before, 0.0) + surprise
    return np.clip(np.nan_to_num(error), low, high)


def update(
    table: Array, error: Array, gains: Sequence[ChannelGains], dt: float, trial: int = 0
) -> Array:
    """Offsets of the next trial, see the module.

    Args:
        table: Offsets of this trial, (T, k), a column for each of the gains.
        error: What is to be corrected, at the same times, (T, k).
        gains: Of the columns.
        dt: Time between rows [s].
        trial: Number of this trial, 0 for the first.
    """
    following = np.empty_like(table)
    for column, own in enumerate(gains):
        leading = lead_error(error[:, column], round(own.lead_s / dt))
        kept = (1.0 - own.forgetting) * table[:, column]
        wanted = kept + own.gain_of(trial) * leading
        smooth = zero_phase(wanted, own.cutoff_hz, dt)
        following[:, column] = np.clip(smooth, -own.limit, own.limit)
    return following


LINK_IMU = "link_angle_imu"
_LEAST_LOAD = 0.15  # share of the weight below which there is no ZMP

_ZMP = ChannelGains(gain=0.6, lead_s=0.26, cutoff_hz=2.0, surprise=0.006, limit=0.06)
_ZMP = _ZMP.replace(forgetting=0.1, halved_after=3.0)


class LearningGains(Model):
    """How the offsets of `iterative` are learned."""

    trials: int = quantity("1", 10, ge=1, le=1000)
    """Trials, such as walks, that it learns from [1]."""
    attitude: ChannelGains = ChannelGains(
        gain=2.0, lead_s=0.032, cutoff_hz=6.0, surprise=1.5e-3, limit=0.08
    )
    """Walker: hip angle per tilt of the pelvis [1], in rad."""
    zmp_x: ChannelGains = _ZMP
    """Walker: forward shift of the planned ZMP per deviation of the ZMP [1], in m."""
    zmp_y: ChannelGains = _ZMP
    """Walker: the same to the left."""
    joint: ChannelGains = ChannelGains(
        gain=0.5, lead_s=0.08, cutoff_hz=1.4, surprise=0.01, limit=0.2
    )
    """Robots on a fixed base: offset per error of the link [1], in rad."""


class LearnedSignals(Protocol):
    """Errors that are corrected, and how."""

    names: tuple[str, ...]
    """Of the columns, with their unit."""
    gains: tuple[ChannelGains, ...]
    """Of the columns."""

    @abstractmethod
    def error(self, asked: Array, seen: Array, info: Mapping[str, Any]) -> Array:
        """Errors measured after a control step, (num_worlds, k); nan where nothing was measured.

        Args:
            asked: Observations before the step, whose reference is that of its end, (num_worlds,
                m).
            seen: Observations after it.
            info: What the environment says of it.
        """

    @abstractmethod
    def offsets(self, table: Array) -> Array:
        """Offsets of the joints for a table over time, (T, k) to (T, n) [rad]."""


class WalkSignals(LearnedSignals):
    """Attitude and ZMP of a walker, see the module.

    Args:
        model: Assumed walker.
        gains: How they are learned.
    """

    names: tuple[str, ...] = ("roll_rad", "pitch_rad", "zmp_x_m", "zmp_y_m")

    def __init__(self, model: WalkerModel, gains: LearningGains) -> None:
        self.gains = (gains.attitude, gains.attitude, gains.zmp_x, gains.zmp_y)
        table = model.observation_table
        self._model = model
        self._feet = FlatFeet(model, _LEAST_LOAD * model.biped.weight)
        self._attitude = table.group("imu_attitude")
        self._wrench = table.group("wrench")

    @override
    def error(self, asked: Array, seen: Array, info: Mapping[str, Any]) -> Array:
        """Tilt, and error of the ZMP of feet that are flat where planned, (num_worlds, 4)."""
        error = self._feet.zmp_error(asked, seen[:, self._wrench])
        return np.hstack([seen[:, self._attitude], -error])

    @override
    def offsets(self, table: Array) -> Array:
        return hip_offsets(table[:, :2]) + zmp_shift_offsets(self._model, table[:, 2:])


class JointSignals(LearnedSignals):
    """Links of a robot on a fixed base, see the module.

    Args:
        model: Assumed robot.
        gains: How they are learned.

    Raises:
        ConfigurationError: Nothing shows its links.
    """

    def __init__(self, model: RobotModel, gains: LearningGains) -> None:
        joints = model.joint_names
        table = model.observation_table
        self.names = tuple(f"{joint}_rad" for joint in joints)
        self.gains = (gains.joint,) * len(joints)
        self._reference = table.group("reference_angle")
        has_encoders = LINK_ENCODER in {name.split(".")[0] for name in table.names}
        self._encoder = table.group(LINK_ENCODER) if has_encoders else None
        if self._encoder is None and len(joints) > 1:
            raise ConfigurationError(
                f"learning the offsets of {len(joints)} joints needs their links measured; make the"
                f" environment with sensors=[{LINK_ENCODER!r}]"
            )

    @override
    def error(self, asked: Array, seen: Array, info: Mapping[str, Any]) -> Array:
        by_imu = self._encoder is None
        link = np.reshape(info[LINK_IMU], (-1, 1)) if by_imu else seen[:, self._encoder]
        return asked[:, self._reference] - link

    @override
    def offsets(self, table: Array) -> Array:
        return table


def learned_signals(model: RobotModel, gains: LearningGains) -> LearnedSignals:
    """Signals that are learned of a robot."""
    if isinstance(model, WalkerModel):
        return WalkSignals(model, gains)
    return JointSignals(model, gains)


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
