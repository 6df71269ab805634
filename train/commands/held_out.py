"""Held-out errors of an identification from poses: their options, and how they are printed."""

from collections.abc import Callable

from rich import box
from rich.console import Console

from baselines.identification.holdout import HeldOut, Judged, judge, num_fits, split
from elastic_env.core.config import Model, quantity
from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import IntArray
from train.runs.console import make_table
from train.runs.progress import show_progress


class HoldoutOptions(Model):
    """What `elastic identify` keeps back from a fit, to judge it."""

    holdout: float = quantity("1", 0.3, ge=0, lt=1)
    """Share of the poses or logs that is not fitted, and predicted beside rivals; 0 for none."""
    folds: int = quantity("1", 1, ge=1, le=20)
    """Hold each pose out once, in so many folds."""


def judge_poses(
    judged: Judged, options: HoldoutOptions, console: Console, seed: int
) -> HeldOut | None:
    """Held-out errors; None where nothing is held out, which is said.

    Args:
        judged: Poses, and ways to predict them.
        options: Share or folds.
        console: Where progress goes, and why nothing is held out.
        seed: Seed of the draw.
    """
    if not options.holdout:
        return None
    parts = split(len(judged.theta), options.holdout, options.folds, seed)
    if reason := judged.too_few(parts):
        console.print(f"nothing is held out: {reason}", highlight=False)
        return None
    try:
        return _judge(judged, parts, console, seed)
    except ElasticError as error:
        console.print(f"nothing is held out: without some poses {error}", highlight=False)
        return None


def _judge(judged: Judged, parts: list[IntArray], console: Console, seed: int) -> HeldOut:
    work = {"held-out fits": num_fits(judged, parts)}
    with show_progress(console, work, transient=True) as show:
        report: Callable[[int], None] = lambda done: show(0, done)  # noqa: E731
        return judge(judged, parts, seed, report)


def show_held_out(held_out: HeldOut, console: Console) -> None:
    """Print the verdict, all errors, and how they fall with the number of poses."""
    console.print(verdict(held_out), highlight=False)
    rows = [
        [error.name, *(_text(value, held_out) for value in (error.rms, error.mean, error.worst))]
        for error in held_out.errors
    ]
    title = f"error of {held_out.of} at {held_out.held_out} poses that were held out"
    head = ["prediction", f"rms [{held_out.unit}]", "mean", "worst"]
    console.print(make_table(title, head, rows, box=box.SIMPLE))
    points = [
        f"{point.poses} poses {_text(point.rms, held_out)} {held_out.unit}"
        for point in held_out.curve
    ]
    console.print(f"by the number of poses: {', '.join(points)}", highlight=False)


def verdict(held_out: HeldOut) -> str:
    """Held-out errors in a sentence; a rival that is ahead comes first."""
    rigid = _text(held_out.errors[0].rms, held_out)
    own = _text(held_out.errors[-1].rms, held_out)
    rival = held_out.best_rival
    best = f"{_text(rival.rms, held_out)} {held_out.unit}"
    if held_out.is_ahead:
        return (
            f"held out: {rigid} {held_out.unit} rms as given, {own} {held_out.unit} identified;"
            f" the best of the rest, {rival.name}, reaches {best}"
        )
    return (
        f"{rival.name} is ahead: {best} rms at held-out poses, where the identification has {own}"
        f" {held_out.unit}: use that, or log more poses"
    )


def _text(value: float, held_out: HeldOut) -> str:
    return f"{value:.3f}" if held_out.unit == "N·m" else f"{value:.2f}"
