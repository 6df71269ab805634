"""What all figures share: style, colours, files; and the bar chart of a whole comparison."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from elastic_env.core.errors import missing_extra
from elastic_env.core.files import write_whole
from train.evaluate.environments import Column
from train.evaluate.episodes import Evaluation

MRAD, MM = 1e3, 1e3
"""Factors from rad and m to what figures show."""

COLOURS = {
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
"""Of the baselines."""
STRONG = ("#d6006c", "#e69500", "#3d3df5", "#00a63e", "#111111", "#00a5cf", "#a05a00", "#8a8a8a")
"""Of residuals and of one's own policies: far from the baselines' and from one another."""
FAILED = "#111111"
"""Colour of the mark of a failure that belongs to no policy alone."""
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


def colours(policies: Sequence[str]) -> dict[str, str]:
    """A colour for every policy of a comparison: those that have none of their own take the others in turn."""
    unnamed = [policy for policy in policies if policy not in COLOURS]
    return {policy: COLOURS.get(policy) or STRONG[unnamed.index(policy) % len(STRONG)] for policy in policies}


def line_style(policy: str) -> str:
    """Line of a policy: dashed where no center of mass is fed back."""
    return "--" if policy in _DASHED else "-"


def columns_of(entries: int, widest: int = 5) -> int:
    """Columns of a legend, so that its rows are about equally full."""
    rows = -(-entries // widest)
    return -(-entries // max(rows, 1))


def save(figure: Any, path: Path) -> Path:
    """Write a figure and forget it."""
    content = io.BytesIO()
    figure.savefig(content, format=path.suffix[1:], bbox_inches="tight")
    write_whole(path, content.getvalue())
    require_matplotlib().close(figure)
    return path


def draw_overview(evaluations: Sequence[Evaluation], column: Column, path: Path) -> Path:
    """A metric of every policy: a panel per reference with all scenarios; of one scenario a panel with all references.

    Bars are medians over the episodes that did not fail, dots these episodes, crosses episodes that failed.
    """
    plt = require_matplotlib()
    known = evaluations[0].condition.environment
    policies = list(dict.fromkeys(e.condition.policy.title for e in evaluations))
    scenarios = list(dict.fromkeys(e.condition.scenario for e in evaluations))
    panels: dict[str, dict[str, list[Evaluation]]] = {}
    for evaluation in evaluations:
        reference, scenario = evaluation.condition.reference_name, evaluation.condition.scenario
        outer, inner = (
            (f"scenario {scenario}", reference) if len(scenarios) == 1 else (known.title(reference), scenario)
        )
        panels.setdefault(outer, {}).setdefault(inner, []).append(evaluation)
    width = 1.2 + max(3.0, (0.35 + 0.14 * len(policies)) * max(map(len, panels.values())))
    stacked = len(panels) > 1 and width * len(panels) > _WIDEST
    rows, columns = (len(panels), 1) if stacked else (1, len(panels))
    figure, axes = plt.subplots(
        rows, columns, figsize=(min(width, 1.4 * _WIDEST) * columns, (2.3 if stacked else 3.8) * rows),
        sharey=True, sharex=stacked, squeeze=False, layout="constrained",
    )  # fmt: skip
    for axis, (title, groups) in zip(axes.flat, panels.items(), strict=True):
        _draw_bars(axis, groups, column, policies)
        axis.set_title(title)
        if axis.get_subplotspec().is_first_col():
            axis.set_ylabel(column.label)
    if len(scenarios) == 1 and known.quantity:
        axes[-1][0].set_xlabel(known.quantity)
    _legend(figure, axes.flat[0], evaluations, policies, per_row=max(int(columns * width / 1.7), 2))
    return save(figure, path)


_WIDEST = 12.0
"""Width beyond which panels stand one above the other [in]."""
_ROOMY = 7
"""From so many bars in a group on, the name of the group has room below it."""


def _draw_bars(axis: Any, groups: dict[str, list[Evaluation]], column: Column, policies: Sequence[str]) -> None:
    """A bar per policy in every group."""
    width, shades = 0.84 / len(policies), colours(policies)
    for place, evaluation in ((place, e) for place, group in enumerate(groups.values()) for e in group):
        policy = evaluation.condition.policy.title
        index = policies.index(policy)
        x = place + (index - (len(policies) - 1) / 2) * width
        values = column.scale * evaluation.values(column.metric)
        shade = shades[policy]
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
    crowded = len(groups) > 2 and len(policies) < _ROOMY
    slanted = {"rotation": 25, "ha": "right"} if crowded else {}
    axis.set_xticks(range(len(groups)), list(groups), **slanted)
    axis.set_xlim(-0.55, len(groups) - 0.45)
    axis.grid(axis="x", visible=False)


def _legend(figure: Any, axis: Any, evaluations: Sequence[Evaluation], policies: Sequence[str], per_row: int) -> None:
    """Policies, and the mark of failures if there are any."""
    handles = [axis.bar(np.nan, 0.0, color=shade, label=policy) for policy, shade in colours(policies).items()]
    if any(evaluation.num_failed for evaluation in evaluations):
        failure = evaluations[0].condition.environment.failure
        handles.append(axis.scatter([], [], marker="X", s=26, color=FAILED, label=failure))
    figure.legend(handles=handles, ncols=columns_of(len(handles), per_row), loc="outside lower center")
