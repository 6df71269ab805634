"""Cells of a comparison: which policy plays which motion in which environment."""

from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Annotated, Any

from pydantic import AfterValidator, Field, model_validator

from baselines.catalogue import Track
from baselines.policies import sensors_needed, track
from elastic_env.core.config import LARGEST_SEED, Locator, Model, Title, quantity
from elastic_env.core.config_problems import meaning_of
from elastic_env.core.errors import ConfigurationError, quote
from elastic_env.core.robot_ranges import RobotRanges
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
Seed = Annotated[int, quantity("1", ge=0, le=LARGEST_SEED - MOST_EPISODES)]
"""Seed of the first episode; others follow."""
"""Episodes of a cell."""
SCENARIO = "scenario."
"""Prefix of a field of the scenario that is varied, such as scenario.stiffness."""
HALF_WIDTH = "half_width"
"""Part of such a name: half the width of an interval about 0 is varied."""


def _options(value: dict[str, Any]) -> dict[str, Any]:
    motions = {known.motion for known in ENVIRONMENTS.values()}
    _refuse(value.keys() & {*RESERVED, *motions}, "given here")
    return value


EnvOptions = Annotated[dict[str, Any], AfterValidator(_options)]
"""Further arguments of an environment, none of which has a place of its own."""


def _reference(value: Any) -> Reference:
    kinds = str | int | float | list | tuple | dict
    if isinstance(value, bool) or not isinstance(value, kinds):
        raise ValueError(
            "a reference is a name, a step period [s], three durations [s] or a mapping of"
            f" parameters, got {quote(value)}"
        )
    if isinstance(value, dict):
        _refuse(value.keys() & set(RESERVED), "part of a reference")
    return list(value) if isinstance(value, tuple) else value


def _refuse(taken: set[str], what: str) -> None:
    """Refuse arguments of the environments that stand in the wrong place."""
    for name in sorted(taken):
        place = "it has a key, or an option, of its own"
        if name in UNPLACED:
            place = "the commands set it themselves"
        raise ValueError(f"{name} cannot be {what}; {place}")


GivenReference = Annotated[Any, AfterValidator(_reference)]
"""A `Reference`, checked when it is read."""


def _ranges(value: Any) -> Any:
    make_scenario("drawn", ranges=value)
    return value


GivenRanges = Annotated[
    dict[str, Any] | Annotated[list[dict[str, Any]], Field(max_length=MOST_RANGES)],
    AfterValidator(_ranges),
]
"""Intervals of drawn robots that differ from those of their scenario, by the names of
`RobotRanges`; or several such mappings, each of an equal share of the robots."""


def require_drawn(scenarios: Sequence[str], ranges: GivenRanges) -> None:
    """Refuse ranges that no scenario uses.

    Raises:
        ConfigurationError: There are ranges, and no scenario is `drawn` or joined with it.
    """
    if ranges and not any("drawn" in name.split("+") for name in scenarios):
        raise ConfigurationError(
            "ranges need a scenario whose robots are drawn from them, such as 'drawn', got"
            f" {quote(list(scenarios))}"
        )


class PolicySpec(Model):
    """A policy of a comparison: a baseline, or "FILE.py:function" for one's own, with options."""

    name: Locator
    """A baseline, residual:PATH, iterative:PATH, FILE.py:function or module:function."""
    label: Locator | None = None
    """How tables and figures call it; None for its name."""
    options: dict[str, Any] = {}
    """Keyword arguments of `baselines.make`, or of one's own function."""
    env_options: EnvOptions = {}
    """Arguments of the environment for this policy alone, such as form: rigid."""
    level: bool = False
    """In a sweep: whether it plays once without the swept option, as a level to compare with."""
    track: Track | None = None
    """On a leaderboard: what it needs; None for what is known of it, and of one's own policy the
    standard sensors.
    """

    @property
    def title(self) -> str:
        """Label, or name."""
        return self.label or self.name


class Member(Model):
    """A training seed of a residual, in a comparison that may have more of them."""

    folder: str
    """Folder of the residual."""
    training_seed: int | None = None
    """Seed that it was trained with; None where nothing says it."""
    base: str
    """Title of the policy that it corrects."""
    rival: str | None = None
    """Title of the best policy without learning and with the standard sensors; None where that is
    the base, or nobody plays it."""


class Condition(Model):
    """One cell of a comparison: who plays what under which scenario."""

    env: str = "testbed"
    policy: PolicySpec
    member: Member | None = None
    """Of a residual: which training seed the policy is, and what it corrects."""
    reference: GivenReference = None
    """The motion: on the testbed a name or a mapping with `kind`, on the walker a step period [s],
    three durations [s], or a mapping with `step_period` and further arguments of the environment;
    None for the environment's default."""
    label: str | None = None
    """How tables and figures call the reference; None for what the environment calls it."""
    scenario: Title = "nominal"
    env_options: EnvOptions = {}
    """Further arguments of the environment, such as stiffness."""
    ranges: GivenRanges = {}
    """Intervals in place of those of the scenario, where it draws robots from ranges."""
    swept: dict[str, float] = {}
    """The varied quantity and its value: an option of the policy, or with `SCENARIO` before it
    one of the scenario.
    """
    episodes: NumEpisodes = 1
    """Number of episodes [1]."""
    seed: Seed = 0
    """Seed of the first episode; the next ones follow [1]."""

    def swept_values(self, names: Iterable[str]) -> list[str]:
        """Varied values as tables show them; - of what does not vary here."""
        return [f"{self.swept[n]:g}" if n in self.swept else "-" for n in names]

    @model_validator(mode="before")
    @classmethod
    def _environment_has_a_default(cls, values: dict[str, Any]) -> dict[str, Any]:
        is_named = isinstance(values, dict) and isinstance(values.get("env", ""), str)
        if is_named and values.get("reference") is None:
            known = environment(values.get("env", "testbed"))
            values = {**values, "reference": known.default_reference}
        return values

    @property
    def environment(self) -> Environment:
        """The environment, as the commands know it."""
        return environment(self.env)

    @property
    def reference_name(self) -> str:
        """Label of the reference, or what the environment calls it."""
        return self.label or self.environment.label(self.reference)

    @property
    def cell(self) -> tuple[object, ...]:
        """Key of the cell of a policy: motion, scenario, and the varied values."""
        return (self.reference_name, self.scenario, *self.swept.items())

    @property
    def number(self) -> float | None:
        """Number of the reference that scores can be drawn against [s]; None without one."""
        return next(iter(self.environment.abscissa(self.reference).values()), None)

    @property
    def arguments(self) -> dict[str, Any]:
        """Arguments of the environment, with the sensors that a baseline reads.

        The policy's options replace those of the condition, and the reference replaces both.
        """
        motion = self.environment.arguments(self.reference)
        options = {**self.env_options, **self.policy.env_options, **motion}
        found = {"scenario": self.scenario_played, **options}
        given = found.get("sensors", [])
        needed = sensors_needed(self.policy.name, self.environment.walks)
        # else the environment says what they are
        if needed and isinstance(given, list | tuple):
            found["sensors"] = [*given, *(name for name in needed if name not in given)]
        return found

    @property
    def scenario_played(self) -> str | Scenario:
        """The scenario with its own ranges and varied fields; its name where it has neither."""
        swept = self.swept.items()
        fields = {name: v for name, v in swept if name.startswith(SCENARIO)}
        if not fields and not self.ranges:
            return self.scenario
        scenario = make_scenario(self.scenario, self.environment.walks, self.ranges)
        return vary_scenario(scenario, fields)

    @property
    def draws_robots(self) -> bool:
        """True if episodes differ in their robots; on hardware there is one."""
        known = self.environment
        if known.is_real:
            return False
        return make_scenario(self.scenario_played, known.walks).draws_robots

    @property
    def policy_options(self) -> dict[str, Any]:
        """Options of the policy with the swept one."""
        swept = self.swept.items()
        own = {name: v for name, v in swept if not name.startswith(SCENARIO)}
        return {**self.policy.options, **own}

    @property
    def track(self) -> Track:
        """Needs of the policy, by its specification or by its name."""
        return self.policy.track or track(self.policy.name, self.environment.walks)


def cell_of(options: Any, policy: PolicySpec) -> Condition:
    """The cell of a policy that options name by their env, scenario, reference and seed."""
    names = ("env", "scenario", "reference", "seed")
    return Condition(policy=policy, **{name: getattr(options, name) for name in names})


def vary_scenario(scenario: Scenario, fields: Mapping[str, float]) -> Scenario:
    """A scenario with other values of some fields, such as `scenario.stiffness` [SI].

    Of `scenario.mounting_rad.half_width` the value is half the width of an interval about 0.

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
    return _numbers_of(Scenario, SCENARIO)


def _numbers_of(model: type[Model], before: str) -> dict[str, tuple[str, str]]:
    found: dict[str, tuple[str, str]] = {}
    for name, field in model.model_fields.items():
        extra = field.json_schema_extra
        if isinstance(field.annotation, type) and issubclass(field.annotation, Model):
            found |= _numbers_of(field.annotation, f"{before}{name}.")
        elif isinstance(extra, dict):
            meaning = meaning_of(field) or name
            unit = str(extra["unit"])
            found[f"{before}{name}"] = meaning, unit
            bounds: Any = extra.get("bounds", (0.0, 1.0))
            if bounds[0] == -bounds[1]:
                found[f"{before}{name}.{HALF_WIDTH}"] = f"half-width: {meaning}", unit
    return found
