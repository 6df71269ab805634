"""Charts of scores and of their changes on a page: the ladder of policies, and every residual
against its base.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import pandas as pd

from train.evaluate.changes import CEILING, HELD_OUT, Change, by_line, percent_interval
from train.evaluate.environments import Column
from train.evaluate.statistics import Estimate
from train.evaluate.table import EpisodeTable, failures, score
from train.figures.colours import INK, LINE, VERDICTS
from train.report.render import number_interval
from train.report.specs import (
    LONGEST_NAME,
    PageChart,
    Spec,
    base_axis,
    base_layout,
    digits,
    domain,
    error_bars,
    nth,
    shorten,
)
from train.runs.escaping import chart_text


@dataclass(frozen=True, eq=False)
class _Rung:
    """A policy in a scenario, and its place on the ladder."""

    scenario: str
    policy: str
    rows: pd.DataFrame
    place: float


def ladder(table: EpisodeTable, reference: str, colours: Mapping[str, str]) -> PageChart:
    """Every policy in every scenario: its mean over the episodes that did not fail; of families
    with interval.
    """
    rungs, headings, bottom = _rungs(table, reference)
    columns = table.environment.judged
    layout = base_layout(
        left=8 * min(max(map(len, table.policies)), LONGEST_NAME) + 24, top=34, bottom=10
    )
    data: list[Spec] = []
    for number, column in enumerate(columns):
        axis = nth(number)
        levels = [score(rung.rows, column) for rung in rungs]
        edge = _edges([level.times(column.scale) for level in levels if level.is_known])
        for policy in table.policies:
            own = [
                (rung, level)
                for rung, level in zip(rungs, levels, strict=True)
                if rung.policy == policy
            ]
            symbol = "diamond" if policy in table.members else "circle"
            data.append(_points(own, column, colours[policy], symbol, axis))
            data.append(_figures(own, column, edge[0], axis, table.environment.failure))
        ticks = _round_numbers(10 ** edge[0], 10 ** edge[1])
        layout[f"xaxis{axis}"] = base_axis(
            column.label,
            type="log",
            range=edge,
            domain=domain(number, len(columns), gap=0.03),
            side="top",
            tickvals=ticks,
            ticktext=[f"{value:g}" for value in ticks],
            anchor="y",
        )
    layout["yaxis"] = base_axis(
        range=[bottom - 0.3, -0.7],
        tickvals=[rung.place for rung in rungs],
        ticktext=[chart_text(shorten(rung.policy)) for rung in rungs],
        showgrid=False,
    )
    layout["annotations"] = [_heading(scenario, place) for scenario, place in headings.items()]
    layout["shapes"] = [_rule(place - 0.6) for place in list(headings.values())[1:]]
    layout["showlegend"] = False
    row = 24 if len(rungs) < 40 else 19
    return PageChart({"data": data, "layout": layout}, int(70 + row * (bottom + 1)))


def _rungs(table: EpisodeTable, reference: str) -> tuple[list[_Rung], dict[str, float], float]:
    """Rungs, places of the headings by scenario, and the place below all of them."""
    rungs: list[_Rung] = []
    headings: dict[str, float] = {}
    place = 0.0
    for scenario in table.scenarios:
        for policy in table.policies:
            cells = table.cells_of(policy, reference, scenario)
            if cells and scenario not in headings:
                headings[scenario] = place + (0.5 if headings else 0.0)
                place = headings[scenario] + 1.0
            if cells:
                rungs.append(_Rung(scenario, policy, table.of(policy, *cells), place))
                place += 1.0
    return rungs, headings, place


def _edges(levels: Sequence[Estimate]) -> list[float]:
    """Ends of a logarithmic axis, with room for figures at its right."""
    low = min([level.ends[0] for level in levels], default=1.0)
    high = max([level.ends[1] for level in levels], default=1.0)
    low = max(low, high / 1e4, 1e-6)
    room = math.log10(max(high / low, 1.3))
    return [math.log10(low) - 0.04 * room - 0.02, math.log10(max(high, low)) + 0.34 * room + 0.1]


def _points(
    own: Sequence[tuple[_Rung, Estimate]], column: Column, colour: str, symbol: str, axis: str
) -> Spec:
    """Points of a policy with their intervals."""
    known = [(rung, level.times(column.scale)) for rung, level in own if level.is_known]
    return {
        "type": "scatter",
        "mode": "markers",
        "name": chart_text(own[0][0].policy) if own else "",
        "xaxis": f"x{axis}",
        "x": [digits(level.value) for _, level in known],
        "y": [rung.place for rung, _ in known],
        "error_x": error_bars([level for _, level in known], colour),
        "marker": {"size": 10, "color": colour, "symbol": symbol},
        "hoverinfo": "x+name",
    }


def _figures(
    own: Sequence[tuple[_Rung, Estimate]], column: Column, left: float, axis: str, failure: str
) -> Spec:
    """Figures beside the points, with failures."""
    x = []
    texts = []
    for rung, level in own:
        failed, played = failures(rung.rows)
        cross = (
            f'  <b style="color:{VERDICTS["higher"]}">✕ {failure} {failed}/{played}</b>'
            if failed
            else ""
        )
        x.append(digits(column.scale * level.ends[1]) if level.is_known else 10 ** (left + 1e-3))
        texts.append(f"  {number_interval(level, column)}{cross}" if level.is_known else cross)
    places = [rung.place for rung, _ in own]
    return {**_texts(x, places, texts, axis), "cliponaxis": False}


def _texts(x: Sequence[float], y: Sequence[float], texts: Sequence[str], axis: str) -> Spec:
    return {
        "type": "scatter",
        "mode": "text",
        "x": list(x),
        "y": list(y),
        "text": list(texts),
        "textposition": "middle right",
        "textfont": {"size": 12, "color": INK},
        "hoverinfo": "skip",
        "showlegend": False,
        "xaxis": f"x{axis}",
    }


def _heading(text: str, place: float) -> Spec:
    where = {"x": 0.0, "y": place, "xref": "paper", "yref": "y", "xanchor": "right", "xshift": -8}
    return {
        **where,
        "text": f"<b>{chart_text(text)}</b>",
        "showarrow": False,
        "font": {"size": 13, "color": INK},
    }


def _rule(place: float) -> Spec:
    where = {"xref": "paper", "yref": "y", "x0": 0, "x1": 1, "y0": place, "y1": place}
    return {"type": "line", **where, "line": {"color": LINE, "width": 1}}


def _round_numbers(low: float, high: float) -> list[float]:
    """1, 2, 5, 10, ... between two bounds."""
    exponents = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    return [d * 10.0**e for e in exponents for d in (1, 2, 5) if low <= d * 10.0**e <= high]


def forest(rows: Sequence[Change]) -> PageChart:
    """Changes of one residual against its base, in every cell, with intervals."""
    lines = by_line(rows)
    columns = list(dict.fromkeys(row.column for row in rows))
    several = len({row.reference for row in rows}) > 1
    scopes = [
        f"{line[0].reference} · {line[0].scope}" if several else line[0].scope for line in lines
    ]
    layout = base_layout(left=7.4 * min(max(map(len, scopes)), 46) + 26, top=40, bottom=10)
    layout["showlegend"] = False
    data: list[Spec] = []
    for number, column in enumerate(columns):
        axis = nth(number)
        shown = [next(row for row in line if row.column == column) for line in lines]
        known = [(place, row) for place, row in enumerate(shown) if row.relative.is_known]
        ends = [100.0 * end for _, row in known for end in (row.relative.value, *row.relative.ends)]
        low = min([*ends, 0.0])
        high = max([*ends, 0.0])
        span = max(high - low, 1.0)
        for verdict, colour in VERDICTS.items():
            own = [(place, row) for place, row in known if row.verdict == verdict]
            data.append(_changes(own, colour, axis))
        x = [
            digits(100.0 * row.relative.ends[1]) if row.relative.is_known else 0.0 for row in shown
        ]
        texts = [
            f"  {percent_interval(row.relative) if row.relative.is_known else 'nothing to compare'}"
            for row in shown
        ]
        data.append(_texts(x, range(len(shown)), texts, axis))
        layout[f"xaxis{axis}"] = base_axis(
            f"change of {column.title} [%]",
            range=[low - 0.05 * span, high + 0.5 * span],
            domain=domain(number, len(columns), gap=0.03),
            anchor="y",
            side="top",
            zeroline=True,
            zerolinecolor=INK,
            zerolinewidth=1.2,
        )
    names = [
        f"<b>{chart_text(scope)}</b>" if line[0].is_group else chart_text(scope)
        for scope, line in zip(scopes, lines, strict=True)
    ]
    layout["yaxis"] = base_axis(
        range=[len(lines) - 0.4, -0.6],
        tickvals=list(range(len(lines))),
        ticktext=names,
        showgrid=False,
    )
    return PageChart({"data": data, "layout": layout}, 80 + 27 * len(lines))


def _changes(own: Sequence[tuple[int, Change]], colour: str, axis: str) -> Spec:
    """Changes of one verdict, with their intervals."""
    relative = [row.relative.times(100.0) for _, row in own]
    symbols = [_symbol(row) for _, row in own]
    return {
        "type": "scatter",
        "mode": "markers",
        "showlegend": False,
        "xaxis": f"x{axis}",
        "x": [digits(change.value) for change in relative],
        "y": [place for place, _ in own],
        "error_x": error_bars(relative, colour),
        "marker": {
            "size": 9,
            "color": colour,
            "symbol": symbols,
            "line": {"width": 1.6, "color": colour},
        },
        "hoverinfo": "text",
        "hovertext": [chart_text(f"{row.scope}: {row.sentence}") for _, row in own],
    }


def _symbol(row: Change) -> str:
    if CEILING in row.marks:
        return "star"
    return "circle-open" if any(mark.startswith(HELD_OUT) for mark in row.marks) else "circle"
