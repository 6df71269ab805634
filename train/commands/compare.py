"""`elastic compare`: policies × scenarios × references × seeds under one protocol."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Self

import tyro
from pydantic import Field, field_validator, model_validator
from rich.console import Console

from baselines.policies import is_saved
from elastic_env.core.config import MOST_ENTRIES, Entries, Locator, Model, Once, Title, load_yaml
from elastic_env.core.errors import ConfigurationError, SystemFailedError, quote, require_known
from elastic_env.world.scenario import make_scenario
from train.cells.play import CellsFailedError, run_conditions
from train.cells.store import CELLS, Store
from train.commands.options import OnHardware, name_options
from train.evaluate.changes import changes
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
from train.evaluate.episodes import Evaluation, merge_seeds
from train.evaluate.maps import MapConfig, heat_maps
from train.evaluate.residual_seeds import expand
from train.evaluate.robots import robot_scores
from train.evaluate.rollout import make_policy, single_world_envs
from train.evaluate.standings import Standing, append_standings, standings
from train.figures import plots
from train.figures.comparison_figures import draw_figures, draw_maps
from train.report import leaderboard
from train.report.change_tables import print_changes, write_maps, write_statistics
from train.report.report_text import Results
from train.report.score_tables import print_robots, write_robots
from train.report.summary import print_summary, write_episodes, write_summary
from train.report.write import require_libraries, write_report
from train.runs import folders
from train.runs.console import print_files, warn_once
from train.runs.presets import find_configuration, print_presets
from train.runs.user_code import CodeNamingModel, is_a, recorded_config
from train.speed.step_times import step_times
from train.workers.executors import LOCAL_EXECUTORS, Executors

_MOST_CELLS = 10_000


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


_USUAL_POLICIES = [PolicySpec(name=name) for name in ("uncompensated", "input")]


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
    policies: Entries[PolicySpec] = _USUAL_POLICIES
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
    """Intervals that the robots of the scenario `drawn` are drawn from, in place of its own."""
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
        known = environment(name)
        default = [known.default_reference]
        motions = _motions_of_map(values.get("map"), known)
        return {"references": motions or default, **values}

    # the last one runs first
    _kind = model_validator(mode="before")(is_a("comparison"))

    @field_validator("policies", mode="before")
    @classmethod
    def _names_are_policies(cls, value: Any) -> Any:
        if not isinstance(value, list):
            return value
        return [{"name": item} if isinstance(item, str) else item for item in value]

    @model_validator(mode="after")
    def _parts_fit(self) -> Self:
        for problem in chain(self._problems_of_map(), self._problems()):
            raise ConfigurationError(problem)
        return self

    @property
    def origin(self) -> str:
        """Version and protocol: rows of leaderboards can stand together if these are the same."""
        others = {"name", "policies", "figure_policies", "leaderboard"}
        protocol = self.model_dump(mode="json", exclude=others)
        walks = environment(self.env).walks
        played = [make_scenario(name, walks, self.ranges) for name in self.scenarios]
        protocol["scenarios"] = [own.model_dump(mode="json") for own in played]
        text = json.dumps(protocol, sort_keys=True)
        digest = hashlib.sha256(text.encode()).hexdigest()[:16]
        packages = ("elastic-env", "mujoco")
        versions = [f"{name} {folders.installed_version(name)}" for name in packages]
        return "; ".join([*versions, f"protocol {digest}"])

    @property
    def names_of_code(self) -> list[str]:
        """Names that may stand for code."""
        names = [policy.name for policy in self.policies]
        return [self.env, *(name for name in names if not is_saved(name))]

    def _problems(self) -> Iterator[str]:
        """Yield what is wrong with single parts, or between them."""
        titles = [policy.title for policy in self.policies]
        references = self._reference_names()
        if repeated := _repeated(titles):
            yield f"two policies are called {repeated[0]!r}; give one of them a label"
        if self.sweep is not None and all(policy.level for policy in self.policies):
            yield "a sweep needs a policy that it varies; level: true leaves all of them out of it"
        require_drawn(self.scenarios, self.ranges)
        require_known("policy of the figures", self.figure_policies, titles)
        known = self.scenarios
        own = self.reference_scenarios
        require_known("scenario with episodes of its own", self.scenario_episodes, known)
        require_known("reference with scenarios of its own", own, references)
        for name, scenarios in own.items():
            require_known(f"scenario of {name!r}", scenarios, known)
        if repeated := _repeated(references):
            yield f"the reference {quote(repeated[0])} stands twice; leave out one of them"
        for name, scenarios in self.groups.items():
            require_known(f"scenario of the group {name!r}", scenarios, known)
            if name in known:
                yield f"group {name!r} must have a name that no scenario has"
        is_real = environment(self.env).is_real
        if self.leaderboard and (self.sweep or self.map or is_real):
            yield "a leaderboard is of simulated cells without a sweep or a map; leave these out"

    def _problems_of_map(self) -> Iterator[str]:
        """Yield how environment or other parts contradict the map."""
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
        """All cells, in the order reference, scenario, policy, training seed, swept value.

        Args:
            with_bases: Whether a residual's base that is not among the policies plays too.

        Raises:
            ConfigurationError: Residuals that do not exist, or are no family.
        """
        entrants = expand(self.policies, with_bases)
        own = self.reference_scenarios
        played = [own.get(name, self.scenarios) for name in self._reference_names()]
        swept = max(len(self._swept(policy)) for policy in self.policies)
        cells = sum(map(len, played)) * len(entrants) * swept
        if cells > _MOST_CELLS:
            raise ConfigurationError(
                f"a comparison must have at most {_MOST_CELLS} cells, {len(self.references)}"
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
        if self.map is not None:
            return self.map.coordinates()
        if self.sweep is None or policy.level:
            return [{}]
        return [{self.sweep.option: value} for value in self.sweep.values]

    def _reference_names(self) -> list[str]:
        """Names of the references in tables."""
        known = environment(self.env)
        labelled = zip(self._reference_labels(), self.references, strict=True)
        return [label or known.label(reference) for label, reference in labelled]

    def _reference_labels(self) -> list[str | None]:
        """Names that tell references of one kind apart; None where the kind is enough."""
        known = environment(self.env)
        kinds = [known.label(reference) for reference in self.references]

        def label(kind: str, reference: Reference) -> str | None:
            given = reference.items() if isinstance(reference, dict) else ()
            others = [f"{k}={v}" for k, v in given if k not in ("kind", known.motion)]
            words = dict.fromkeys([*kind.split(), *others])
            return " ".join(words) if kinds.count(kind) > 1 else None

        return list(map(label, kinds, self.references))


@dataclass(frozen=True)
class Comparison:
    """A finished comparison and its files."""

    folder: Path
    evaluations: list[Evaluation]
    files: list[Path]


@warn_once()
def compare(
    config: CompareConfig,
    console: Console,
    output: Path | None = None,
    executors: Executors = LOCAL_EXECUTORS,
    resumes: bool = False,
    fresh: bool = False,
    report: bool = True,
    figure_format: plots.FigureFormat = "png",
    published: Sequence[Standing] = (),
) -> Comparison:
    """Run a comparison, write its folder, and print its tables.

    Args:
        config: What to compare.
        console: Where progress and table go.
        output: Folder for the results; default runs/<name>, numbered if taken.
        executors: Where its cells are played.
        resumes: Whether the output folder is a run that is gone on with.
        fresh: Whether cells that such a run keeps are played again.
        report: Whether policies are compared with one another, and bases of residuals added for it;
            else they are scored alone, and no cells are kept.
        figure_format: Of the pictures.
        published: Rows of a leaderboard that one's own are appended to.

    Raises:
        ConfigurationError: A name or a parameter does not exist; found before the work begins.
        ResultsExistError: The output folder holds results.
        KeyboardInterrupt: Ctrl-C; finished cells are kept.
    """
    plots.require_matplotlib()
    if report:
        require_libraries()
    conditions = config.conditions(with_bases=report)
    _require_new(config, published)
    try_out(conditions)
    with _open_run(config, output, resumes) as folder:
        store = Store(folder / CELLS) if report else None
        with _finished_kept(folder, console):
            evaluations = run_conditions(conditions, console, executors, store, fresh)
        files = [write_episodes(evaluations, folder / "episodes.csv")]
        cells = merge_seeds(evaluations)
        robots = robot_scores(evaluations)
        axis = config.sweep and config.sweep.title
        maps = [] if config.map is None else heat_maps(evaluations, config.map)
        rows = changes(evaluations, config.groups) if report else []
        # these find the best policy of each column or cell
        if config.leaderboard or maps:
            rows = [row for row in rows if not row.is_rival]
        board = []
        if config.leaderboard:
            console.print("measuring the time of every policy, in turn")
            times = step_times(conditions)
            board = standings(evaluations, config.groups, times, config.origin)
            if published:
                board = append_standings(published, board)
        if robots:
            files.append(write_robots(robots, folder / "robots.csv"))
        files.append(write_summary(cells, folder / "summary.md"))
        if maps:
            files += draw_maps(maps, folder, figure_format)
            files.append(write_maps(maps, folder / "map.csv"))
        else:
            files += draw_figures(cells, folder, config.figure_policies, axis, figure_format)
        if board:
            files += leaderboard.write_leaderboard(board, folder)
        if rows:
            files.append(write_statistics(rows, folder / "statistics.csv"))
        if report:
            parts = (rows, folder, axis, maps, board, robots)
            files += write_report(Results(config.name, evaluations, *parts))
        folders.record_results(folder, files)
    print_summary(cells, console)
    print_robots(robots, console)
    print_changes(rows, console)
    if board:
        leaderboard.print_leaderboard(board, console)
    return Comparison(folder, evaluations, files)


def _require_new(config: CompareConfig, published: Sequence[Standing]) -> None:
    """Refuse published rows that one's own cannot stand beside, before anything is played.

    Raises:
        ConfigurationError: No leaderboard is written, a policy of this name is published, or the
            protocol is another one.
    """
    if not published:
        return
    if not config.leaderboard:
        raise ConfigurationError("published rows are for a configuration with leaderboard: true")
    known = {row.policy for row in published}
    again = [policy.title for policy in config.policies if policy.title in known]
    if again:
        cure = "name your own by --policies, or give it a label in a configuration"
        raise ConfigurationError(f"{quote(again[0])} is published already; {cure}")
    own = [replace(published[0], origin=config.origin)]
    append_standings(published, own)


@contextmanager
def _open_run(config: CompareConfig, output: Path | None, resumes: bool) -> Iterator[Path]:
    """The folder of a run, new or gone on with, for this program alone."""
    recorded = (config.model_dump(mode="json"), config.seed)
    if not resumes or output is None:
        with folders.run_folder(config.name, *recorded, output) as new, folders.lock_run(new):
            yield new
        return
    folders.require_run(output)
    with folders.lock_run(output):
        folders.describe(output, *recorded)
        yield output


@contextmanager
def _finished_kept(folder: Path, console: Console) -> Iterator[None]:
    """Keep finished cells where some fail within, and say so at Ctrl-C."""
    try:
        yield
    except CellsFailedError as error:
        if error.finished:
            write_summary(merge_seeds(error.finished), folder / "summary.md")
            kept = write_episodes(error.finished, folder / "episodes.csv")
            console.print(f"finished cells: {len(error.finished)}, in {kept} and summary.md")
        raise
    except (KeyboardInterrupt, SystemFailedError, OSError) as error:
        if any((folder / CELLS).glob("*.npz")):
            cure = f"go on with: elastic compare --resume {folder}"
            error.add_note(f"finished cells are kept; {cure}")
        raise


def _repeated(values: Sequence[Any]) -> list[Any]:
    """Values that stand more than once."""
    return [value for value in values if values.count(value) > 1]


def try_out(conditions: Sequence[Condition]) -> None:
    """Make environments and policies once, so that a wrong name fails before anything runs."""
    for condition, env in single_world_envs(_each_once(conditions)):
        try:
            policy = make_policy(condition.policy, env, condition.policy_options)
        except ConfigurationError as error:
            if not condition.swept:
                raise
            cure = "level: true leaves a policy out of the sweep"
            raise ConfigurationError(f"{error}; {cure}") from None
        if not hasattr(policy, "predict"):
            name = condition.policy.name
            got = f"no method predict(), got {type(policy).__name__}"
            raise ConfigurationError(f"policy {name!r} has {got}")


def _each_once(conditions: Sequence[Condition]) -> Iterator[Condition]:
    """Conditions with an environment, or a policy at a motion, that no earlier one has.

    There are as many as the sum of both, not their product.
    """
    seen = set[str]()
    for condition in conditions:
        motion = (condition.env, condition.env_options, condition.reference)
        played = (motion, condition.policy, condition.swept)
        own = {repr((motion, condition.scenario_played)), repr(played)}
        if not own <= seen:
            seen |= own
            yield condition


def _motions_of_map(axes: Any, known: Environment) -> list[Any]:
    """Values of the axis of a raw map that varies the motion; empty where none does."""
    for axis in axes.values() if isinstance(axes, dict) else []:
        if isinstance(axis, dict) and axis.get("what") == known.motion:
            values = axis.get("values")
            return values if isinstance(values, list) else []
    return []


class Compare(Model):
    """Compare policies × scenarios × references × seeds as a configuration says.

    Writes episodes.csv (one row per episode), statistics.csv (paired changes), report.html (charts
    and tables, works offline), report.md, summary.md and figures beside the resolved configuration,
    seed, versions and commit.

    A policy residual:PATH may have a * in its path, such as residual:runs/NAME/seed_*/last: all
    training seeds of a residual, compared with their base on the same episodes. The base is added
    if it is not among the policies. residual:walker_3s/seed_* and the like are the trained ones of
    the package. Intervals are over training seeds, and over the robots of scenarios that draw them.

    Example, one joint: elastic compare testbed

    Example, the paper's walks: elastic compare paper

    Example, trained residuals: elastic compare learned_testbed

    Example, all policies in tracks by what they need: elastic compare leaderboard

    Example, your policy beside them, which are not played again: elastic compare leaderboard
        --policies mine.py:make --published leaderboard

    Example, heat maps over two axes: elastic compare map_payload_slope
    """

    config: Annotated[Path | None, tyro.conf.Positional] = None
    """YAML file, or name of a preset; with --resume the configuration of the run unless another is
    named.
    """
    list_presets: Annotated[bool, tyro.conf.arg(name="list")] = False
    """List the presets, which are the configurations of the package, and play none."""
    output: Path | None = None
    """Folder for the results, new or empty; default runs/<name>, numbered if taken."""
    episodes: int | None = None
    """Episodes per cell, in place of what the configuration says: 1 for a first look."""
    policies: tuple[Locator, ...] = ()
    """Policies in place of those of the configuration: baselines, or FILE.py:function."""
    published: Path | None = None
    """leaderboard.csv whose rows yours are appended to, and which are not played; `leaderboard` is
    the one of the package. It must be of the same version and protocol.
    """
    resume: Path | None = None
    """Folder of a run to go on with: what is missing or has changed is played."""
    figure_format: plots.FigureFormat = "png"
    """Of the figures: pdf and svg have no resolution, and png has 300 dpi."""
    fresh: bool = False
    """With --resume: play all cells again."""
    trust_code: bool = False
    """With --resume and no configuration: run the code that the run's own names."""
    executors: Executors = Executors()
    hardware: OnHardware = OnHardware()

    def run(self, console: Console) -> None:
        """Compare, or list the presets."""
        if self.list_presets:
            print_presets("comparison", console)
            return
        if self.resume is not None and self.output is not None:
            problem = "a run goes on in its own folder: --resume takes no --output"
            raise ConfigurationError(problem)
        if self.resume is None and self.fresh:
            problem = "--fresh needs --resume; a new run plays all of its cells"
            raise ConfigurationError(problem)
        if self.config is not None:
            config = load_yaml(find_configuration(self.config, "comparison"), CompareConfig)
        elif self.resume is not None:
            config = recorded_config(self.resume, CompareConfig, self.trust_code)
        else:
            problem = (
                "name a configuration or a preset, which --list shows, or, with --resume, the run"
                " to go on with"
            )
            raise ConfigurationError(problem)
        if self.episodes is not None:
            with name_options():
                config = config.replace(episodes=self.episodes, scenario_episodes={})
        if self.policies:
            with name_options():
                config = config.replace(policies=list(self.policies), figure_policies=[])
        published = ()
        if self.published is not None:
            published = leaderboard.read_leaderboard(leaderboard.find_published(self.published))
        if self.hardware.arguments:
            real = self.hardware.environment(config.env)
            real["env_options"] = {**config.env_options, **real["env_options"]}
            simulated = {"scenario_episodes": {}, "groups": {}}
            config = config.replace(scenarios=["hardware"], **simulated, **real)
        finished = compare(
            config,
            console,
            self.resume or self.output,
            self.executors,
            resumes=self.resume is not None,
            fresh=self.fresh,
            figure_format=self.figure_format,
            published=published,
        )
        print_files(finished.folder, finished.files, console)
