"""Charts of the report as plain specifications for plotly.js: lists, numbers and colours."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from elastic_env.core.signals import Array
from train.evaluate.statistics import Estimate
from train.figures.chart import Chart, Curve, Panel
from train.figures.colours import FRAME, GRID, INK, SHADE
from train.runs.escaping import chart_text

FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'DejaVu Sans', sans-serif"
LONGEST_NAME = 34
"""Longest name of a policy at an axis [letters]."""
_LEGEND_ROW = 150
"""Length of a row of a legend [letters]."""
_PIXELS = 110
"""Pixels per inch of a picture."""
_STRIP = 8
"""Height of the strip that marks times [px]."""
_GAP = 0.05
"""Gap between panels, as a share of the height."""

Spec = dict[str, Any]
"""A chart, with its height in the layout [px], or a part of it."""


def page_chart(chart: Chart) -> Spec:
    """Return the panels of a chart one below the other, with a legend on top."""
    curves = [curve for panel in chart.panels for curve in panel.curves]
    names = dict.fromkeys(curve.name for curve in curves if curve.name)
    legend_rows = -(-sum(len(name) + 9 for name in names) // _LEGEND_ROW)
    rows = [cut_name(row) for panel in chart.panels for row in panel.rows]
    left = max(76, 7.4 * max(map(len, rows), default=0) + 20)
    layout = base_layout(left=left, top=28 + 20 * legend_rows, bottom=50)
    total = sum(panel.height for panel in chart.panels)
    scale = (1.0 - _GAP * (len(chart.panels) - 1)) / total
    top = 1.0
    data: list[Spec] = []
    for number, panel in enumerate(chart.panels):
        axis = nth(number)
        for curve in panel.curves:
            is_first = curve.name in names
            names.pop(curve.name, None)
            data += _curve_traces(curve, axis, is_first)
        low = max(top - scale * panel.height, 0.0)
        layout[f"yaxis{axis}"] = _panel_axis(panel, [round(low, 6), round(top, 6)])
        top = low - _GAP
    ticks: Spec = {"showgrid": False}
    if chart.ticks is not None:
        texts = [f"{value:g}" for value in chart.ticks]
        ticks = {"type": "log", "tickvals": list(chart.ticks), "ticktext": texts}
    last = nth(len(chart.panels) - 1)
    layout["xaxis"] = base_axis(chart.label, anchor=f"y{last}", **ticks)
    height = round(130 + _PIXELS * total)
    strip = _STRIP / (height - 28 - 20 * legend_rows - 50) if chart.marks else 0.0
    above = 1.0 + 1.5 * strip
    layout["legend"] = {"orientation": "h", "y": above, "yanchor": "bottom", "x": 0.0}
    layout["showlegend"] = True
    is_small = len({curve.name for curve in curves if curve.name}) < 7
    layout["hovermode"] = "x unified" if is_small else "closest"
    shapes = [_band(*span, SHADE) for span in chart.shaded]
    ends = (1.0 + 0.5 * strip, above)
    shapes += [_band(*span, mark.colour, ends) for mark in chart.marks for span in mark.spans]
    layout["shapes"] = shapes
    return {"data": data, "layout": {**layout, "height": height}}


def _panel_axis(panel: Panel, place: Sequence[float]) -> Spec:
    options: Spec = {}
    if panel.is_log:
        options = {"type": "log", "dtick": "D2", "tickformat": "~r"}
    if panel.rows:
        titles = [chart_text(cut_name(row)) for row in panel.rows]
        places = list(range(len(titles)))
        options = {"tickvals": places, "ticktext": titles, "showgrid": False}
    if panel.limits is not None:
        options["range"] = [digits(end) for end in panel.limits]
    return base_axis("" if panel.rows else panel.label, domain=list(place), anchor="x", **options)


def _curve_traces(curve: Curve, axis: str, is_first: bool) -> list[Spec]:
    """Return a line, and before it the band around it."""
    x: Spec = {"x": curve.x.tolist()}
    if len(curve.x) >= 20:  # evenly spaced
        x = {"x0": digits(float(curve.x[0])), "dx": digits(float(curve.x[1] - curve.x[0]))}
    line = {
        "type": "scatter",
        "yaxis": f"y{axis}",
        **x,
        "mode": "lines+markers" if curve.has_points else "lines",
        "y": numbers(curve.y),
        "name": chart_text(curve.name),
        "legendgroup": curve.name,
        "showlegend": is_first and bool(curve.name),
        "line": {"color": curve.colour, "width": curve.width, "dash": curve.dash},
        "marker": {"size": 7},
    }
    if curve.crosses:
        symbols = ["x" if is_filled else "x-open" for is_filled in curve.crosses]
        marker = {"symbol": symbols, "size": 9, "color": curve.colour}
        return [{**line, "mode": "markers", "marker": marker, "hoverinfo": "skip"}]
    if curve.band is None:
        return [line]
    style = {"mode": "lines", "showlegend": False, "hoverinfo": "skip"}
    edge = {**line, **style, "line": {"width": 0}}
    low, high = map(numbers, curve.band)
    filled = {"fill": "tonexty", "fillcolor": translucent(curve.colour)}
    return [{**edge, "y": low}, {**edge, "y": high, **filled}, line]


def _band(begin: float, end: float, colour: str, ends: tuple[float, float] = (0, 1)) -> Spec:
    """Return a coloured time span, between two heights as shares of the chart."""
    x = {"xref": "x", "x0": digits(begin), "x1": digits(end)}
    y = {"yref": "paper", "y0": round(ends[0], 6), "y1": round(ends[1], 6)}
    look = {"fillcolor": colour, "line": {"width": 0}, "layer": "below"}
    return {"type": "rect", **x, **y, **look}


def cut_name(name: str) -> str:
    """Return a name, or the end of a long one, since the ends of paths differ."""
    return name if len(name) <= LONGEST_NAME else "…" + name[1 - LONGEST_NAME :]


def error_bars(estimates: Sequence[Estimate], colour: str) -> Spec:
    """Return intervals around points."""
    return {
        "type": "data",
        "symmetric": False,
        "array": [digits(e.ends[1] - e.value) for e in estimates],
        "arrayminus": [digits(e.value - e.ends[0]) for e in estimates],
        "color": colour,
        "thickness": 2,
        "width": 5,
        "visible": any(e.has_interval for e in estimates),
    }


def base_layout(left: float, top: float, bottom: float) -> Spec:
    """Return the common layout of all charts, with margins [px]."""
    return {
        "paper_bgcolor": "white",
        "plot_bgcolor": "white",
        "font": {"family": FONT, "size": 13, "color": INK},
        "margin": {"l": left, "r": 10, "t": top, "b": bottom, "pad": 4},
        "hoverlabel": {"font": {"size": 12, "family": FONT}},
        "hovermode": "closest",
    }


def base_axis(title: str = "", **options: Any) -> Spec:
    """Return an axis."""
    return {
        "title": {"text": title, "font": {"size": 13}, "standoff": 8},
        "gridcolor": GRID,
        "linecolor": FRAME,
        "zeroline": False,
        "ticks": "",
        "automargin": False,
        **options,
    }


def domain(number: int, count: int, gap: float) -> list[float]:
    """Return the domain of a panel among several."""
    width = (1.0 - gap * (count - 1)) / count
    begin = number * (width + gap)
    return [round(begin, 6), round(min(begin + width, 1.0), 6)]


def nth(number: int) -> str:
    """Return the suffix of an axis in plotly; the first axis has none."""
    return "" if number == 0 else str(number + 1)


def translucent(colour: str) -> str:
    """Return a translucent form of a colour."""
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},0.18)"


def numbers(values: Array) -> list[float | None]:
    """Return values for plotly, None for those that are not finite."""
    return [digits(float(value)) if np.isfinite(value) else None for value in values]


def digits(value: float) -> float:
    """Return a number with the digits that a picture can show; nan stays nan."""
    return float(f"{value:.5g}")
