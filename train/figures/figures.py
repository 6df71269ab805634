"""Which figures a comparison draws, and what their files are called."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from train.evaluate.environments import Environment
from train.evaluate.episodes import Evaluation, group_by
from train.evaluate.maps import HeatMap
from train.evaluate.rollout import make_vector_env
from train.figures.map_plots import draw_map
from train.figures.plots import draw_overview
from train.figures.sweep_plots import Curve, draw_sweep
from train.figures.testbed_plots import draw_static_errors, draw_time_series
from train.figures.walk_plots import draw_pelvis, draw_zmp, paper_figure

Draw = Callable[[Sequence[Evaluation], Path], Path]

_MIN_SWEPT_REFERENCES = 3
"""From so many references with a number of their own on, the scores are drawn against it."""


def draw_figures(
    evaluations: Sequence[Evaluation], folder: Path, policies: Sequence[str] = (), swept: str | None = None
) -> list[Path]:
    """Draw the figures of a comparison.

    Args:
        evaluations: All cells.
        folder: Where to.
        policies: Policies of the time series, all if empty.
        swept: What an axis of swept options says; None without a sweep.
    """
    if swept is not None:
        groups = cells(evaluations)
        return [draw_sweep(option_curves(group), swept, folder / f"sweep_{_stem(group[0])}.png") for group in groups]
    known = evaluations[0].condition.environment
    files = [draw_overview(evaluations, known.overview, folder / "overview.png")]
    files += _draw_reference_sweeps(evaluations, known, folder)
    for group in cells(evaluations):
        shown = [e for e in group if not policies or e.condition.policy.title in policies]
        for name in known.figures:
            files += draw_figure(name, shown, folder)
    return files


def draw_maps(maps: Sequence[HeatMap], folder: Path) -> list[Path]:
    """Draw the maps of a comparison, a picture per scenario, motion and metric."""
    return [draw_map(found, folder / f"map_{_safe(f'{found.title}_{found.column.metric}')}.png") for found in maps]


def draw_figure(name: str, evaluations: Sequence[Evaluation], folder: Path) -> list[Path]:
    """Draw a figure of one reference and scenario, if there is something to show.

    Args:
        name: Name in the environment's description.
        evaluations: The policies.
        folder: Where to.
    """
    if not evaluations or (name == "static" and evaluations[0].points is None):
        return []
    return [_FIGURES[name](evaluations, folder / f"{figure_name(name, evaluations[0])}.png")]


def figure_name(name: str, evaluation: Evaluation) -> str:
    """Name of a figure's file; the paper's conditions have the number of its figure in front."""
    number = paper_figure(name, evaluation.condition)
    return f"{'' if number is None else f'fig{number}_'}{name}_{_stem(evaluation)}"


def cells(evaluations: Sequence[Evaluation]) -> list[list[Evaluation]]:
    """Evaluations of the same reference and scenario together."""
    return list(group_by(evaluations, lambda e: (e.condition.reference_name, e.condition.scenario)).values())


def option_curves(evaluations: Sequence[Evaluation]) -> list[Curve]:
    """A curve per policy over the swept option; a policy that was not swept is a level."""
    return [
        Curve(title, [next(iter(e.condition.swept.values()), None) for e in own], own)
        for title, own in _by_policy(evaluations).items()
    ]


def reference_curves(evaluations: Sequence[Evaluation]) -> list[Curve]:
    """A curve per policy over the number of the references."""
    return [Curve(title, [e.condition.number for e in own], own) for title, own in _by_policy(evaluations).items()]


def _draw_reference_sweeps(evaluations: Sequence[Evaluation], known: Environment, folder: Path) -> list[Path]:
    return [
        draw_sweep(
            reference_curves([e for e in evaluations if e.condition.scenario == scenario]), f"{known.quantity} [s]",
            folder / f"sweep_{_safe(scenario)}.png",
        )
        for scenario in swept_scenarios(evaluations)
    ]  # fmt: skip


def _by_policy(evaluations: Sequence[Evaluation]) -> dict[str, list[Evaluation]]:
    return group_by(evaluations, lambda e: e.condition.policy.title)


def _stem(evaluation: Evaluation) -> str:
    return _safe(f"{evaluation.condition.reference_name}_{evaluation.condition.scenario}")


def _safe(text: str) -> str:
    return re.sub(r"[^\w.=+-]+", "_", text)


def _draw_static(evaluations: Sequence[Evaluation], path: Path) -> Path:
    model = make_vector_env(evaluations[0].condition, 1).unwrapped.assumed_model
    return draw_static_errors(evaluations, model, path)


_FIGURES: dict[str, Draw] = {
    "time": draw_time_series,
    "static": _draw_static,
    "pelvis": draw_pelvis,
    "zmp": draw_zmp,
}


def swept_scenarios(evaluations: Sequence[Evaluation]) -> list[str]:
    """Scenarios in which the references that are played are points of one axis."""
    by_scenario = group_by(evaluations, lambda e: e.condition.scenario)
    return [scenario for scenario, own in by_scenario.items() if has_swept_references(own)]


def has_swept_references(evaluations: Sequence[Evaluation]) -> bool:
    """Whether the references are points of one axis: enough of them have a number, and each one of its own."""
    numbers = {e.condition.reference_name: e.condition.number for e in evaluations}
    known = [number for number in numbers.values() if number is not None]
    return len(known) >= _MIN_SWEPT_REFERENCES and len(set(known)) == len(known)
