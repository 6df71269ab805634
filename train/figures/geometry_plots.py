"""Figure of an identification with geometry: held-out errors, the curve over poses, stiffness."""

from pathlib import Path
from typing import Any

import numpy as np

from baselines.identification.geometry_result import GeometryIdentification
from baselines.identification.holdout import HeldOut
from train.figures.plots import new_figure, save, show_numbers

_OWN = "#2a6f97"
_OTHER = "#9aa5b1"
_HEIGHT = 3.4
_ROW = 0.24


def draw_geometry(result: GeometryIdentification, path: Path) -> Path:
    """Held-out errors beside rivals, the error over the number of poses, K of each joint."""
    shown = [own for own in result.joints if np.isfinite(own.stiffness_nm_per_rad)]
    panels = 1 if result.held_out is None else 3
    height = max(_HEIGHT, _ROW * len(shown) + 1.2)
    figure, axes = new_figure(1, panels, (4.3 * panels, height))
    if result.held_out is not None:
        draw_errors(axes[0], result.held_out)
        draw_curve(axes[1], result.held_out)
    axis = axes[-1]
    axis.set_title("K [N·m/rad] with 95 % intervals")
    for row, joint in enumerate(shown):
        low = joint.stiffness_low_nm_per_rad
        high = joint.stiffness_high_nm_per_rad
        K = joint.stiffness_nm_per_rad
        axis.plot([low or K, high or 10.0 * K], [row, row], color=_OTHER, lw=2.5)
        axis.plot(K, row, "o", color=_OWN, ms=5)
    axis.set_yticks(range(len(shown)), [joint.joint for joint in shown], fontsize=8)
    axis.set_xscale("log")
    show_numbers(axis.xaxis, numticks=6)  # those between the decades would overlap
    axis.invert_yaxis()
    return save(figure, path)


def draw_errors(axis: Any, held_out: HeldOut) -> None:
    """Bars of the held-out errors of all predictions."""
    names = [error.name for error in held_out.errors]
    values = [error.rms for error in held_out.errors]
    colours = [_OTHER] * (len(names) - 1) + [_OWN]
    bars = axis.barh(names, values, color=colours)
    axis.bar_label(bars, [f"{value:.3g}" for value in values], padding=3, fontsize=9)
    axis.set_xlim(0.0, 1.18 * max(values))
    axis.invert_yaxis()
    title = f"{held_out.held_out} held-out poses:\nrms [{held_out.unit}]"
    axis.set_title(title, fontsize=9)


def draw_curve(axis: Any, held_out: HeldOut) -> None:
    """The held-out error of the identification over the number of poses."""
    poses = [point.poses for point in held_out.curve]
    axis.plot(poses, [point.rms for point in held_out.curve], "o-", color=_OWN)
    rigid = held_out.errors[0].rms
    axis.axhline(rigid, color=_OTHER, lw=1.0, ls="--")
    axis.text(poses[0], rigid, "rigid, as given", fontsize=8, va="bottom")
    axis.set_yscale("log")
    show_numbers(axis.yaxis)
    axis.set_xlabel("poses that were fitted")
    axis.set_title(f"identified, over the number of poses:\nrms [{held_out.unit}]", fontsize=9)
