"""The pictures of a comparison: their choice, their content, and the names of their files."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from baselines.compensation.gravity_torque import make_gravity
from baselines.identification.static_points import link_torque
from elastic_env.core.signals import Array
from elastic_env.world.robot_model import RobotModel
from train.evaluate.conditions import Condition
from train.evaluate.environments import Column, TracedSignal
from train.evaluate.episodes import Evaluation, group_by
from train.evaluate.maps import HeatMap
from train.evaluate.rollout import make_vector_env
from train.figures.chart import Cells, Curve, Panel
from train.figures.colours import policy_colours
from train.figures.map_plots import draw_map
from train.figures.plots import (
    MRAD,
    Evaluations,
    FigureFormat,
    draw_chart,
    draw_overview,
    label_text,
    new_figure,
    save,
)
from train.figures.score_charts import median, sweep_chart
from train.figures.time_chart import time_chart

_MIN_SWEPT_REFERENCES = 3
"""Fewest references with different numbers for which scores are drawn over the number."""
_MOST_LINES = 4
"""Most lines of a panel over time."""
_PAPER_BOUND_MRAD = 10.0
"""Bound of the pelvis error with compensation in the paper, in its two gaits."""
_PAPER_FIGURES = {"pelvis": {"24 s": 7, "3 s": 8}, "zmp": {"24 s": 9, "3 s": 10}}
_PAPER_SCENARIOS = ("ideal", "nominal")
_SUBJECTS = {"pelvis": "Pelvis error. ", "zmp": "Zero moment point. "}
"""Beginnings of the titles of pictures of a walk."""
_PAPER_RANGES_MRAD = {"uncompensated": (-56.2, 41.7), "input": (-3.7, 7.1)}
"""Ranges of the link error at rest in Fig. 6 of the paper."""


def draw_figures(
    evaluations: Evaluations,
    folder: Path,
    policies: Sequence[str] = (),
    swept: str | None = None,
    figure_format: FigureFormat = "png",
) -> list[Path]:
    """Draw the figures of a comparison.

    Args:
        evaluations: All cells, the training seeds of a residual joined.
        folder: Folder for the files.
        policies: Policies of the time series; all if empty.
        swept: Title of the axis of swept options; None without a sweep.
        figure_format: Format of the files.
    """
    environment = evaluations[0].condition.environment
    files = []
    for name, chart in sweep_charts(evaluations, swept, environment.swept).items():
        files.append(draw_chart(chart, folder / f"sweep_{name}.{figure_format}"))
    if swept is not None:
        return files
    overview = folder / f"overview.{figure_format}"
    files.insert(0, draw_overview(evaluations, environment.judged, overview))
    for group in group_cells(evaluations):
        by_policy = group_by(group, lambda e: e.condition.policy.title)
        shown = [runs for t, runs in by_policy.items() if not policies or t in policies]
        if shown:
            files += draw_signals(list(chain(*shown)), folder, figure_format)
    return files


def draw_maps(
    maps: Sequence[HeatMap], folder: Path, figure_format: FigureFormat = "png"
) -> list[Path]:
    """Draw the maps of a comparison, a picture per scenario, motion and metric."""
    names = [_file_name(f"map_{m.title}_{m.column.metric}.{figure_format}") for m in maps]
    return [draw_map(m, folder / name) for m, name in zip(maps, names, strict=True)]


def draw_signals(
    evaluations: Evaluations, folder: Path, figure_format: FigureFormat = "png"
) -> list[Path]:
    """Draw the signals of one motion and scenario over time, and static errors if it has any.

    Args:
        evaluations: The policies, a line each.
        folder: Folder for the files.
        figure_format: Format of the files.
    """
    first = evaluations[0]
    signal_groups = group_by(first.condition.environment.curves, lambda s: s.picture)
    files = []
    for name, signals in signal_groups.items():
        if name:
            path = folder / f"{figure_name(name, first)}.{figure_format}"
            files.append(draw_picture(name, signals, evaluations, path))
    if first.points is not None:
        path = folder / f"{figure_name('static', first)}.{figure_format}"
        model = make_vector_env(first.condition, 1).unwrapped.assumed_model
        files.append(draw_static_errors(evaluations, model, path))
    return files


def draw_picture(
    name: str, signals: Sequence[TracedSignal], evaluations: Evaluations, path: Path
) -> Path:
    """Draw signals of several policies over time, as Figs. 7 to 10 of the paper.

    A panel has at most four lines, so more policies have more panels.
    """
    condition = evaluations[0].condition
    policies = {e.condition.policy.title: [e] for e in evaluations}
    colours = policy_colours(list(policies))
    chart = time_chart(policies, signals, colours, most_lines=_MOST_LINES)
    number = paper_figure(name, condition)
    title = f"{_SUBJECTS.get(name, '')}{_title(condition)}"
    if number is not None:
        title = f"{title} (cf. Fig. {number} of the paper)"
        if name == "pelvis":
            chart = replace(chart, panels=list(map(_add_paper_bounds, chart.panels)))
    return draw_chart(replace(chart, title=title), path)


def _add_paper_bounds(panel: Panel) -> Panel:
    """Return a panel of the pelvis error with the bounds of the paper's pelvis error."""
    bound = _PAPER_BOUND_MRAD
    name = f"paper, compensated: ±{bound:.0f} mrad"
    ends = panel.curves[0].x[[0, -1]]
    bounds = [
        Curve(label, "#777777", ends, np.full(2, y), dash="dot", width=0.9)
        for label, y in ((name, bound), ("", -bound))
    ]
    low, high = panel.limits or (0.0, 0.0)
    limits = (min(low, -1.2 * bound), max(high, 1.2 * bound))
    return replace(panel, curves=[*panel.curves, *bounds], limits=limits)


def figure_name(name: str, evaluation: Evaluation) -> str:
    """Name of a figure's file; for conditions of the paper it begins with its figure's number."""
    number = paper_figure(name, evaluation.condition)
    return f"{'' if number is None else f'fig{number}_'}{name}_{_cell_name(evaluation)}"


def paper_figure(name: str, condition: Condition) -> int | None:
    """Number of the paper's figure that corresponds to a picture of a condition, if any."""
    if condition.scenario not in _PAPER_SCENARIOS:
        return None
    return _PAPER_FIGURES.get(name, {}).get(condition.reference_name)


def group_cells(evaluations: Evaluations) -> list[list[Evaluation]]:
    """Group evaluations by reference and scenario."""
    return list(group_by(evaluations, lambda e: e.condition.cell[:2]).values())


def group_by_option(evaluations: Evaluations) -> Cells:
    """Group evaluations of every policy by the swept value; None if the policy is not swept."""
    return _cells(evaluations, lambda e: next(iter(e.condition.swept.values()), None))


def group_by_reference(evaluations: Evaluations) -> Cells:
    """Group evaluations of every policy by the number of the reference, such as a step period."""
    numbered = [e for e in evaluations if e.condition.number is not None]
    return _cells(numbered, lambda e: e.condition.number)


def _cells(evaluations: Evaluations, key: Callable[[Evaluation], Any]) -> Cells:
    policies = group_by(evaluations, lambda e: e.condition.policy.title)
    return {title: group_by(cells, key) for title, cells in policies.items()}


def sweep_charts(
    evaluations: Evaluations,
    swept: str | None,
    columns: Sequence[Column],
    statistic: Any = median,
) -> dict[str, Any]:
    """Charts of scores over a swept option, or over the numbers of the references.

    Args:
        evaluations: All cells.
        swept: Title of the axis of swept options; None without a sweep.
        columns: Metrics, a panel for each.
        statistic: See `sweep_chart`.

    Returns:
        Charts by the ends of the names of their files.
    """
    colours = policy_colours([e.condition.policy.title for e in evaluations])
    charts = {}
    if swept is not None:
        for group in group_cells(evaluations):
            cells = group_by_option(group)
            chart = sweep_chart(cells, columns, swept, colours, statistic)
            charts[_cell_name(group[0])] = replace(chart, title=_title(group[0].condition))
        return charts
    label = f"{evaluations[0].condition.environment.quantity} [s]"
    for scenario, group in group_by(evaluations, lambda e: e.condition.scenario).items():
        if has_swept_references(group):
            cells = group_by_reference(group)
            chart = sweep_chart(cells, columns, label, colours, statistic)
            charts[_file_name(scenario)] = replace(chart, title=f"Scenario {scenario}")
    return charts


def _title(condition: Condition) -> str:
    motion = condition.environment.title(condition.reference_name)
    return f"{motion[:1].upper()}{motion[1:]}, scenario {condition.scenario}"


def has_swept_references(evaluations: Evaluations) -> bool:
    """True if enough references have a number and no two have the same: points of one axis."""
    numbers = {e.condition.reference_name: e.condition.number for e in evaluations}
    points = [number for number in numbers.values() if number is not None]
    return len(points) >= _MIN_SWEPT_REFERENCES and len(set(points)) == len(points)


def _cell_name(evaluation: Evaluation) -> str:
    condition = evaluation.condition
    return _file_name(f"{condition.reference_name}_{condition.scenario}")


def _file_name(text: str) -> str:
    return re.sub(r"[^\w.+-]+", "_", text)


def draw_static_errors(evaluations: Evaluations, model: RobotModel, path: Path) -> Path:
    """Link error at the static positions, with and without compensation, as Fig. 6 of the paper."""
    figure, (axis,) = new_figure(1, 1, (7.6, 5.2))
    gravity = [make_gravity(model)]
    shades = policy_colours([e.condition.policy.title for e in evaluations])
    for index, evaluation in enumerate(evaluations):
        policy = evaluation.condition.policy.title
        points = evaluation.points
        if points is None:
            continue
        error = MRAD * static_errors(evaluation)
        shade = shades[policy]
        style = {"marker": "xosDv^"[index % 6], "linewidths": 1.3, "zorder": 3}
        open_dots = {"facecolors": "none", "edgecolors": shade}
        style |= open_dots if index else {"color": shade}
        low = error.min()
        high = error.max()
        label = f"{label_text(policy)}: {low:+.1f} to {high:+.1f} mrad"
        paper_range = _PAPER_RANGES_MRAD.get(policy, ())
        if paper_range:
            label += " (paper, dotted: {:+.1f} to {:+.1f})".format(*paper_range)
        torque = link_torque(points, gravity, points.q)
        axis.scatter(torque, error, s=34, label=label, **style)
        axis.axhspan(low, high, color=shade, alpha=0.08, lw=0)
        for bound in paper_range:
            axis.axhline(bound, color=shade, lw=0.9, ls=":")
    axis.set_title(f"Link error at rest, scenario {evaluations[0].condition.scenario}")
    axis.set_xlabel("gravity torque at the link angle [N·m]")
    axis.set_ylabel("q_ref − q by the link's IMU [mrad]")
    axis.legend(loc="upper left", bbox_to_anchor=(0.0, -0.16), fontsize=9)
    return save(figure, path)


def static_errors(evaluation: Evaluation) -> Array:
    """Link error by the IMU, averaged over each window at rest, (visits,) [rad]."""
    assert evaluation.points is not None
    return evaluation.rest_references - evaluation.points.q
