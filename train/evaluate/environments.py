"""The environments as the commands know them: their arguments, figures and tables."""

import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias

from pydantic import ConfigDict, ImportString, TypeAdapter

from elastic_env import IDS
from elastic_env.core.config import Locator, Model, load_yaml, quantity
from elastic_env.core.errors import ConfigurationError, quote, unknown_name
from elastic_env.motion.gait import Gait
from elastic_env.robots.joint_robot import JointRobot
from elastic_env.world.scenario import make_scenario
from train.runs.user_code import named_object

ENDINGS = (".yaml", ".yml")
"""Of files of robots."""


class RobotFile(Model):
    """A robot on a fixed base; keys as of `gymnasium.make("elastic_env/Robot-v0", ...)`."""

    model: Locator
    """Rigid model, a file of MJCF (.xml) or URDF (.urdf)."""
    joints: Locator | dict[str, Any]
    """Elastic joints: a YAML file, or a mapping from names or patterns."""
    end_effector: Locator | None = None
    """Site or body whose place and tilt are scored; None for the outermost body."""
    home: dict[str, float] | list[float] | None = None
    """Angles about which the joints follow a reference, by name or in order [rad]."""
    load_kg: float | None = quantity("kg", None, gt=0)
    """The scenario `payload` adds a fifth of it at the end effector [kg]."""
    imu: Locator | None = None
    """Site of the accelerometer."""

    def arguments(self, folder: Path) -> dict[str, Any]:
        """Arguments of the environment; files are those of a folder."""
        given = self.model_dump(exclude_none=True)
        files = {name: str(folder / path) for name, path in _files(given)}
        return {**given, **files}


def read_robot_file(name: str) -> dict[str, Any]:
    """Arguments of `elastic_env/Robot-v0` from a file, which `--env arm.robot.yaml` names.

        model: arm.xml
        joints: arm.yaml
        end_effector: tool

    Files that it names are looked for beside it.

    Raises:
        ConfigurationError: The file is missing or does not describe a robot.
    """
    try:
        return load_yaml(name, RobotFile).arguments(Path(name).parent)
    except ConfigurationError as error:
        raise ConfigurationError(
            f"--env {quote(name)[1:-1]} must be a file of a robot, with the keys model and joints:"
            f" {error}"
        ) from None


def files_of_robot(name: str) -> Iterator[Path]:
    """The files that a robot's file names, if it is one."""
    if name.endswith(ENDINGS) and Path(name).is_file():
        try:
            arguments = read_robot_file(name)
        except ConfigurationError:
            return  # another file
        yield from (Path(path) for _, path in _files(arguments))


def _files(arguments: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Arguments that name a file."""
    given = [(name, arguments[name]) for name in ("model", "joints")]
    return [(name, value) for name, value in given if isinstance(value, str)]


Reference: TypeAlias = str | int | float | list[float] | dict[str, Any]
"""The motion: a name, a number, durations, or a mapping of parameters; each environment says
which of them it takes.
"""

UNPLACED = (
    *("num_envs", "num_threads", "autoreset_mode", "render_mode", "backend", "device"),
    *("id", "vectorization_mode", "vector_kwargs", "wrappers", "self"),
)
"""Arguments of the environments, and of the functions that make them, that have no place in a
comparison.
"""
RESERVED = ("scenario", *UNPLACED)
"""These, and the argument that has a key of its own."""

_STRICT = ConfigDict(extra="forbid")
"""A name in `environments.toml` that nobody knows is a mistake."""
_UNITS = {"_rad": ("mrad", 1e3), "_m": ("mm", 1e3), "_s": ("ms", 1e3)}


@dataclass(frozen=True)
class Column:
    """A metric in tables and charts.

    Attributes:
        title: Words for it, short.
        metric: Name in the record of an episode; its end is the unit.
        on_console: Whether it is shown where there is little room.
        decimals: How many are shown.
        note: What the title leaves open, for the legend; empty where it says it all.
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
        return self._shown[0]

    @property
    def scale(self) -> float:
        """Factor from SI to the shown unit."""
        return self._shown[1]

    @property
    def label(self) -> str:
        """Title with unit."""
        return f"{self.title} [{self.unit}]"

    @property
    def _shown(self) -> tuple[str, float]:
        return _UNITS[self.metric[self.metric.rindex("_") :]]


@dataclass(frozen=True)
class TracedSignal:
    """A traced signal in charts over time.

    Attributes:
        title: Words for it.
        name: Its name in the trace.
        unit: Unit in which it is shown.
        reference: Name of what it should be in the trace; None where that is zero.
        picture: Name of the picture that shows it; empty where it stands on the page alone.
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
        motion: Argument of `gymnasium.make` that says which motion is played; what a configuration
            calls its reference.
        default_reference: Reference where none is named.
        watched_reference: The same for a picture; None for the default.
        looped_policy: Policy in the loop of which the speed is measured, the best that needs no
            truth.
        live_policy: Policy that is timed against the clock; None for the looped one.
        on_hardware: Short name of the same robot on hardware; empty where there is none.
        make_reference: The motion of a reference; None where it is never random.
        given: Further arguments of `gymnasium.make`.
        traced: Signals of the first episode that are kept.
        columns: The summary table.
        splits: Further tables of the summary: columns by title.
        subject: What the summary table is about.
        note: What its reader has to know beside the legend of the columns.
        swept: Columns drawn against a swept value; the first is that of the bar chart.
        learned_from: Further arguments of worlds that are learned from, which keep them apart from
            those of evaluation.
        judged: Columns that policies are compared by, pair by pair.
        also: Columns whose paired changes stand in the tables too.
        curves: Signals over time in the report and in pictures.
        quantity: What a reference is, in titles; empty where its label says it.
        failure: Heading for episodes that end before their time.
        is_real: Whether it is hardware: one world at a time, in this process, without a truth to
            score by.
        walks: Whether its policies are those of the walker.
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
    learned_from: dict[str, Any] = field(default_factory=dict)
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
    given: dict[str, Any] = field(default_factory=dict)

    def arguments(self, reference: Reference) -> dict[str, Any]:
        """Arguments of `gymnasium.make` for a reference."""
        return {**self.given, self.motion: reference}

    def label(self, reference: Reference) -> str:
        """Name of a reference in tables and figures."""
        return str(reference.get("kind") if isinstance(reference, dict) else reference)

    def abscissa(self, reference: Reference) -> dict[str, float]:  # noqa: ARG002
        """Number of a reference that sweeps can be drawn against, by name; empty without one."""
        return {}

    def draws(self, reference: Reference) -> bool:
        """True if episodes of a reference have motions of their own."""
        make = self.make_reference
        return make is not None and make(reference).is_random

    def is_deterministic(self, scenario: str, reference: Reference) -> bool:
        """True if all episodes of a condition are one and the same."""
        if self.is_real:
            return False
        return not (make_scenario(scenario, self.walks).is_random or self.draws(reference))

    def differs_by_noise_alone(self, scenario: str, reference: Reference) -> bool:
        """True if the episodes of a condition are of one robot and one motion."""
        if self.is_real:
            return False
        return not (make_scenario(scenario, self.walks).draws_robots or self.draws(reference))

    @property
    def failures(self) -> str:
        """Name of such episodes in a sentence."""
        return "falls" if self.failure == "falls" else "failures"

    def title(self, reference_name: str) -> str:
        """A reference's name as it stands in titles."""
        return f"{self.quantity} {reference_name}".strip()


_STEPS_OF_THE_PAPER = {"24 s": 2}
"""Number of steps of the gaits of configs/paper.yaml that have another one than the default."""


class _Walker(Environment):
    """The walker, whose reference is a step period, or a mapping with one."""

    def arguments(self, reference: Reference) -> dict[str, Any]:
        given = reference if isinstance(reference, dict) else {}
        return {**given, self.motion: _step_period(reference)}

    def label(self, reference: Reference) -> str:
        parts = _durations(reference)
        texts = (f"{p:g}" if isinstance(p, int | float) else str(p) for p in parts)
        label = f"{'+'.join(texts)} s"
        given = reference if isinstance(reference, dict) else {}
        steps = given.get("num_steps")
        usual = Gait.model_fields["num_steps"].default
        is_usual = steps in (None, usual, _STEPS_OF_THE_PAPER.get(label))
        gait = given.get("gait")
        differs = gait if isinstance(gait, dict) else {}
        further = {**({} if is_usual else {"num_steps": steps}), **differs}
        return " ".join([label, *(f"{name}={value}" for name, value in further.items())])

    def abscissa(self, reference: Reference) -> dict[str, float]:
        return {"step_period_s": float(f"{sum(map(float, _durations(reference))):.6g}")}


def _step_period(reference: Reference) -> Any:
    """Step period of a walker's reference, or its durations [s]."""
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
    """The environment of a short name, or that of a robot of one's own.

    Args:
        name: Short name; a file of a robot, see `read_robot_file`; or "FILE.py:ROBOT" or
            "module:ROBOT", a `JointRobot`, which is imported and registered.

    Raises:
        ConfigurationError: It does not exist.
    """
    if name.endswith(ENDINGS):
        return replace(ENVIRONMENTS["robot"], given=read_robot_file(name))
    if ":" in name:
        return _of_ones_own(name)
    if name not in ENVIRONMENTS:
        choices = [*ENVIRONMENTS, "ROBOT.yaml", "FILE.py:ROBOT"]
        raise unknown_name("environment", name, choices)
    return ENVIRONMENTS[name]


@lru_cache(maxsize=64)
def _of_ones_own(name: str) -> Environment:
    robot = named_object(name)
    if not isinstance(robot, JointRobot):
        raise ConfigurationError(
            f"{name} is no elastic_env.JointRobot but of type {type(robot).__name__}"
        )
    robot.register()
    known = _EVERY["joints" if robot.end_effector is None else "end_effector"]
    return replace(known, id=robot.id, robot=robot.name)


def _environments() -> dict[str, Environment]:
    """Environments by their short names, from `environments.toml`."""
    file = Path(__file__).with_suffix(".toml")
    parts = tomllib.loads(file.read_text(encoding="utf-8"))

    def values(name: str) -> dict[str, Any]:
        part = dict(parts.get(name, parts["joints"]))
        like = part.pop("like", None)
        return part if like is None else {**values(like), **part}

    plain = TypeAdapter(Environment)
    walking = TypeAdapter(_Walker)
    found = {}
    for name in [*IDS, *_KINDS]:
        content = {"id": IDS.get(name, ""), "robot": name, **values(name)}
        kind = walking if content.get("walks") else plain
        found[name] = kind.validate_python(content)
    return found


_KINDS = ("joints", "end_effector")
"""Descriptions of robots that are no environments of ours."""
_EVERY = _environments()
ENVIRONMENTS = {name: known for name, known in _EVERY.items() if name not in _KINDS}
"""Environments by their short names."""
