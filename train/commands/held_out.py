"""Held-out errors of an identification from poses, and their printing."""

from functools import partial

from rich import box
from rich.console import Console

from baselines.identification.holdout import HeldOut, HoldoutProblem, judge, num_fits, split
from elastic_env.core.errors import ElasticError
from train.commands.identify_options import HoldoutOptions
from train.runs.console import make_table
from train.runs.progress import show_progress


def judge_poses(
    problem: HoldoutProblem, options: HoldoutOptions, console: Console, seed: int
) -> HeldOut | None:
    """Return held-out errors; if nothing is held out, print the reason and return None.

    Args:
        problem: Poses, and ways to predict them.
        options: Share or folds.
        console: Console for progress, and for the reason.
        seed: Seed of the draw.
    """
    if not options.holdout:
        return None
    parts = split(len(problem.theta), options.holdout, options.folds, seed)
    if reason := problem.shortage(parts):
        console.print(f"nothing is held out: {reason}")
        return None
    try:
        work = {"held-out fits": num_fits(problem, parts)}
        with show_progress(console, work, transient=True) as show:
            return judge(problem, parts, seed, partial(show, 0))
    except ElasticError as error:
        console.print(f"nothing is held out: without some poses {error}")
        return None


def print_held_out(held_out: HeldOut, console: Console) -> None:
    """Print the verdict, all errors, and errors by the number of poses."""
    console.print(verdict(held_out))
    rows = []
    for error in held_out.errors:
        figures = (error.rms, error.mean, error.worst)
        rows.append([error.name, *(_text(figure, held_out) for figure in figures)])
    title = f"error of {held_out.of} at {held_out.held_out} poses that were held out"
    head = ["prediction", f"rms [{held_out.unit}]", "mean", "worst"]
    console.print(make_table(title, head, rows, box=box.SIMPLE))
    points = [
        f"{point.poses} poses {_text(point.rms, held_out)} {held_out.unit}"
        for point in held_out.curve
    ]
    console.print(f"by the number of poses: {', '.join(points)}")


def verdict(held_out: HeldOut) -> str:
    """Return held-out errors in a sentence; a rival that is ahead comes first."""
    rigid = _text(held_out.errors[0].rms, held_out)
    identified = _text(held_out.errors[-1].rms, held_out)
    rival = held_out.best_rival
    best = f"{_text(rival.rms, held_out)} {held_out.unit}"
    if held_out.is_ahead:
        return (
            f"held out: {rigid} {held_out.unit} rms as given, {identified} {held_out.unit}"
            f" identified; the best of the rest, {rival.name}, reaches {best}"
        )
    return (
        f"{rival.name} is ahead: {best} rms at held-out poses, where the identification has"
        f" {identified} {held_out.unit}: use that, or log more poses"
    )


def number_or_dash(value: float | None, form: str = ".4g", scale: float = 1.0) -> str:
    """Return a figure for a table; – for None."""
    return "–" if value is None else format(scale * value, form)


def _text(value: float, held_out: HeldOut) -> str:
    return f"{value:.3f}" if held_out.unit == "N·m" else f"{value:.2f}"
