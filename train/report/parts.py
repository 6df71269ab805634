"""What the charts of the report have in common, as plain specifications for plotly.js: lists, numbers and colours."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from elastic_env.core.signals import Array
from train.evaluate.environments import Column, Environment, TracedSignal
from train.evaluate.episodes import Evaluation
from train.evaluate.statistics import Estimate
from train.evaluate.table import EpisodeTable, score
from train.figures.plots import colours

FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'DejaVu Sans', sans-serif"
INK, GRID, FRAME = "#1f2328", "#e8eaed", "#8b949e"
LINE, SHADE, REFERENCE = "#d0d7de", "#f1f3f5", "#111111"
"""Colours of a line between groups, of single support behind a curve, and of the reference."""
NIGHT = {
    "white": "#0d1117", INK: "#e6edf3", GRID: "#262c34", FRAME: "#4a525c", LINE: "#3d444d", SHADE: "#1c2128",
    REFERENCE: "#e6edf3", "#1a7f5a": "#3fb27f", "#b42318": "#ff7b72", "#6e7781": "#9aa5b1", "#1f2a55": "#9fb0ff",
    "#3d3df5": "#9d9dff", "#555555": "#a8a8a8", "#2a6f97": "#4c9bc9", "#8e5ea2": "#b184c6", "#d6006c": "#ff5aa5",
    "#a05a00": "#d08a30",
}  # fmt: skip
"""Colours in the dark in place of those that would not be seen there, in all parts of a chart."""
VERDICTS = {"lower": "#1a7f5a", "higher": "#b42318", "none": "#6e7781", "unclear": "#6e7781"}
"""Colours of what a row shows."""
LONGEST_NAME = 34
"""Letters of a policy that stand beside an axis."""

Spec = dict[str, Any]


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


@dataclass(frozen=True)
class Chart:
    """A chart.

    Attributes:
        spec: `data` and `layout` for plotly.js.
        height: Height [px].
    """

    spec: Spec
    height: int


def level(cell: Sequence[Evaluation], column: Column) -> Estimate:
    """Score of a policy in a cell."""
    return score(EpisodeTable(cell).rows, column)


def shortened(name: str) -> str:
    """The end of a name that is too long: of a path it is what differs."""
    return name if len(name) <= LONGEST_NAME else "…" + name[1 - LONGEST_NAME :]


def error_bars(estimates: Sequence[Estimate], colour: str) -> Spec:
    """Intervals around points."""
    up = [0.0 if e.high is None else digits(e.high - e.value) for e in estimates]
    down = [0.0 if e.low is None else digits(e.value - e.low) for e in estimates]
    return {"type": "data", "symmetric": False, "array": up, "arrayminus": down, "color": colour, "thickness": 2,
            "width": 5, "visible": any(e.has_interval for e in estimates)}  # fmt: skip


def band_between(low: Array, high: Array, colour: str, where: Spec, title: str) -> list[Spec]:
    """The band between two curves, over the abscissa that `where` has."""
    hidden = {**where, "mode": "lines", "legendgroup": title, "showlegend": False, "hoverinfo": "skip",
              "line": {"width": 0}}  # fmt: skip
    return [
        {**hidden, "y": numbers(low)},
        {**hidden, "y": numbers(high), "fill": "tonexty", "fillcolor": faint(colour)},
    ]


def range_of(evaluations: Sequence[Evaluation], signal: TracedSignal) -> list[float]:
    """Range of a signal and its reference, shortly before a fall left out."""
    found = []
    for e in evaluations:
        found += [e.trace[name][e.is_steady] for name in (signal.name, signal.reference) if name is not None]
    values = np.concatenate(found)
    values = signal.scale * values[np.isfinite(values)]
    if len(values) == 0:
        return [-1.0, 1.0]
    margin = 0.06 * float(np.ptp(values)) + 1e-6
    return [digits(float(values.min()) - margin), digits(float(values.max()) + margin)]


def band(values: Array) -> tuple[Array, Array, Array]:
    """Least, median and most over the first axis, nan where there is nothing."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # columns of nothing but nan
        return np.nanmin(values, axis=0), np.nanmedian(values, axis=0), np.nanmax(values, axis=0)


def layout_of(margin: Spec) -> Spec:
    """What all charts have in common."""
    return {
        "paper_bgcolor": "white", "plot_bgcolor": "white", "font": {"family": FONT, "size": 13, "color": INK},
        "margin": {**margin, "pad": 4}, "hoverlabel": {"font": {"size": 12, "family": FONT}}, "hovermode": "closest",
    }  # fmt: skip


def axis_of(title: str = "", **options: Any) -> Spec:
    """An axis."""
    return {
        "title": {"text": title, "font": {"size": 13}, "standoff": 8}, "gridcolor": GRID, "linecolor": FRAME,
        "zeroline": False, "ticks": "", "automargin": False, **options,
    }  # fmt: skip


def note(x: float, y: float, text: str, **options: Any) -> Spec:
    """A text in a chart."""
    return {"x": x, "y": y, "text": text, "showarrow": False, "font": {"size": 13, "color": INK}, **options}


def domain(number: int, count: int, gap: float) -> list[float]:
    """Domain of a panel among several."""
    width = (1.0 - gap * (count - 1)) / count
    begin = number * (width + gap)
    return [round(begin, 6), round(min(begin + width, 1.0), 6)]


def nth(number: int) -> str:
    """How plotly numbers its axes: the first has no number."""
    return "" if number == 0 else str(number + 1)


def round_numbers(low: float, high: float) -> list[float]:
    """1, 2, 5, 10, ... between two bounds."""
    exponents = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    return [d * 10.0**e for e in exponents for d in (1, 2, 5) if low <= d * 10.0**e <= high]


def faint(colour: str) -> str:
    """A colour that lets through what is behind it."""
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},0.18)"


def thinned(values: Array, stride: int) -> list[float | None]:
    """Every so many of some values."""
    return numbers(values[::stride])


def numbers(values: Array) -> list[float | None]:
    """Values for plotly, None where there is none."""
    return [digits(float(value)) if np.isfinite(value) else None for value in values]


def digits(value: float) -> float:
    """A number with the digits that a picture can show; nan stays."""
    return float(f"{value:.5g}")
