"""Colours of the report's charts: what is drawn on dark paper can be seen there."""

import json
import re
from pathlib import Path

import pytest

from tests.test_leaderboard import played
from train.evaluate.changes import changes
from train.figures.colours import (
    COLOURS,
    FRAME,
    GRID,
    INK,
    LINE,
    NIGHT,
    REFERENCE,
    SHADE,
    STRONG,
    VERDICTS,
    policy_colours,
)
from train.report.report_text import Results
from train.report.write import write_report
from train.runs.folders import run_folder

PAPER = NIGHT["white"]
SOFT = {GRID, FRAME, LINE, SHADE}
"""Colours of lines and areas that stand back."""


def luminance(colour: str) -> float:
    """Relative luminance of WCAG 2."""
    channels = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def test_a_policy_has_its_colour_however_often_others_are_named() -> None:
    """Catches cells of a sweep that are counted as policies: two would share a colour."""
    colours = policy_colours(["mine", "yours"])
    assert policy_colours([*["mine"] * len(STRONG), "yours"]) == colours
    assert colours["mine"] != colours["yours"]


def contrast(one: str, other: str) -> float:
    """Ratio of WCAG 2, 1 to 21."""
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize(
    "colour", sorted({*COLOURS.values(), *STRONG, *VERDICTS.values(), INK, REFERENCE})
)
def test_every_colour_is_seen_on_dark_paper(colour: str) -> None:
    """Catches words and curves that are dark on dark; WCAG asks for 3 to 1 of parts of a chart."""
    assert contrast(NIGHT.get(colour, colour), PAPER) >= 3.0


def test_words_and_lines_of_a_chart_have_a_colour_of_the_night(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a colour that is new to the charts and stays dark in the dark."""
    monkeypatch.chdir(tmp_path)
    found = [own for own in played() if own.condition.scenario == "soft"]
    colours = dict(NIGHT)
    with run_folder("x", {}, 0) as folder:
        write_report(Results("x", found, changes(found), folder))
    page = (folder / "report.html").read_text(encoding="utf-8")
    specs = re.findall(
        r'<script type="application/json" id="c\d+-spec">(.*?)</script>', page, flags=re.DOTALL
    )
    assert len(specs) >= 3
    seen: set[str] = set(
        re.findall(r"#[0-9a-f]{6}", "".join(json.dumps(json.loads(spec)) for spec in specs))
    )
    assert {INK, GRID} <= seen
    assert {c for c in seen - SOFT if contrast(colours.get(c, c), PAPER) < 3.0} == set()
    assert all(1.05 < contrast(NIGHT[colour], PAPER) < 3.0 for colour in SOFT)
