"""Features that decide a residual: from the observation, the plan and the model.

| name | meaning |
|---|---|
| a group or a signal of the observation, such as `clock` or `clock.swing` | the same |
| `observation` | all groups |
| `encoder_error` | encoder angles less reference angles, which are small compared with both [rad] |
| `link_error` | with encoders on the links: reference angles less the links' angles, small too [rad] |
| `contact_error` | walker: measured ZMP [m] and load share [1] as on level ground, less the planned ones |
| `zmp_error` | walker: measured ZMP of flat feet less the planned one [m], with the effect of the ground's tilt |
| `zmp_of_steps` | walker: mean `zmp_error` in the last step on either foot |
| `level` | walker: attitude and foot wrenches as on level ground (`baselines.estimation.level_ground`) |
| `bending` | walker: relative error of the model's bending, and the load (`baselines.estimation.model_error`) |
| `phase` | walker: the first eight harmonics of the phase of a step [1] |
| `standing`, `zmp_offset`, `feet`, `landing`, `shear` | estimates of the robot by a base such as `foothold`, from its memory |
| `base_action` | present command of the base alone [rad] |
"""  # noqa: E501

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from baselines.compensation.memory_rows import put_rows, select_rows
from baselines.compensation.policy import ObservationView
from baselines.estimation.level_ground import GroundMemory, LevelGround
from baselines.estimation.model_error import BendingObserver
from baselines.residual.correction import Corrected
from baselines.residual.mirror import LeftFirst
from baselines.residual.true_robot import true_robot
from baselines.walking.flat_feet import LEAST_LOAD, FlatFeet
from baselines.walking.foothold import OF_FEET
from baselines.walking.phase_table import harmonics, stride_angle
from baselines.walking.zmp_offset import IN_PLANE
from elastic_env.core.errors import ConfigurationError, unknown_name
from elastic_env.core.signals import Array, BoolArray, Signal, SignalGroup, rename_group
from elastic_env.motion.trajectory import STAND_S
from elastic_env.world.robot_model import RobotModel, WalkerModel

OBSERVATION = "observation"
BASE_ACTION = "base_action"


class FeaturesMemory(NamedTuple):
    """Memory of the features.

    Attributes:
        past: Measurements of the last decisions, (num_worlds, history · k), the latest first.
        sources: Memory of the sources.
    """

    past: Array
    sources: tuple[Any, ...]


class Features:
    """Features that decide a residual, in the order of the settings.

    After them come the truth of a teacher, the base's action, and earlier measurements.

    Args:
        corrected: The base and its correction.

    Attributes:
        signals: Signals of the present decision.
        columns: All features; `NAME@-k` is a measurement of k decisions ago.
        mirror: Shows steps on the right foot as steps on the left; None without.

    Raises:
        ConfigurationError: A name that does not exist, or not for this robot.
    """

    def __init__(self, corrected: Corrected) -> None:
        settings = corrected.settings
        model = corrected.model
        self._corrected = corrected
        period_s = settings.decision_period * model.control_period_s
        names = _source_names(settings.observe, model)
        self._sources = [_source(name, corrected, period_s) for name in names]
        if settings.privileged:
            signals, read = true_robot(settings.privileged, model, corrected.truth)
            self._sources.append(_Instant(signals, lambda rows: read()))  # noqa: ARG005
        self._reads_base = [getattr(s, "reads_base", False) for s in self._sources]
        self._has_action = BASE_ACTION in settings.observe
        present = [signal for source in self._sources for signal in source.signals]
        self._measured = np.flatnonzero([s.kind == "measured" for s in present])
        self._history = settings.history
        commands = model.observation_table.signals_of("last_command")
        action = rename_group(commands, BASE_ACTION) if self._has_action else ()
        self.signals = (*present, *action)
        measured = [present[i] for i in self._measured]
        earlier = [
            replace(signal, name=f"{signal.name}@-{k + 1}")
            for k in range(self._history)
            for signal in measured
        ]
        self.columns = (*self.signals, *earlier)
        self.width = len(self.columns)
        """Number of features."""
        self.mirror = LeftFirst(self.columns, corrected) if settings.mirror else None

    def begin(self, num_worlds: int) -> FeaturesMemory:
        """Memory before the first decision."""
        past = np.zeros((num_worlds, self._history * len(self._measured)))
        return FeaturesMemory(past, tuple(s.begin(num_worlds) for s in self._sources))

    def at(
        self, rows: Array, memory: Any, is_first: BoolArray, state: Any, episode_start: Any
    ) -> tuple[Array, FeaturesMemory]:
        """Features of a decision, and the memory for the next one.

        Args:
            rows: Observations, (num_worlds, m).
            memory: Memory of the last decision; None at the first.
            is_first: Worlds that decide for the first time in their episode.
            state: State of the corrected policy.
            episode_start: Worlds whose episode begins, for the policy.

        Returns:
            (num_worlds, width), and the memory.
        """
        last = self.begin(len(rows))
        if memory is None:
            is_first = np.ones_like(is_first)
        else:
            last = put_rows(memory, is_first, select_rows(last, is_first))
        memories = last.sources
        if any(self._reads_base):
            base = self._corrected.base_memory(rows, state, episode_start)
            pairs = zip(self._reads_base, memories, strict=True)
            memories = [base if reads_base else source for reads_base, source in pairs]
        pairs = zip(self._sources, memories, strict=True)
        observed = [source.observe(rows, memory) for source, memory in pairs]
        present = np.hstack([np.zeros((len(rows), 0)), *(v for v, _ in observed)])
        measured = present[:, self._measured]
        repeated = np.tile(measured, (1, self._history))
        past = np.where(is_first[:, None], repeated, last.past)
        parts = [present]
        if self._has_action:
            action = self._corrected.base_action(rows, state, episode_start)
            parts.append(action.astype(np.float64))
        features = np.hstack([*parts, past])
        if self.mirror is not None:
            features = self.mirror(rows, features)
        next_past = np.hstack([measured, past])[:, : past.shape[1]]
        return features, FeaturesMemory(next_past, tuple(m for _, m in observed))

    def turn_back(self, rows: Array, residual: Array) -> Array:
        """Residual as it acts, turned back where it was decided in the mirror, (num_worlds, k).

        Args:
            rows: Observations of the decision.
            residual: Decision by their features.
        """
        return residual if self.mirror is None else self.mirror.turn_back(rows, residual)


def _groups(model: RobotModel) -> list[str]:
    """Groups of a robot's observation, in order."""
    names = model.observation_table.names
    return list(dict.fromkeys(name.split(".")[0] for name in names))


def _source_names(observe: tuple[str, ...], model: RobotModel) -> list[str]:
    """Names of the sources, with all groups for the whole observation."""
    names: list[str] = []
    for name in observe:
        names += _groups(model) if name == OBSERVATION else [name]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ConfigurationError(
            f"observe must name everything once, {', '.join(twice)} are there twice"
        )
    return [name for name in names if name != BASE_ACTION]


def _source(name: str, corrected: Corrected, period_s: float) -> Any:
    """Make a source of features.

    It has `signals`, `begin(num_worlds)` makes its memory, and `observe(rows, memory)` returns
    features and the new memory.
    """
    model = corrected.model
    base = corrected.base
    if signals := base.estimates.get(name):
        return _Instant(signals, partial(base.estimate, name), reads_base=True)
    table = model.observation_table
    groups = _groups(model)
    if name in groups or name in table.names:
        columns = table.group(name)
        return _Instant(table.signals[columns], lambda rows: rows[:, columns])
    others = [error for error, pair in _DIFFERENCES.items() if set(pair) <= set(groups)]
    if name in others:
        minuend, subtrahend = (table.group(group) for group in _DIFFERENCES[name])
        signals = rename_group(table.signals_of("encoder_angle"), name)
        return _Instant(signals, lambda rows: rows[:, minuend] - rows[:, subtrahend])
    if isinstance(model, WalkerModel):
        walker_sources: dict[str, Callable[[], Any]] = {
            "contact_error": lambda: _ContactError(model, period_s),
            "level": lambda: LevelGround(model, period_s),
            "bending": lambda: BendingObserver(model),
            "phase": lambda: _phase(model),
            "zmp_error": lambda: _zmp_error(model),
            "zmp_of_steps": lambda: _ZmpOfSteps(model),
        }
        if name in walker_sources:
            return walker_sources[name]()
        others += [*walker_sources, *base.estimates]
    names = [OBSERVATION, BASE_ACTION, *others, *groups]
    raise unknown_name("feature of a residual", name, names)


class _Instant:
    """A source without memory: values of observations, or of the base's memory too."""

    def __init__(
        self, signals: Any, function: Callable[..., Array], reads_base: bool = False
    ) -> None:
        self.signals = signals
        self.reads_base = reads_base
        self._function = function

    def begin(self, num_worlds: int) -> Array:
        return np.zeros((num_worlds, 0))

    def observe(self, rows: Array, memory: Any) -> tuple[Array, Array]:
        values = self._function(rows, memory) if self.reads_base else self._function(rows)
        return values, self.begin(len(rows))


def _zmp_error(model: WalkerModel) -> _Instant:
    """ZMP of flat feet less the planned one; zero where the feet carry too little."""
    feet = FlatFeet(model, LEAST_LOAD * model.biped.weight)
    meaning = "{part} of the ZMP of flat feet less the planned one"
    signals = SignalGroup.of("zmp_error", "m", meaning, IN_PLANE, None).signals
    return _Instant(signals, lambda rows: np.nan_to_num(feet.zmp_error(rows), nan=0.0))


class _StepMemory(NamedTuple):
    """Memory of `_ZmpOfSteps`.

    Attributes:
        total: Sum of the errors in this step, (num_worlds, 2) [m].
        number: Measurements in it, (num_worlds,).
        support: Support foot of this step, (num_worlds,).
        means: Means of the last steps on both feet, (num_worlds, 2, 2) [m].
    """

    total: Array
    number: Array
    support: Array
    means: Array


class _ZmpOfSteps:
    """Mean error of the ZMP in the last step on the left foot, and on the right; zero before it.

    It shows errors that alternate with the steps, which a slow integral does not.
    """

    def __init__(self, model: WalkerModel) -> None:
        text = "mean ZMP error {part} in the last step on a foot"
        self.signals = SignalGroup.of("zmp_of_steps", "m", text, OF_FEET, None).signals
        self._error = _zmp_error(model)
        clock = model.observation_table.group("clock")
        self._time = clock.start
        self._support = clock.stop - 1

    def begin(self, num_worlds: int) -> _StepMemory:
        total = np.zeros((num_worlds, 2))
        means = np.zeros((num_worlds, 2, 2))
        return _StepMemory(total, np.zeros(num_worlds), np.zeros(num_worlds), means)

    def observe(self, rows: Array, memory: _StepMemory) -> tuple[Array, _StepMemory]:
        error, _ = self._error.observe(rows, memory.total)
        support = rows[:, self._support]
        is_new = support != memory.support
        mean = memory.total / np.maximum(memory.number, 1.0)[:, None]
        feet = np.arange(2) == memory.support[:, None]
        ended = (is_new[:, None] & feet)[:, :, None]
        means = np.where(ended, mean[:, None], memory.means)
        is_walking = rows[:, self._time] > STAND_S
        total = np.where(is_new[:, None], 0.0, memory.total) + is_walking[:, None] * error
        number = np.where(is_new, 0.0, memory.number) + is_walking
        return means.reshape(len(rows), 4), _StepMemory(total, number, support, means)


def _phase(model: WalkerModel) -> _Instant:
    """Harmonics of the phase of a step, also before and after the walk."""
    plan = model.plan
    psi = stride_angle(plan.timing, plan.gait.step_period_s)
    table = harmonics(psi, _PHASE_HARMONICS, is_odd=False)
    view = ObservationView(model)
    orders = range(1, _PHASE_HARMONICS + 1)
    parts: Any = {f"{kind}_{k}": "same" for k in orders for kind in ("cosine", "sine")}
    text = "{part} of the phase of a step"
    signals = SignalGroup.of("phase", "1", text, parts, None).signals

    def observe(rows: Array) -> Array:
        return table.take(view.plan_row(rows), axis=0, mode="clip")

    return _Instant(signals, observe)


_PHASE_HARMONICS = 8
"""Number of harmonics; decisions every 0.1 s resolve as many in a step of 1.6 s."""

_DIFFERENCES = {
    "encoder_error": ("encoder_angle", "reference_angle"),
    "link_error": ("reference_angle", "link_encoder"),
}
"""Differences of two groups of the observation with a column per joint."""


class _ContactError:
    """ZMP [m] and load share by the foot wrenches of flat feet, less the planned ones.

    The wrenches are corrected to level ground, for which the plan was made. Values are zero where
    the feet carry too little for a ZMP.
    """

    signals = (
        Signal("contact_error.x", "m", "ZMP less the planned one", mirrored="same"),
        Signal("contact_error.y", "m", "likewise, to the left", mirrored="opposite"),
        Signal("contact_error.share", "1", "likewise, of load", mirrored="opposite"),
    )
    _LEAST_N = 50.0

    def __init__(self, model: WalkerModel, period_s: float) -> None:
        self._level = LevelGround(model, period_s)
        self._share = model.observation_table.group("load_share")
        self._feet = FlatFeet(model, self._LEAST_N)

    def begin(self, num_worlds: int) -> GroundMemory:
        return self._level.begin(num_worlds)

    def observe(self, rows: Array, memory: GroundMemory) -> tuple[Array, GroundMemory]:
        _, wrenches, memory = self._level.upright(rows, memory)
        force, zmp = self._feet.ground(rows, wrenches)
        vertical = force[:, :, 2].sum(axis=1)
        share = force[:, 1, 2] / np.where(vertical >= self._LEAST_N, vertical, np.nan)
        error = np.column_stack([zmp, share[:, None] - rows[:, self._share]])
        return np.nan_to_num(error, nan=0.0), memory
