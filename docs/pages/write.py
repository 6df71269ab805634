"""Pages of the documentation whose figures come from the results beside them, and from nowhere
else.

    python -m docs.pages          # README.md and docs/*.md from docs/results

A page has a part between two marks, such as `<!-- leaderboard: begin -->` and `<!-- leaderboard:
end -->`. A figure within a sentence stands between `<!-- = paper; input_output; 3 s; nominal;
pelvis_roll_rms_rad -->` and `<!-- / -->`. The tool writes all of them anew. A test fails where a
page and the results disagree.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from docs.pages import arms, joints, recorded, speeds, walks
from docs.pages.cells import KEPT, Cells, Rows, in_table_unit, minus, page_table, read_rows
from docs.pages.learned import (
    ARM,
    ARM_SCENARIOS,
    MAPS,
    MOTIONS,
    LearnedMap,
    both_opponents,
    changes_table,
    learned_maps,
    learning_in_short,
    maps_markdown,
    twenty_steps,
)
from docs.pages.standings import board_markdown
from docs.pages.step_picture import step_svg
from elastic_env.core.errors import ConfigurationError
from train.commands.demo import PAPER_PELVIS
from train.evaluate.leaderboard_rows import Standing
from train.report.leaderboard import read_leaderboard

_TITLES = {"uncompensated": "without compensation", "input_output": "with the paper's compensator"}
_SAGS = ("uncompensated_rms", "input_rms", "soft_uncompensated_rms", "soft_input_rms")
FAST_WALKERS = ("learned_walker_1600ms", "learned_walker_1100ms")
"""Comparisons of residuals of the walker at fast gaits."""
_PEAKS = ("pelvis_roll_peak_rad", "pelvis_pitch_peak_rad")


TABLES = {
    "demo_episodes": "copy it from runs/demo/episodes.csv after `elastic demo`",
    "gallery": "python -m docs.pages.gallery writes it",
    **{
        name: f"copy it from statistics.csv after `elastic compare configs/{name}.yaml`"
        for name in (
            "learned_robot",
            "learned_testbed",
            "learned_testbed_friction",
            "learned_walker",
            *FAST_WALKERS,
        )
    },
    "link_encoder": "copy it from episodes.csv after `elastic compare configs/robot.yaml`",
    "drawn_robots": "copy it from robots.csv after `elastic compare configs/drawn_robots.yaml`",
    **{
        kept.table or name: f"python -m docs.pages.keep writes it from a run of configs/{name}.yaml"
        for name, kept in KEPT.items()
    },
    **{
        f"speed_{env}": (
            f"copy it from speed.csv after `elastic speed --env {env} --num-envs 64 1 16 256 1024`"
        )
        for env in ("walker", "testbed")
    },
    "speed_gpu": (
        "copy it from speed.csv after `elastic speed --backend warp --num-envs 1024 4096 16384"
        " --no-others --no-ppo --steps 20 --rounds 3`, and with --env testbed"
    ),
    "cluster": "python -m tests.cluster_trials measures it",
    "servo_coverage": "python -m tests.servo_trials measures it",
    "arm_identification": "python -m tests.identification_trials measures it",
    **dict.fromkeys(("recorded_justin", "recorded_servos"), "python -m docs.recorded writes it"),
    "margins": "copy it from runs/margins/margins.csv after `elastic margins`",
    "step": "python -m docs.pages.step writes it",
    **dict.fromkeys(
        ("identification", "output_compensator", "gravity_torque"),
        "python -m docs.pages.statics writes it",
    ),
}
"""Tables of the results, and where they come from."""


@dataclass(frozen=True)
class Results:
    """The results that pages show.

    Attributes:
        standings: Rows of the leaderboard.
        maps: Maps of what learning adds, by the name of their file.
        tables: Rows of the other tables, by the name of their file.
    """

    standings: Sequence[Standing]
    maps: Mapping[str, Sequence[LearnedMap]]
    tables: Mapping[str, Rows]

    @classmethod
    def read(cls, folder: Path) -> "Results":
        """From a folder with the tables that `TABLES` names, `leaderboard.csv` and the maps.

        Raises:
            ConfigurationError: A table is missing, or not one of ours.
        """
        for name, source in TABLES.items():
            if not (folder / f"{name}.csv").is_file():
                raise ConfigurationError(f"{folder / name}.csv is missing; {source}")
        maps = {name: learned_maps(folder / f"{name}.csv") for name in MAPS}
        tables = {name: read_rows(folder / f"{name}.csv") for name in TABLES}
        return cls(read_leaderboard(folder / "leaderboard.csv"), maps, tables)


def walks_beside_the_paper(walks: Rows) -> str:
    """Largest roll and pitch of the walks in `nominal` without and with compensation, and those
    of the paper.
    """
    rows = []
    for row in walks:
        if (
            row["scenario"] == "nominal" and row["policy"] in PAPER_PELVIS and row[_PEAKS[0]]
        ):  # else the testbed's
            roll, pitch = (f"{1e3 * float(row[name]):.1f}" for name in _PEAKS)
            rows.append(
                [row["reference"], _TITLES[row["policy"]], roll, pitch, PAPER_PELVIS[row["policy"]]]
            )
    head = ["step period", "largest error of the pelvis [mrad]", "roll", "pitch", "paper"]
    return page_table(head, rows, words=2)


def gallery_table(gallery: Rows) -> str:
    """How far the robots of the gallery sag, with and without compensation."""
    rows = []
    for row in gallery:
        least, most = (float(row[f"stiffness_{which}_Nm_per_rad"]) for which in ("least", "most"))
        sags = [f"{1e3 * float(row[f'{name}_m']):.1f}" for name in _SAGS]
        rows.append([row["title"], f"{least:g} to {most:g}", *sags])
    head = ["robot", "K [N·m/rad]", "sag [mm]", "`input`", "sag, soft", "`input`, soft"]
    return page_table(head, rows)


def gallery_pictures(gallery: Rows) -> str:
    """Pictures of the robots of the gallery, each under its name."""
    return "\n".join(
        f"**{row['title']}**\n\n![{row['title']}](images/gallery/{row['robot']}.png)\n"
        for row in gallery
    )


@dataclass(frozen=True)
class Part:
    """A part of a page: the results that it shows, and its text."""

    reads: Sequence[str]
    text: Callable[[Results], str]


def _of(text: Callable[..., str], *tables: str) -> Part:
    return Part(tables, lambda results: text(*(results.tables[name] for name in tables)))


def _of_standings(text: Callable[[Sequence[Standing]], str]) -> Part:
    return Part(["leaderboard"], lambda results: text(results.standings))


def _of_map(name: str) -> Part:
    return Part([name], lambda results: maps_markdown(results.maps[name]))


PARTS: Mapping[str, Part] = {
    "leaderboard": _of_standings(board_markdown),
    "learning in short": _of(
        learning_in_short,
        "learned_walker",
        *FAST_WALKERS,
    ),
    "learning over twenty steps": _of(twenty_steps, "learned_walker", *FAST_WALKERS),
    "walks in short": _of(walks.walks_in_short, "walks"),
    "margins": _of(walks.margins, "margins"),
    "twenty steps": _of(walks.twenty_steps, "walks"),
    "forty steps": _of(walks.forty_steps, "footholds"),
    "learned in ten walks": _of_standings(walks.learned_in_ten_walks),
    "walks beside the paper": _of(walks_beside_the_paper, "demo_episodes"),
    "one arm": _of(arms.one_arm, "gallery"),
    "recorded hands": _of(recorded.hands, "recorded_justin"),
    "recorded hands by poses": _of(recorded.by_poses, "recorded_justin"),
    "replays of recorded servos": _of(recorded.replays, "recorded_servos"),
    "recorded servos in slow motion": _of(recorded.slow_motion, "recorded_servos"),
    "priors of recorded servos": _of(recorded.priors, "recorded_servos"),
    "coverage of a servo": _of(recorded.coverage, "servo_coverage"),
    "recorded in short": _of(recorded.in_short, "recorded_justin"),
    "link encoders": _of(arms.link_encoders, "link_encoder"),
    "identification of an arm": _of(arms.arm_identification, "arm_identification"),
    "gallery": _of(gallery_table, "gallery"),
    "gallery pictures": _of(gallery_pictures, "gallery"),
    "learned at fast gaits": _of(
        both_opponents,
        *FAST_WALKERS,
    ),
    "learned on the testbed": _of(
        partial(changes_table, scopes=MOTIONS),
        "learned_testbed",
    ),
    "learned on friction of the testbed": _of(
        partial(changes_table, scopes=MOTIONS),
        "learned_testbed_friction",
    ),
    "learned on an arm": _of(
        partial(changes_table, metrics=ARM, scopes=ARM_SCENARIOS),
        "learned_robot",
    ),
    "learned on the walker": _of(both_opponents, "learned_walker"),
    "last steps of residuals": _of(
        walks.last_steps, "walks_walker", "walks_walker_1600ms", "walks_walker_1100ms"
    ),
    "speed of vector environments": _of(
        speeds.vector_environments, "speed_walker", "speed_testbed"
    ),
    "speed on a GPU": _of(
        partial(speeds.vector_environments, shown=("1024", "4096", "16384")), "speed_gpu"
    ),
    "speed of other ways": _of(speeds.other_ways, "speed_walker", "speed_testbed"),
    "costs of cells": _of(speeds.costs_of_cells, "cluster"),
    "policies alone": _of_standings(speeds.policies_alone),
    "drawn robots": _of(walks.drawn_robots, "drawn_robots"),
    "gravity torques": _of(walks.gravity_torques, "gravity_torque"),
    "sensitivity of the walk": _of(walks.sensitivity, "walker_sensitivity"),
    "walks of the paper": _of(walks.paper_walks, "paper"),
    "walks in all scenarios": _of(walks.all_scenarios, "walker"),
    "testbed of the paper": _of(joints.paper_testbed, "paper_testbed", "identification"),
    "identification": _of(joints.identification, "identification"),
    "output compensators": _of(joints.output_compensators, "output_compensator"),
    "damping of the testbed": _of(joints.damping, "testbed_damping", "identification"),
    "testbed in all scenarios": _of(joints.scenarios, "testbed"),
    "testbed's rivals": _of(joints.rivals, "testbed_rivals"),
    **{name: _of_map(name) for name in MAPS},
}
"""Parts of pages by the name of their marks."""
PICTURES: Mapping[str, Part] = {"step_errors.svg": _of(step_svg, "step")}
"""Pictures in docs/images that are drawn from the results."""

_FIGURE = re.compile(r"<!-- = (.*?) -->(.*?)<!-- / -->")


def figure(results: Results, place: str, now: str) -> str:
    """A figure within a sentence, with as many decimals as it has now.

    Args:
        results: The results.
        place: Table, policy, reference, scenario, metric, and a statistic where it is not the first
            one.
        now: The text between its marks.

    Raises:
        ConfigurationError: There is no such figure.
    """
    table, *cell, metric = [part.strip() for part in place.split("; ")]
    statistic = cell.pop() if len(cell) == 4 else ""
    if table not in results.tables or len(cell) != 3:
        raise ConfigurationError(
            f"{place!r} is no figure: give table; policy; reference; scenario; statistic; metric"
        )
    row = Cells(results.tables[table]).row(*cell, statistic=statistic)
    decimals = len(now.partition(".")[2])
    return minus(f"{in_table_unit(row, metric):.{decimals}f}")


def in_words(table: str) -> str:
    """Names of walks as a reader says them: "3 s, 20 steps" for "3 s num_steps=20"."""
    return re.sub(r" num_steps=(\d+)", r", \1 steps", table)


def marks(part: str) -> tuple[str, str]:
    """Lines of a page, between which a part is written."""
    return f"<!-- {part}: begin -->", f"<!-- {part}: end -->"


def has_parts(text: str) -> bool:
    """True if a page has a mark of any part or figure."""
    return _FIGURE.search(text) is not None or any(
        mark in text for part in PARTS for mark in marks(part)
    )


def page_with(text: str, results: Results) -> str:
    """A page with every part and every figure between its marks written anew.

    Raises:
        ConfigurationError: It has no marks of any part, or not both of a part, each once and in
            order.
    """
    parts = [part for part in PARTS if any(mark in text for mark in marks(part))]
    for part in parts or ([] if _FIGURE.search(text) else PARTS):
        begin, end = marks(part)
        if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
            raise ConfigurationError(
                f"a page for the {part} needs the lines {begin!r} and {end!r}, each once"
            )
        before, _, rest = text.partition(begin)
        own = in_words(PARTS[part].text(results))
        text = f"{before}{begin}\n\n{own}\n{end}{rest.partition(end)[2]}"
    return _FIGURE.sub(lambda m: f"<!-- = {m[1]} -->{figure(results, m[1], m[2])}<!-- / -->", text)


def reads(text: str) -> set[str]:
    """Names of the results that a page shows."""
    shown = {name for part, own in PARTS.items() if marks(part)[0] in text for name in own.reads}
    shown |= {
        name
        for picture, own in PICTURES.items()
        if f"images/{picture}" in text
        for name in own.reads
    }
    return shown | {place.partition("; ")[0] for place, _ in _FIGURE.findall(text)}


def pages(root: Path) -> list[Path]:
    """Pages under a checkout that show results."""
    candidates = [root / "README.md", *sorted((root / "docs").glob("*.md"))]
    return [
        page
        for page in candidates
        if page.is_file() and has_parts(page.read_text(encoding="utf-8"))
    ]


def main(arguments: Sequence[str]) -> None:
    """Write the parts of all pages of a checkout: [FOLDER], by default the working directory."""
    if len(arguments) > 1:
        raise SystemExit("usage: python -m docs.pages [CHECKOUT]")
    root = Path(*arguments)
    found = pages(root)
    results = Results.read(root / "docs" / "results")
    for page in found:
        page.write_text(page_with(page.read_text(encoding="utf-8"), results), encoding="utf-8")
    for name, picture in PICTURES.items():
        images = root / "docs" / "images"
        images.mkdir(exist_ok=True)
        (images / name).write_text(picture.text(results), encoding="utf-8")
    print(f"{len(found)} pages written: {', '.join(str(page.relative_to(root)) for page in found)}")
