"""A chart as data: panels of curves over one axis.

Pictures and the page of a report draw the same charts.
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, product
from typing import Any

import numpy as np

from elastic_env.core.signals import Array
from elastic_env.motion.trajectory import STAND_S
from train.evaluate.environments import Column, TracedSignal
from train.evaluate.episodes import Evaluation
from train.evaluate.progress import Curves
from train.evaluate.statistics import Estimate
from train.figures.colours import RAMP, REFERENCE, SCORED, dash_of

Colours = Mapping[str, str]
"""Colour of every policy."""
Evaluations = Sequence[Evaluation]
Cells = Mapping[str, Mapping[float | None, Evaluations]]
"""Evaluations of every policy by the value of what is swept; None where it is not swept."""


@dataclass(frozen=True, eq=False)
class Curve:
    """A curve of a panel.

    Attributes:
        name: In the legend; empty to stand in none.
        colour: Its colour.
        x, y: Its points, (n,) each; y is nan where there is none.
        dash: solid, dash or dot.
        band: Ends of the band around it, (n,) each; None without one.
        width: Width of the line.
        has_points: Whether its points are marked.
        fails: Whether a cross marks its end.
        crosses: Whether each point is a filled cross or an open one, in place of a line; empty for
            a line.
    """

    name: str
    colour: str
    x: Array
    y: Array
    dash: str = "solid"
    band: tuple[Array, Array] | None = None
    width: float = 1.4
    has_points: bool = False
    fails: bool = False
    crosses: Sequence[bool] = ()


@dataclass(frozen=True, eq=False)
class Panel:
    """A panel of a chart.

    Attributes:
        label: Title of its axis, with the unit.
        curves: What it shows.
        limits: Ends of its axis; None for those of the curves.
        is_log: Whether its axis is logarithmic.
        height: Its height in a picture [in].
        rows: Names of rows in place of numbers, from the top; a curve has the row as its y.
        own: Names of curves that other panels of a picture lack: its own legend has them.
    """

    label: str
    curves: Sequence[Curve]
    limits: tuple[float, float] | None = None
    is_log: bool = False
    height: float = 1.9
    rows: Sequence[str] = ()
    own: Sequence[str] = ()


@dataclass(frozen=True)
class Mark:
    """Times that a strip above the panels marks.

    Attributes:
        name: What they are.
        colour: Of the strip.
        spans: Their beginnings and ends.
    """

    name: str
    colour: str
    spans: Sequence[tuple[float, float]]


@dataclass(frozen=True, eq=False)
class Chart:
    """Panels one below the other over one axis.

    Attributes:
        title: Of a picture.
        label: Title of the axis that the panels share.
        panels: From the top.
        shaded: Beginnings and ends of what is shaded.
        shade_name: Name of that in the legend.
        marks: Strips above the panels; they do not overlap.
        ticks: Values of a logarithmic axis; None for a linear one.
        width: Width of a picture [in].
    """

    title: str
    label: str
    panels: Sequence[Panel]
    shaded: Sequence[tuple[float, float]] = ()
    shade_name: str = "single support"
    marks: Sequence[Mark] = ()
    ticks: Sequence[float] | None = None
    width: float = 7.2


def time_chart(
    policies: Mapping[str, Evaluations],
    signals: Sequence[TracedSignal],
    colours: Colours,
    most_points: int | None = None,
    most_lines: int | None = None,
) -> Chart:
    """Signals of the first episodes over time; over training seeds the median with its band.

    The scale is that of the walks that go on: what happens shortly before a fall leaves the chart.
    Strips mark the time in which policies ramp in, and what is scored.

    Args:
        policies: Evaluations with a trace, by title of the policy.
        signals: A panel for each.
        colours: Of the policies.
        most_points: Points of a curve, about; None for all.
        most_lines: Lines of a panel, with the reference; None for all. Policies of like errors
            share a panel.
    """
    every = list(chain(*policies.values()))
    longest = _longest(every)
    time_s = longest["time_s"]
    stride = 1 if most_points is None else max(1, -(-len(time_s) // most_points))
    most = len(policies)
    if most_lines is not None:
        most = most_lines - any(signal.reference is not None for signal in signals)
    parts = _split(policies, signals, most)
    panels = []
    for signal, titles in product(signals, parts):
        curves = [
            _trace_curve(title, colours[title], policies[title], signal, stride) for title in titles
        ]
        if signal.reference is not None:
            y = signal.scale * longest[signal.reference][::stride]
            look = (REFERENCE, time_s[::stride], y, "dash")
            curves.append(Curve("reference", *look, width=1.1))
        limits = _limits([*chain(*(policies[title] for title in titles))], signal)
        panels.append(Panel(signal.label, curves, limits, own=titles if len(parts) > 1 else ()))
    single = longest.get("single_support", np.zeros(len(time_s)))
    chart = Chart("", "time [s]", panels, shaded=intervals(single, time_s))
    return replace(chart, marks=_marks(longest))


def _split(
    policies: Mapping[str, Evaluations], signals: Sequence[TracedSignal], most: int
) -> list[list[str]]:
    """Policies in parts of at most so many, about equally large, the greatest errors first.

    One part has the order of the policies.
    """
    number = -(-len(policies) // most)
    if number == 1:
        return [list(policies)]
    errors = np.array([[_rms(own, s) for s in signals] for own in policies.values()])
    sizes = np.nansum(errors / np.maximum(np.nanmax(errors, axis=0), 1e-12), axis=1)
    titles = list(policies)
    order = [titles[place] for place in np.argsort(-sizes, kind="stable")]
    return [list(part) for part in np.array_split(order, number)]


def _rms(own: Evaluations, signal: TracedSignal) -> float:
    """How far a signal is from what it should be; shortly before a fall left out."""
    parts = []
    for e in own:
        wanted = 0.0 if signal.reference is None else e.trace[signal.reference]
        parts.append((e.trace[signal.name] - wanted)[e.is_steady])
    values = np.concatenate(parts)
    if not np.isfinite(values).any():
        return float("nan")
    return float(np.sqrt(np.nanmean(values**2)))


def _marks(trace: Mapping[str, Array]) -> list[Mark]:
    """When policies ramp in, and what is scored."""
    time_s = trace["time_s"]
    ramp = (float(time_s[0]), min(STAND_S, float(time_s[-1])))
    scored = intervals(trace["scored"], time_s)
    return [Mark("ramp-in", RAMP, [ramp]), Mark("scored", SCORED, scored)]


def _longest(evaluations: Evaluations) -> Mapping[str, Array]:
    """The longest trace."""
    traces = [e.trace for e in evaluations]
    return max(traces, key=lambda trace: len(trace["time_s"]))


def _trace_curve(
    title: str, colour: str, own: Evaluations, signal: TracedSignal, stride: int
) -> Curve:
    time_s = _longest(own)["time_s"]
    values = np.full((len(own), len(time_s)), np.nan)
    for row, e in zip(values, own, strict=True):
        row[: len(e.trace[signal.name])] = signal.scale * e.trace[signal.name]
    look = {"dash": dash_of(title), "fails": len(own) == 1 and own[0].first_failed}
    return _median_curve(title, colour, time_s[::stride], values[:, ::stride], **look)


def _median_curve(name: str, colour: str, x: Array, values: Array, **look: Any) -> Curve:
    """Median of values, (series, n), with the band of all where there are several."""
    low, middle, high = quantiles(values)
    band = (low, high) if len(values) > 1 else None
    return Curve(name, colour, x, middle, band=band, **look)


def _limits(evaluations: Evaluations, signal: TracedSignal) -> tuple[float, float]:
    """Range of a signal and its reference, with a margin; neither of ramp-in nor of a fall."""
    names = [name for name in (signal.name, signal.reference) if name is not None]
    masks = [e.is_steady & (e.trace["time_s"] > STAND_S) for e in evaluations]
    if not any(mask.any() for mask in masks):
        masks = [e.is_steady for e in evaluations]
    played = list(zip(evaluations, masks, strict=True))
    parts = [e.trace[name][mask] for e, mask in played for name in names]
    values = np.concatenate(parts)
    values = signal.scale * values[np.isfinite(values)]
    if len(values) == 0:
        return -1.0, 1.0
    margin = 0.06 * float(np.ptp(values)) + 1e-6
    return float(values.min()) - margin, float(values.max()) + margin


def intervals(mask: Array, time: Array) -> list[tuple[float, float]]:
    """Beginnings and ends of the times in which a mask is true, (n,) each."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0.0], mask > 0.5, [0.0]])))
    pairs = edges.reshape(-1, 2)
    return [(float(time[begin]), float(time[end - 1])) for begin, end in pairs]


def quantiles(values: Array) -> tuple[Array, Array, Array]:
    """Least, median and most over the first axis, nan where there is nothing."""
    shares = [0.0, 0.5, 1.0]
    has_gap = np.isnan(values).any(axis=0)
    found = np.empty((len(shares), *has_gap.shape))
    found[:, ~has_gap] = np.quantile(values[:, ~has_gap], shares, axis=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # columns of nothing but nan
        # column by column: a hundred times slower
        found[:, has_gap] = np.nanquantile(values[:, has_gap], shares, axis=0)
    return found[0], found[1], found[2]


def median(cell: Evaluations, column: Column) -> Estimate:
    """Median over the episodes of a cell that did not fail [SI]; nan where all did."""
    values = np.concatenate([e.values(column.metric) for e in cell])
    return Estimate(float(np.median(values)) if len(values) else float("nan"))


Statistic = Callable[[Evaluations, Column], Estimate]


def sweep_chart(
    cells: Cells,
    columns: Sequence[Column],
    label: str,
    colours: Colours,
    statistic: Statistic = median,
) -> Chart:
    """Scores over a swept value, a curve or a level per policy; on top, who fails where.

    Args:
        cells: Evaluations by policy and value.
        columns: A panel for each.
        label: Title of the axis.
        colours: Of the policies.
        statistic: Over the episodes of a cell [SI].
    """
    swept = {*chain(*cells.values())}
    values = sorted(value for value in swept if value is not None)
    panels = _failures(cells, values, colours)
    for column in columns:
        curves = []
        for title, own in cells.items():
            is_level = None in own
            x = [value for value in values if value in own]
            if is_level:
                x = [values[0], values[-1]]
            found = [statistic(own[None if is_level else key], column) for key in x]
            shown = [estimate.times(column.scale) for estimate in found]
            low, high = np.array([estimate.ends for estimate in shown]).T
            has_band = not is_level and any(estimate.has_interval for estimate in shown)
            curve = Curve(
                title,
                colours[title],
                np.array(x),
                np.array([estimate.value for estimate in shown]),
                dash="dot" if is_level else dash_of(title),
                band=(low, high) if has_band else None,
                width=1.6,
                has_points=not is_level,
            )
            curves.append(curve)
        panels.append(Panel(column.label, curves, is_log=True, height=2.4))
    return Chart("", label, panels, ticks=values, width=8.0)


def _failures(cells: Cells, values: Sequence[float], colours: Colours) -> list[Panel]:
    """A panel with a row for each policy that fails somewhere; none where nobody does."""
    rows = []
    curves = []
    for title, own in cells.items():
        shares = {}
        for value in values:
            cell = own.get(value, own.get(None, ()))  # a level fails at all of them
            failed = sum(e.num_failed for e in cell)
            if failed:
                shares[value] = failed == sum(len(e.episodes) for e in cell)
        if shares:
            y = np.full(len(shares), float(len(rows)))
            x = np.array(list(shares))
            crosses = list(shares.values())
            curves.append(Curve("", colours[title], x, y, crosses=crosses))
            rows.append(title)
    first = next(e for own in cells.values() for e in chain(*own.values())).condition
    limits = (len(rows) - 0.4, -0.6)
    height = 0.2 * len(rows) + 0.2
    panel = Panel(first.environment.failure, curves, limits, height=height, rows=rows)
    return [panel] if rows else []


def learning_chart(
    learning: Mapping[str, Curves], columns: Sequence[Column], colours: Colours
) -> Chart:
    """Share of the base's score during a training: median over training seeds with its band."""
    panels = []
    for column in columns:
        curves = []
        for title, found in learning.items():
            line = (title, colours[title], found.decisions, found.ratios[column.metric])
            curves.append(_median_curve(*line, width=2.0, has_points=True))
        ends = np.array([0.0, max(curve.x[-1] for curve in curves)])
        ratios = [own.ratios[column.metric].ravel() for own in learning.values()]
        all_ratios = np.concatenate(ratios)
        top = min(float(np.nanmax(all_ratios, initial=1.0)), 2.0)
        curves.append(Curve("", REFERENCE, ends, np.ones(2), dash="dot", width=1.0))
        label = f"{column.title}, share of the base's"
        panels.append(Panel(label, curves, (0.0, 1.08 * top), height=2.4))
    return Chart("", "decisions of all worlds", panels)


def trials_chart(trials: Sequence[Any], columns: Sequence[Column], title: str) -> Chart:
    """Metrics over the trials of a policy that learns on the robot: each robot, and the mean.

    Args:
        trials: `baselines.adaptation.iterative.Trial`, in order, the first without offsets.
        columns: Metrics, a panel for each.
        title: Of the chart.
    """
    numbers = np.array([trial.number for trial in trials])
    failed = np.array([trial.failed for trial in trials])
    panels = []
    for column in columns:
        found = [[own[column.metric] for own in trial.metrics] for trial in trials]
        values = column.scale * np.array(found)
        values[failed] = np.nan
        counts = np.isfinite(values).sum(axis=1)
        sums = np.nansum(values, axis=1)
        means = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
        curves = [Curve("", "#8fbbd9", numbers, robot, width=0.9) for robot in values.T]
        look = {"width": 2.0, "has_points": True}
        curves.append(Curve("mean", "#2a6f97", numbers, means, **look))
        limits = (0.0, 1.05 * float(np.nanmax(values, initial=1e-9)))
        panels.append(Panel(column.label, curves, limits))
    return Chart(title, "trials learned from", panels, width=7.0)
