"""Time series of a walk, as Figs. 7 to 10 of the paper: pelvis in mrad, zero moment point in mm.

Single support is shaded; a cross marks a fall. The scale is that of the walks that go on: a fall leaves the picture.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from elastic_env.core.signals import Array
from train.evaluate.conditions import Condition
from train.evaluate.episodes import Evaluation
from train.figures.plots import FAILED, MM, MRAD, colours, columns_of, line_style, require_matplotlib, save

_SHADE = "#e9ebee"
_PAPER_BOUND_MRAD = 10.0
"""What the pelvis error stays below with compensation in the paper, in its two gaits."""
_PAPER_LABEL = "paper, compensated: ±10 mrad"
_PAPER_FIGURES = {("pelvis", "24 s"): 7, ("pelvis", "3 s"): 8, ("zmp", "24 s"): 9, ("zmp", "3 s"): 10}
_PAPER_SCENARIOS = ("ideal", "nominal")


def draw_pelvis(evaluations: Sequence[Evaluation], path: Path) -> Path:
    """Roll and pitch of the pelvis, which should be level, one line per policy."""
    figure, axes = _panels(evaluations, "pelvis", "Pelvis error")
    for axis, signal, name in zip(axes, ("pelvis_roll", "pelvis_pitch"), ("roll", "pitch"), strict=True):
        axis.axhline(0.0, color="#777777", lw=0.8)
        _draw_lines(axis, evaluations, signal, MRAD)
        if paper_figure("pelvis", evaluations[0].condition) is not None:
            for bound in (-_PAPER_BOUND_MRAD, _PAPER_BOUND_MRAD):
                axis.axhline(bound, color="#777777", lw=0.9, ls=":", label=_PAPER_LABEL)
            low, high = axis.get_ylim()
            axis.set_ylim(min(low, -1.2 * _PAPER_BOUND_MRAD), max(high, 1.2 * _PAPER_BOUND_MRAD))
        axis.set_ylabel(f"{name} [mrad]")
    return _finish(figure, axes, evaluations, path)


def draw_zmp(evaluations: Sequence[Evaluation], path: Path) -> Path:
    """Zero moment point, forward and to the left, with its reference, one line per policy."""
    figure, axes = _panels(evaluations, "zmp", "Zero moment point", height_ratios=(1.0, 1.5))
    trace = _longest(evaluations)
    for axis, along, name in zip(axes, "xy", ("x, forward", "y, to the left"), strict=True):
        _draw_lines(axis, evaluations, f"zmp_{along}", MM, f"zmp_reference_{along}")
        axis.plot(trace["time_s"], MM * trace[f"zmp_reference_{along}"], color="#111111", lw=1.1, ls=(0, (4, 2)),
                  label="reference", zorder=4)  # fmt: skip
        axis.set_ylabel(f"{name} [mm]")
    return _finish(figure, axes, evaluations, path)


def paper_figure(name: str, condition: Condition) -> int | None:
    """Number of the paper's figure that a picture of a condition stands beside, if there is one."""
    is_like_the_paper = condition.scenario in _PAPER_SCENARIOS
    return _PAPER_FIGURES.get((name, condition.reference_name)) if is_like_the_paper else None


def intervals(mask: Array, time: Array) -> list[tuple[float, float]]:
    """Beginnings and ends of the times in which a mask is true, (n,) each."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0.0], mask > 0.5, [0.0]])))
    return [(float(time[begin]), float(time[end - 1])) for begin, end in edges.reshape(-1, 2)]


def _panels(
    evaluations: Sequence[Evaluation], name: str, what: str, height_ratios: tuple[float, float] = (1.0, 1.0)
) -> Any:
    plt = require_matplotlib()
    figure, axes = plt.subplots(
        2, 1, figsize=(9.0, 5.2), sharex=True, height_ratios=height_ratios, layout="constrained"
    )
    condition, trace = evaluations[0].condition, _longest(evaluations)
    number = paper_figure(name, condition)
    beside = "" if number is None else f" (cf. Fig. {number} of the paper)"
    reference = condition.environment.title(condition.reference_name)
    axes[0].set_title(f"{what}, {reference}, scenario {condition.scenario}{beside}")
    for axis in axes:
        for begin, end in intervals(trace["single_support"], trace["time_s"]):
            axis.axvspan(begin, end, color=_SHADE, lw=0, zorder=0, label="single support")
        axis.grid(axis="x", visible=False)
        axis.margins(x=0.0)
    axes[1].set_xlabel("time [s]")
    return figure, axes


def _draw_lines(
    axis: Any, evaluations: Sequence[Evaluation], signal: str, scale: float, reference: str | None = None
) -> None:
    """A line per policy, the scale set by what is not a fall."""
    low, high = zip(*(_range(e, signal, reference) for e in evaluations), strict=True)
    bottom, top = scale * min(low), scale * max(high)
    margin = 0.08 * (top - bottom) + 1e-9
    axis.set_ylim(bottom - margin, top + margin)
    shades = colours([evaluation.condition.policy.title for evaluation in evaluations])
    for evaluation in evaluations:
        policy, trace = evaluation.condition.policy.title, evaluation.trace
        shade = shades[policy]
        axis.plot(trace["time_s"], scale * trace[signal], color=shade, lw=1.1, ls=line_style(policy), label=policy)
        if evaluation.first_failed:
            last = trace[signal][np.isfinite(trace[signal])][-1:]
            y = np.clip(scale * last, bottom, top)
            axis.scatter(trace["time_s"][-1:], y, marker="X", s=70, color=shade, edgecolors="white", lw=0.8, zorder=6,
                         clip_on=False)  # fmt: skip


def _range(evaluation: Evaluation, signal: str, reference: str | None) -> tuple[float, float]:
    """Smallest and largest value of a signal and its reference, shortly before a fall left out."""
    names = [signal] if reference is None else [signal, reference]
    values = np.concatenate([evaluation.trace[name][evaluation.is_steady] for name in names])
    values = values[np.isfinite(values)]
    return float(values.min()), float(values.max())


def _longest(evaluations: Sequence[Evaluation]) -> dict[str, Array]:
    """The trace that shows most of the plan, which is the same for all."""
    return max((e.trace for e in evaluations), key=lambda trace: len(trace["time_s"]))


def _finish(figure: Any, axes: Any, evaluations: Sequence[Evaluation], path: Path) -> Path:
    """With a legend: policies first."""
    if any(evaluation.first_failed for evaluation in evaluations):
        axes[0].scatter([], [], marker="X", s=60, color=FAILED, label="fall")
    once = {label: handle for handle, label in zip(*axes[0].get_legend_handles_labels(), strict=True)}
    policies = [e.condition.policy.title for e in evaluations]
    labels = [*policies, *(label for label in once if label not in policies)]
    figure.legend([once[label] for label in labels], labels, ncols=columns_of(len(labels)), loc="outside lower center")
    return save(figure, path)
