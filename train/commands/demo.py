"""`elastic demo`: the paper's experiments (Figs. 5 to 10) in short."""

from collections.abc import Sequence
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from baselines.compensation.gravity_torque import make_gravity
from baselines.identification.identify import Identification, identify_points
from baselines.policies import is_saved
from elastic_env.core.config import Model
from train.cells.play import run_conditions
from train.commands.compare_config import CompareConfig
from train.evaluate.conditions import PolicySpec
from train.evaluate.episodes import Evaluation
from train.evaluate.rollout import make_vector_env
from train.figures import comparison_figures, plots
from train.figures.colours import policy_colours
from train.figures.identification_plots import draw_identification
from train.report import summary
from train.report.page import TEXTS, Page
from train.report.report_text import capital
from train.report.tables import Table
from train.report.write import add_time_chart, require_libraries, write_page
from train.runs.console import make_table, print_files
from train.runs.folders import run_folder

PAPER_PELVIS = {"uncompensated": "about 40", "input_output": "below 10"}
"""Angle error of the pelvis that the paper reports in both gaits [mrad], its Figs. 7 and 8."""


def _part(
    reference: Any, *names: str, scenario: str = "nominal", **env_options: Any
) -> CompareConfig:
    """Return a comparison of policies in one motion; the label of a saved policy is residual."""
    labels = {name: "residual" if is_saved(name) else None for name in names}
    return CompareConfig(
        name="demo",
        env="testbed" if isinstance(reference, str) else "walker",
        references=[reference],
        scenarios=[scenario],
        env_options=env_options,
        policies=[PolicySpec(name=name, label=label) for name, label in labels.items()],
    )


_PARTS = [
    _part("hold", "uncompensated", "input"),
    _part("sine", "uncompensated", "input", "dynamic", "oracle", "residual:testbed/seed_0"),
    _part({"step_period": 24, "num_steps": 2}, "uncompensated", "input_output"),
    _part(3, "uncompensated", "input_output", "input_wrench"),
    # while policies ramp in and learn the softness, the pitch is that of the uncompensated robot
    _part(
        3,
        "input_output",
        "phase_table",
        "residual:walker_3s/seed_0",
        scenario="soft",
        gait={"settling_steps": 1},
    ),
]
"""Static poses and a motion of the testbed, then walks."""

Cells = Sequence[Evaluation]
Rows = list[tuple[str, str, str]]
"""Quantities, with the figures of this program and of the paper."""


class Demo(Model):
    """The paper's experiments in short, on testbed and walker, in some minutes, with a report."""

    output: Path | None = None
    """Folder for the results, new or empty; default runs/demo, numbered if taken."""
    figure_format: plots.FigureFormat = "png"
    """Of the figures: pdf and svg have no resolution, and png has 300 dpi."""

    def run(self, console: Console) -> None:
        """Play the parts, and print and write tables with the paper's figures, and pictures."""
        plots.require_matplotlib()
        require_libraries()
        parts = [config.conditions() for config in _PARTS]
        conditions = list(chain(*parts))
        recorded = {"conditions": [cell.model_dump(mode="json") for cell in conditions]}
        with run_folder("demo", recorded, 0, self.output) as folder:
            console.print(_INTRODUCTION)
            evaluations = iter(run_conditions(conditions, console))
            played = [list(islice(evaluations, len(part))) for part in parts]
            static, motion, *walked = played
            walks = list(chain(*walked))
            scored = [*motion, *walks]
            model = make_vector_env(static[0].condition, 1).unwrapped.assumed_model
            points = static[0].points
            assert points is not None
            result = identify_points(points, [make_gravity(model)])
            result.save(folder / "identification.json")
            curves = static[0].condition.environment.curves
            names = ("fig5_identification", "fig6_static_errors", "sine")
            fig5, fig6, sine = (folder / f"{name}.{self.figure_format}" for name in names)
            files = [
                draw_identification(result, points, [model], fig5),
                comparison_figures.draw_static_errors(static, model, fig6),
                comparison_figures.draw_picture("time", curves, motion, sine),
            ]
            for walk in comparison_figures.group_cells(walks):
                files += comparison_figures.draw_signals(walk, folder, self.figure_format)
            testbed_rows = _testbed_rows(result, static)
            files += [
                *write_page(_report(testbed_rows, files[:2], motion, walks), folder),
                folder / "identification.json",
                summary.write_episodes(scored, folder / "episodes.csv"),
                summary.write_summary(scored, folder / "summary.md"),
            ]
        console.print(make_table(_TESTBED, _HEAD, testbed_rows), "")
        summary.print_summary(motion, console)
        console.print("", make_table(_WALKS, _HEAD, _walk_rows(walks)), "")
        summary.print_summary(walks, console)
        print_files(folder, files, console)


_INTRODUCTION = (
    "Robots of the paper, simulated (scenario nominal): one joint with servo, elastic gear and a"
    " pendulum of 60 N·m, and a humanoid that walks in place on twelve of them; at the end with"
    " joints that are softer than assumed (scenario soft), where the first step settles and is not"
    " scored"
)
_HEAD = ("quantity", "here", "paper")
_TESTBED = "the paper's testbed experiments, Figs. 5 and 6"
_PICTURES = (
    "Deflection under gravity (cf. Fig. 5 of the paper)",
    "Link error at rest (cf. Fig. 6 of the paper)",
)
"""Titles of the pictures of the page."""
_WALKS = "the paper's walks, Figs. 7 and 8: largest roll and pitch"


def _report(rows: Rows, pictures: Sequence[Path], motion: Cells, walks: Cells) -> Page:
    """Return a page with the tables of the demonstration, and with curves that can be zoomed."""
    page = Page("Demonstration", f"{_INTRODUCTION}.")
    page.section("One joint, at rest")
    page.add("table", Table.plain(_HEAD, rows))
    for picture, title in zip(pictures, _PICTURES, strict=True):
        page.add("picture", picture, title)
    page.section("One joint, in motion", TEXTS["curves"])
    _add_cells(page, motion)
    page.section("Walks", f"{TEXTS['curves']}{TEXTS['curves_walk']}")
    page.add("table", Table.plain(_HEAD, _walk_rows(walks)), capital(_WALKS))
    _add_cells(page, walks)
    return page


def _add_cells(page: Page, evaluations: Cells) -> None:
    """Add the scores of some cells, and a chart for each motion and scenario."""
    columns = evaluations[0].condition.environment.columns
    page.add("table", summary.summary_table(evaluations, columns))
    for cells in comparison_figures.group_cells(evaluations):
        policies = dict.fromkeys(cell.condition.policy.title for cell in cells)
        add_time_chart(page, cells, policy_colours(list(policies)), _MAX_POINTS)


_MAX_POINTS = 1500
"""Largest number of points of a curve on the page."""


def _testbed_rows(result: Identification, static: Cells) -> Rows:
    """Return the rows of Figs. 5 and 6."""
    stiffness = f"{result.stiffness_nm_per_rad:.1f}"
    interval = f"{result.stiffness_low_nm_per_rad:.1f} to {result.stiffness_high_nm_per_rad:.1f}"
    line = f"{result.line_stiffness_nm_per_rad:.1f}"
    rows = [
        ("true stiffness of the plant [N·m/rad]", "1001", "-"),
        ("identified stiffness [N·m/rad]", stiffness, "1001"),
        ("95 % interval of the stiffness [N·m/rad]", interval, "-"),
        ("stiffness by a plain line [N·m/rad]", line, "1001"),
        ("friction [N·m]", f"{result.friction_nm:.2f}", "-"),
        ("Pearson r", f"{result.pearson_r:.4f}", "0.9775"),
    ]
    ranges = ("-56.2 to +41.7", "-3.7 to +7.1")
    for evaluation, paper in zip(static, ranges, strict=True):
        error = 1e3 * comparison_figures.static_errors(evaluation)
        name = f"link error at rest, {evaluation.condition.policy.title} [mrad]"
        rows.append((name, f"{error.min():+.1f} to {error.max():+.1f}", paper))
    return rows


def _walk_rows(walks: Cells) -> Rows:
    """Return the rows of Figs. 7 and 8."""
    rows = []
    for walk in walks:
        condition = walk.condition
        is_paper = condition.scenario == "nominal"
        scenario = "" if is_paper else f", {condition.scenario}"
        if condition.env_options.get("gait", {}).get("settling_steps"):
            scenario += " from the second step on"
        motion = condition.environment.title(condition.reference_name) + scenario
        peaks = [
            f"{1e3 * np.max(walk.values(f'pelvis_{axis}_peak_rad')):.1f}"
            for axis in ("roll", "pitch")
            if not walk.num_failed
        ]
        paper = PAPER_PELVIS.get(condition.policy.title, "-") if is_paper else "-"
        name = f"{motion}, {condition.policy.title} [mrad]"
        rows.append((name, " and ".join(peaks) or "fell", paper))
    return rows
