"""Charts of scores and of their changes: the ladder of policies, and every residual against its base."""

import math
from collections.abc import Sequence

import numpy as np

from train.evaluate.changes import CEILING, HELD_OUT, Change, by_line, percent_interval
from train.evaluate.environments import Column
from train.evaluate.episodes import Evaluation
from train.evaluate.statistics import Estimate
from train.report.parts import (
    INK,
    LINE,
    LONGEST_NAME,
    VERDICTS,
    Chart,
    Lines,
    Spec,
    axis_of,
    digits,
    domain,
    error_bars,
    layout_of,
    level,
    note,
    nth,
    round_numbers,
    shortened,
)
from train.report.render import number_interval
from train.runs.escaping import chart_text


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
    layout = layout_of(margin={"l": 8 * min(max(map(len, lines.titles)), LONGEST_NAME) + 24, "r": 10, "t": 34, "b": 10})
    for number, column in enumerate(columns):
        estimates = [level(cell, column).scaled(column.scale) for _, _, cell in rungs]
        axis, known = nth(number), [e for e in estimates if np.isfinite(e.value)]
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
        layout[f"xaxis{axis}"] = axis_of(
            type="log", range=edge, domain=domain(number, len(columns), 0.03), side="top", title=column.label,
            tickvals=round_numbers(10 ** edge[0], 10 ** edge[1]), anchor="y",
        )  # fmt: skip
        layout[f"xaxis{axis}"]["ticktext"] = [f"{value:g}" for value in layout[f"xaxis{axis}"]["tickvals"]]
    layout["yaxis"] = axis_of(
        range=[y - 0.3, -0.7], tickvals=places, ticktext=[chart_text(shortened(r[1])) for r in rungs], showgrid=False
    )
    layout["annotations"] = [
        note(0.0, place, f"<b>{chart_text(scenario)}</b>", xref="paper", yref="y", xanchor="right", xshift=-8)
        for place, scenario in headings
    ]
    layout["shapes"] = [
        {"type": "line", "xref": "paper", "yref": "y", "x0": 0, "x1": 1, "y0": place - 0.6, "y1": place - 0.6,
         "line": {"color": LINE, "width": 1}}
        for place, _ in headings[1:]
    ]  # fmt: skip
    layout["showlegend"] = False
    row = 24 if len(rungs) < 40 else 19
    return Chart({"data": data, "layout": layout}, int(70 + row * (y + 1)))


def forest(rows: Sequence[Change]) -> Chart:
    """Changes of one residual against its base, in every cell, with intervals."""
    lines = by_line(rows)
    columns = list(dict.fromkeys(row.column for row in rows))
    names = [_scope_of(line[0], len({row.reference for row in rows}) > 1) for line in lines]
    data: list[Spec] = []
    widest = max(len(name.replace("<b>", "").replace("</b>", "")) for name in names)
    layout = layout_of(margin={"l": 7.4 * min(widest, 46) + 26, "r": 10, "t": 40, "b": 10})
    layout["showlegend"] = False
    for number, column in enumerate(columns):
        axis = nth(number)
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
                    "x": [digits(100.0 * row.relative.value) for _, row in chosen], "y": [i for i, _ in chosen],
                    "error_x": error_bars([row.relative.scaled(100.0) for _, row in chosen], VERDICTS[verdict]),
                    "marker": {"size": 9, "color": VERDICTS[verdict], "symbol": [_symbol(row) for _, row in chosen],
                               "line": {"width": 1.6, "color": VERDICTS[verdict]}},
                    "hoverinfo": "text", "hovertext": [chart_text(f"{row.scope}: {row.sentence}") for _, row in chosen],
                }
            )  # fmt: skip
        data.append(
            {
                "type": "scatter", "mode": "text", "xaxis": f"x{axis}", "showlegend": False, "hoverinfo": "skip",
                "x": [digits(100.0 * max(row.relative.value, row.relative.high or row.relative.value))
                      if row in finite else 0.0 for row in shown],
                "y": list(range(len(shown))), "textposition": "middle right", "textfont": {"size": 12},
                "text": [f"  {percent_interval(row.relative)}" if row in finite else "  nothing to compare"
                         for row in shown],
            }
        )  # fmt: skip
        layout[f"xaxis{axis}"] = axis_of(
            range=[low - 0.05 * span, high + 0.5 * span], domain=domain(number, len(columns), 0.03), anchor="y",
            side="top", title=f"change of {column.title} [%]", zeroline=True, zerolinecolor=INK, zerolinewidth=1.2,
        )  # fmt: skip
    layout["yaxis"] = axis_of(
        range=[len(lines) - 0.4, -0.6], tickvals=list(range(len(lines))), ticktext=names, showgrid=False
    )
    return Chart({"data": data, "layout": layout}, 80 + 27 * len(lines))


_VERDICT_WORDS = {
    "lower": "lower", "higher": "higher", "none": "no difference shown", "unclear": "too few training seeds"
}  # fmt: skip


def _rungs(title: str, colour: str, symbol: str, places: Sequence[float], estimates: Sequence[Estimate], axis: str
           ) -> Spec:  # fmt: skip
    """Points of a policy with their intervals."""
    kept = [(y, e) for y, e in zip(places, estimates, strict=True) if np.isfinite(e.value)]
    return {
        "type": "scatter", "mode": "markers", "name": chart_text(title), "xaxis": f"x{axis}",
        "x": [digits(e.value) for _, e in kept], "y": [y for y, _ in kept],
        "error_x": error_bars([e for _, e in kept], colour),
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
        x.append(digits(end) if known else 10 ** (left + 1e-3))
        text.append(f"  {number_interval(estimate.scaled(1.0 / column.scale), column)}{crosses}" if known else crosses)
    return {
        "type": "scatter", "mode": "text", "x": x, "y": list(places), "text": text, "textposition": "middle right",
        "textfont": {"size": 12, "color": INK}, "hoverinfo": "skip", "xaxis": f"x{axis}", "cliponaxis": False,
    }  # fmt: skip


def _scope_of(row: Change, with_reference: bool) -> str:
    name = chart_text(f"{row.reference} · {row.scope}" if with_reference else row.scope)
    return f"<b>{name}</b>" if row.is_group else name


def _symbol(row: Change) -> str:
    if CEILING in row.marks:
        return "star"
    return "circle-open" if any(mark.startswith(HELD_OUT) for mark in row.marks) else "circle"
