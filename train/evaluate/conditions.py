"""Cells of a comparison: a policy, a motion and an environment with its scenario."""

from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Annotated, Any

from pydantic import AfterValidator, Field, model_validator

from baselines.catalogue import Track
from baselines.policies import sensors_needed, track
from elastic_env.core.config import LARGEST_SEED, Locator, Model, Title, quantity
from elastic_env.core.config_problems import meaning_of
from elastic_env.core.errors import ConfigurationError, quote
from elastic_env.world.robot_ranges import RobotRanges
from elastic_env.world.scenario import MOST_RANGES, Scenario, make_scenario
from train.evaluate.environments import (
    ENVIRONMENTS,
    RESERVED,
    UNPLACED,
    Environment,
    Reference,
    environment,
)

MOST_EPISODES = 100_000
NumEpisodes = Annotated[int, quantity("1", ge=1, le=MOST_EPISODES)]
"""Episodes of a cell."""
Seed = Annotated[int, quantity("1", ge=0, le=LARGEST_SEED - MOST_EPISODES)]
"""Seed of the first episode; others follow."""
SCENARIO = "scenario."
"""Prefix of a field of the scenario that is varied, such as scenario.stiffness."""
HALF_WIDTH = "half_width"
"""Ending of such a name: half the width of an interval about 0 is varied."""


def _check_options(value: dict[str, Any]) -> dict[str, Any]:
    motions = {environment.motion for environment in ENVIRONMENTS.values()}
    _refuse(value.keys() & {*RESERVED, *motions}, "given here")
    return value


EnvOptions = Annotated[dict[str, Any], AfterValidator(_check_options)]
"""Further arguments of an environment, without those that have a key of their own."""


def _check_reference(value: Any) -> Reference:
    kinds = str | int | float | list | tuple | dict
    if isinstance(value, bool) or not isinstance(value, kinds):
        raise ValueError(
            "a reference is a name, a step period [s], three durations [s] or a mapping of"
            f" parameters, got {quote(value)}"
        )
    if isinstance(value, dict):
        _refuse(value.keys() & set(RESERVED), "part of a reference")
    return list(value) if isinstance(value, tuple) else value


def _refuse(names: set[str], place: str) -> None:
    """Refuse arguments of the environments in a place where they do not belong."""
    for name in sorted(names):
        cure = "it has a key, or an option, of its own"
        if name in UNPLACED:
            cure = "the commands set it themselves"
        raise ValueError(f"{name} cannot be {place}; {cure}")


GivenReference = Annotated[Any, AfterValidator(_check_reference)]
"""A `Reference`, checked when it is read."""


def _check_ranges(value: Any) -> Any:
    make_scenario("drawn", ranges=value)
    return value


GivenRanges = Annotated[
    dict[str, Any] | Annotated[list[dict[str, Any]], Field(max_length=MOST_RANGES)],
    AfterValidator(_check_ranges),
]
"""Intervals of drawn robots that replace those of their scenario, by the names of `RobotRanges`.

Or a list of such mappings, each for an equal share of the robots.
"""


def require_drawn(scenarios: Sequence[str], ranges: GivenRanges) -> None:
    """Refuse ranges that no scenario uses.

    Raises:
        ConfigurationError: There are ranges, and no scenario is `drawn` or combined with it.
    """
    if ranges and not any("drawn" in name.split("+") for name in scenarios):
        raise ConfigurationError(
            "ranges need a scenario whose robots are drawn from them, such as 'drawn', got"
            f" {quote(list(scenarios))}"
        )


class PolicySpec(Model):
    """A policy of a comparison with options: a baseline, or your own as "FILE.py:function"."""

    name: Locator
    """A baseline, residual:PATH, iterative:PATH, FILE.py:function or module:function."""
    label: Locator | None = None
    """Name in tables and figures; None for its name."""
    options: dict[str, Any] = {}
    """Keyword arguments of `baselines.make`, or of your own function."""
    env_options: EnvOptions = {}
    """Arguments of the environment for this policy alone, such as form: rigid."""
    level: bool = False
    """In a sweep: true to play once without the swept option, as a level to compare with."""
    track: Track | None = None
    """On a leaderboard: its needs; None for those of its name, and for your own policy the
    standard sensors.
    """

    @property
    def title(self) -> str:
        """The label, or the name without one."""
        return self.label or self.name


class Member(Model):
    """A training seed of a residual, in a comparison that may have more of them."""

    folder: str
    """Folder of the residual."""
    training_seed: int | None = None
    """Seed that it was trained with; None if neither its files nor its path name one."""
    base: str
    """Title of the policy that it corrects."""
    rival: str | None = None
    """Title of the best policy without learning and with the standard sensors; None if that is
    the base, or does not play."""


class Condition(Model):
    """One cell of a comparison: a policy plays a motion in a scenario."""

    env: str = "testbed"
    policy: PolicySpec
    member: Member | None = None
    """Training seed and base of a residual; None for another policy."""
    reference: GivenReference = None
    """The motion; None for the environment's default. On the testbed: a name or a mapping with
    `kind`. On the walker: a step period [s], three durations [s], or a mapping with `step_period`
    and further arguments of the environment."""
    label: str | None = None
    """Name of the reference in tables and figures; None for the environment's name."""
    scenario: Title = "nominal"
    env_options: EnvOptions = {}
    """Further arguments of the environment, such as stiffness."""
    ranges: GivenRanges = {}
    """Intervals that replace those of the scenario, if it draws robots from ranges."""
    swept: dict[str, float] = {}
    """Varied quantities and their values: options of the policy, or with the prefix `SCENARIO`
    fields of the scenario.
    """
    episodes: NumEpisodes = 1
    """Number of episodes [1]."""
    seed: Seed = 0
    """Seed of the first episode; the next ones follow [1]."""

    def swept_values(self, names: Iterable[str]) -> list[str]:
        """Varied values as tables show them; - for a quantity that does not vary here."""
        return [f"{self.swept[n]:g}" if n in self.swept else "-" for n in names]

    @model_validator(mode="before")
    @classmethod
    def _environment_has_a_default(cls, values: dict[str, Any]) -> dict[str, Any]:
        is_named = isinstance(values, dict) and isinstance(values.get("env", ""), str)
        if is_named and values.get("reference") is None:
            default = environment(values.get("env", "testbed")).default_reference
            values = {**values, "reference": default}
        return values

    @property
    def environment(self) -> Environment:
        """Description of the environment."""
        return environment(self.env)

    @property
    def reference_name(self) -> str:
        """Label of the reference, or the environment's name of it."""
        return self.label or self.environment.label(self.reference)

    @property
    def cell(self) -> tuple[object, ...]:
        """Key of the cell of a policy: motion, scenario, and the varied values."""
        return (self.reference_name, self.scenario, *self.swept.items())

    @property
    def number(self) -> float | None:
        """Number of the reference for the axis of a chart [s]; None without one."""
        return next(iter(self.environment.abscissa(self.reference).values()), None)

    @property
    def arguments(self) -> dict[str, Any]:
        """Arguments of the environment, with the sensors that a baseline reads.

        The policy's options replace those of the condition, and the reference replaces both.
        """
        motion = self.environment.arguments(self.reference)
        options = {**self.env_options, **self.policy.env_options, **motion}
        arguments = {"scenario": self.scenario_played, **options}
        sensors = arguments.get("sensors", [])
        needed = sensors_needed(self.policy.name, self.environment.walks)
        # the environment refuses sensors of another type
        if needed and isinstance(sensors, list | tuple):
            arguments["sensors"] = [*sensors, *(name for name in needed if name not in sensors)]
        return arguments

    @property
    def scenario_played(self) -> str | Scenario:
        """The scenario with its own ranges and varied fields; its name if it has neither."""
        fields = {name: v for name, v in self.swept.items() if name.startswith(SCENARIO)}
        if not fields and not self.ranges:
            return self.scenario
        scenario = make_scenario(self.scenario, self.environment.walks, self.ranges)
        return vary_scenario(scenario, fields)

    @property
    def draws_robots(self) -> bool:
        """True if episodes differ in their robots; hardware has one robot."""
        if self.environment.is_real:
            return False
        return make_scenario(self.scenario_played, self.environment.walks).draws_robots

    @property
    def policy_options(self) -> dict[str, Any]:
        """Options of the policy, with those that are swept."""
        swept = {name: v for name, v in self.swept.items() if not name.startswith(SCENARIO)}
        return {**self.policy.options, **swept}

    @property
    def track(self) -> Track:
        """Needs of the policy, by its specification or by its name."""
        return self.policy.track or track(self.policy.name, self.environment.walks)


def cell_of(options: Any, policy: PolicySpec) -> Condition:
    """The cell of a policy, with env, scenario, reference and seed of a command's options."""
    names = ("env", "scenario", "reference", "seed")
    return Condition(policy=policy, **{name: getattr(options, name) for name in names})


def vary_scenario(scenario: Scenario, fields: Mapping[str, float]) -> Scenario:
    """Return a scenario with other values of some fields, such as `scenario.stiffness` [SI].

    The value of `scenario.mounting_rad.half_width` is half the width of an interval about 0.

    Raises:
        ConfigurationError: A value is beyond the bounds of its field, or robots differ in it.
    """
    for path, value in fields.items():
        first, _, inner = path.removeprefix(SCENARIO).partition(".")
        new: Any = value
        if inner == HALF_WIDTH:
            new = (-value, value)
        elif inner:
            new = getattr(scenario, first).replace(**{inner: value})
        elif first in RobotRanges.model_fields and scenario.draws(first):
            width = f"{SCENARIO}{first}.{HALF_WIDTH}"
            further = f", or vary {width}" if width in scenario_fields() else ""
            raise ConfigurationError(
                f"scenario {scenario.name!r} draws {first} from ranges; vary it in another"
                f" one{further}"
            )
        scenario = scenario.replace(**{first: new})
    return scenario


@lru_cache(maxsize=1)
def scenario_fields() -> Mapping[str, tuple[str, str]]:
    """Numbers of a scenario that can be varied: description and unit by name."""
    return _number_fields(Scenario, SCENARIO)


def _number_fields(model: type[Model], prefix: str) -> dict[str, tuple[str, str]]:
    fields: dict[str, tuple[str, str]] = {}
    for name, field in model.model_fields.items():
        extra = field.json_schema_extra
        if isinstance(field.annotation, type) and issubclass(field.annotation, Model):
            fields |= _number_fields(field.annotation, f"{prefix}{name}.")
        elif isinstance(extra, dict):
            meaning = meaning_of(field) or name
            unit = str(extra["unit"])
            fields[f"{prefix}{name}"] = meaning, unit
            bounds: Any = extra.get("bounds", (0.0, 1.0))
            if bounds[0] == -bounds[1]:
                fields[f"{prefix}{name}.{HALF_WIDTH}"] = f"half-width: {meaning}", unit
    return fields
