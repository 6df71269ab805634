"""The environments as the commands know them: their arguments, figures and tables."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, TypeAlias

from elastic_env import IDS
from elastic_env.core.errors import ConfigurationError, quote, unknown_name
from elastic_env.motion.arm_references import make_arm_reference
from elastic_env.motion.gait import Gait
from elastic_env.motion.references import make_reference
from elastic_env.robots.joint_robot import JointRobot
from elastic_env.world.scenario import make_scenario
from train.evaluate.robot_file import ENDINGS, read_robot_file
from train.runs.user_code import named_object

Reference: TypeAlias = str | float | list[float] | dict[str, Any]
"""The motion: a name, a number, durations, or a mapping of parameters; each environment says
which of them it takes.
"""

UNPLACED = (
    "num_envs",
    "num_threads",
    "autoreset_mode",
    "render_mode",
    "id",
    "vectorization_mode",
    "vector_kwargs",
    "wrappers",
    "self",
)
"""Arguments of the environments, and of the functions that make them, that have no place in a
comparison.
"""
RESERVED = ("scenario", *UNPLACED)
"""These, and the argument that has a key of its own."""

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
        return next(shown for suffix, shown in _UNITS.items() if self.metric.endswith(suffix))


@dataclass(frozen=True)
class TracedSignal:
    """A traced signal in charts over time.

    Attributes:
        title: Words for it.
        name: Its name in the trace.
        unit: Unit in which it is shown.
        reference: Name of what it should be in the trace; None where that is zero.
    """

    title: str
    name: str
    unit: str
    reference: str | None = None

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
        splits: Further tables of the summary, title and columns.
        subject: What the summary table is about.
        note: What its reader has to know beside the legend of the columns.
        figures: Names of the time series to draw, see `train.figures.comparison_figures`.
        overview: Column of the bar chart.
        swept: Columns drawn against a swept value.
        learned_from: Further arguments of worlds that are learned from, which keep them apart from
            those of evaluation.
        judged: Columns that policies are compared by, pair by pair.
        also: Columns whose paired changes stand in the tables too.
        curves: Signals over time in the report.
        quantity: What a reference is, in titles; empty where its label says it.
        failure: Heading for episodes that end before their time.
        is_real: Whether it is hardware: one world at a time, in this process, without a truth to
            score by.
        walks: Whether its policies are those of the walker.
    """

    id: str
    robot: str
    motion: str
    default_reference: Reference
    traced: tuple[str, ...]
    columns: tuple[Column, ...]
    subject: str
    figures: tuple[str, ...]
    overview: Column
    swept: tuple[Column, ...]
    judged: tuple[Column, ...]
    curves: tuple[TracedSignal, ...]
    also: tuple[Column, ...] = ()
    splits: tuple[tuple[str, tuple[Column, ...]], ...] = ()
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
    make_reference: Callable[[Any], Any] | None = None
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
        return self.make_reference is not None and self.make_reference(reference).is_random

    def is_deterministic(self, scenario: str, reference: Reference) -> bool:
        """True if all episodes of a condition are one and the same."""
        return not (self.is_real or make_scenario(scenario).is_random or self.draws(reference))

    def differs_by_noise_alone(self, scenario: str, reference: Reference) -> bool:
        """True if the episodes of a condition are of one robot and one motion."""
        return not (self.is_real or make_scenario(scenario).draws_robots or self.draws(reference))

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
        texts = (f"{part:g}" if isinstance(part, int | float) else str(part) for part in parts)
        label = f"{'+'.join(texts)} s"
        steps = reference.get("num_steps") if isinstance(reference, dict) else None
        usual = (None, Gait.model_fields["num_steps"].default, _STEPS_OF_THE_PAPER.get(label))
        return label if steps in usual else f"{label} num_steps={steps}"

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
        name: Short name; a file of a robot, see `train.evaluate.robot_file`; or "FILE.py:ROBOT" or
            "module:ROBOT", a `JointRobot`, which is imported and registered.

    Raises:
        ConfigurationError: It does not exist.
    """
    if name.endswith(ENDINGS):
        return replace(ENVIRONMENTS["robot"], given=read_robot_file(name))
    if ":" in name:
        return _of_ones_own(name)
    if name not in ENVIRONMENTS:
        raise unknown_name("environment", name, [*ENVIRONMENTS, "ROBOT.yaml", "FILE.py:ROBOT"])
    return ENVIRONMENTS[name]


@lru_cache(maxsize=64)
def _of_ones_own(name: str) -> Environment:
    robot = named_object(name)
    if not isinstance(robot, JointRobot):
        raise ConfigurationError(
            f"{name} is no elastic_env.JointRobot but of type {type(robot).__name__}"
        )
    robot.register()
    known = _JOINTS if robot.end_effector is None else _WITH_END_EFFECTOR
    return replace(known, id=robot.id, robot=robot.name)


_LINK = Column("link error rms", "link_error_rms_rad")
_TESTBED = Environment(
    id=IDS["testbed"],
    robot="testbed",
    motion="reference",
    default_reference="hold",
    make_reference=make_reference,
    traced=(
        "time_s",
        "reference_angle",
        "link_angle",
        "link_angle_imu",
        "deflection",
        "link_error",
        "link_error_imu",
        "joint_torque",
    ),
    columns=(
        Column("rms", "link_error_rms_rad"),
        Column("peak", "link_error_peak_rad"),
        Column("IMU-", "link_error_imu_min_rad", note="least error by the link's IMU"),
        Column("IMU+", "link_error_imu_max_rad", note="greatest error by it"),
        Column("est.", "link_estimate_error_rms_rad", note="rms error of the estimated link angle"),
    ),
    subject="link error",
    figures=("time", "static"),
    overview=_LINK,
    swept=(_LINK, Column("peak", "link_error_peak_rad")),
    judged=(_LINK,),
    curves=(
        TracedSignal("link angle", "link_angle", "rad", reference="reference_angle"),
        TracedSignal("link error", "link_error", "mrad"),
    ),
    watched_reference="sine",
    looped_policy="input",
    on_hardware="hardware",
)

_JOINTS = replace(
    _TESTBED,
    default_reference="multisine",
    make_reference=make_arm_reference,
    columns=tuple(column for column in _TESTBED.columns if not column.title.startswith("IMU")),
    traced=("time_s", "link_error", "deflection", "joint_torque", "command_rate"),
    figures=(),
    curves=(_TESTBED.curves[1], TracedSignal("deflection", "deflection", "mrad")),
    watched_reference=None,
    on_hardware="",
)
"""Several joints on a fixed base: the figures are those of all joints together."""

_TOOL = Column("end effector error rms", "end_effector_error_rms_m")
_DISTANCE = "rms distance from where the reference has it"
_ANGLE = "rms angle of the end effector from the reference"
_WITH_END_EFFECTOR = replace(
    _JOINTS,
    columns=(
        Column("end effector", "end_effector_error_rms_m", note=_DISTANCE),
        Column("tilt", "end_effector_tilt_rms_rad", note=_ANGLE),
        *_JOINTS.columns,
    ),
    traced=("time_s", "end_effector_error", "end_effector_tilt", *_JOINTS.traced[1:]),
    subject="end effector and link error",
    overview=_TOOL,
    swept=(_TOOL, *_JOINTS.swept),
    judged=(_TOOL,),
    also=_JOINTS.judged,
    curves=(TracedSignal("end effector error", "end_effector_error", "mm"), *_JOINTS.curves),
)
"""The same robots where what counts is the place of an end effector."""

_ROLL = Column("pelvis roll rms", "pelvis_roll_rms_rad")
_ZMP = Column("ZMP deviation rms", "zmp_deviation_rms_m")
_EARLY = "swing foot down before its time"
_TILT = "error of its attitude, roll and pitch together"
_BY_PHASE = tuple(
    Column(f"{title} {phase}", f"{metric}_{phase}_rms_{unit}")
    for title, metric, unit in (
        ("roll", "pelvis_roll", "rad"),
        ("pitch", "pelvis_pitch", "rad"),
        ("ZMP", "zmp_deviation", "m"),
    )
    for phase in ("double", "single", "transition")
)

_WALKER = _Walker(
    id=IDS["walker"],
    robot="walker",
    motion="step_period",
    default_reference=3,
    traced=(
        "time_s",
        "pelvis_roll",
        "pelvis_pitch",
        "zmp_x",
        "zmp_y",
        "zmp_reference_x",
        "zmp_reference_y",
        "single_support",
        "support",
        "load_share",
        "force_left",
        "force_right",
    ),
    columns=(
        Column("roll rms", "pelvis_roll_rms_rad"),
        Column("roll peak", "pelvis_roll_peak_rad"),
        Column("pitch rms", "pelvis_pitch_rms_rad"),
        Column("pitch peak", "pelvis_pitch_peak_rad", on_console=False),
        Column("ZMP rms", "zmp_deviation_rms_m", decimals=1),
        Column("ZMP x rms", "zmp_deviation_x_rms_m", on_console=False, decimals=1),
        Column("ZMP y rms", "zmp_deviation_y_rms_m", on_console=False, decimals=1),
        Column("IMU", "imu_error_rms_rad", on_console=False, note=_TILT),
        Column(
            "early", "early_touchdown_mean_s", decimals=0, note="swing foot down before its time"
        ),
        Column("e mean", "frame_error_mean_m", decimals=1, note="Eq. 1 at the support changes"),
        Column("COM jump", "com_jump_mean_m", decimals=1),
    ),
    splits=(("By phase, rms", _BY_PHASE),),
    subject="pelvis and ZMP of the walk",
    figures=("pelvis", "zmp"),
    overview=_ROLL,
    swept=(_ROLL, _ZMP),
    judged=(Column("pelvis error rms", "pelvis_error_rms_rad"), _ZMP),
    learned_from={"bank": 1},
    also=(_ROLL, Column("pelvis pitch rms", "pelvis_pitch_rms_rad")),
    curves=(
        TracedSignal("pelvis roll", "pelvis_roll", "mrad"),
        TracedSignal("pelvis pitch", "pelvis_pitch", "mrad"),
        TracedSignal("ZMP to the left", "zmp_y", "mm", reference="zmp_reference_y"),
    ),
    quantity="step period",
    failure="falls",
    walks=True,
    looped_policy="input_wrench",
    live_policy="adaptive_posture",
)

_HARDWARE = replace(
    _TESTBED,
    id=IDS["hardware"],
    columns=tuple(
        column for column in _TESTBED.columns if column.title not in ("est.", "peak")
    ),  # IMU- or IMU+ is it
    traced=(*_TESTBED.traced, "jitter", "overruns", "missed_replies"),
    subject="link error by the IMU",
    note="On hardware there is no truth to score an estimate by.",
    is_real=True,
)

_OWN = {
    "testbed": _TESTBED,
    "walker": _WALKER,
    "hardware": _HARDWARE,
    "robot": replace(_WITH_END_EFFECTOR, id=IDS["robot"], robot="robot", default_reference="poses"),
}
ENVIRONMENTS = {
    name: _OWN.get(name) or replace(_JOINTS, id=known, robot=name) for name, known in IDS.items()
}
"""Environments by their short names: those with figures of their own, and other robots of
elastic joints.
"""
