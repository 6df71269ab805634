"""`elastic bench`: compare short rollouts with accepted figures, in CI and without torch."""

import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
import tyro
import yaml
from pydantic import Field, model_validator
from rich.console import Console

from baselines.policies import is_saved
from elastic_env.core.config import (
    MOST_ENTRIES,
    Entries,
    Locator,
    Model,
    Title,
    load_yaml,
    quantity,
)
from elastic_env.core.errors import ConfigurationError, require_known
from elastic_env.core.files import write_whole
from train.cells.play import run_conditions
from train.evaluate.conditions import (
    Condition,
    GivenReference,
    NumEpisodes,
    PolicySpec,
    Seed,
    cell_of,
)
from train.evaluate.episodes import Evaluation, group_by
from train.evaluate.scores import over_cells
from train.evaluate.statistics import Estimate
from train.report.markdown import to_markdown
from train.report.tables import Head, Row, Table
from train.report.terminal import print_table
from train.runs.folders import run_folder
from train.runs.github_annotations import annotation, runs_in_workflow
from train.runs.user_code import CodeNamingModel, kind_check, load_without_code

DEFAULT_CONFIG = Path("configs/bench.yaml")
"""The default configuration; a checkout of the package has it."""
_PACKAGE_CONFIG = Path(__file__).with_name("bench.yaml")


Margin = Annotated[float, Field(ge=0, le=100)]
"""Relative amount by which a figure may exceed the accepted one."""


class BenchCase(Model):
    """A short rollout and its accepted figures."""

    env: str
    policy: Locator
    """A baseline, residual:PATH, "FILE.py:function" or "module:function"."""
    options: dict[str, Any] = {}
    """Options of the policy."""
    scenario: Title = "nominal"
    reference: GivenReference | None = None
    """Motion, as in a comparison; None for the environment's default."""
    seed: Seed = 0
    """Seed of the first episode."""
    episodes: NumEpisodes = 1
    """Episodes, with seeds that follow; a figure is the mean over them."""
    figures: dict[str, float | None] = Field(min_length=1, max_length=MOST_ENTRIES)
    """Metrics of the episodes with accepted values; null until `--update` measures them. Their
    absolute value counts, and smaller is better."""
    margins: dict[str, Margin] = {}
    """Margins of single figures, instead of the margin of the file."""

    @model_validator(mode="after")
    def _margins_are_of_figures(self) -> Self:
        require_known("figure with a margin of its own", self.margins, self.figures)
        return self

    @property
    def condition(self) -> Condition:
        """The cell to play."""
        policy = PolicySpec(name=self.policy, options=self.options)
        return cell_of(self, policy).replace(episodes=self.episodes)


class BenchConfig(CodeNamingModel):
    """The rollouts of `elastic bench`."""

    name: Title = "bench"
    margin: float = quantity("1", 0.05, ge=0, le=100)
    """Relative amount by which a figure without its own margin may exceed the accepted one."""
    _kind = model_validator(mode="before")(kind_check("bench"))
    cases: Entries[BenchCase]

    @property
    def names_of_code(self) -> list[str]:
        """Names that may stand for code."""
        policies = [case.policy for case in self.cases if not is_saved(case.policy)]
        return [*policies, *(case.env for case in self.cases)]


class Bench(Model):
    """Guard figures in CI: compare short rollouts of both environments with accepted figures.

    A worse figure gives exit code 1 and a line, and its rollout comes first in the table. In
    GitHub's workflows these lines are annotations of the configuration, and the table is appended
    to the file in $GITHUB_STEP_SUMMARY. Example, to accept new figures: elastic bench --update
    """

    config: Annotated[Path | None, tyro.conf.Positional] = None
    """Configuration with rollouts and accepted figures. Without one configs/bench.yaml, whose code
    does not run unless it is named; where that does not exist, the configuration of the package.
    """
    update: bool = False
    """Accept the measured figures: replace the figures in the configuration, and nothing else."""
    output: Path | None = None
    """Folder for bench.json and bench.md, new or empty; default runs/bench, numbered if taken."""

    def run(self, console: Console) -> None:
        """Play the rollouts, and write and print their figures."""
        path = find_config(self.config or DEFAULT_CONFIG, self.update)
        if path == _PACKAGE_CONFIG:
            console.print(f"there is no {DEFAULT_CONFIG}; these are the rollouts of the package")
        if self.config is None:  # the user did not name it
            cure = f"name it: elastic bench {path}"
            config = load_without_code(path, BenchConfig, cure)
        else:
            config = load_yaml(path, BenchConfig)
        recorded = config.model_dump(mode="json")
        conditions = [case.condition for case in config.cases]
        with run_folder(config.name, recorded, None, self.output) as folder:
            evaluations = run_conditions(conditions, console)
            figures = list[_Figure]()
            for case, evaluation in zip(config.cases, evaluations, strict=True):
                figures += _figures(case, evaluation, config.margin)
            write_whole(folder / "bench.json", json.dumps(figures, indent=2) + "\n")
            table = _table(figures)
            markdown = f"## elastic bench\n\n{to_markdown(table)}\n"
            write_whole(folder / "bench.md", markdown)
        if summary := os.environ.get("GITHUB_STEP_SUMMARY"):
            with Path(summary).open("a", encoding="utf-8") as file:
                file.write(markdown)
        print_table(table, console, "bench.md")
        console.print(f"wrote {folder}/bench.json and bench.md")
        if self.update:
            accepted = _accept(path, evaluations)
            console.print(f"accepted {accepted} of {len(figures)} figures into {path}")
        failures = [figure for figure in figures if figure["problem"]]
        if self.update:
            failures = [figure for figure in figures if figure["measured"] is None]
        for figure in failures:
            problem = f"{figure['case']}: {figure['problem']}"
            console.print(annotation(problem, path) if runs_in_workflow() else problem)
        if failures:
            sys.exit(1)


def find_config(path: Path, update: bool = False) -> Path:
    """Return a path, or the package's configuration if the path is the default and has no file.

    Raises:
        ConfigurationError: `update` would change the configuration of the package.
    """
    if path != DEFAULT_CONFIG or path.exists():
        return path
    if update:
        cure = f"copy {_PACKAGE_CONFIG} there first"
        raise ConfigurationError(f"there is no {DEFAULT_CONFIG} to update; {cure}")
    return _PACKAGE_CONFIG


_UNITS = ("_m", "_rad", "_s", "_nm", "_share", "_count")
"""Suffixes of metrics."""
_Figure = dict[str, Any]
"""A figure of a rollout: measured, accepted and largest value, and its problem in words.

`measured` is None if the episode failed or lacks the figure; `interval` is the 95 % interval over
several episodes.
"""


def _figures(case: BenchCase, evaluation: Evaluation, margin: float) -> Iterator[_Figure]:
    motion = evaluation.condition.reference_name
    policy = f"{case.policy} {case.options}" if case.options else case.policy
    metrics = [name for name in evaluation.episodes[0] if name.endswith(_UNITS)]
    if not evaluation.num_failed:
        require_known(f"metric of the {case.env}", case.figures, metrics)
    for metric, accepted in case.figures.items():
        score = _score(evaluation, metric)
        factor = 1.0 + case.margins.get(metric, margin)
        figure: _Figure = {
            "case": f"{case.env}, {motion}, {case.scenario}, {policy}",
            "metric": metric,
            "measured": score and score.value,
            "interval": score.ends if score and score.has_interval else None,
            "accepted": accepted,
            "bound": None if accepted is None else factor * abs(accepted),
        }
        yield {**figure, "problem": _problem(figure, evaluation)}


def _score(evaluation: Evaluation, metric: str) -> Estimate | None:
    """Return the mean of a metric over the episodes; None if one failed or lacks the metric."""
    values = evaluation.values(metric)
    is_whole = len(values) == len(evaluation.episodes) and not np.isnan(values).any()
    return over_cells([values[None]]) if is_whole else None


def _problem(figure: _Figure, evaluation: Evaluation) -> str:
    """Return why a figure is not accepted; empty if it is."""
    metric, measured, bound = (figure[key] for key in ("metric", "measured", "bound"))
    terminations = [episode["termination"] for episode in evaluation.episodes]
    if failures := dict.fromkeys(filter(None, terminations)):
        who = f"{evaluation.num_failed} of {len(terminations)} episodes"
        who = "the episode" if len(terminations) == 1 else who
        return f"{metric} has no value: {who} ended as {' and '.join(map(repr, failures))}"
    if measured is None:
        return f"{metric} of this episode is not a number"
    if bound is None:
        cure = "nothing was accepted yet; --update accepts it"
        return f"{metric} is {_text(measured)}, and {cure}"
    if float(_text(abs(measured))) <= bound:
        return ""
    worse = f" ({_change(measured, figure['accepted'])})" if figure["accepted"] else ""
    return f"{metric} is {_text(measured)}{worse}, at most {_text(bound)} is accepted"


def _text(figure: float) -> str:
    """Return a figure as it is accepted and printed."""
    return f"{figure:.4g}"


def _accept(path: Path, evaluations: list[Evaluation]) -> int:
    """Replace accepted figures by measured ones; the text around them does not change.

    Returns:
        Number of replaced figures.

    Raises:
        ConfigurationError: A case has its figures from another case.
    """
    text = path.read_bytes().decode()
    cases = _child(yaml.compose(text), "cases").value
    changes = dict[tuple[int, int], str]()
    last = 0
    for number, (case, evaluation) in enumerate(zip(cases, evaluations, strict=True)):
        figures = _child(case, "figures")
        pairs = [] if figures is None else figures.value
        places = [(value.start_mark.index, value.end_mark.index) for _, value in pairs]
        # the position of an alias is that of its anchor, which comes earlier
        is_own = [*places] == sorted({*places}) and min(places, default=(0, 0))[0] > last
        if not is_own or any(key.value == "<<" for key, _ in pairs):
            problem = f"{path}: figures of cases.{number} stand elsewhere"
            raise ConfigurationError(f"{problem}; give it figures of its own to update them")
        last = places[-1][0]
        for place, (key, _) in zip(places, pairs, strict=True):
            if (measured := _score(evaluation, key.value)) is not None:
                changes[place] = _text(measured.value)
    for (begin, end), value in sorted(changes.items(), reverse=True):
        text = text[:begin] + (value if end > begin else f" {value}") + text[end:]
    write_whole(path.resolve(), text.encode())  # the user named it, maybe by a link
    return len(changes)


def _child(node: Any, name: str) -> Any:
    return next((value for key, value in node.value if key.value == name), None)


def _table(figures: list[_Figure]) -> Table:
    heads = (
        Head("rollout and figure", is_number=False),
        Head("", is_number=False),
        Head("measured"),
        Head("change"),
        Head("at most", leaves=3),
        Head("accepted", leaves=2),
        Head("95 % interval", leaves=1),
    )
    rows = []
    failed = {figure["case"] for figure in figures if figure["problem"]}
    figures = sorted(figures, key=lambda f: (f["case"] not in failed, not f["problem"]))
    for case, case_figures in group_by(figures, lambda figure: figure["case"]).items():
        rows.append(Row((case,), kind="heading"))
        for figure in case_figures:
            numbers = [figure[key] for key in ("measured", "bound", "accepted")]
            measured, bound, accepted = numbers
            verdict = "falls short" if figure["problem"] else "kept"
            if measured is not None and bound is None:
                verdict = "new"
            elif measured is not None and abs(measured) < 2.0 * abs(accepted) - bound:
                verdict = "better"
            text, *limits = ["-" if n is None else _text(n) for n in numbers]
            change = _change(measured, accepted)
            interval = ", ".join(map(_text, figure["interval"] or ())) or "-"
            rows.append(Row((figure["metric"], verdict, text, change, *limits, interval)))
    title = "short rollouts against what was accepted"
    verdicts = {row.cells[1] for row in rows if row.kind != "heading"}
    is_better = "better" in verdicts and "falls short" not in verdicts
    caption = "--update accepts what is better." if is_better else ""
    table = Table(heads, tuple(rows), title=title, caption=caption)
    for place in reversed(range(len(heads))):
        if set(table.column(place)) == {"-"}:
            table = table.without(place)
    return table


def _change(measured: float | None, accepted: float | None) -> str:
    """Return the change of a figure's absolute value [%]; a dash without an accepted figure."""
    if measured is None or not accepted:
        return "-"
    return f"{100.0 * (abs(measured) / abs(accepted) - 1.0):+.1f} %"
