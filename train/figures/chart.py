"""A chart as data: panels of curves over one axis.

Pictures and the page of a report draw the same charts.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from elastic_env.core.signals import Array
from train.evaluate.episodes import Evaluation

Colours = Mapping[str, str]
"""Colours by title of the policy."""
Evaluations = Sequence[Evaluation]
Cells = Mapping[str, Mapping[float | None, Evaluations]]
"""Evaluations of every policy by the swept value; None for a policy that is not swept."""


@dataclass(frozen=True, eq=False)
class Curve:
    """A curve of a panel.

    Attributes:
        name: Name in the legend; empty for no entry.
        colour: Its colour.
        x, y: Its points, (n,) each; y is nan where there is none.
        dash: solid, dash or dot.
        band: Ends of the band around it, (n,) each; None without one.
        width: Width of the line.
        has_points: True if its points are marked.
        fails: True if a cross marks its end.
        crosses: For crosses instead of a line, True per point for a filled one; empty for a line.
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

    @classmethod
    def median(cls, name: str, colour: str, x: Array, y: Array, **look: Any) -> Self:
        """Median of several series, (series, n), with a band from the least to the greatest."""
        low, middle, high = quantiles(y)
        band = (low, high) if len(y) > 1 else None
        return cls(name, colour, x, middle, band=band, **look)


@dataclass(frozen=True, eq=False)
class Panel:
    """A panel of a chart.

    Attributes:
        label: Title of its axis, with the unit.
        curves: Its curves.
        limits: Ends of its axis; None to fit the curves.
        is_log: True for a logarithmic axis.
        height: Its height in a picture [in].
        rows: Names of rows instead of numbers, from the top; y of a curve is then the row.
        own_legend: Names of curves in a legend of this panel, since other panels lack them.
    """

    label: str
    curves: Sequence[Curve]
    limits: tuple[float, float] | None = None
    is_log: bool = False
    height: float = 1.9
    rows: Sequence[str] = ()
    own_legend: Sequence[str] = ()


@dataclass(frozen=True)
class Mark:
    """Times that a strip above the panels marks.

    Attributes:
        name: Name in the legend.
        colour: Colour of the strip.
        spans: Beginnings and ends of the times.
    """

    name: str
    colour: str
    spans: Sequence[tuple[float, float]]


@dataclass(frozen=True, eq=False)
class Chart:
    """Panels one below the other over one axis.

    Attributes:
        title: Title of a picture.
        label: Title of the axis that the panels share.
        panels: Panels from the top.
        shaded: Beginnings and ends of the shaded parts of the axis.
        shade_name: Name of the shade in the legend.
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


def quantiles(values: Array) -> tuple[Array, Array, Array]:
    """Minimum, median and maximum over the first axis; nan where all values are nan."""
    shares = [0.0, 0.5, 1.0]
    has_gap = np.isnan(values).any(axis=0)
    result = np.empty((len(shares), *has_gap.shape))
    result[:, ~has_gap] = np.quantile(values[:, ~has_gap], shares, axis=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # columns that are all nan
        # nanquantile is a hundred times slower
        result[:, has_gap] = np.nanquantile(values[:, has_gap], shares, axis=0)
    return result[0], result[1], result[2]
