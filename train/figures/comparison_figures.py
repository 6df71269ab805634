"""The pictures of a comparison: which are drawn, what they show, and names of their files."""

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
from train.figures.chart import Cells, Curve, Panel, median, sweep_chart, time_chart
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

_MIN_SWEPT_REFERENCES = 3
"""From so many references with a number of their own on, the scores are drawn against it."""
_MOST_LINES = 4
"""Lines of a panel over time."""
_PAPER_BOUND_MRAD = 10.0
"""The pelvis error stays below it with compensation in the paper, in its two gaits."""
_PAPER_FIGURES = {"pelvis": {"24 s": 7, "3 s": 8}, "zmp": {"24 s": 9, "3 s": 10}}
_PAPER_SCENARIOS = ("ideal", "nominal")
_SUBJECTS = {"pelvis": "Pelvis error. ", "zmp": "Zero moment point. "}
"""Beginnings of the titles of pictures of a walk."""
_PAPER_RANGES_MRAD = {"uncompensated": (-56.2, 41.7), "input": (-3.7, 7.1)}
"""Fig. 6 of the paper."""


def draw_figures(
    evaluations: Evaluations,
    folder: Path,
    policies: Sequence[str] = (),
    swept: str | None = None,
    figure_format: FigureFormat = "png",
) -> list[Path]:
    """Draw the figures of a comparison.

    Args:
        evaluations: All cells, the training seeds of a residual put together.
        folder: Where to.
        policies: Policies of the time series, all if empty.
        swept: Title of the axis of swept options; None without a sweep.
        figure_format: Of the files.
    """
    known = evaluations[0].condition.environment
    files = []
    for name, chart in sweep_charts(evaluations, swept, known.swept).items():
        files.append(draw_chart(chart, folder / f"sweep_{name}.{figure_format}"))
    if swept is not None:
        return files
    overview = folder / f"overview.{figure_format}"
    files.insert(0, draw_overview(evaluations, known.judged, overview))
    for group in cells_together(evaluations):
        by_policy = group_by(group, lambda e: e.condition.policy.title)
        shown = [own for t, own in by_policy.items() if not policies or t in policies]
        files += draw_signals(list(chain(*shown)), folder, figure_format) if shown else []
    return files


def draw_maps(
    maps: Sequence[HeatMap], folder: Path, figure_format: FigureFormat = "png"
) -> list[Path]:
    """Draw the maps of a comparison, a picture per scenario, motion and metric."""
    files = []
    for found in maps:
        name = _safe(f"{found.title}_{found.column.metric}")
        files.append(draw_map(found, folder / f"map_{name}.{figure_format}"))
    return files


def draw_signals(
    evaluations: Evaluations, folder: Path, figure_format: FigureFormat = "png"
) -> list[Path]:
    """Draw the signals of one motion and scenario over time, and what it shows at rest.

    Args:
        evaluations: The policies, a line each.
        folder: Where to.
        figure_format: Of the files.
    """
    first = evaluations[0]
    known = first.condition.environment
    files = []
    for name, signals in group_by(known.curves, lambda signal: signal.picture).items():
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

    A panel has four lines at most, so several policies have several panels.
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
            chart = replace(chart, panels=list(map(_with_bounds, chart.panels)))
    return draw_chart(replace(chart, title=title), path)


def _with_bounds(panel: Panel) -> Panel:
    """A panel of the pelvis error with the bounds that the paper's stays in."""
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
    """Name of a figure's file; the paper's conditions have the number of its figure in front."""
    number = paper_figure(name, evaluation.condition)
    return f"{'' if number is None else f'fig{number}_'}{name}_{_stem(evaluation)}"


def paper_figure(name: str, condition: Condition) -> int | None:
    """Number of the paper's figure that a picture of a condition stands beside, if there is one."""
    is_like_the_paper = condition.scenario in _PAPER_SCENARIOS
    numbers = _PAPER_FIGURES.get(name, {}) if is_like_the_paper else {}
    return numbers.get(condition.reference_name)


def cells_together(evaluations: Evaluations) -> list[list[Evaluation]]:
    """Evaluations of the same reference and scenario together."""
    cells = group_by(evaluations, lambda e: e.condition.cell[:2])
    return list(cells.values())


def by_option(evaluations: Evaluations) -> Cells:
    """Evaluations of every policy by the swept value; None for a policy that was not swept."""
    return _by_policy(evaluations, lambda e: next(iter(e.condition.swept.values()), None))


def by_reference(evaluations: Evaluations) -> Cells:
    """Evaluations of every policy by the number of the reference, such as the step period [s]."""
    numbered = [e for e in evaluations if e.condition.number is not None]
    return _by_policy(numbered, lambda e: e.condition.number)


def _by_policy(evaluations: Evaluations, key: Callable[[Evaluation], Any]) -> Cells:
    policies = group_by(evaluations, lambda e: e.condition.policy.title)
    return {title: group_by(own, key) for title, own in policies.items()}


def sweep_charts(
    evaluations: Evaluations,
    swept: str | None,
    columns: Sequence[Column],
    statistic: Any = median,
) -> dict[str, Any]:
    """Scores over a swept option, or over what the references differ in.

    Args:
        evaluations: All cells.
        swept: Title of the axis of swept options; None without a sweep.
        columns: A panel for each.
        statistic: See `sweep_chart`.

    Returns:
        Charts by the ends of the names of their files.
    """
    known = evaluations[0].condition.environment
    colours = policy_colours([e.condition.policy.title for e in evaluations])
    found = {}
    if swept is not None:
        for own in cells_together(evaluations):
            chart = sweep_chart(by_option(own), columns, swept, colours, statistic)
            found[_stem(own[0])] = replace(chart, title=_title(own[0].condition))
        return found
    for scenario, own in group_by(evaluations, lambda e: e.condition.scenario).items():
        if has_swept_references(own):
            label = f"{known.quantity} [s]"
            chart = sweep_chart(by_reference(own), columns, label, colours, statistic)
            found[_safe(scenario)] = replace(chart, title=f"Scenario {scenario}")
    return found


def _title(condition: Condition) -> str:
    motion = condition.environment.title(condition.reference_name)
    return f"{motion[:1].upper()}{motion[1:]}, scenario {condition.scenario}"


def has_swept_references(evaluations: Evaluations) -> bool:
    """True if enough references have a number, and each one of its own: points of one axis."""
    numbers = {e.condition.reference_name: e.condition.number for e in evaluations}
    known = [number for number in numbers.values() if number is not None]
    return len(known) >= _MIN_SWEPT_REFERENCES and len(set(known)) == len(known)


def _stem(evaluation: Evaluation) -> str:
    condition = evaluation.condition
    return _safe(f"{condition.reference_name}_{condition.scenario}")


def _safe(text: str) -> str:
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
        label = f"{label_text(policy)}: {low:+.1f} to {high:+.1f} mrad{_paper(policy)}"
        torque = link_torque(points, gravity, points.q)
        axis.scatter(torque, error, s=34, label=label, **style)
        axis.axhspan(low, high, color=shade, alpha=0.08, lw=0)
        for bound in _PAPER_RANGES_MRAD.get(policy, ()):
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


def _paper(policy: str) -> str:
    if policy not in _PAPER_RANGES_MRAD:
        return ""
    low, high = _PAPER_RANGES_MRAD[policy]
    return f" (paper, dotted: {low:+.1f} to {high:+.1f})"
