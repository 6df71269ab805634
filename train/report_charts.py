"""Charts of the report, as plain specifications for plotly.js: data and layout of nothing but lists and numbers."""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from elastic_env.signals import Array
from train.changes import CEILING, HELD_OUT, Change, by_line, level, percent_interval
from train.environments import Column, Environment, Signal
from train.evaluate import Evaluation
from train.plots import colours, line_style
from train.progress import Curves
from train.statistics import Estimate
from train.walk_plots import intervals

FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'DejaVu Sans', sans-serif"
_INK, _GRID, _FRAME = "#1f2328", "#e8eaed", "#8b949e"
_SHADE = "#f1f3f5"
VERDICTS = {"lower": "#1a7f5a", "higher": "#b42318", "none": "#6e7781", "unclear": "#6e7781"}
"""Colours of what a row shows."""
_POINTS, _LEAST_POINTS, _ALL_POINTS = 600, 250, 6000
"""Most points of a line; the least of that and of all cells together, so that a large comparison stays small."""
_LONGEST_NAME = 34
"""Letters of a policy that stand beside an axis."""
_BEFORE_FALL_S = 0.6
"""What happens in this time before a fall does not set the scale [s]."""

Spec = dict[str, Any]


@dataclass(frozen=True)
class Chart:
    """A chart with its caption.

    Attributes:
        spec: `data` and `layout` for plotly.js.
        height: Height [px].
        caption: What it shows, as HTML.
    """

    spec: Spec
    height: int
    caption: str


class Lines:
    """Evaluations by policy, with a colour for each, the same in every chart."""

    def __init__(self, evaluations: Sequence[Evaluation]) -> None:
        self.evaluations = list(evaluations)
        self.titles = list(dict.fromkeys(e.condition.policy.title for e in evaluations))
        self.colour = colours(self.titles)
        self.residuals = {e.condition.policy.title for e in evaluations if e.condition.member is not None}
        self.environment: Environment = evaluations[0].condition.environment
        self.references = list(dict.fromkeys(e.condition.reference_name for e in evaluations))
        self.scenarios = list(dict.fromkeys(e.condition.scenario for e in evaluations))

    def cell(self, title: str, **wanted: Any) -> list[Evaluation]:
        """Training seeds of a policy in the cell that is described."""
        return [
            e for e in self.evaluations
            if e.condition.policy.title == title
            and all(getattr(e.condition, name) == value for name, value in wanted.items())
        ]  # fmt: skip


def ladder(lines: Lines, reference: str) -> Chart:
    """Every policy in every scenario: its mean over the episodes that did not fail; of families with interval."""
    columns = lines.environment.judged
    rungs = [
        (scenario, title, lines.cell(title, reference_name=reference, scenario=scenario))
        for scenario in lines.scenarios
        for title in lines.titles
    ]
    rungs = [rung for rung in rungs if rung[2]]
    places, headings, y, previous = [], [], 0.0, ""
    for scenario, _, _ in rungs:
        if scenario != previous:
            headings.append((y + (0.5 if previous else 0.0), scenario))
            y += 1.5 if previous else 1.0
            previous = scenario
        places.append(y)
        y += 1.0
    data: list[Spec] = []
    layout = _layout(margin={"l": 8 * min(max(map(len, lines.titles)), _LONGEST_NAME) + 24, "r": 10, "t": 34, "b": 10})
    for number, column in enumerate(columns):
        estimates = [level(cell, column).scaled(column.scale) for _, _, cell in rungs]
        axis, known = _nth(number), [e for e in estimates if np.isfinite(e.value)]
        low = min([e.value if e.low is None else e.low for e in known], default=1.0)
        high = max([e.value if e.high is None else e.high for e in known], default=1.0)
        low = max(low, high / 1e4, 1e-6)
        room = math.log10(max(high / low, 1.3))
        edge = [math.log10(low) - 0.04 * room - 0.02, math.log10(max(high, low)) + 0.34 * room + 0.1]
        for title in lines.titles:
            chosen = [i for i, rung in enumerate(rungs) if rung[1] == title]
            symbol = "diamond" if title in lines.residuals else "circle"
            data.append(_rungs(title, lines.colour[title], symbol, [places[i] for i in chosen],
                               [estimates[i] for i in chosen], axis))  # fmt: skip
            data.append(_values([places[i] for i in chosen], [estimates[i] for i in chosen],
                                [rungs[i][2] for i in chosen], column, edge[0], axis))  # fmt: skip
        layout[f"xaxis{axis}"] = _axis(
            type="log", range=edge, domain=_share(number, len(columns), 0.03), side="top", title=column.label,
            tickvals=_round_numbers(10 ** edge[0], 10 ** edge[1]), anchor="y",
        )  # fmt: skip
        layout[f"xaxis{axis}"]["ticktext"] = [f"{value:g}" for value in layout[f"xaxis{axis}"]["tickvals"]]
    layout["yaxis"] = _axis(
        range=[y - 0.3, -0.7], tickvals=places, ticktext=[_short(r[1]) for r in rungs], showgrid=False
    )
    layout["annotations"] = [
        _note(0.0, place, f"<b>{scenario}</b>", xref="paper", yref="y", xanchor="right", xshift=-8)
        for place, scenario in headings
    ]
    layout["shapes"] = [
        {"type": "line", "xref": "paper", "yref": "y", "x0": 0, "x1": 1, "y0": place - 0.6, "y1": place - 0.6,
         "line": {"color": "#d0d7de", "width": 1}}
        for place, _ in headings[1:]
    ]  # fmt: skip
    layout["showlegend"] = False
    row = 24 if len(rungs) < 40 else 19
    return Chart({"data": data, "layout": layout}, int(70 + row * (y + 1)), "")


def forest(rows: Sequence[Change]) -> Chart:
    """Changes of one residual against its base, in every cell, with intervals."""
    lines = by_line(rows)
    columns = list(dict.fromkeys(row.column for row in rows))
    names = [_scope_of(line[0], len({row.reference for row in rows}) > 1) for line in lines]
    data: list[Spec] = []
    widest = max(len(name.replace("<b>", "").replace("</b>", "")) for name in names)
    layout = _layout(margin={"l": 7.4 * min(widest, 46) + 26, "r": 10, "t": 40, "b": 10})
    layout["showlegend"] = False
    for number, column in enumerate(columns):
        axis = _nth(number)
        shown = [next(row for row in line if row.column == column) for line in lines]
        finite = [row for row in shown if np.isfinite(row.relative.value)]
        ends = [100.0 * v for row in finite for v in (row.relative.value, row.relative.low, row.relative.high)
                if v is not None]  # fmt: skip
        low, high = min([*ends, 0.0]), max([*ends, 0.0])
        span = max(high - low, 1.0)
        for verdict, words in _VERDICT_WORDS.items():
            chosen = [(i, row) for i, row in enumerate(shown) if row in finite and row.verdict == verdict]
            data.append(
                {
                    "type": "scatter", "mode": "markers", "name": words, "showlegend": False, "xaxis": f"x{axis}",
                    "x": [_digits(100.0 * row.relative.value) for _, row in chosen], "y": [i for i, _ in chosen],
                    "error_x": _error([row.relative.scaled(100.0) for _, row in chosen], VERDICTS[verdict]),
                    "marker": {"size": 9, "color": VERDICTS[verdict], "symbol": [_symbol(row) for _, row in chosen],
                               "line": {"width": 1.6, "color": VERDICTS[verdict]}},
                    "hoverinfo": "text", "hovertext": [f"{row.scope}: {row.sentence}" for _, row in chosen],
                }
            )  # fmt: skip
        data.append(
            {
                "type": "scatter", "mode": "text", "xaxis": f"x{axis}", "showlegend": False, "hoverinfo": "skip",
                "x": [_digits(100.0 * max(row.relative.value, row.relative.high or row.relative.value))
                      if row in finite else 0.0 for row in shown],
                "y": list(range(len(shown))), "textposition": "middle right", "textfont": {"size": 12},
                "text": [f"  {percent_interval(row.relative)}" if row in finite else "  nothing to compare"
                         for row in shown],
            }
        )  # fmt: skip
        layout[f"xaxis{axis}"] = _axis(
            range=[low - 0.05 * span, high + 0.42 * span], domain=_share(number, len(columns), 0.03), anchor="y",
            side="top", title=f"change of {column.title} [%]", zeroline=True, zerolinecolor=_INK, zerolinewidth=1.2,
        )  # fmt: skip
    layout["yaxis"] = _axis(
        range=[len(lines) - 0.4, -0.6], tickvals=list(range(len(lines))), ticktext=names, showgrid=False
    )
    return Chart({"data": data, "layout": layout}, 80 + 27 * len(lines), "")


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
    grid = {"x0": _digits(float(time[0])), "dx": _digits(float(stride * (time[1] - time[0])))}
    data: list[Spec] = []
    layout = _layout(margin={"l": 70, "r": 10, "t": 10, "b": 50})
    for number, signal in enumerate(signals):
        axis = _nth(number)
        where = {**grid, "yaxis": f"y{axis}", "type": "scatter", "mode": "lines"}
        if signal.reference is not None:
            data.append({**where, "y": _thin(signal.scale * longest[signal.reference], stride), "name": "reference",
                         "line": {"color": "#111111", "width": 1.2, "dash": "dash"}, "hoverinfo": "skip"})  # fmt: skip
        for title, cell in cells.items():
            data += _curves(title, lines.colour[title], cell, signal, stride, where, first=number == 0)
        layout[f"yaxis{axis}"] = _axis(
            title=signal.label, domain=_share(len(signals) - 1 - number, len(signals), 0.05), anchor="x",
            range=_range_of([e for cell in cells.values() for e in cell], signal), zeroline=True, zerolinecolor=_GRID,
        )  # fmt: skip
    layout["xaxis"] = _axis(
        title="time [s]", range=[float(time[0]), float(time[-1])], anchor=f"y{_nth(len(signals) - 1)}", showgrid=False
    )
    layout["legend"] = {"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 0.0, "xanchor": "left"}
    layout["hovermode"] = "x unified" if len(cells) < 7 else "closest"
    if "single_support" in longest:
        layout["shapes"] = [
            {"type": "rect", "xref": "x", "yref": "paper", "x0": _digits(begin), "x1": _digits(end), "y0": 0, "y1": 1,
             "fillcolor": _SHADE, "line": {"width": 0}, "layer": "below"}
            for begin, end in intervals(longest["single_support"], time)
        ]  # fmt: skip
    layout["margin"]["t"] = 28 + 20 * -(-sum(len(title) + 9 for title in cells) // 150)
    return Chart({"data": data, "layout": layout}, 130 + 165 * len(signals), "")


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
    layout = _layout(margin={"l": 76, "r": 10, "t": 10, "b": 50})
    strip = 24 * len(failing) + 12 if failing else 0
    height = 300 * len(columns) + strip + 90
    top = 1.0 - strip / height if failing else 1.0
    for number, column in enumerate(columns):
        axis = _nth(number)
        for title, own in points.items():
            data += _sweep_lines(title, lines.colour[title], own, values, column, axis, first=number == 0)
        low, high = _share(len(columns) - 1 - number, len(columns), 0.06)
        layout[f"yaxis{axis}"] = _axis(title=column.label, type="log", domain=[top * low, top * high], anchor="x",
                                       dtick="D2", tickformat="~r")  # fmt: skip
    if failing:
        axis = _nth(len(columns))
        data += [_fall_marks(t, lines.colour[t], points[t], values, row, axis) for row, t in enumerate(failing)]
        layout[f"yaxis{axis}"] = _axis(
            domain=[min(top + 0.02, 0.99), 1.0], tickvals=list(range(len(failing))), ticktext=list(map(_short, failing)), anchor="x",
            range=[len(failing) - 0.4, -0.6], showgrid=False,
        )  # fmt: skip
        layout["margin"]["l"] = max(76, 7.4 * min(max(map(len, failing)), _LONGEST_NAME) + 20)
    layout["xaxis"] = _axis(
        type="log", title=label, tickvals=values, ticktext=[f"{value:g}" for value in values],
        anchor=f"y{_nth(len(columns) - 1)}",
    )  # fmt: skip
    layout["legend"] = {"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 0.0, "xanchor": "left"}
    layout["margin"]["t"] = 28 + 20 * -(-sum(len(title) + 9 for title in points) // 150)
    return Chart({"data": data, "layout": layout}, height, "")


def learning(curves: Mapping[str, Curves], columns: Sequence[Column], colour: Mapping[str, str]) -> Chart:
    """Score over base on the way: median over training seeds, band from the best to the worst."""
    data: list[Spec] = []
    layout = _layout(margin={"l": 76, "r": 10, "t": 40, "b": 50})
    for number, column in enumerate(columns):
        axis = _nth(number)
        where = {"xaxis": f"x{axis}", "yaxis": f"y{axis}", "type": "scatter", "mode": "lines"}
        tallest = 1.0
        for title, found in curves.items():
            ratio = found.ratios[column.metric]
            low, middle, high = _band(ratio)
            tallest = max(tallest, float(np.nanmax(ratio, initial=1.0)))
            x = [int(value) for value in found.decisions]
            if len(ratio) > 1:
                data += _filled(x, low, high, colour[title], where, title)
            data.append({**where, "mode": "lines+markers", "x": x, "y": _numbers(middle), "name": title,
                         "legendgroup": title, "showlegend": number == 0, "marker": {"size": 6},
                         "line": {"color": colour[title], "width": 2}})  # fmt: skip
        layout[f"xaxis{axis}"] = _axis(title="decisions of all worlds", domain=_share(number, len(columns), 0.08),
                                       anchor=f"y{axis}", rangemode="tozero")  # fmt: skip
        layout[f"yaxis{axis}"] = _axis(title=f"{column.title}, share of the base's", anchor=f"x{axis}",
                                       range=[0.0, 1.08 * min(tallest, 2.0)])  # fmt: skip
    layout["shapes"] = [
        {"type": "line", "xref": f"x{_nth(n)} domain", "yref": f"y{_nth(n)}", "x0": 0, "x1": 1, "y0": 1, "y1": 1,
         "line": {"color": _INK, "width": 1, "dash": "dot"}}
        for n in range(len(columns))
    ]  # fmt: skip
    layout["legend"] = {"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 0.0, "xanchor": "left"}
    layout["showlegend"] = True
    return Chart({"data": data, "layout": layout}, 400, "")


_VERDICT_WORDS = {
    "lower": "lower", "higher": "higher", "none": "no difference shown", "unclear": "no interval: one training seed"
}  # fmt: skip


def _rungs(title: str, colour: str, symbol: str, places: Sequence[float], estimates: Sequence[Estimate], axis: str
           ) -> Spec:  # fmt: skip
    """Points of a policy with their intervals."""
    kept = [(y, e) for y, e in zip(places, estimates, strict=True) if np.isfinite(e.value)]
    return {
        "type": "scatter", "mode": "markers", "name": title, "xaxis": f"x{axis}",
        "x": [_digits(e.value) for _, e in kept], "y": [y for y, _ in kept],
        "error_x": _error([e for _, e in kept], colour),
        "marker": {"size": 10, "color": colour, "symbol": symbol},
        "hoverinfo": "x+name",
    }  # fmt: skip


def _values(places: Sequence[float], estimates: Sequence[Estimate], cells: Sequence[list[Evaluation]], column: Column,
            left: float, axis: str) -> Spec:  # fmt: skip
    """Figures beside the points, with falls."""
    x, text = [], []
    for estimate, cell in zip(estimates, cells, strict=True):
        failed, played = sum(e.num_failed for e in cell), sum(len(e.episodes) for e in cell)
        what = cell[0].condition.environment.failure
        crosses = f'  <b style="color:{VERDICTS["higher"]}">✕ {what} {failed}/{played}</b>' if failed else ""
        known = np.isfinite(estimate.value)
        end = estimate.value if estimate.high is None else estimate.high
        x.append(_digits(end) if known else 10 ** (left + 1e-3))
        text.append(f"  {number_interval(estimate, column)}{crosses}" if known else crosses)
    return {
        "type": "scatter", "mode": "text", "x": x, "y": list(places), "text": text, "textposition": "middle right",
        "textfont": {"size": 12, "color": _INK}, "hoverinfo": "skip", "xaxis": f"x{axis}", "cliponaxis": False,
    }  # fmt: skip


def number_interval(estimate: Estimate, column: Column) -> str:
    """A figure in the unit in which it is shown, with its interval; - where there is none."""
    if not np.isfinite(estimate.value):
        return "-"
    text = f"{estimate.value:.{column.decimals}f}"
    if estimate.low is None or estimate.high is None:
        return text
    return f"{text} [{estimate.low:.{column.decimals}f}, {estimate.high:.{column.decimals}f}]"


def _scope_of(row: Change, with_reference: bool) -> str:
    name = f"{row.reference} · {row.scope}" if with_reference else row.scope
    return f"<b>{name}</b>" if row.is_group else name


def _short(name: str) -> str:
    """The end of a name that is too long: of a path it is what differs."""
    return name if len(name) <= _LONGEST_NAME else "…" + name[1 - _LONGEST_NAME :]


def _symbol(row: Change) -> str:
    if CEILING in row.marks:
        return "star"
    return "circle-open" if any(mark.startswith(HELD_OUT) for mark in row.marks) else "circle"


def _error(estimates: Sequence[Estimate], colour: str) -> Spec:
    up = [0.0 if e.high is None else _digits(e.high - e.value) for e in estimates]
    down = [0.0 if e.low is None else _digits(e.value - e.low) for e in estimates]
    return {"type": "data", "symmetric": False, "array": up, "arrayminus": down, "color": colour, "thickness": 2,
            "width": 5, "visible": any(e.has_interval for e in estimates)}  # fmt: skip


def _curves(title: str, colour: str, cell: Sequence[Evaluation], signal: Signal, stride: int, where: Spec, first: bool
            ) -> list[Spec]:  # fmt: skip
    """A line, and of several training seeds the band around it."""
    length = max(len(e.trace["time_s"]) for e in cell)
    padded = np.full((len(cell), length), np.nan)
    for row, e in zip(padded, cell, strict=True):
        row[: len(e.trace[signal.name])] = signal.scale * e.trace[signal.name]
    low, middle, high = _band(padded[:, ::stride])
    dash = "dash" if line_style(title) == "--" else "solid"
    line = {**where, "y": _numbers(middle), "name": title, "legendgroup": title, "showlegend": first,
            "line": {"color": colour, "width": 1.5, "dash": dash}}  # fmt: skip
    if len(cell) < 2:
        return [line]
    hidden = {**where, "legendgroup": title, "showlegend": False, "hoverinfo": "skip", "line": {"width": 0}}
    return [
        {**hidden, "y": _numbers(low)},
        {**hidden, "y": _numbers(high), "fill": "tonexty", "fillcolor": _faint(colour)},
        line,
    ]


def _sweep_lines(title: str, colour: str, own: Mapping[float | None, list[Evaluation]], values: Sequence[float],
                 column: Column, axis: str, first: bool) -> list[Spec]:  # fmt: skip
    """A curve with its band, or a level."""
    where = {"type": "scatter", "yaxis": f"y{axis}", "legendgroup": title}
    named = {"name": title, "showlegend": first}
    estimates = {value: level(cell, column).scaled(column.scale) for value, cell in own.items()}
    if None in own:
        y = _numbers(np.full(2, estimates[None].value))
        return [{**where, **named, "mode": "lines", "x": [values[0], values[-1]], "y": y,
                 "line": {"color": colour, "width": 1.6, "dash": "dot"}}]  # fmt: skip
    x = [value for value in values if value in estimates]
    found = [estimates[value] for value in x]
    dash = "dash" if line_style(title) == "--" else "solid"
    line = {**where, **named, "mode": "lines+markers", "x": x, "y": _numbers(np.array([e.value for e in found])),
            "marker": {"size": 7}, "line": {"color": colour, "width": 2, "dash": dash}}  # fmt: skip
    if not any(e.has_interval for e in found):
        return [line]
    low = np.array([e.value if e.low is None else e.low for e in found])
    high = np.array([e.value if e.high is None else e.high for e in found])
    return [*_filled(x, low, high, colour, where, title), line]


def _filled(x: Sequence[float], low: Array, high: Array, colour: str, where: Spec, title: str) -> list[Spec]:
    """The band between two curves."""
    hidden = {**where, "x": list(x), "mode": "lines", "legendgroup": title, "showlegend": False, "hoverinfo": "skip",
              "line": {"width": 0}}  # fmt: skip
    return [
        {**hidden, "y": _numbers(low)},
        {**hidden, "y": _numbers(high), "fill": "tonexty", "fillcolor": _faint(colour)},
    ]


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
        "marker": {"symbol": symbols, "size": 9, "color": colour}, "hoverinfo": "skip", "name": title,
    }  # fmt: skip


def _range_of(evaluations: Sequence[Evaluation], signal: Signal) -> list[float]:
    """Range of a signal and its reference, shortly before a fall left out."""
    found = []
    for e in evaluations:
        kept = e.trace["time_s"] <= e.trace["time_s"][-1] - (_BEFORE_FALL_S if e.first_failed else 0.0)
        found += [e.trace[name][kept] for name in (signal.name, signal.reference) if name is not None]
    values = np.concatenate(found)
    values = signal.scale * values[np.isfinite(values)]
    if len(values) == 0:
        return [-1.0, 1.0]
    margin = 0.06 * float(np.ptp(values)) + 1e-6
    return [_digits(float(values.min()) - margin), _digits(float(values.max()) + margin)]


def _band(values: Array) -> tuple[Array, Array, Array]:
    """Least, median and most over the first axis, nan where there is nothing."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # columns of nothing but nan
        return np.nanmin(values, axis=0), np.nanmedian(values, axis=0), np.nanmax(values, axis=0)


def _layout(margin: Spec) -> Spec:
    return {
        "paper_bgcolor": "white", "plot_bgcolor": "white", "font": {"family": FONT, "size": 13, "color": _INK},
        "margin": {**margin, "pad": 4}, "hoverlabel": {"font": {"size": 12, "family": FONT}}, "hovermode": "closest",
    }  # fmt: skip


def _axis(title: str = "", **options: Any) -> Spec:
    return {
        "title": {"text": title, "font": {"size": 13}, "standoff": 8}, "gridcolor": _GRID, "linecolor": _FRAME,
        "zeroline": False, "ticks": "", "automargin": False, **options,
    }  # fmt: skip


def _note(x: float, y: float, text: str, **options: Any) -> Spec:
    return {"x": x, "y": y, "text": text, "showarrow": False, "font": {"size": 13, "color": _INK}, **options}


def _share(number: int, count: int, gap: float) -> list[float]:
    """Domain of a panel among several."""
    width = (1.0 - gap * (count - 1)) / count
    begin = number * (width + gap)
    return [round(begin, 6), round(min(begin + width, 1.0), 6)]


def _nth(number: int) -> str:
    """How plotly numbers its axes: the first has no number."""
    return "" if number == 0 else str(number + 1)


def _round_numbers(low: float, high: float) -> list[float]:
    """1, 2, 5, 10, ... between two bounds."""
    exponents = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    return [d * 10.0**e for e in exponents for d in (1, 2, 5) if low <= d * 10.0**e <= high]


def _faint(colour: str) -> str:
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},0.18)"


def _thin(values: Array, stride: int) -> list[float | None]:
    return _numbers(values[::stride])


def _numbers(values: Array) -> list[float | None]:
    return [_digits(float(value)) if np.isfinite(value) else None for value in values]


def _digits(value: float) -> float:
    """A number with the digits that a picture can show; nan stays."""
    return float(f"{value:.5g}")
