"""What all figures share: style, colours, files; and the bar chart of a whole comparison."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from elastic_env.errors import missing_extra
from train.environments import Column
from train.evaluate import Evaluation

MRAD, MM = 1e3, 1e3
"""Factors from rad and m to what figures show."""

_COLOURS = {
    "zero": "#9c6644",
    "rigid": "#555555",
    "uncompensated_open": "#e6a57e",
    "uncompensated": "#c8553d",
    "input_open": "#8fbbd9",
    "input": "#2a6f97",
    "input_output": "#14a098",
    "input_wrench": "#1f2a55",
    "dynamic": "#7aa344",
    "oracle": "#8e5ea2",
}
FAILED = "#111111"
"""Colour of the mark of a failure that belongs to no policy alone."""
_OTHERS = ("#bc8034", "#3d8b8b", "#8d5524", "#d1495b", "#4a4e69")
_DASHED = ("zero", "rigid", "uncompensated_open", "input_open")


def require_matplotlib() -> Any:
    """Matplotlib's pyplot with our style, drawing into files.

    Raises:
        MissingExtraError: It is not installed.
    """
    try:
        import matplotlib as mpl
    except ImportError:
        raise missing_extra("matplotlib", "report", "drawing figures") from None
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    plt.rcParams.update(
        {
            "figure.dpi": 130,
            "font.size": 10,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.grid": True,
            "axes.axisbelow": True,
            "grid.alpha": 0.25,
            "legend.frameon": False,
            "axes.titlesize": 11,
            "axes.titleweight": "bold",
            "axes.titlelocation": "left",
        }
    )
    return plt


def colour(policy: str, index: int = 0) -> str:
    """Colour of a policy, the same in every figure."""
    return _COLOURS.get(policy, _OTHERS[index % len(_OTHERS)])


def line_style(policy: str) -> str:
    """Line of a policy: dashed where no center of mass is fed back."""
    return "--" if policy in _DASHED else "-"


def save(figure: Any, path: Path) -> Path:
    """Write a figure and forget it."""
    figure.savefig(path, bbox_inches="tight")
    require_matplotlib().close(figure)
    return path


def draw_overview(evaluations: Sequence[Evaluation], column: Column, path: Path) -> Path:
    """A metric of every policy in every scenario, one panel per reference.

    Bars are medians over the episodes that did not fail, dots these episodes, crosses episodes that failed.
    """
    plt = require_matplotlib()
    references = list(dict.fromkeys(e.condition.reference_name for e in evaluations))
    scenarios = list(dict.fromkeys(e.condition.scenario for e in evaluations))
    policies = list(dict.fromkeys(e.condition.policy.title for e in evaluations))
    panel = 1.2 + max(3.0, (0.35 + 0.14 * len(policies)) * len(scenarios))
    stacked = panel * len(references) > _WIDEST
    rows, columns = (len(references), 1) if stacked else (1, len(references))
    figure, axes = plt.subplots(
        rows, columns, figsize=(min(panel, 1.4 * _WIDEST) * columns, (2.3 if stacked else 3.8) * rows),
        sharey=True, sharex=stacked, squeeze=False, layout="constrained",
    )  # fmt: skip
    for axis, reference in zip(axes.flat, references, strict=True):
        of_reference = [e for e in evaluations if e.condition.reference_name == reference]
        _draw_bars(axis, of_reference, column, scenarios, policies)
        axis.set_title(evaluations[0].condition.environment.title(reference))
        if axis.get_subplotspec().is_first_col():
            axis.set_ylabel(column.label)
    _legend(figure, axes.flat[0], evaluations, policies, per_row=max(int(columns * panel / 1.7), 2))
    return save(figure, path)


_WIDEST = 12.0


def _draw_bars(
    axis: Any, evaluations: Sequence[Evaluation], column: Column, scenarios: Sequence[str], policies: Sequence[str]
) -> None:
    """One group of bars per scenario."""
    width = 0.84 / len(policies)
    for evaluation in evaluations:
        policy = evaluation.condition.policy.title
        index = policies.index(policy)
        x = scenarios.index(evaluation.condition.scenario) + (index - (len(policies) - 1) / 2) * width
        values = column.scale * evaluation.values(column.metric)
        shade = colour(policy, index)
        axis.bar(x, np.median(values) if len(values) else 0.0, width=0.9 * width, color=shade)
        if len(evaluation.episodes) > 1:
            axis.scatter(np.full(len(values), x), values, s=4, color="#222222", alpha=0.45, lw=0, zorder=3)
        if evaluation.num_failed:
            shown = {
                "color": shade if len(values) == 0 else FAILED,
                "zorder": 4,
                "transform": axis.get_xaxis_transform(),
            }
            axis.scatter(x, 0.035, marker="X", s=26, edgecolors="white", lw=0.5, **shown)
    slanted = {"rotation": 25, "ha": "right"} if len(scenarios) > 2 else {}
    axis.set_xticks(range(len(scenarios)), scenarios, **slanted)
    axis.grid(axis="x", visible=False)


def _legend(figure: Any, axis: Any, evaluations: Sequence[Evaluation], policies: Sequence[str], per_row: int) -> None:
    """Policies, and the mark of failures if there are any."""
    handles = [axis.bar(np.nan, 0.0, color=colour(policy, i), label=policy) for i, policy in enumerate(policies)]
    if any(evaluation.num_failed for evaluation in evaluations):
        failure = evaluations[0].condition.environment.failure
        handles.append(axis.scatter([], [], marker="X", s=26, color=FAILED, label=failure))
    figure.legend(handles=handles, ncols=min(len(handles), per_row), loc="outside lower center")
