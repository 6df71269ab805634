"""`elastic bench`: short rollouts whose figures a CI guards; seconds long, without torch."""

import json
import os
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
import yaml
from pydantic import Field, model_validator
from rich import box
from rich.console import Console
from rich.table import Table

from baselines.policies import is_saved
from elastic_env.core.config import (
    LARGEST_SEED,
    MOST_ENTRIES,
    Locator,
    Model,
    Title,
    load_yaml,
    quantity,
)
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.files import write_whole
from train.cells.play import run_conditions
from train.evaluate.conditions import Condition, GivenReference, PolicySpec
from train.evaluate.environments import environment
from train.evaluate.episodes import Evaluation
from train.runs.console import make_table
from train.runs.escaping import markdown_table
from train.runs.folders import run_folder
from train.runs.kinds import is_a
from train.runs.user_code import load_without_code

USUAL = Path("configs/bench.yaml")
"""Where a configuration is looked for; in a checkout it is that of the package."""
_SHIPPED = Path(__file__).with_name("bench.yaml")


class BenchCase(Model):
    """A short rollout and the figures that it must keep."""

    env: str
    policy: Locator
    """A baseline, residual:PATH, "FILE.py:function" or "module:function"."""
    scenario: Title = "nominal"
    reference: GivenReference | None = None
    """Motion, as in a comparison; None for the environment's default."""
    seed: int = quantity("1", 0, ge=0, le=LARGEST_SEED // 2)
    """Seed of the episode."""
    figures: dict[str, float | None] = Field(min_length=1, max_length=MOST_ENTRIES)
    """Metrics of the episode with what was accepted; null where `--update` has not measured yet."""

    @property
    def condition(self) -> Condition:
        """The cell to play."""
        motion = (
            environment(self.env).default_reference if self.reference is None else self.reference
        )
        policy = PolicySpec(name=self.policy)
        return Condition(
            env=self.env, policy=policy, scenario=self.scenario, seed=self.seed, reference=motion
        )


class BenchConfig(Model):
    """The rollouts of `elastic bench`."""

    name: Title = "bench"
    margin: float = quantity("1", 0.05, ge=0, le=100)
    """Relative amount by which a figure may exceed the accepted."""
    _kind = model_validator(mode="before")(is_a("bench"))
    cases: list[BenchCase] = Field(min_length=1, max_length=MOST_ENTRIES)


@dataclass(frozen=True)
class Figure:
    """A figure of a rollout against what was accepted.

    Attributes:
        case: Environment, motion, scenario and policy.
        metric: Its name, which ends with its unit.
        measured: nan where the episode failed or does not have it.
        accepted: None where nothing was accepted yet.
        bound: What it may be at most.
        problem: Why it falls short, in words; empty where it does not.
    """

    case: str
    metric: str
    measured: float
    accepted: float | None
    bound: float | None
    problem: str


def bench(
    path: Path,
    console: Console,
    update: bool = False,
    output: Path | None = None,
    is_named: bool = True,
) -> bool:
    """Play the rollouts of a configuration, write and print their figures.

    Args:
        path: Configuration; with `update` its figures are changed.
        console: Where progress and results go.
        update: Accept what is measured now.
        output: Folder for bench.json and bench.md; default runs/bench, numbered if taken.
        is_named: Whether the user named the configuration; of another one no code is imported.

    Returns:
        Whether all figures kept their bounds; with `update` whether all have a value.

    Raises:
        ConfigurationError: Names or options that do not exist, or code in a configuration that
            nobody named.
        ResultsExistError: The output folder holds results.
    """
    cure = f"name it: elastic bench {path}"
    config = (
        load_yaml(path, BenchConfig)
        if is_named
        else load_without_code(path, BenchConfig, _names_of_code, cure)
    )
    with run_folder(config.name, config.model_dump(mode="json"), None, output) as folder:
        evaluations = run_conditions([case.condition for case in config.cases], console)
        figures = [
            figure
            for case, evaluation in zip(config.cases, evaluations, strict=True)
            for figure in _figures(case, evaluation, config.margin)
        ]
        write_whole(
            folder / "bench.json",
            json.dumps([_plain(figure) for figure in figures], indent=2) + "\n",
        )
        markdown = _markdown(figures)
        write_whole(folder / "bench.md", markdown)
    summary = os.environ.get("GITHUB_STEP_SUMMARY")
    if summary:
        with Path(summary).open("a", encoding="utf-8") as file:
            file.write(markdown)
    console.print(_table(figures))
    console.print(f"wrote {folder}/bench.json and bench.md", soft_wrap=True)
    if update:
        _accept(path, config, evaluations)
        console.print(f"accepted the figures into {path}", soft_wrap=True)
    short = [
        figure for figure in figures if (np.isnan(figure.measured) if update else figure.problem)
    ]
    for figure in short:
        console.print(
            f"{figure.case}: {figure.problem}", soft_wrap=True, markup=False, highlight=False
        )
    return not short


def _names_of_code(config: BenchConfig) -> list[str]:
    """Names that may stand for code."""
    policies = [case.policy for case in config.cases if not is_saved(case.policy)]
    return [*policies, *(case.env for case in config.cases)]


def _figures(case: BenchCase, evaluation: Evaluation, margin: float) -> list[Figure]:
    (episode,) = evaluation.episodes
    name = f"{case.env}, {evaluation.condition.reference_name}, {case.scenario}, {case.policy}"
    found = []
    for metric, accepted in case.figures.items():
        measured = (
            float(episode.get(metric, np.nan)) if not episode["termination"] else float("nan")
        )
        bound = None if accepted is None else accepted + margin * abs(accepted)
        found.append(
            Figure(
                name, metric, measured, accepted, bound, _problem(metric, measured, bound, episode)
            )
        )
    return found


def _problem(metric: str, measured: float, bound: float | None, episode: dict[str, Any]) -> str:
    if episode["termination"]:
        return f"{metric} has no value: the episode ended as {episode['termination']!r}"
    if metric not in episode:
        known = ", ".join(name for name in episode if name.endswith(("_m", "_rad", "_s", "_nm")))
        return f"{metric} is no metric of this episode; those are {known}"
    if bound is None:
        return (
            f"{metric} is {measured:.4g}, and nothing was accepted yet; elastic bench --update"
            " accepts it"
        )
    return (
        f"{metric} is {measured:.4g}, at most {bound:.4g} is accepted"
        if not measured <= bound
        else ""
    )


def configuration(path: Path, update: bool = False) -> Path:
    """The configuration that is meant: where the usual one does not exist, that of the package.

    Raises:
        ConfigurationError: The one of the package is to be changed.
    """
    if path != USUAL or path.exists():
        return path
    if update:
        raise ConfigurationError(f"there is no {USUAL} to update; copy {_SHIPPED} there first")
    return _SHIPPED


def _accept(path: Path, config: BenchConfig, evaluations: list[Evaluation]) -> None:
    """Write measured figures in the place of accepted ones; what stands around them stays."""
    text = path.read_text(encoding="utf-8")
    changes = []
    for case, evaluation, figures in zip(
        config.cases, evaluations, _figure_nodes(text), strict=True
    ):
        (episode,) = evaluation.episodes
        for metric in case.figures:
            if metric in episode and not episode["termination"]:
                changes.append((figures[metric], f"{episode[metric]:.4g}"))
    for node, value in sorted(changes, key=lambda change: -change[0].start_mark.index):
        begin = node.start_mark.index
        end = node.end_mark.index
        text = text[:begin] + (value if end > begin else f" {value}") + text[end:]
    write_whole(path.resolve(), text)  # the user named it, maybe by a link


def _figure_nodes(text: str) -> list[dict[str, yaml.Node]]:
    """Nodes of the figures of every case in a configuration, by metric."""
    cases = _child(yaml.compose(text), "cases")
    return [
        {key.value: value for key, value in _child(case, "figures").value} for case in cases.value
    ]


def _child(node: Any, name: str) -> Any:
    return next(value for key, value in node.value if key.value == name)


def _plain(figure: Figure) -> dict[str, Any]:
    return {
        name: None if value != value else value for name, value in asdict(figure).items()
    }  # nan is not JSON


def _rows(figures: list[Figure]) -> list[tuple[str, ...]]:
    def text(value: float | None) -> str:
        return "-" if value is None or np.isnan(value) else f"{value:.4g}"

    def verdict(figure: Figure) -> str:
        if not figure.problem:
            return "kept"
        return "new" if figure.bound is None and np.isfinite(figure.measured) else "falls short"

    return [
        (f.case, f.metric, text(f.measured), text(f.accepted), text(f.bound), verdict(f))
        for f in figures
    ]


_COLUMNS = ("rollout", "figure", "measured", "accepted", "at most", "")


def _table(figures: list[Figure]) -> Table:
    rows = []
    last = ""
    for case, metric, measured, _, bound, verdict in _rows(figures):
        if case != last:
            rows.append((case, "", "", ""))
        rows.append((f"  {metric}", measured, bound, verdict))
        last = case
    head = ["rollout and figure", "measured", "at most", ""]
    table = make_table("short rollouts against what was accepted", head, rows, box=box.SIMPLE)
    table.columns[-1].justify = "left"
    return table


def _markdown(figures: list[Figure]) -> str:
    rules = ["---", "---", "---:", "---:", "---:", "---"]
    return f"## elastic bench\n\n{markdown_table(_COLUMNS, rules, _rows(figures))}\n"


class Bench(Model):
    """Guard figures in CI: short rollouts of both environments against what was accepted.

    Exit code 1, and a line for every figure that falls short. Appends its table to the file that
    $GITHUB_STEP_SUMMARY names. Example, to accept new figures: elastic bench --update
    """

    config: Annotated[Path | None, tyro.conf.Positional] = None
    """Configuration with rollouts and accepted figures. Without one configs/bench.yaml, whose code
    does not run unless it is named; where that does not exist, the configuration of the package.
    """
    update: bool = False
    """Accept what is measured now: the figures in the configuration change, and nothing else of
    it.
    """
    output: Path | None = None
    """Folder for bench.json and bench.md, new or empty; default runs/bench, numbered if taken."""

    def run(self, console: Console) -> None:
        """Play and compare."""
        path = configuration(self.config or USUAL, self.update)
        is_named = self.config is not None
        if not bench(path, console, self.update, self.output, is_named):
            sys.exit(1)
