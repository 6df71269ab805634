"""Charts as pictures, by Matplotlib: style, files, curves, and the bar chart of a comparison."""

import io
from collections.abc import Mapping, Sequence
from itertools import chain, product
from pathlib import Path
from typing import Any, Literal

import numpy as np

from elastic_env.core.errors import missing_extra
from elastic_env.core.files import write_whole
from train.evaluate.environments import Column
from train.evaluate.episodes import Evaluation
from train.evaluate.scores import median_of
from train.figures.chart import Chart, Curve, Evaluations, Mark, Panel
from train.figures.colours import FAILED, INK, policy_colours
from train.runs.escaping import visible

FigureFormat = Literal["png", "pdf", "svg"]
"""Ending and format of a picture's file."""
MRAD = 1e3
"""Factor from rad to the mrad that figures show."""


def require_matplotlib() -> Any:
    """Return Matplotlib's pyplot with our style, drawing into files.

    Raises:
        MissingExtraError: It is not installed.
    """
    try:
        import matplotlib as mpl
    except ImportError:
        raise missing_extra("matplotlib", "report", "drawing figures") from None
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    plt.style.use(Path(__file__).with_name("pictures.mplstyle"))
    return plt


def new_figure(rows: int, columns: int, size: tuple[float, float], **shape: Any) -> Any:
    """A figure of a size [in], and its axes row by row."""
    plt = require_matplotlib()
    shape |= {"figsize": size, "squeeze": False, "layout": "constrained"}
    figure, axes = plt.subplots(rows, columns, **shape)
    return figure, list(axes.flat)


def label_text(name: str) -> str:
    """A user's name as a label; Matplotlib would leave it out if it began with "_"."""
    text = visible(name)
    return f" {text}" if text.startswith("_") else text


def legend_columns(entries: int, most: int = 5) -> int:
    """Number of columns of a legend, so that its rows have about equally many entries."""
    rows = -(-entries // most)
    return -(-entries // max(rows, 1))


def save(figure: Any, path: Path) -> Path:
    """Write a figure in the format of the file's ending, and close it."""
    for text in figure.findobj(lambda part: hasattr(part, "set_text")):
        text.set_text(visible(text.get_text()))
    content = io.BytesIO()
    figure.savefig(content, format=path.suffix[1:], bbox_inches="tight")
    write_whole(path, content.getvalue())
    require_matplotlib().close(figure)
    return path


def draw_chart(chart: Chart, path: Path) -> Path:
    """Draw the panels of a chart one below the other, with a legend below.

    A panel with curves that the others lack has a legend of its own. A filled cross on top means
    that all episodes of a policy failed, an open one that some failed.
    """
    heights = [panel.height for panel in chart.panels]
    size = (chart.width, sum(heights) + 1.2)
    figure, axes = new_figure(len(heights), 1, size, sharex=True, height_ratios=heights)
    for axis, panel in zip(axes, chart.panels, strict=True):
        for begin, end in chart.shaded:
            axis.axvspan(begin, end, color="#e9ebee", lw=0, zorder=0, label=chart.shade_name)
        _draw_panel(axis, panel)
        axis.grid(axis="x", visible=chart.ticks is not None)
        if chart.ticks is None:
            axis.margins(x=0.0)
    if chart.ticks is not None:
        axes[-1].set_xscale("log")
        axes[-1].set_xticks(chart.ticks, [f"{value:g}" for value in chart.ticks])
        axes[-1].minorticks_off()
    axes[0].set_title(chart.title, pad=12 if chart.marks else None)
    for mark in chart.marks:
        _draw_mark(axes, mark)
    axes[-1].set_xlabel(chart.label)
    if any(curve.fails for panel in chart.panels for curve in panel.curves):
        axes[-1].scatter([], [], marker="X", s=60, color=FAILED, label="fall")
    entries = _common_entries(axes, chart)
    figure.align_ylabels(axes)
    ncols = legend_columns(len(entries))
    figure.legend(entries.values(), entries.keys(), ncols=ncols, loc="outside lower center")
    return save(figure, path)


def _draw_panel(axis: Any, panel: Panel) -> None:
    """Draw the curves of a panel, its y axis, and its own legend to the right."""
    for curve in panel.curves:
        _draw_curve(axis, curve, panel.limits)
    axis.set_ylabel(panel.label)
    if panel.is_log:
        axis.set_yscale("log")
        show_numbers(axis.yaxis)
    if panel.limits is not None:
        axis.set_ylim(*panel.limits)
    if panel.rows:
        names = [label_text(row) for row in panel.rows]
        axis.set_yticks(range(len(names)), names, fontsize=8)
        axis.grid(axis="y", visible=False)
    elif panel.limits is not None and panel.limits[0] < 0.0 < panel.limits[1]:
        axis.axhline(0.0, color="#777777", lw=0.8, zorder=1)
    if panel.own_legend:
        entries = _legend_entries(axis)
        names = [label_text(title) for title in panel.own_legend]
        place = {"loc": "center left", "bbox_to_anchor": (1.0, 0.5)}
        axis.legend([entries[name] for name in names], names, fontsize=8, **place)


def _common_entries(axes: Sequence[Any], chart: Chart) -> dict[str, Any]:
    """Entries of the legend below a chart: those that no panel has in its own legend."""
    entries = {}
    for axis in axes:
        entries |= _legend_entries(axis)
    for title in chain(*(panel.own_legend for panel in chart.panels)):
        entries.pop(label_text(title), None)
    if chart.shade_name in entries:  # the shade comes after the curves
        entries[chart.shade_name] = entries.pop(chart.shade_name)
    return entries


def _legend_entries(axis: Any) -> dict[str, Any]:
    """Handles of an axis by their labels."""
    handles, labels = axis.get_legend_handles_labels()
    return dict(zip(labels, handles, strict=True))


def _draw_mark(axes: Sequence[Any], mark: Mark) -> None:
    """Draw a strip above the first panel; a single span also gets lines through all panels."""
    style = {"color": mark.colour, "lw": 0, "clip_on": False}
    for number, (begin, end) in enumerate(mark.spans):
        label = {} if number else {"label": mark.name}
        axes[0].axvspan(begin, end, ymin=1.02, ymax=1.06, **style, **label)
    if len(mark.spans) == 1:
        for axis, x in product(axes, mark.spans[0]):
            axis.axvline(x, color=mark.colour, lw=0.7, ls=":", zorder=1)


def _draw_curve(axis: Any, curve: Curve, limits: tuple[float, float] | None) -> None:
    colour = curve.colour
    if curve.crosses:
        faces = [colour if is_filled else "none" for is_filled in curve.crosses]
        style = {"marker": "X", "s": 46, "facecolors": faces, "edgecolors": colour}
        axis.scatter(curve.x, curve.y, lw=1.0, **style)
        return
    style = {"marker": "o", "ms": 4} if curve.has_points else {}
    style |= {"color": colour, "lw": curve.width, "ls": _DASHES[curve.dash]}
    # Matplotlib leaves "_" out of the legend
    axis.plot(curve.x, curve.y, label=label_text(curve.name) or "_", **style)
    if curve.band is not None:
        axis.fill_between(curve.x, *curve.band, color=colour, alpha=0.18, lw=0)
    if curve.fails:
        last = curve.y[np.isfinite(curve.y)][-1:]
        y = last if limits is None else np.clip(last, *limits)
        cross = {"marker": "X", "s": 70, "edgecolors": "white", "lw": 0.8, "zorder": 6}
        axis.scatter(curve.x[-1:], y, color=colour, clip_on=False, **cross)


_DASHES = {"solid": "-", "dash": "--", "dot": ":"}


def show_numbers(axis: Any, numticks: int | None = None) -> None:
    """Show numbers instead of powers of ten on a logarithmic axis."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=numticks))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())


def draw_overview(evaluations: Evaluations, columns: Sequence[Column], path: Path) -> Path:
    """Draw metrics of every policy: a panel per metric and reference; with one scenario per metric.

    Bars are medians over the episodes that did not fail, with their 95 % intervals. Dots are these
    episodes, crosses are failed ones.
    """
    environment = evaluations[0].condition.environment
    shades = policy_colours([e.condition.policy.title for e in evaluations])
    is_one_scenario = len({e.condition.scenario for e in evaluations}) == 1
    panels = _group_bars(evaluations, is_one_scenario)
    group_width = 0.35 + 0.14 * len(shades)
    width = 1.2 + max(3.0, group_width * max(map(len, panels.values())))
    is_stacked = width * len(panels) > _LARGEST_WIDTH
    per_row = 1 if is_stacked else len(panels)
    rows = len(panels) * len(columns) // per_row
    height = 3.8 if rows == 1 else 2.3
    size = (min(width, 1.4 * _LARGEST_WIDTH) * per_row, height * rows)
    # panels do not share groups, since a reference need not be played in all scenarios
    figure, axes = new_figure(rows, per_row, size)
    for number, column in enumerate(columns):
        column_axes = axes[number * len(panels) :][: len(panels)]
        for axis, (title, groups) in zip(column_axes, panels.items(), strict=True):
            _draw_bars(axis, groups, column, shades)
            if axis is not column_axes[0]:
                axis.sharey(column_axes[0])
            axis.set_title(title if is_stacked or not number else "")
            axis.set_ylabel(column.label if axis.get_subplotspec().is_first_col() else "")
    if is_one_scenario and environment.quantity:
        axes[-per_row].set_xlabel(environment.quantity)
    handles = _overview_handles(axes[0], evaluations, columns, shades)
    ncols = legend_columns(len(handles), max(int(size[0] / 1.7), 2))
    figure.legend(handles=handles, ncols=ncols, loc="outside lower center")
    return save(figure, path)


def _group_bars(
    evaluations: Evaluations, is_one_scenario: bool
) -> dict[str, dict[str, list[Evaluation]]]:
    """Evaluations by panel and group: reference and scenario, or scenario and reference."""
    panels: dict[str, dict[str, list[Evaluation]]] = {}
    for e in evaluations:
        reference = e.condition.reference_name
        panel = e.condition.environment.title(reference)
        group = e.condition.scenario
        if is_one_scenario:
            panel = f"scenario {group}"
            group = reference
        panels.setdefault(panel, {}).setdefault(group, []).append(e)
    return panels


def _overview_handles(
    axis: Any, evaluations: Evaluations, columns: Sequence[Column], shades: Mapping[str, str]
) -> list[Any]:
    """Handles of the legend: policies, and failures, episodes and intervals if there are any."""
    names = {label_text(title): shade for title, shade in shades.items()}
    handles = [axis.bar(np.nan, 0.0, color=c, label=name) for name, c in names.items()]
    if any(e.num_failed for e in evaluations):
        failure = evaluations[0].condition.environment.failure
        handles.append(axis.scatter([], [], marker="X", s=26, color=FAILED, label=failure))
    if any(len(e.episodes) > 1 for e in evaluations):
        handles.append(axis.scatter([], [], label="episode (bar: median)", **_DOTS))
    if any(median_of(e, c.metric).has_interval for e in evaluations for c in columns):
        style = {"marker": "|", "lw": 0.0, "ms": 9, "mew": _INTERVAL_STYLE["lw"], "color": INK}
        handles += axis.plot([], [], label="95 % interval of the median", **style)
    return handles


_DOTS: dict[str, Any] = {"s": 4, "color": "#222222", "alpha": 0.45, "lw": 0, "zorder": 3}
"""Style of single episodes."""
_INTERVAL_STYLE: dict[str, Any] = {"lw": 1.3, "color": INK, "zorder": 4}
"""Style of an interval, drawn next to the dots."""
_LARGEST_WIDTH = 12.0
"""Width beyond which panels are stacked [in]."""
_WIDE_GROUP = 7
"""Fewest bars of a group whose name fits below it without a slant."""


def _draw_bars(
    axis: Any,
    groups: Mapping[str, Evaluations],
    column: Column,
    shades: Mapping[str, str],
) -> None:
    """Draw a bar per policy in every group."""
    policies = list(shades)
    width = 0.84 / len(policies)
    for place, group in enumerate(groups.values()):
        for e in group:
            index = policies.index(e.condition.policy.title)
            x = place + (index - (len(policies) - 1) / 2) * width
            values = column.scale * e.values(column.metric)
            shade = shades[e.condition.policy.title]
            level = median_of(e, column.metric).times(column.scale)
            height = level.value if level.is_known else 0.0
            axis.bar(x, height, width=0.9 * width, color=shade)
            if len(e.episodes) > 1:
                axis.scatter(np.full(len(values), x), values, **_DOTS)
            if level.has_interval:
                axis.vlines(x + 0.25 * width, *level.ends, **_INTERVAL_STYLE)
            if e.num_failed:
                cross = {"marker": "X", "s": 26, "edgecolors": "white", "lw": 0.5}
                cross["color"] = FAILED if len(values) else shade
                bottom = axis.get_xaxis_transform()
                axis.scatter(x, 0.035, transform=bottom, zorder=4, **cross)
    is_crowded = len(groups) > 2 and len(policies) < _WIDE_GROUP
    slant = {"rotation": 25, "ha": "right"} if is_crowded else {}
    axis.set_xticks(range(len(groups)), list(map(label_text, groups)), **slant)
    axis.set_xlim(-0.55, len(groups) - 0.45)
    axis.grid(axis="x", visible=False)
