"""Configuration of a comparison: policies × scenarios × references × seeds."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from itertools import chain
from typing import Annotated, Any, Self

from pydantic import Field, field_validator, model_validator

from baselines.policies import is_saved
from elastic_env.core.config import MOST_ENTRIES, Entries, Model, Once, Title
from elastic_env.core.errors import ConfigurationError, quote, require_known
from elastic_env.world.scenario import make_scenario
from train.evaluate.conditions import (
    Condition,
    EnvOptions,
    GivenRanges,
    GivenReference,
    NumEpisodes,
    PolicySpec,
    Seed,
    require_drawn,
)
from train.evaluate.environments import Environment, Reference, environment
from train.evaluate.maps import MapConfig
from train.evaluate.residual_seeds import expand
from train.runs.folders import installed_version
from train.runs.user_code import CodeNamingModel, kind_check

_MAX_CELLS = 10_000


class Sweep(Model):
    """An option of the policies that takes several values, for curves instead of time series."""

    option: Title
    """Option of the policies, such as stiffness_scale."""
    values: Annotated[list[float], Once] = Field(min_length=2, max_length=MOST_ENTRIES)
    label: Title | None = None
    """Label of the axis; None for the option's name."""

    @property
    def title(self) -> str:
        """Label, or name of the option."""
        return self.label or self.option


class CompareConfig(CodeNamingModel):
    """A comparison, as read from `configs/*.yaml`."""

    name: str = Field(pattern=r"^[\w.-]*\w$", max_length=100)
    """Name of the result folder under runs/: letters, digits, dots, dashes."""
    env: str = "testbed"
    """Environment: testbed, walker, robot, hardware, ROBOT.yaml, or FILE.py:ROBOT."""
    references: Entries[GivenReference]
    """Motions: names, step periods, durations, or mappings with further arguments of the
    environment; default the environment's.
    """
    scenarios: Annotated[Entries[Title], Once] = ["nominal"]
    """Scenarios by name."""
    policies: Entries[PolicySpec] = [PolicySpec(name=name) for name in ("uncompensated", "input")]
    """Baselines by name, or mappings with name, label, options, and env_options of their own."""
    episodes: NumEpisodes = 1
    """Episodes per cell."""
    scenario_episodes: dict[str, NumEpisodes] = {}
    """Episodes per cell of single scenarios, where they differ: {ideal: 1}, in which nothing is
    random.
    """
    seed: Seed = 0
    """Seed of the first episode."""
    ranges: GivenRanges = {}
    """Intervals from which the robots of the scenario `drawn` are drawn, instead of its own."""
    env_options: EnvOptions = {}
    """Further arguments of the environment, such as stiffness."""
    figure_policies: list[str] = []
    """Policies that the time series show, by label or name; all if empty."""
    sweep: Sweep | None = None
    """An option of the policies to vary."""
    map: MapConfig | None = None
    """Two axes to vary, for heat maps: fields of the scenario, or the motion, whose values are
    then the references.
    """
    groups: dict[str, Annotated[Entries[str], Once]] = {}
    """Scenarios that paired changes are also pooled over, by the name of the group."""
    reference_scenarios: dict[str, Annotated[Entries[Title], Once]] = {}
    """Scenarios of single references, by their names in tables, where not all are played: {24 s:
    [nominal]}.
    """
    leaderboard: bool = False
    """Write a leaderboard: policies in tracks, groups and motions as columns, and the time of a
    step.
    """

    @model_validator(mode="before")
    @classmethod
    def _environment_has_a_default(cls, values: Any) -> Any:
        name = values.get("env", "testbed") if isinstance(values, dict) else None
        if not isinstance(name, str):
            return values
        default = environment(name)
        motions = _map_motions(values.get("map"), default)
        return {"references": motions or [default.default_reference], **values}

    # pydantic runs the last of these validators first
    _kind = model_validator(mode="before")(kind_check("comparison"))

    @field_validator("policies", mode="before")
    @classmethod
    def _names_are_policies(cls, value: Any) -> Any:
        if not isinstance(value, list):
            return value
        return [{"name": item} if isinstance(item, str) else item for item in value]

    @model_validator(mode="after")
    def _parts_fit(self) -> Self:
        for problem in chain(self._map_problems(), self._problems()):
            raise ConfigurationError(problem)
        return self

    @property
    def origin(self) -> str:
        """Version and protocol; only rows with the same origin can share a leaderboard."""
        irrelevant = {"name", "policies", "figure_policies", "leaderboard"}
        protocol = self.model_dump(mode="json", exclude=irrelevant)
        walks = environment(self.env).walks
        scenarios = [make_scenario(name, walks, self.ranges) for name in self.scenarios]
        protocol["scenarios"] = [s.model_dump(mode="json") for s in scenarios]
        text = json.dumps(protocol, sort_keys=True)
        digest = hashlib.sha256(text.encode()).hexdigest()[:16]
        packages = ("elastic-env", "mujoco")
        versions = [f"{name} {installed_version(name)}" for name in packages]
        return "; ".join([*versions, f"protocol {digest}"])

    @property
    def names_of_code(self) -> list[str]:
        """Names that may stand for code."""
        names = [policy.name for policy in self.policies]
        return [self.env, *(name for name in names if not is_saved(name))]

    def _problems(self) -> Iterator[str]:
        """Yield problems of single parts, and contradictions between them."""
        titles = [policy.title for policy in self.policies]
        references = self._reference_names()
        if duplicates := _duplicates(titles):
            yield f"two policies are called {duplicates[0]!r}; give one of them a label"
        if self.sweep is not None and all(policy.level for policy in self.policies):
            yield "a sweep needs a policy that it varies; level: true leaves all of them out of it"
        require_drawn(self.scenarios, self.ranges)
        require_known("policy of the figures", self.figure_policies, titles)
        known = self.scenarios
        require_known("scenario with episodes of its own", self.scenario_episodes, known)
        scenarios_of = self.reference_scenarios
        require_known("reference with scenarios of its own", scenarios_of, references)
        for name, scenarios in scenarios_of.items():
            require_known(f"scenario of {name!r}", scenarios, known)
        if duplicates := _duplicates(references):
            yield f"the reference {quote(duplicates[0])} stands twice; leave out one of them"
        for name, scenarios in self.groups.items():
            require_known(f"scenario of the group {name!r}", scenarios, known)
            if name in known:
                yield f"group {name!r} must have a name that no scenario has"
        is_real = environment(self.env).is_real
        if self.leaderboard and (self.sweep or self.map or is_real):
            yield "a leaderboard is of simulated cells without a sweep or a map; leave these out"

    def _map_problems(self) -> Iterator[str]:
        """Yield contradictions between the map and the environment or other parts."""
        if self.map is None:
            return
        self.map.require(environment(self.env))
        if self.sweep is not None or any(policy.level for policy in self.policies):
            yield "a map has two axes of its own; leave out sweep, and level of the policies"
        motion = self.map.motion
        if motion is not None and self.references != motion.values:
            yield (
                f"an axis of the map varies the {motion.what}, so its values are the references;"
                f" leave out references, got {quote(self.references)}"
            )

    def conditions(self, with_bases: bool = True) -> list[Condition]:
        """Return all cells, in the order reference, scenario, policy, training seed, swept value.

        Args:
            with_bases: Add the bases of residuals that are not among the policies.

        Raises:
            ConfigurationError: Residuals do not exist, or are no family.
        """
        entrants = expand(self.policies, with_bases)
        names = self._reference_names()
        played = [self.reference_scenarios.get(name, self.scenarios) for name in names]
        swept = max(len(self._swept(policy)) for policy in self.policies)
        cells = sum(map(len, played)) * len(entrants) * swept
        if cells > _MAX_CELLS:
            raise ConfigurationError(
                f"a comparison must have at most {_MAX_CELLS} cells, {len(self.references)}"
                f" references x {len(self.scenarios)} scenarios x {len(entrants)} policies x"
                f" {swept} values are {cells}; split it"
            )
        motions = zip(self.references, self._reference_labels(), played, strict=True)
        return [
            Condition(
                env=self.env,
                policy=entrant.policy,
                member=entrant.member,
                reference=reference,
                label=label,
                scenario=scenario,
                swept=swept,
                ranges=self.ranges,
                env_options=self.env_options,
                episodes=self.scenario_episodes.get(scenario, self.episodes),
                seed=self.seed,
            )
            for reference, label, scenarios in motions
            for scenario in scenarios
            for entrant in entrants
            for swept in self._swept(entrant.policy)
        ]

    def _swept(self, policy: PolicySpec) -> list[dict[str, float]]:
        """Return the swept values of each cell of a policy."""
        if self.map is not None:
            return self.map.coordinates()
        if self.sweep is None or policy.level:
            return [{}]
        return [{self.sweep.option: value} for value in self.sweep.values]

    def _reference_names(self) -> list[str]:
        """Return the names of the references in tables."""
        kind = environment(self.env).label
        labelled = zip(self._reference_labels(), self.references, strict=True)
        return [label or kind(reference) for label, reference in labelled]

    def _reference_labels(self) -> list[str | None]:
        """Return names that distinguish references of one kind; None where the kind is enough."""
        env = environment(self.env)
        kinds = [env.label(reference) for reference in self.references]

        def label(kind: str, reference: Reference) -> str | None:
            arguments = reference.items() if isinstance(reference, dict) else ()
            others = [f"{k}={v}" for k, v in arguments if k not in ("kind", env.motion)]
            words = dict.fromkeys([*kind.split(), *others])
            return " ".join(words) if kinds.count(kind) > 1 else None

        return list(map(label, kinds, self.references))


def _map_motions(axes: Any, env: Environment) -> list[Any]:
    """Return the values of the axis that varies the motion in a raw map; empty without one."""
    for axis in axes.values() if isinstance(axes, dict) else []:
        if isinstance(axis, dict) and axis.get("what") == env.motion:
            values = axis.get("values")
            return values if isinstance(values, list) else []
    return []


def _duplicates(values: Sequence[Any]) -> list[Any]:
    """Return the values that occur several times."""
    return [value for value in values if values.count(value) > 1]
