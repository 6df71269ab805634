"""Curves of the scores over a swept value, with the places where policies fail."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from elastic_env.core.signals import Array
from train.evaluate.environments import Column
from train.evaluate.episodes import Evaluation
from train.figures.plots import colours, columns_of, line_style, require_matplotlib, save


@dataclass(frozen=True, eq=False)
class Curve:
    """Cells of one policy.

    Attributes:
        policy: Its title.
        values: Swept value of every cell; None for one that was not swept, which is drawn as a level.
        cells: The cells.
    """

    policy: str
    values: list[float | None]
    cells: list[Evaluation]

    @property
    def is_level(self) -> bool:
        """Whether nothing was swept."""
        return None in self.values

    @property
    def x(self) -> Array:
        """Swept values in order, (n,)."""
        return np.array(sorted(value for value in self.values if value is not None))

    @property
    def ordered(self) -> list[Evaluation]:
        """The cells in the order of `x`."""
        swept = [pair for pair in zip(self.values, self.cells, strict=True) if pair[0] is not None]
        return [cell for _, cell in sorted(swept, key=lambda pair: float(pair[0] or 0.0))] if swept else self.cells

    def median(self, column: Column) -> Array:
        """Medians over the episodes that did not fail, nan where all did, (n,)."""
        values = [cell.values(column.metric) for cell in self.ordered]
        return np.array([column.scale * np.median(v) if len(v) else np.nan for v in values])

    @property
    def failed_share(self) -> Array:
        """Share of the episodes that failed, (n,)."""
        return np.array([cell.num_failed / max(len(cell.episodes), 1) for cell in self.ordered])


def draw_sweep(curves: Sequence[Curve], label: str, path: Path) -> Path:
    """Scores against a swept value, one curve per policy; on top, who fails where.

    A filled cross stands where all episodes failed, an open one where some did; a curve has a gap where all did.
    """
    plt = require_matplotlib()
    first = curves[0].cells[0].condition
    columns = first.environment.swept
    failing = [curve for curve in curves if curve.failed_share.any()]
    ratios = ([0.16 * len(failing) + 0.2] if failing else []) + [2.2] * len(columns)
    figure, axes = plt.subplots(
        len(ratios), 1, figsize=(8.0, sum(ratios) + 1.6), sharex=True, squeeze=False, height_ratios=ratios,
        layout="constrained",
    )  # fmt: skip
    panels = list(axes[:, 0])
    swept = sorted({value for curve in curves for value in curve.x.tolist()})
    panels[0].set_title(_title(curves))
    shades = colours([curve.policy for curve in curves])
    if failing:
        _draw_failures(panels[0], failing, curves, shades, first.environment.failure)
    for axis, column in zip(panels[-len(columns) :], columns, strict=True):
        for curve in curves:
            _draw_curve(axis, curve, column, shades[curve.policy])
        axis.set_yscale("log")
        _plain_ticks(axis.yaxis)
        axis.set_ylabel(column.label)
    panels[-1].set_xscale("log")
    panels[-1].set_xticks(swept, [f"{value:g}" for value in swept])
    panels[-1].minorticks_off()
    panels[-1].set_xlabel(label)
    handles, labels = panels[-1].get_legend_handles_labels()
    figure.align_ylabels(panels)
    figure.legend(handles, labels, ncols=columns_of(len(labels)), loc="outside lower center")
    return save(figure, path)


def _title(curves: Sequence[Curve]) -> str:
    references = dict.fromkeys(cell.condition.reference_name for curve in curves for cell in curve.cells)
    first = curves[0].cells[0].condition
    named = [first.environment.title(next(iter(references)))] if len(references) == 1 else []
    title = ", ".join([*named, f"scenario {first.scenario}"])
    return title[0].upper() + title[1:]


def _draw_curve(axis: Any, curve: Curve, column: Column, shade: str) -> None:
    median = curve.median(column)
    if curve.is_level:
        axis.axhline(median[0], color=shade, lw=1.2, ls=":", label=curve.policy)
        return
    axis.plot(curve.x, median, color=shade, lw=1.5, ls=line_style(curve.policy), marker="o", ms=4, label=curve.policy)


def _draw_failures(
    axis: Any, failing: Sequence[Curve], curves: Sequence[Curve], shades: dict[str, str], what: str
) -> None:
    """A row of crosses per policy that fails somewhere."""
    for row, curve in enumerate(reversed(failing)):
        shade = shades[curve.policy]
        swept = curve.x if not curve.is_level else np.array(sorted({x for c in curves for x in c.x.tolist()}))
        share = np.broadcast_to(curve.failed_share, swept.shape)
        for chosen, face in ((share == 1.0, shade), ((share > 0.0) & (share < 1.0), "none")):
            axis.scatter(swept[chosen], np.full(chosen.sum(), row), marker="X", s=46, facecolors=face, edgecolors=shade,
                         lw=1.0)  # fmt: skip
    axis.set_yticks(range(len(failing)), [curve.policy for curve in reversed(failing)], fontsize=8)
    axis.set_ylim(-0.7, len(failing) - 0.3)
    axis.set_ylabel(what)
    axis.tick_params(axis="x", length=0)
    axis.grid(axis="y", visible=False)


def _plain_ticks(axis: Any) -> None:
    """Numbers instead of powers of ten on a logarithmic axis."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())
