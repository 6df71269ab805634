"""Dot plots of a page: scores of all policies, and changes of residuals against their bases."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from train.evaluate.change_text import CEILING, HELD_OUT, percent_interval
from train.evaluate.changes import Change, group_lines
from train.evaluate.environments import Column
from train.evaluate.episodes import group_by
from train.evaluate.scores import failures, score
from train.evaluate.statistics import Estimate
from train.evaluate.table import EpisodeTable
from train.figures.colours import INK, LINE, VERDICTS
from train.report import plotly_charts
from train.report.plotly_charts import LONGEST_NAME, Spec, base_axis
from train.report.tables import number_interval
from train.runs.escaping import chart_text


@dataclass(frozen=True)
class Dot:
    """A figure with its interval in a row of a dot plot.

    Attributes:
        row: Position of the row, counted downwards.
        estimate: Figure in the unit of the axis; nan if there is only a text.
        text: Text next to the dot, as HTML.
        text_x: Left end of the text, in the unit of the axis.
        name: Text under the pointer.
        colour, symbol: Look of the dot.
    """

    row: float
    estimate: Estimate
    text: str
    text_x: float
    name: str
    colour: str
    symbol: str = "circle"


def _dot_plot(
    rows: Mapping[float, str],
    panels: Sequence[tuple[Spec, Sequence[Dot]]],
    left: float,
    height: float,
    top: int = 40,
) -> Spec:
    """Return panels next to each other, with named rows.

    Args:
        rows: Names of rows by position, plain or as HTML.
        panels: Axis and dots of each panel.
        left: Margin at the left [px].
        height: Height of the chart [px].
        top: Margin at the top [px].
    """
    layout = plotly_charts.base_layout(left=left, top=top, bottom=10)
    data: list[Spec] = []
    for number, (axis, dots) in enumerate(panels):
        x = f"x{plotly_charts.nth(number)}"
        known = [dot for dot in dots if dot.estimate.is_known]
        for colour, group in group_by(known, lambda dot: dot.colour).items():
            data.append(_points(group, colour, x))
        texts = {
            "type": "scatter",
            "mode": "text",
            "x": [plotly_charts.digits(dot.text_x) for dot in dots],
            "y": [dot.row for dot in dots],
            "xaxis": x,
            "text": [f"  {dot.text}" for dot in dots],
            "textposition": "middle right",
            "textfont": {"size": 12, "color": INK},
            "hoverinfo": "skip",
            "cliponaxis": False,
        }
        data.append(texts)
        domain = plotly_charts.domain(number, len(panels), gap=0.03)
        layout[f"xaxis{plotly_charts.nth(number)}"] = {
            **axis,
            "domain": domain,
            "anchor": "y",
            "side": "top",
        }
    layout["yaxis"] = base_axis(
        range=[max(rows, default=0.0) + 0.7, -0.7],
        tickvals=list(rows),
        ticktext=list(rows.values()),
        showgrid=False,
    )
    layout["showlegend"] = False
    return {"data": data, "layout": {**layout, "height": int(height)}}


def _points(dots: Sequence[Dot], colour: str, x: str) -> Spec:
    """Return points of one colour with their intervals."""
    symbols = [dot.symbol for dot in dots]
    outline = {"width": 1.6, "color": colour}
    return {
        "type": "scatter",
        "mode": "markers",
        "xaxis": x,
        "x": [plotly_charts.digits(dot.estimate.value) for dot in dots],
        "y": [dot.row for dot in dots],
        "error_x": plotly_charts.error_bars([dot.estimate for dot in dots], colour),
        "marker": {"size": 9, "color": colour, "symbol": symbols, "line": outline},
        "hoverinfo": "x+text",
        "hovertext": [chart_text(dot.name) for dot in dots],
    }


def ladder(table: EpisodeTable, reference: str, colours: Mapping[str, str]) -> Spec:
    """Return the chart of all policies in all scenarios: means over episodes that did not fail."""
    rungs: list[tuple[float, str, Any]] = []
    headings: dict[str, float] = {}
    place = 0.0
    for scenario in table.scenarios:
        for policy in table.policies:
            cells = table.cells_of(policy, reference, scenario)
            if cells and scenario not in headings:
                headings[scenario] = place + (0.5 if headings else 0.0)
                place = headings[scenario] + 1.0
            if cells:
                rungs.append((place, policy, table.rows_of(policy, *cells)))
                place += 1.0
    panels = []
    failure = table.environment.failure
    for column in table.environment.judged:
        levels = [score(episodes, column) for _, _, episodes in rungs]
        axis = _level_axis(column, [level.times(column.scale) for level in levels])
        left = 10 ** (axis["range"][0] + 1e-3)
        dots = []
        for (row, policy, episodes), level in zip(rungs, levels, strict=True):
            shown = level.times(column.scale)
            figure = number_interval(level, column) if level.is_known else ""
            failed, played = failures(episodes)
            mark = f'  <b style="color:{VERDICTS["higher"]}">✕ {failure} {failed}/{played}</b>'
            text = f"{figure}{mark if failed else ''}"
            text_x = shown.ends[1] if level.is_known else left
            symbol = "diamond" if policy in table.members else "circle"
            dots.append(Dot(row, shown, text, text_x, policy, colours[policy], symbol))
        panels.append((axis, dots))
    chart = _dot_plot(
        {row: chart_text(plotly_charts.cut_name(policy)) for row, policy, _ in rungs},
        panels,
        left=8 * min(max(map(len, table.policies)), LONGEST_NAME) + 24,
        height=70 + (24 if len(rungs) < 40 else 19) * (place + 1.0),
        top=34,
    )
    layout = chart["layout"]
    layout["annotations"] = [_heading(*heading) for heading in headings.items()]
    line = {"color": LINE, "width": 1}
    rule = {"type": "line", "xref": "paper", "x0": 0, "x1": 1}
    places = [place - 0.6 for place in list(headings.values())[1:]]
    layout["shapes"] = [{**rule, "y0": y, "y1": y, "line": line} for y in places]
    return chart


def _level_axis(column: Column, levels: Sequence[Estimate]) -> Spec:
    """Return a logarithmic axis, with room for figures at its right."""
    ends = [end for level in levels if level.is_known for end in level.ends]
    high = max(ends, default=1.0)
    low = max(min(ends, default=1.0), high / 1e4, 1e-6)
    room = math.log10(max(high / low, 1.3))
    left = math.log10(low) - 0.04 * room - 0.02
    right = math.log10(max(high, low)) + 0.34 * room + 0.1
    decades = [10.0**power for power in range(math.floor(left), math.ceil(right))]
    numbers = [digit * decade for decade in decades for digit in (1, 2, 5)]
    ticks = [number for number in numbers if left <= math.log10(number) <= right]
    return base_axis(
        column.label,
        type="log",
        range=[left, right],
        tickvals=ticks,
        ticktext=[f"{value:g}" for value in ticks],
    )


def _heading(text: str, place: float) -> Spec:
    return {
        "x": 0.0,
        "y": place,
        "xref": "paper",
        "xanchor": "right",
        "xshift": -8,
        "text": f"<b>{chart_text(text)}</b>",
        "showarrow": False,
        "font": {"size": 13, "color": INK},
    }


def forest(rows: Sequence[Change]) -> Spec:
    """Return the chart of changes of one residual against its base, in all cells."""
    lines = group_lines(rows)
    several = len({row.reference for row in rows}) > 1
    names = [f"{row.reference} · {row.scope}" if several else row.scope for row, *_ in lines]
    panels = []
    for column, metric_rows in group_by(rows, lambda row: row.column).items():
        changes = [row.relative.times(100.0) for row in metric_rows]
        ends = [end for change in changes if change.is_known for end in change.ends]
        low = min([*ends, 0.0])
        high = max([*ends, 0.0])
        span = max(high - low, 1.0)
        axis = base_axis(
            f"change of {column.title} [%]",
            range=[low - 0.05 * span, high + 0.5 * span],
            zeroline=True,
            zerolinecolor=INK,
            zerolinewidth=1.2,
        )
        # texts begin right of all intervals, so that the line at zero crosses none
        panels.append((axis, [_change_dot(n, row, high) for n, row in enumerate(metric_rows)]))
    titles = [
        f"<b>{chart_text(name)}</b>" if line[0].is_group else chart_text(name)
        for name, line in zip(names, lines, strict=True)
    ]
    return _dot_plot(
        dict(enumerate(titles)),
        panels,
        left=7.4 * min(max(map(len, names)), 46) + 26,
        height=80 + 27 * len(lines),
    )


def _change_dot(place: int, row: Change, text_x: float) -> Dot:
    symbol = "circle"
    if CEILING in row.marks:
        symbol = "star"
    elif any(mark.startswith(HELD_OUT) for mark in row.marks):
        symbol = "circle-open"
    return Dot(
        place,
        row.relative.times(100.0),
        percent_interval(row.relative) if row.relative.is_known else "nothing to compare",
        text_x,
        f"{row.scope}: {row.sentence}",
        VERDICTS[row.verdict],
        symbol,
    )
