"""Pages of the documentation whose figures come from the results beside them, and from nowhere else.

    python -m train.report.pages          # README.md and docs/*.md from docs/results

A page has a part between two marks, such as `<!-- leaderboard: begin -->` and `<!-- leaderboard: end -->`. The tool
writes every part anew. A test fails where a page and the results disagree.
"""

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from scipy.stats import bootstrap

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from train.evaluate.evaluate import grouped
from train.evaluate.leaderboard import Standing
from train.report.leaderboard import changed, claims_markdown, leaderboard_markdown, read_leaderboard
from train.report.pages.learned import MAPS, LearnedMap, changes_table, learned_maps, maps_markdown
from train.runs.escaping import markdown_table

PAPER_PELVIS = {"uncompensated": "about 40", "input_output": "below 10"}
"""Angle error of the pelvis that the paper reports in both gaits [mrad], its Figs. 7 and 8."""

_TITLES = {"uncompensated": "without compensation", "input_output": "with the paper's compensator"}
_SAGS = ("uncompensated_rms", "uncompensated_peak", "input_rms", "soft_uncompensated_rms", "soft_input_rms")
_SHORT = ("mixture", "held out")
_PEAKS = ("pelvis_roll_peak_rad", "pelvis_pitch_peak_rad")


TABLES = {
    "demo_episodes.csv": "copy it from runs/demo/episodes.csv after `elastic demo`",
    "gallery.csv": "python -m train.experiments.gallery writes it",
    "learned_posture.csv": "copy it from statistics.csv after `elastic compare configs/learned_posture.yaml`",
    "link_encoder.csv": "copy it from episodes.csv after `elastic compare configs/robot.yaml`",
}
"""Tables of the results, and where they come from."""


@dataclass(frozen=True)
class Results:
    """The results that pages show.

    Attributes:
        standings: Rows of the leaderboard.
        walks: Episodes of `elastic demo`, a column of `episodes.csv` by its name.
        gallery: Robots of the gallery, a column of `gallery.csv` by its name.
        learned: Changes by the residual on `adaptive_posture`, a column of `statistics.csv` by its name.
        maps: Maps of what learning adds, by the name of their file.
        arm: Episodes of an arm, a column of `episodes.csv` by its name.
    """

    standings: Sequence[Standing]
    walks: Sequence[Mapping[str, str]]
    gallery: Sequence[Mapping[str, str]] = ()
    learned: Sequence[Mapping[str, str]] = ()
    maps: Mapping[str, Sequence[LearnedMap]] = field(default_factory=dict)
    arm: Sequence[Mapping[str, str]] = ()

    @classmethod
    def read(cls, folder: Path) -> "Results":
        """From a folder with the tables that `TABLES` names, `leaderboard.csv` and the maps.

        Raises:
            ConfigurationError: A table is missing, or not one of ours.
        """
        for name, source in TABLES.items():
            if not (folder / name).is_file():
                raise ConfigurationError(f"{folder / name} is missing; {source}")
        maps = {name: learned_maps(folder / f"{name}.csv") for name in MAPS}
        walks, gallery, learned, arm = (_rows(folder / name) for name in TABLES)
        return cls(read_leaderboard(folder / "leaderboard.csv"), walks, gallery, learned, maps, arm)


def _rows(table: Path) -> list[dict[str, str]]:
    with table.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def walks_beside_the_paper(results: Results) -> str:
    """Largest roll and pitch of the walks in `nominal` without and with compensation, and those of the paper."""
    rows = []
    for row in results.walks:
        if row["scenario"] == "nominal" and row["policy"] in PAPER_PELVIS and row[_PEAKS[0]]:  # else the testbed's
            roll, pitch = (f"{1e3 * float(row[name]):.1f}" for name in _PEAKS)
            rows.append([row["reference"], _TITLES[row["policy"]], roll, pitch, PAPER_PELVIS[row["policy"]]])
    head = ["step period", "largest error of the pelvis [mrad]", "roll", "pitch", "paper"]
    return markdown_table(head, ["---"] * 2 + ["---:"] * 3, rows) + "\n"


def learning_in_short(results: Results) -> str:
    """What learning adds in the motion that comes first: over its base, and over the best policy without learning."""
    first = results.standings[0].reference
    found = [s for s in results.standings if s.training_seeds and s.reference == first and s.scope in _SHORT]
    titles = list(dict.fromkeys(s.title for s in found))
    rows = [
        [f"{policy}, {scope}", *(shown for title in titles for shown in _over(own, title))]
        for (policy, scope), own in grouped(found, lambda s: (s.policy, s.scope)).items()
    ]
    head = [f"step period {first}", *(f"{title}, ({over})" for title in titles for over in "ab")]
    return markdown_table(head, ["---", *["---:"] * 2 * len(titles)], rows) + "\n"


def _over(standings: Sequence[Standing], title: str) -> tuple[str, str]:
    """The change in a metric over the base, and over the best policy without learning, which may be the base."""
    own = next(s for s in standings if s.title == title)
    return changed(own.base), "as (a)" if own.rival is None else changed(own.rival)


def gallery_table(results: Results) -> str:
    """How far the robots of the gallery sag, with and without compensation."""
    rows = []
    for row in results.gallery:
        least, most = (float(row[f"stiffness_{which}_Nm_per_rad"]) for which in ("least", "most"))
        deviations = [f"{1e3 * float(row[f'{name}_m']):.1f}" for name in _SAGS]
        rows.append(
            [row["title"], row["joints"], f"{least:g} to {most:g}", row["stiffness_source"],
             f"{1e3 * float(row['deflection_peak_rad']):.0f}", *deviations]
        )  # fmt: skip
    head = [
        "robot", "joints", "K [N·m/rad]", "source of K", "largest deflection [mrad]", "sag [mm]", "largest sag",
        "`input`", "sag, soft", "`input`, soft",
    ]  # fmt: skip
    return markdown_table(head, ["---", "---:", "---", "---", *["---:"] * 6], rows) + "\n"


_FIRST_ARM = "panda"
"""Robot of the gallery that README begins with."""
_OF_ARM, _TOOL = ("input", "link_encoder"), "end_effector_error_rms_m"
"""Policies of an arm that are compared, and by what."""


def one_arm(results: Results) -> str:
    """How far one arm of the gallery sags at rest, with and without compensation."""
    row = next(row for row in results.gallery if row["robot"] == _FIRST_ARM)
    shown = [[f"{1e3 * float(row[f'{kind}{policy}_rms_m']):.1f}" for policy in ("uncompensated", "input")]
             for kind in ("", "soft_")]  # fmt: skip
    lines = [[f"{row['title']}, sag at rest [mm]", "without", "input"],
             ["K as assumed", *shown[0]], ["K 30 % softer", *shown[1]]]  # fmt: skip
    text = "\n".join(f"{title:32}{without:>9}{compensated:>8}" for title, without, compensated in lines)
    return f"```text\n{text}\n```\n"


def link_encoders(results: Results) -> str:
    """What encoders on the links of an arm are worth: error of the end effector, episode by episode."""
    rows = []
    for scenario, own in grouped(results.arm, lambda row: row["scenario"]).items():
        errors = {p: np.array([float(row[_TOOL]) for row in own if row["policy"] == p]) for p in _OF_ARM}
        base, other = (errors[policy] for policy in _OF_ARM)
        ends = bootstrap(
            (base, other), _change, paired=True, vectorized=True, method="BCa", rng=np.random.default_rng(0)
        ).confidence_interval
        change = " ".join([_percent(_change(base, other)), f"[{_percent(ends.low)}, {_percent(ends.high)}]"])
        rows.append([f"`{scenario}`", f"{1e3 * base.mean():.2f}", f"{1e3 * other.mean():.2f}", change])
    head = ["scenario", *(f"`{policy}` [mm]" for policy in _OF_ARM), "change"]
    return markdown_table(head, ["---", "---:", "---:", "---:"], rows) + "\n"


def _change(base: Array, other: Array, axis: int = -1) -> Array:
    return np.asarray(other.mean(axis=axis) / base.mean(axis=axis) - 1.0)


def _percent(value: float | Array) -> str:
    return f"{100.0 * float(value):+.0f}".replace("-", "−") + " %"


def gallery_pictures(results: Results) -> str:
    """Pictures of the robots of the gallery, each under its name."""
    return "\n".join(
        f"**{row['title']}**\n\n![{row['title']} without and with compensation](images/gallery/{row['robot']}.png)\n"
        for row in results.gallery
    )


def _map_part(name: str, results: Results) -> str:
    return maps_markdown(results.maps[name])


PARTS: Mapping[str, Callable[[Results], str]] = {
    "leaderboard": lambda results: leaderboard_markdown(results.standings),
    "what learning adds": lambda results: claims_markdown(results.standings),
    "learning in short": learning_in_short,
    "walks beside the paper": walks_beside_the_paper,
    "one arm": one_arm,
    "link encoders": link_encoders,
    "gallery": gallery_table,
    "gallery pictures": gallery_pictures,
    "learned posture": lambda results: changes_table(results.learned),
    **{name: partial(_map_part, name) for name in MAPS},
}
"""Parts of pages by the name of their marks."""


def marks(part: str) -> tuple[str, str]:
    """Lines of a page, between which a part is written."""
    return f"<!-- {part}: begin -->", f"<!-- {part}: end -->"


def has_parts(text: str) -> bool:
    """Whether a page has a mark of any part."""
    return any(mark in text for part in PARTS for mark in marks(part))


def page_with(text: str, results: Results) -> str:
    """A page with every part between its marks written anew.

    Raises:
        ConfigurationError: It has no marks of any part, or not both of a part, each once and in order.
    """
    parts = [part for part in PARTS if any(mark in text for mark in marks(part))]
    for part in parts or PARTS:
        begin, end = marks(part)
        if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
            raise ConfigurationError(f"a page for the {part} needs the lines {begin!r} and {end!r}, each once")
        before, _, rest = text.partition(begin)
        text = f"{before}{begin}\n\n{PARTS[part](results)}\n{end}{rest.partition(end)[2]}"
    return text


def pages(root: Path) -> list[Path]:
    """Pages under a checkout that show results."""
    candidates = [root / "README.md", *sorted((root / "docs").glob("*.md"))]
    return [page for page in candidates if page.is_file() and has_parts(page.read_text(encoding="utf-8"))]


def main(arguments: Sequence[str]) -> None:
    """Write the parts of all pages of a checkout: [FOLDER], by default the working directory."""
    if len(arguments) > 1:
        raise SystemExit("usage: python -m train.report.pages [CHECKOUT]")
    root = Path(*arguments)
    found, results = pages(root), Results.read(root / "docs" / "results")
    for page in found:
        page.write_text(page_with(page.read_text(encoding="utf-8"), results), encoding="utf-8")
    print(f"{len(found)} pages written: {', '.join(str(page.relative_to(root)) for page in found)}")
