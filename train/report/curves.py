"""Charts with curves: signals over time, scores over a swept value, learning."""

from collections.abc import Mapping, Sequence

import numpy as np

from train.evaluate.environments import Column, TracedSignal
from train.evaluate.episodes import Evaluation
from train.evaluate.progress import Curves
from train.figures.plots import line_style
from train.figures.walk_plots import intervals
from train.report.parts import (
    GRID,
    INK,
    LONGEST_NAME,
    REFERENCE,
    SHADE,
    Chart,
    Lines,
    Spec,
    axis_of,
    band,
    band_between,
    digits,
    domain,
    layout_of,
    level,
    nth,
    numbers,
    range_of,
    shortened,
    thinned,
)
from train.runs.escaping import chart_text

_POINTS, _LEAST_POINTS, _ALL_POINTS = 600, 250, 6000
"""Most points of a line; the least of that and of all cells together, so that a large comparison stays small."""


def over_time(lines: Lines, reference: str, scenario: str) -> Chart | None:
    """Signals of the first episode; of families the median over training seeds and the band from least to most."""
    cells = {t: lines.cell(t, reference_name=reference, scenario=scenario) for t in lines.titles}
    cells = {title: [e for e in cell if e.trace] for title, cell in cells.items()}
    cells = {title: cell for title, cell in cells.items() if cell}
    if not cells:
        return None
    signals = lines.environment.curves
    longest = max((e.trace for cell in cells.values() for e in cell), key=lambda trace: len(trace["time_s"]))
    time = longest["time_s"]
    points = min(_POINTS, max(_LEAST_POINTS, _ALL_POINTS // (len(lines.references) * len(lines.scenarios))))
    stride = max(1, -(-len(time) // points))
    grid = {"x0": digits(float(time[0])), "dx": digits(float(stride * (time[1] - time[0])))}
    data: list[Spec] = []
    layout = layout_of(margin={"l": 70, "r": 10, "t": 10, "b": 50})
    for number, signal in enumerate(signals):
        axis = nth(number)
        where = {**grid, "yaxis": f"y{axis}", "type": "scatter", "mode": "lines"}
        if signal.reference is not None:
            data.append({**where, "y": thinned(signal.scale * longest[signal.reference], stride), "name": "reference",
                         "line": {"color": REFERENCE, "width": 1.2, "dash": "dash"}, "hoverinfo": "skip"})  # fmt: skip
        for title, cell in cells.items():
            data += _curves(title, lines.colour[title], cell, signal, stride, where, first=number == 0)
        layout[f"yaxis{axis}"] = axis_of(
            title=signal.label, domain=domain(len(signals) - 1 - number, len(signals), 0.05), anchor="x",
            range=range_of([e for cell in cells.values() for e in cell], signal), zeroline=True, zerolinecolor=GRID,
        )  # fmt: skip
    layout["xaxis"] = axis_of(
        title="time [s]", range=[float(time[0]), float(time[-1])], anchor=f"y{nth(len(signals) - 1)}", showgrid=False
    )
    layout["legend"] = {"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 0.0, "xanchor": "left"}
    layout["hovermode"] = "x unified" if len(cells) < 7 else "closest"
    if "single_support" in longest:
        layout["shapes"] = [
            {"type": "rect", "xref": "x", "yref": "paper", "x0": digits(begin), "x1": digits(end), "y0": 0, "y1": 1,
             "fillcolor": SHADE, "line": {"width": 0}, "layer": "below"}
            for begin, end in intervals(longest["single_support"], time)
        ]  # fmt: skip
    layout["margin"]["t"] = 28 + 20 * -(-sum(len(title) + 9 for title in cells) // 150)
    return Chart({"data": data, "layout": layout}, 130 + 165 * len(signals))


def sweep(lines: Lines, points: Mapping[str, Mapping[float | None, list[Evaluation]]], label: str) -> Chart:
    """Scores against a swept value; of families with their interval, a level where nothing is swept.

    Args:
        lines: Policies and their colours.
        points: Cells by policy and swept value, None where it is not swept.
        label: What the axis says.
    """
    columns = lines.environment.judged
    values = sorted({value for own in points.values() for value in own if value is not None})
    failing = [t for t, own in points.items() if any(e.num_failed for cell in own.values() for e in cell)]
    data: list[Spec] = []
    layout = layout_of(margin={"l": 76, "r": 10, "t": 10, "b": 50})
    strip = 24 * len(failing) + 12 if failing else 0
    height = 300 * len(columns) + strip + 90
    top = 1.0 - strip / height if failing else 1.0
    for number, column in enumerate(columns):
        axis = nth(number)
        for title, own in points.items():
            data += _sweep_lines(title, lines.colour[title], own, values, column, axis, first=number == 0)
        low, high = domain(len(columns) - 1 - number, len(columns), 0.06)
        layout[f"yaxis{axis}"] = axis_of(title=column.label, type="log", domain=[top * low, top * high], anchor="x",
                                       dtick="D2", tickformat="~r")  # fmt: skip
    if failing:
        axis = nth(len(columns))
        data += [_fall_marks(t, lines.colour[t], points[t], values, row, axis) for row, t in enumerate(failing)]
        layout[f"yaxis{axis}"] = axis_of(
            domain=[min(top + 0.02, 0.99), 1.0], tickvals=list(range(len(failing))), anchor="x",
            ticktext=[chart_text(shortened(title)) for title in failing], range=[len(failing) - 0.4, -0.6],
            showgrid=False,
        )  # fmt: skip
        layout["margin"]["l"] = max(76, 7.4 * min(max(map(len, failing)), LONGEST_NAME) + 20)
    layout["xaxis"] = axis_of(
        type="log", title=label, tickvals=values, ticktext=[f"{value:g}" for value in values],
        anchor=f"y{nth(len(columns) - 1)}",
    )  # fmt: skip
    layout["legend"] = {"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 0.0, "xanchor": "left"}
    layout["margin"]["t"] = 28 + 20 * -(-sum(len(title) + 9 for title in points) // 150)
    return Chart({"data": data, "layout": layout}, height)


def learning(curves: Mapping[str, Curves], columns: Sequence[Column], colour: Mapping[str, str]) -> Chart:
    """Score over base on the way: median over training seeds, band from the best to the worst."""
    data: list[Spec] = []
    layout = layout_of(margin={"l": 76, "r": 10, "t": 40, "b": 50})
    for number, column in enumerate(columns):
        axis = nth(number)
        where = {"xaxis": f"x{axis}", "yaxis": f"y{axis}", "type": "scatter", "mode": "lines"}
        tallest = 1.0
        for title, found in curves.items():
            ratio = found.ratios[column.metric]
            low, middle, high = band(ratio)
            tallest = max(tallest, float(np.nanmax(ratio, initial=1.0)))
            x = [int(value) for value in found.decisions]
            if len(ratio) > 1:
                data += band_between(low, high, colour[title], {**where, "x": x}, title)
            data.append({**where, "mode": "lines+markers", "x": x, "y": numbers(middle), "name": chart_text(title),
                         "legendgroup": title, "showlegend": number == 0, "marker": {"size": 6},
                         "line": {"color": colour[title], "width": 2}})  # fmt: skip
        layout[f"xaxis{axis}"] = axis_of(title="decisions of all worlds", domain=domain(number, len(columns), 0.08),
                                       anchor=f"y{axis}", rangemode="tozero")  # fmt: skip
        layout[f"yaxis{axis}"] = axis_of(title=f"{column.title}, share of the base's", anchor=f"x{axis}",
                                       range=[0.0, 1.08 * min(tallest, 2.0)])  # fmt: skip
    layout["shapes"] = [
        {"type": "line", "xref": f"x{nth(n)} domain", "yref": f"y{nth(n)}", "x0": 0, "x1": 1, "y0": 1, "y1": 1,
         "line": {"color": INK, "width": 1, "dash": "dot"}}
        for n in range(len(columns))
    ]  # fmt: skip
    layout["legend"] = {"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 0.0, "xanchor": "left"}
    layout["showlegend"] = True
    return Chart({"data": data, "layout": layout}, 400)


def _curves(title: str, colour: str, cell: Sequence[Evaluation], signal: TracedSignal, stride: int, where: Spec,
            first: bool) -> list[Spec]:  # fmt: skip
    """A line, and of several training seeds the band around it."""
    length = max(len(e.trace["time_s"]) for e in cell)
    padded = np.full((len(cell), length), np.nan)
    for row, e in zip(padded, cell, strict=True):
        row[: len(e.trace[signal.name])] = signal.scale * e.trace[signal.name]
    low, middle, high = band(padded[:, ::stride])
    dash = "dash" if line_style(title) == "--" else "solid"
    line = {**where, "y": numbers(middle), "name": chart_text(title), "legendgroup": title, "showlegend": first,
            "line": {"color": colour, "width": 1.5, "dash": dash}}  # fmt: skip
    if len(cell) < 2:
        return [line]
    return [*band_between(low, high, colour, where, title), line]


def _sweep_lines(title: str, colour: str, own: Mapping[float | None, list[Evaluation]], values: Sequence[float],
                 column: Column, axis: str, first: bool) -> list[Spec]:  # fmt: skip
    """A curve with its band, or a level."""
    where = {"type": "scatter", "yaxis": f"y{axis}", "legendgroup": title}
    named = {"name": chart_text(title), "showlegend": first}
    estimates = {value: level(cell, column).scaled(column.scale) for value, cell in own.items()}
    if None in own:
        y = numbers(np.full(2, estimates[None].value))
        return [{**where, **named, "mode": "lines", "x": [values[0], values[-1]], "y": y,
                 "line": {"color": colour, "width": 1.6, "dash": "dot"}}]  # fmt: skip
    x = [value for value in values if value in estimates]
    found = [estimates[value] for value in x]
    dash = "dash" if line_style(title) == "--" else "solid"
    line = {**where, **named, "mode": "lines+markers", "x": x, "y": numbers(np.array([e.value for e in found])),
            "marker": {"size": 7}, "line": {"color": colour, "width": 2, "dash": dash}}  # fmt: skip
    if not any(e.has_interval for e in found):
        return [line]
    low = np.array([e.value if e.low is None else e.low for e in found])
    high = np.array([e.value if e.high is None else e.high for e in found])
    return [*band_between(low, high, colour, {**where, "x": x}, title), line]


def _fall_marks(title: str, colour: str, own: Mapping[float | None, list[Evaluation]], values: Sequence[float],
                row: int, axis: str) -> Spec:  # fmt: skip
    """Crosses where a policy fails: filled where in all episodes, open where in some."""
    x, symbols = [], []
    for value in values:
        cell = own.get(value, own.get(None, []))
        failed, played = sum(e.num_failed for e in cell), sum(len(e.episodes) for e in cell)
        if failed:
            x.append(value)
            symbols.append("x" if failed == played else "x-open")
    return {
        "type": "scatter", "mode": "markers", "x": x, "y": [row] * len(x), "yaxis": f"y{axis}", "showlegend": False,
        "marker": {"symbol": symbols, "size": 9, "color": colour}, "hoverinfo": "skip", "name": chart_text(title),
    }  # fmt: skip
