"""The environments as the commands know them: their arguments, figures and tables."""

import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any, TypeAlias

from pydantic import ConfigDict, ImportString, TypeAdapter

from elastic_env import IDS
from elastic_env.core.errors import ConfigurationError, quote, unknown_name
from elastic_env.motion.gait import Gait
from elastic_env.robots.joint_robot import JointRobot
from elastic_env.robots.thormang.walk_signals import BLOCK_STEPS
from elastic_env.world.scenario import make_scenario
from train.evaluate.robot_file import ENDINGS, read_robot_file
from train.runs.user_code import named_object

Reference: TypeAlias = str | int | float | list[float] | dict[str, Any]
"""The motion: a name, a number, durations, or a mapping of parameters.

Each environment accepts some of these forms.
"""

UNPLACED = (
    *("num_envs", "num_threads", "autoreset_mode", "render_mode", "backend", "device"),
    *("id", "vectorization_mode", "vector_kwargs", "wrappers", "self"),
)
"""Arguments of environments, and of the functions that make them, that the commands set."""
RESERVED = ("scenario", *UNPLACED)
"""Arguments that `env_options` must not contain: these, and the one with a key of its own."""

_STRICT = ConfigDict(extra="forbid")
"""An unknown name in `environments.toml` is an error."""
_UNITS = {"_rad": ("mrad", 1e3), "_m": ("mm", 1e3), "_s": ("ms", 1e3)}
"""Shown unit of a metric and its factor from SI, by the ending of the metric's name."""


@dataclass(frozen=True)
class Column:
    """A metric in tables and charts.

    Attributes:
        title: Short words for it.
        metric: Name in the record of an episode; its end is the unit.
        on_console: True if it is also shown on the console, where there is little room.
        decimals: Number of decimals that are shown.
        note: Explanation of the title for the legend; empty if it needs none.
    """

    __pydantic_config__ = _STRICT
    title: str
    metric: str
    on_console: bool = True
    decimals: int = 2
    note: str = ""

    @property
    def unit(self) -> str:
        """Unit in which it is shown."""
        return self._unit_and_scale[0]

    @property
    def scale(self) -> float:
        """Factor from SI to the shown unit."""
        return self._unit_and_scale[1]

    @property
    def label(self) -> str:
        """Title with unit."""
        return f"{self.title} [{self.unit}]"

    @property
    def _unit_and_scale(self) -> tuple[str, float]:
        return _UNITS[self.metric[self.metric.rindex("_") :]]


@dataclass(frozen=True)
class TracedSignal:
    """A traced signal in charts over time.

    Attributes:
        title: Words for it.
        name: Its name in the trace.
        unit: Unit in which it is shown.
        reference: Name of its reference in the trace; None if the reference is zero.
        picture: Name of the picture that shows it; empty if only the page shows it.
    """

    __pydantic_config__ = _STRICT
    title: str
    name: str
    unit: str
    reference: str | None = None
    picture: str = ""

    @property
    def scale(self) -> float:
        """Factor from SI to the shown unit."""
        return 1e3 if self.unit.startswith("m") else 1.0

    @property
    def label(self) -> str:
        """Title with unit."""
        return f"{self.title} [{self.unit}]"


@dataclass(frozen=True)
class Environment:
    """An environment as the commands see it.

    Attributes:
        id: Its name for `gymnasium.make`.
        robot: Name of its task, under which trained policies are kept.
        motion: Argument of `gymnasium.make` for the motion, which a configuration calls its
            reference.
        default_reference: Reference if none is named.
        watched_reference: Reference of a film or picture; None for the default.
        looped_policy: Policy whose loop is timed for the speed, the best that needs no truth.
        live_policy: Policy that is timed against the clock; None for `looped_policy`.
        on_hardware: Short name of the same robot on hardware; empty if there is none.
        make_reference: Makes the motion of a reference; None if motions are never random.
        further_arguments: Further arguments of `gymnasium.make`.
        traced: Signals of the first episode that are kept.
        columns: Columns of the summary table.
        splits: Further tables of the summary: columns by title.
        subject: Subject of the summary table.
        note: A note below the summary table, apart from the legend of the columns.
        swept: Columns drawn against a swept value; the bar chart shows the first.
        training_arguments: Further arguments of training worlds, so that they differ from the
            worlds of evaluation.
        judged: Columns that policies are compared by, pair by pair.
        also: Columns whose paired changes are in the tables too.
        curves: Signals over time in the report and in pictures.
        quantity: Name of the references' quantity in titles; empty if labels need none.
        failure: Heading for episodes that end before their time.
        is_real: True for hardware: one world at a time, in this process, without a truth for
            scores.
        walks: True if its policies are those of the walker.
    """

    __pydantic_config__ = _STRICT
    id: str
    robot: str
    motion: str
    default_reference: Reference
    traced: tuple[str, ...]
    columns: tuple[Column, ...]
    subject: str
    swept: tuple[Column, ...]
    judged: tuple[Column, ...]
    curves: tuple[TracedSignal, ...]
    also: tuple[Column, ...] = ()
    splits: dict[str, tuple[Column, ...]] = field(default_factory=dict)
    training_arguments: dict[str, Any] = field(default_factory=dict)
    note: str = ""
    quantity: str = ""
    failure: str = "fail"
    is_real: bool = False
    walks: bool = False
    watched_reference: Reference | None = None
    looped_policy: str = "zero"
    live_policy: str | None = None
    on_hardware: str = ""
    make_reference: ImportString[Callable[[Any], Any]] | None = None
    further_arguments: dict[str, Any] = field(default_factory=dict)

    @property
    def metrics(self) -> list[str]:
        """Metrics of all tables and changes."""
        columns = chain(self.columns, self.judged, self.also, *self.splits.values())
        return list(dict.fromkeys(column.metric for column in columns))

    def splits_of(self, cells: Iterable[Mapping[str, Any]]) -> dict[str, tuple[Column, ...]]:  # noqa: ARG002
        """Further tables of the summary for cells with these arguments."""
        return self.splits

    def arguments(self, reference: Reference) -> dict[str, Any]:
        """Arguments of `gymnasium.make` for a reference."""
        return {**self.further_arguments, self.motion: reference}

    def label(self, reference: Reference) -> str:
        """Name of a reference in tables and figures."""
        return str(reference.get("kind") if isinstance(reference, dict) else reference)

    def abscissa(self, reference: Reference) -> dict[str, float]:  # noqa: ARG002
        """Number of a reference for the axis of a sweep, by name; empty without one."""
        return {}

    def draws(self, reference: Reference) -> bool:
        """True if every episode of a reference has a motion of its own."""
        make = self.make_reference
        return make is not None and make(reference).is_random

    def is_deterministic(self, scenario: str, reference: Reference) -> bool:
        """True if all episodes of a condition are the same."""
        is_random = self.is_real or make_scenario(scenario, self.walks).is_random
        return not (is_random or self.draws(reference))

    def differs_by_noise_alone(self, scenario: str, reference: Reference) -> bool:
        """True if all episodes of a condition have one robot and one motion."""
        draws_robots = self.is_real or make_scenario(scenario, self.walks).draws_robots
        return not (draws_robots or self.draws(reference))

    @property
    def failures(self) -> str:
        """Name of failed episodes in a sentence."""
        return "falls" if self.failure == "falls" else "failures"

    def title(self, reference_name: str) -> str:
        """Name of a reference in titles, with its quantity."""
        return f"{self.quantity} {reference_name}".strip()


_PAPER_NUM_STEPS = {"24 s": 2}
"""Number of steps of the gaits of configs/paper.yaml, if it is not the default."""


class _Walker(Environment):
    """The walker, whose reference is a step period, or a mapping with one."""

    def splits_of(self, cells: Iterable[Mapping[str, Any]]) -> dict[str, tuple[Column, ...]]:
        if any(_num_scored_steps(arguments) > BLOCK_STEPS for arguments in cells):
            return self.splits
        # the first and the last steps are the whole walk
        splits = self.splits.items()
        return {title: cols for title, cols in splits if "first_steps" not in cols[0].metric}

    def arguments(self, reference: Reference) -> dict[str, Any]:
        further = reference if isinstance(reference, dict) else {}
        return {**further, self.motion: _step_period(reference)}

    def label(self, reference: Reference) -> str:
        parts = _durations(reference)
        texts = (f"{p:g}" if isinstance(p, int | float) else str(p) for p in parts)
        label = f"{'+'.join(texts)} s"
        parameters = reference if isinstance(reference, dict) else {}
        steps = parameters.get("num_steps")
        default = Gait.model_fields["num_steps"].default
        further = {}
        if steps not in (None, default, _PAPER_NUM_STEPS.get(label)):
            further["num_steps"] = steps
        if isinstance(gait := parameters.get("gait"), dict):
            further |= gait
        return " ".join([label, *(f"{k}={v}" for k, v in further.items())])

    def abscissa(self, reference: Reference) -> dict[str, float]:
        return {"step_period_s": float(f"{sum(map(float, _durations(reference))):.6g}")}


def _num_scored_steps(arguments: Mapping[str, Any]) -> int:
    """Number of scored steps of a walk with these arguments."""
    gait = arguments.get("gait") or {}
    steps = arguments.get("num_steps") or Gait.model_fields["num_steps"].default
    return steps - gait.get("settling_steps", 0)


def _step_period(reference: Reference) -> Any:
    """Step period of a walker's reference, or its three durations [s]."""
    if not isinstance(reference, dict):
        return reference
    if "step_period" not in reference:
        raise ConfigurationError(
            "a reference of the walker that is a mapping needs the key 'step_period', got"
            f" {quote(reference)}; for example {{step_period: 24, num_steps: 2}}"
        )
    return reference["step_period"]


def _durations(reference: Reference) -> Any:
    period = _step_period(reference)
    return period if isinstance(period, list | tuple) else [period]


def environment(name: str) -> Environment:
    """The environment of a short name, or of a user's robot.

    Args:
        name: Short name; a file of a robot, see `read_robot_file`; or "FILE.py:ROBOT" or
            "module:ROBOT", a `JointRobot`, which is imported and registered.

    Raises:
        ConfigurationError: It does not exist.
    """
    if name.endswith(ENDINGS):
        return replace(ENVIRONMENTS["robot"], further_arguments=read_robot_file(name))
    if ":" in name:
        return _user_robot(name)
    if name not in ENVIRONMENTS:
        choices = [*ENVIRONMENTS, "ROBOT.yaml", "FILE.py:ROBOT"]
        raise unknown_name("environment", name, choices)
    return ENVIRONMENTS[name]


@lru_cache(maxsize=64)
def _user_robot(name: str) -> Environment:
    robot = named_object(name)
    if not isinstance(robot, JointRobot):
        raise ConfigurationError(
            f"{name} is no elastic_env.JointRobot but of type {type(robot).__name__}"
        )
    robot.register()
    kind = "joints" if robot.end_effector is None else "end_effector"
    return replace(_DESCRIPTIONS[kind], id=robot.id, robot=robot.name)


def _read_descriptions() -> dict[str, Environment]:
    """Read the descriptions in `environments.toml`, by short name."""
    file = Path(__file__).with_suffix(".toml")
    parts = tomllib.loads(file.read_text(encoding="utf-8"))

    def values(name: str) -> dict[str, Any]:
        part = dict(parts.get(name, parts["joints"]))
        like = part.pop("like", None)
        return part if like is None else {**values(like), **part}

    standing = TypeAdapter(Environment)
    walking = TypeAdapter(_Walker)
    descriptions = {}
    for name in [*IDS, *_USER_ROBOTS]:
        content = {"id": IDS.get(name, ""), "robot": name, **values(name)}
        kind = walking if content.get("walks") else standing
        descriptions[name] = kind.validate_python(content)
    return descriptions


_USER_ROBOTS = ("joints", "end_effector")
"""Descriptions for robots of users, without and with an end effector."""
_DESCRIPTIONS = _read_descriptions()
ENVIRONMENTS = {name: _DESCRIPTIONS[name] for name in IDS}
"""Environments of the package by their short names."""
