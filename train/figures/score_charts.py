"""Charts of scores: over a swept value, during a training, and over trials on the robot."""

from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np

from train.evaluate.environments import Column
from train.evaluate.learning_curves import Curves
from train.evaluate.statistics import Estimate
from train.figures.chart import Cells, Chart, Colours, Curve, Evaluations, Panel
from train.figures.colours import REFERENCE, dash_of

Statistic = Callable[[Evaluations, Column], Estimate]
"""Score of the episodes of a cell in a metric [SI]."""


def median(cell: Evaluations, column: Column) -> Estimate:
    """Median over the episodes of a cell that did not fail [SI]; nan if all failed."""
    values = np.concatenate([e.values(column.metric) for e in cell])
    return Estimate(float(np.median(values)) if len(values) else float("nan"))


def sweep_chart(
    cells: Cells,
    columns: Sequence[Column],
    label: str,
    colours: Colours,
    statistic: Statistic = median,
) -> Chart:
    """Chart of scores over a swept value, a curve or a level per policy; failures on top.

    Args:
        cells: Evaluations by policy and value.
        columns: Metrics, a panel for each.
        label: Title of the axis.
        colours: Colours of the policies.
        statistic: Score of the episodes of a cell.
    """
    values = sorted(value for value in {*chain(*cells.values())} if value is not None)
    panels = _failure_panels(cells, values, colours)
    for column in columns:
        curves = []
        for title, points in cells.items():
            is_level = None in points
            x = [value for value in values if value in points]
            if is_level:
                x = [values[0], values[-1]]
            scores = [statistic(points[None if is_level else key], column) for key in x]
            scores = [score.times(column.scale) for score in scores]
            low, high = np.array([score.ends for score in scores]).T
            has_band = not is_level and any(score.has_interval for score in scores)
            curve = Curve(
                title,
                colours[title],
                np.array(x),
                np.array([score.value for score in scores]),
                dash="dot" if is_level else dash_of(title),
                band=(low, high) if has_band else None,
                width=1.6,
                has_points=not is_level,
            )
            curves.append(curve)
        panels.append(Panel(column.label, curves, is_log=True, height=2.4))
    return Chart("", label, panels, ticks=values, width=8.0)


def _failure_panels(cells: Cells, values: Sequence[float], colours: Colours) -> list[Panel]:
    """A panel with a row for each policy that fails at any value; none without failures."""
    rows = []
    curves = []
    for title, points in cells.items():
        all_failed = {}
        for value in values:
            cell = points.get(value, points.get(None, ()))  # a level counts everywhere
            failed = sum(e.num_failed for e in cell)
            if failed:
                all_failed[value] = failed == sum(len(e.episodes) for e in cell)
        if all_failed:
            y = np.full(len(all_failed), float(len(rows)))
            x = np.array(list(all_failed))
            crosses = list(all_failed.values())
            curves.append(Curve("", colours[title], x, y, crosses=crosses))
            rows.append(title)
    first = next(e for row in cells.values() for e in chain(*row.values())).condition
    limits = (len(rows) - 0.4, -0.6)
    height = 0.2 * len(rows) + 0.2
    panel = Panel(first.environment.failure, curves, limits, height=height, rows=rows)
    return [panel] if rows else []


def learning_chart(
    learning: Mapping[str, Curves], columns: Sequence[Column], colours: Colours
) -> Chart:
    """Chart of the share of the base's score during a training: median and band over seeds."""
    panels = []
    for column in columns:
        curves = []
        for title, seeds in learning.items():
            line = (title, colours[title], seeds.decisions, seeds.ratios[column.metric])
            curves.append(Curve.median(*line, width=2.0, has_points=True))
        ends = np.array([0.0, max(curve.x[-1] for curve in curves)])
        ratios = [seeds.ratios[column.metric].ravel() for seeds in learning.values()]
        top = min(float(np.nanmax(np.concatenate(ratios), initial=1.0)), 2.0)
        curves.append(Curve("", REFERENCE, ends, np.ones(2), dash="dot", width=1.0))
        label = f"{column.title}, share of the base's"
        panels.append(Panel(label, curves, (0.0, 1.08 * top), height=2.4))
    return Chart("", "decisions of all worlds", panels)


def trials_chart(trials: Sequence[Any], columns: Sequence[Column], title: str) -> Chart:
    """Chart of metrics over the trials of a policy that learns on the robot: robots and mean.

    Args:
        trials: `baselines.adaptation.iterative.Trial`, in order, the first without offsets.
        columns: Metrics, a panel for each.
        title: Title of the chart.
    """
    numbers = np.array([trial.number for trial in trials])
    failed = np.array([trial.failed for trial in trials])
    panels = []
    for column in columns:
        scores = [[m[column.metric] for m in trial.metrics] for trial in trials]
        values = column.scale * np.array(scores)
        values[failed] = np.nan
        counts = np.isfinite(values).sum(axis=1)
        sums = np.nansum(values, axis=1)
        means = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
        curves = [Curve("", "#8fbbd9", numbers, robot, width=0.9) for robot in values.T]
        curves.append(Curve("mean", "#2a6f97", numbers, means, width=2.0, has_points=True))
        limits = (0.0, 1.05 * float(np.nanmax(values, initial=1e-9)))
        panels.append(Panel(column.label, curves, limits))
    return Chart(title, "trials learned from", panels, width=7.0)
