"""`elastic bench`: short rollouts whose figures a CI guards; seconds long, without torch."""

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
from train.report.table_formats import Head, Row, Table, print_table, to_markdown
from train.runs.annotations import annotation, in_workflow
from train.runs.folders import run_folder
from train.runs.user_code import CodeNamingModel, is_a, load_without_code

USUAL = Path("configs/bench.yaml")
"""The default configuration; in a checkout it is that of the package."""
_SHIPPED = Path(__file__).with_name("bench.yaml")


Margin = Annotated[float, Field(ge=0, le=100)]
"""Relative amount by which a figure may exceed the accepted one."""


class BenchCase(Model):
    """A short rollout and the figures that it must keep."""

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
    """Metrics of the episodes with what was accepted; null where `--update` has not measured.
    Their size counts, and smaller is better."""
    margins: dict[str, Margin] = {}
    """Margins of single figures, in place of that of the file."""

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
    """Relative amount by which a figure may exceed the accepted, where it has no margin of its own.
    """
    _kind = model_validator(mode="before")(is_a("bench"))
    cases: Entries[BenchCase]

    @property
    def names_of_code(self) -> list[str]:
        """Names that may stand for code."""
        policies = [case.policy for case in self.cases if not is_saved(case.policy)]
        return [*policies, *(case.env for case in self.cases)]


class Bench(Model):
    """Guard figures in CI: short rollouts of both environments against what was accepted.

    Exit code 1, and a line for every figure that falls short, which stand first in the table. In
    GitHub's workflows these lines are annotations of the configuration, and the table is appended
    to the file that $GITHUB_STEP_SUMMARY names. Example, to accept new figures: elastic bench
    --update
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
        """Play the rollouts, and write and print their figures."""
        path = configuration(self.config or USUAL, self.update)
        if path == _SHIPPED:
            console.print(f"there is no {USUAL}; these are the rollouts of the package")
        if self.config is None:  # it was found, and nobody named it
            cure = f"name it: elastic bench {path}"
            config = load_without_code(path, BenchConfig, cure)
        else:
            config = load_yaml(path, BenchConfig)
        recorded = config.model_dump(mode="json")
        with run_folder(config.name, recorded, None, self.output) as folder:
            conditions = [case.condition for case in config.cases]
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
        short = [one for one in figures if one["problem"]]
        if self.update:
            short = [one for one in figures if one["measured"] is None]
        for one in short:
            problem = f"{one['case']}: {one['problem']}"
            console.print(annotation(problem, path) if in_workflow() else problem)
        if short:
            sys.exit(1)


def configuration(path: Path, update: bool = False) -> Path:
    """The configuration that is meant: where the usual one does not exist, that of the package.

    Raises:
        ConfigurationError: The one of the package is to be changed.
    """
    if path != USUAL or path.exists():
        return path
    if update:
        cure = f"copy {_SHIPPED} there first"
        raise ConfigurationError(f"there is no {USUAL} to update; {cure}")
    return _SHIPPED


_UNITS = ("_m", "_rad", "_s", "_nm", "_share", "_count")
"""Ends of the names of metrics."""
_Figure = dict[str, Any]
"""A figure of a rollout: measured, accepted and largest value, and what is wrong in words.

`measured` is None where the episode failed or does not have the figure; `interval` is that of
several episodes, 95 %.
"""


def _figures(case: BenchCase, found: Evaluation, margin: float) -> Iterator[_Figure]:
    motion = found.condition.reference_name
    policy = f"{case.policy} {case.options}" if case.options else case.policy
    known = [name for name in found.episodes[0] if name.endswith(_UNITS)]
    if not found.num_failed:
        require_known(f"metric of the {case.env}", case.figures, known)
    for metric, accepted in case.figures.items():
        score = _score(found, metric)
        own = case.margins.get(metric, margin)
        figure: _Figure = {
            "case": f"{case.env}, {motion}, {case.scenario}, {policy}",
            "metric": metric,
            "measured": score and score.value,
            "interval": score.ends if score and score.has_interval else None,
            "accepted": accepted,
            "bound": None if accepted is None else (1.0 + own) * abs(accepted),
        }
        yield {**figure, "problem": _problem(figure, found)}


def _score(found: Evaluation, metric: str) -> Estimate | None:
    """Mean of a metric over the episodes; None where one of them failed or does not have it."""
    values = found.values(metric)
    is_whole = len(values) == len(found.episodes) and not np.isnan(values).any()
    return over_cells([values[None]]) if is_whole else None


def _problem(figure: _Figure, found: Evaluation) -> str:
    metric, measured, bound = (figure[key] for key in ("metric", "measured", "bound"))
    terminations = [own["termination"] for own in found.episodes]
    if ends := dict.fromkeys(filter(None, terminations)):
        who = f"{found.num_failed} of {len(found.episodes)} episodes"
        who = "the episode" if len(found.episodes) == 1 else who
        return f"{metric} has no value: {who} ended as {' and '.join(map(repr, ends))}"
    if measured is None:
        return f"{metric} of this episode is not a number"
    if bound is None:
        cure = "nothing was accepted yet; --update accepts it"
        return f"{metric} is {_rounded(measured)}, and {cure}"
    if float(_rounded(abs(measured))) <= bound:
        return ""
    worse = f" ({_change(measured, figure['accepted'])})" if figure["accepted"] else ""
    return f"{metric} is {_rounded(measured)}{worse}, at most {_rounded(bound)} is accepted"


def _rounded(figure: float) -> str:
    """A figure as it is accepted and printed."""
    return f"{figure:.4g}"


def _accept(path: Path, evaluations: list[Evaluation]) -> int:
    """Write measured figures in the place of accepted ones; what stands around them stays.

    Returns:
        How many were written.

    Raises:
        ConfigurationError: A case takes its figures from another one.
    """
    text = path.read_bytes().decode()
    cases = _child(yaml.compose(text), "cases").value
    changes = dict[tuple[int, int], str]()
    last = 0
    for number, (case, evaluation) in enumerate(zip(cases, evaluations, strict=True)):
        figures = _child(case, "figures")
        pairs = [] if figures is None else figures.value
        places = [(value.start_mark.index, value.end_mark.index) for _, value in pairs]
        # an alias stands before: where its anchor does
        is_own = [*places] == sorted({*places}) and min(places, default=(0, 0))[0] > last
        if not is_own or any(key.value == "<<" for key, _ in pairs):
            problem = f"{path}: figures of cases.{number} stand elsewhere"
            raise ConfigurationError(f"{problem}; give it figures of its own to update them")
        last = places[-1][0]
        for place, (key, _) in zip(places, pairs, strict=True):
            if (measured := _score(evaluation, key.value)) is not None:
                changes[place] = _rounded(measured.value)
    for (begin, end), value in sorted(changes.items(), reverse=True):
        text = text[:begin] + (value if end > begin else f" {value}") + text[end:]
    write_whole(path.resolve(), text.encode())  # the user named it, maybe by a link
    return len(changes)


def _child(node: Any, name: str) -> Any:
    return next((value for key, value in node.value if key.value == name), None)


_NUMBERS = ("measured", "accepted", "bound")


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
    figures = sorted(figures, key=lambda one: (one["case"] not in failed, not one["problem"]))
    for case, own in group_by(figures, lambda figure: figure["case"]).items():
        rows.append(Row((case,), kind="heading"))
        for figure in own:
            measured, accepted, bound = (figure[key] for key in _NUMBERS)
            verdict = "falls short" if figure["problem"] else "kept"
            if measured is not None and bound is None:
                verdict = "new"
            elif measured is not None and abs(measured) < 2.0 * abs(accepted) - bound:
                verdict = "better"
            three = (measured, bound, accepted)
            shown, *limits = ["-" if n is None else _rounded(n) for n in three]
            change = _change(measured, accepted)
            ends = figure["interval"]
            interval = f"{_rounded(ends[0])}, {_rounded(ends[1])}" if ends else "-"
            rows.append(Row((figure["metric"], verdict, shown, change, *limits, interval)))
    title = "short rollouts against what was accepted"
    return Table(heads, tuple(rows), title=title, caption="--update accepts what is better.")


def _change(measured: float | None, accepted: float | None) -> str:
    """Change of a figure's size against what was accepted, in per cent; a dash without one."""
    if measured is None or not accepted:
        return "-"
    return f"{100.0 * (abs(measured) / abs(accepted) - 1.0):+.1f} %"
