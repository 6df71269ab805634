"""`python -m docs.recorded FOLDER`: every figure of the page "Recorded robots"."""

import json
from itertools import count
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich import box
from rich.console import Console

from docs.recorded.justin import HandError, hand_errors, num_trials, read_poses
from docs.recorded.pictures import draw_hand_errors
from docs.recorded.servos import COLUMNS, num_fits, servo_figures, servo_rows
from docs.recorded.sources import SOURCES
from elastic_env.core.files import write_whole
from train.commands.cli import CONSOLE, run_program
from train.commands.entry import start as start_program
from train.runs.console import make_table, print_files
from train.runs.escaping import write_records
from train.runs.folders import run_folder
from train.runs.progress import show_progress


def main(
    folder: Annotated[Path, tyro.conf.Positional], fetch: bool = False, output: Path | None = None
) -> None:
    """Identify recorded robots and predict what was held out; takes half an hour.

    The recordings are of others, and are not part of the project. Each is one commit of a public
    repository, and is checked by its digest.

    Args:
        folder: Folder of the recordings.
        fetch: Fetch what the folder does not have from github.com.
        output: Folder for tables and figures; default runs/recorded, numbered if taken.
    """
    for source in SOURCES.values():
        CONSOLE.print(
            f"{source.name}: {source.what}\n  {source.repository}, commit {source.commit};"
            f" licence: {source.licence}",
            highlight=False,
            soft_wrap=True,
        )
        if fetch:
            source.fetch(folder, lambda address: CONSOLE.print(f"fetching {address}"))
    files = {
        name: [source.file(folder, path) for path in source.files]
        for name, source in SOURCES.items()
    }
    poses = read_poses(files["agile_justin"][0])
    logs = [*files["xl330"], *files["sts3250"]]
    totals = {"servos": num_fits(), "humanoid": num_trials(len(poses.theta))}
    with (
        run_folder("recorded", {"folder": str(folder)}, None, output) as results,
        show_progress(CONSOLE, totals, unit="fits") as show,
    ):
        done = count(1)
        figures = servo_figures(logs, results, lambda what: show(0, next(done), what))
        servos = servo_rows(figures)
        hands = hand_errors(poses, lambda done: show(1, done))
        write_records(servos, results / "recorded_servos.csv")
        write_records([row.model_dump() for row in hands], results / "recorded_justin.csv")
        draw_hand_errors(hands, results / "recorded_justin.png")
        write_whole(results / "servos.json", json.dumps(figures, indent=1))
    _print_servos(servos, CONSOLE)
    _print_hands(hands, CONSOLE)
    print_files(results, sorted(results.iterdir()), CONSOLE)


def _print_servos(rows: list[dict[str, Any]], console: Console) -> None:
    """Errors of the servos' logs that were not fitted."""
    keys = (*COLUMNS, "replay_all_mrad")
    lines = []
    for row in rows:
        shown = [f"{row[key]:.1f}" if key in row else "–" for key in keys]
        lines.append([row["servo"], row["measure"], row["of"], *shown])
    head = ["servo", "measure", "motion or gain", "goal", "offset", "line", "identified"]
    head.append("identified, torque off included")
    title = "error of the angle in logs that were not fitted, torque on, rms [mrad]"
    console.print(make_table(title, head, lines, box=box.SIMPLE))


def _print_hands(rows: list[HandError], console: Console) -> None:
    """Errors of the hands, most poses last."""
    lines = [
        [
            row.prediction,
            f"{row.poses}",
            row.masses,
            f"{row.mean_mm:.2f}",
            f"{row.least_mm:.2f} to {row.most_mm:.2f}",
            f"{row.rms_mm:.2f}",
        ]
        for row in rows
    ]
    title = (
        f"error of a hand at {rows[0].held_out} poses that were held out, {rows[0].halves} halves"
    )
    head = ["prediction", "poses", "masses", "mean [mm]", "halves", "rms"]
    console.print(make_table(title, head, lines, box=box.SIMPLE))


if __name__ == "__main__":
    start_program(lambda: run_program(lambda: tyro.cli(main)))
