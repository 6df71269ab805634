"""Figures of README and docs: they come from docs/results, each page shows what is there, and
nothing else."""

import csv
import re
import shutil
from collections.abc import Callable, Collection
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest

from docs.pages.cells import KEPT, Cells, Kept, condense, in_table_unit, keep, read_rows
from docs.pages.learned import MAPS, learned_maps
from docs.pages.write import (
    PARTS,
    PICTURES,
    TABLES,
    Results,
    figure,
    in_words,
    marks,
    page_with,
    pages,
    reads,
)
from docs.pages.write import main as write_pages
from elastic_env.core.errors import ConfigurationError
from train.report.leaderboard import read_leaderboard
from train.runs.escaping import write_records

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results"
FILES = sorted(path.stem for path in RESULTS.glob("*.csv"))
DRAWN = {name for picture in PICTURES.values() for name in picture.reads}
BEGIN, END = marks("leaderboard")


@cache
def results_of_the_docs() -> Results:
    """All results, read once."""
    return Results.read(RESULTS)


@cache
def texts_of_the_docs() -> dict[str, str]:
    """Parts, pages and pictures of these results, by their names."""
    results = results_of_the_docs()
    made = {name: own.text(results) for name, own in {**PARTS, **PICTURES}.items()}
    return made | {str(page): page.read_text(encoding="utf-8") for page in pages(ROOT)}


def changed_rows(name: str, change: Callable[[str, str], str]) -> list[dict[str, str]]:
    """Rows of a table with every cell changed: its column and its text."""
    return [
        {key: change(key, text) for key, text in row.items()}
        for row in read_rows(RESULTS / f"{name}.csv")
    ]


PLACE = {
    *("x", "y", "failed", "episodes", "training_seeds", "seeds", "covered"),
    *("stiffness_nm_per_rad", "no_rest", "failed_before", "robots"),
    *("damping_nms_per_rad", "joints", "time_s", "single_support"),
}
"""Columns that say where a figure belongs."""


def other_figure(column: str, text: str) -> str:
    """A measured figure changed."""
    return text if column in PLACE else larger(text)


@cache
def other_results(folder: Path) -> Results:
    """Results of which every table is changed."""
    made = results_of_the_docs()
    for name in FILES:
        one = with_changed(name, other_figure, folder)
        if name in made.tables:
            made = replace(made, tables={**made.tables, name: one.tables[name]})
        elif name in made.maps:
            made = replace(made, maps={**made.maps, name: one.maps[name]})
        else:
            made = replace(made, standings=one.standings)
    return made


def changed_but(kept: Collection[str], folder: Path) -> Results:
    """Results of which every table is changed but some."""
    before, other = results_of_the_docs(), other_results(folder)
    return replace(
        other,
        tables={**other.tables, **{k: v for k, v in before.tables.items() if k in kept}},
        maps={**other.maps, **{k: v for k, v in before.maps.items() if k in kept}},
        standings=before.standings if "leaderboard" in kept else other.standings,
    )


def with_changed(name: str, change: Callable[[str, str], str], folder: Path) -> Results:
    """All results, with one table changed."""
    before = results_of_the_docs()
    rows = changed_rows(name, change)
    if name in before.tables:
        return replace(before, tables={**before.tables, name: rows})
    table = write_records(rows, folder / f"{name}.csv")
    if name in before.maps:
        return replace(before, maps={**before.maps, name: learned_maps(table)})
    return replace(before, standings=read_leaderboard(table))


def larger(text: str) -> str:
    """A measured figure made larger by a third; all other text as it is."""
    return f"{4 / 3 * float(text):.5g}" if re.fullmatch(r"-?\d+\.?\d*(e-?\d+)?", text) else text


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A checkout with results and without pages, in the working directory."""
    shutil.copytree(RESULTS, tmp_path / "docs" / "results")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_table_is_known_and_says_where_it_comes_from() -> None:
    """Catches a CSV file that no page reads, and one of which nobody knows the command."""
    assert set(FILES) == {*TABLES, *MAPS, "leaderboard"}
    docs = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    assert set().union(*(reads(page.read_text(encoding="utf-8")) for page in docs)) == set(FILES)


def test_pages_are_those_of_the_results_beside_them() -> None:
    """Catches a figure that somebody typed, and results that were renewed without the page."""
    results = results_of_the_docs()
    shown = {page.name: page.read_text(encoding="utf-8") for page in pages(ROOT)}
    assert {
        "README.md",
        "leaderboard.md",
        "learned.md",
        "walker.md",
        "testbed.md",
        "iterative.md",
    } <= set(shown)
    assert {name: page_with(text, results) for name, text in shown.items()} == shown
    for name, picture in PICTURES.items():
        assert (ROOT / "docs" / "images" / name).read_text(encoding="utf-8") == picture.text(
            results
        )


@pytest.mark.parametrize("name", FILES)
def test_changed_figures_of_a_table_change_every_page_that_shows_it(
    name: str, tmp_path: Path
) -> None:
    """Catches a part that ignores its table."""
    changed = with_changed(name, other_figure, tmp_path)
    before = texts_of_the_docs()
    for part, own in {**PARTS, **PICTURES}.items():
        if name in own.reads:
            assert (own.text(changed) != before[part]) == (part != "gallery pictures"), part
    for page in pages(ROOT):
        text = before[str(page)]
        if name in reads(text):
            assert (page_with(text, changed) != text) == (name not in DRAWN), page.name


def test_changed_figures_change_no_page_that_does_not_show_their_table(tmp_path: Path) -> None:
    """Catches a part or a page that shows figures of a table which it does not name."""
    before = texts_of_the_docs()
    for part, own in {**PARTS, **PICTURES}.items():
        assert own.text(changed_but(own.reads, tmp_path)) == before[part], part
    for page in pages(ROOT):
        text = before[str(page)]
        assert page_with(text, changed_but(reads(text), tmp_path)) == text, page.name


@pytest.mark.parametrize(
    ("name", "metric"),
    [(kept.table or name, metric) for name, kept in KEPT.items() for metric in kept.metrics],
)
def test_every_kept_figure_is_shown_or_a_click_away(name: str, metric: str, tmp_path: Path) -> None:
    """Catches a metric that is kept for nobody, and a folded table without a link to the whole."""
    changed = with_changed(
        name, lambda key, text: larger(text) if key == metric else text, tmp_path
    )
    texts = [page.read_text(encoding="utf-8") for page in pages(ROOT)]
    own = [text for text in texts if name in reads(text)]
    assert any(f"](results/{name}.csv)" in text or page_with(text, changed) != text for text in own)


def test_one_number_changes_a_sentence(checkout: Path) -> None:
    """Catches a figure within a sentence that stays, or that is rounded to other digits than the
    author's."""
    text = (
        "It is <!-- = paper; input_output; 3 s; nominal; pelvis_roll_rms_rad -->9.99<!-- / -->"
        " mrad."
    )
    Path("docs", "one.md").write_text(text)
    write_pages([])
    assert re.sub("<!--.*?-->", "", Path("docs", "one.md").read_text()) == "It is 1.63 mrad."
    results = Results.read(checkout / "docs" / "results")
    assert (
        figure(results, "paper; input_output; 24 s; nominal; worst; pelvis_roll_peak_rad", "1")
        == "3"
    )
    for wrong, message in (
        (
            "paper; nobody; 3 s; nominal; pelvis_roll_rms_rad",
            "no cell nobody, 3 s, nominal, median",
        ),
        ("nothing; input; 3 s; nominal; x", "is no figure"),
        ("paper; input; 3 s; x", "is no figure"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            figure(results, wrong, "1")


def test_a_page_is_written_between_its_marks_and_nowhere_else(checkout: Path) -> None:
    """Catches text of the page that is lost, tables that pile up, and a page without marks."""
    results = Results.read(checkout / "docs" / "results")
    page = Path("README.md")
    page.write_text(f"before\n{BEGIN}\nold 1.23\n{END}\nafter\n")
    Path("docs", "other.md").write_text("no marks")
    for _ in range(2):
        write_pages([])
        assert (
            page.read_text()
            == f"before\n{BEGIN}\n\n{in_words(PARTS['leaderboard'].text(results))}\n{END}\nafter\n"
        )
    assert Path("docs", "other.md").read_text() == "no marks"
    for text in ("no marks", f"{END}\n{BEGIN}", f"{BEGIN}\n{END}\n{BEGIN}\n{END}"):
        with pytest.raises(ConfigurationError, match="needs the lines"):
            page_with(text, results)
    Path("docs", "results", "gallery.csv").unlink()
    with pytest.raises(
        ConfigurationError, match=r"gallery.csv is missing; python -m docs.pages.gallery"
    ):
        write_pages([])
    Path("docs", "results", "demo_episodes.csv").unlink()
    with pytest.raises(
        ConfigurationError, match=r"demo_episodes.csv is missing; copy it from runs/demo"
    ):
        write_pages([])


# What is kept of a comparison.

EPISODES = [
    {
        "policy": p,
        "reference": "3 s",
        "scenario": s,
        "termination": end,
        "pelvis_error_rms_rad": value,
    }
    for p, s, end, value in (
        ("input", "soft", "", "0.001"),
        ("input", "soft", "", "0.003"),
        ("input", "soft", "", "0.008"),
        ("input", "soft", "fell", "0.5"),
        ("zero", "soft", "fell", ""),
        ("input", "push", "", "0.002"),
    )
]


def test_a_cell_has_its_statistics_without_those_who_fell() -> None:
    """Catches a fall that is averaged in, a mean in the place of a median, and cells that run
    into each other."""
    head, *rows = condense(EPISODES, Kept(("pelvis_error_rms_rad",), ("median", "mean", "worst")))
    table = [dict(zip(map(str, head), map(str, row), strict=True)) for row in rows]
    cells = Cells(table)
    row = cells.row("input", "3 s", "soft")
    assert (row["episodes"], row["failed"], in_table_unit(row, "pelvis_error_rms_rad")) == (
        "4",
        "1",
        3.0,
    )
    assert cells.row("input", "3 s", "soft", "mean")["pelvis_error_rms_rad"] == "0.004"
    assert cells.row("input", "3 s", "soft", "worst")["pelvis_error_rms_rad"] == "0.008"
    assert cells.row("zero", "3 s", "soft")["pelvis_error_rms_rad"] == ""
    assert [cells.has("input", "3 s", "push"), cells.has("zero", "3 s", "push")] == [True, False]
    some = condense(EPISODES, Kept(("pelvis_error_rms_rad",), only={"policy": ["zero"]}))
    assert len(list(some)) == 2


def test_a_run_is_kept_by_the_name_of_its_comparison(tmp_path: Path) -> None:
    """Catches a table under the name of a folder, and a run of something else that overwrites
    one."""
    with pytest.raises(ConfigurationError, match="holds no finished comparison"):
        keep(tmp_path, tmp_path)
    columns = ["policy", "reference", "scenario", "termination", *KEPT["testbed"].metrics]
    with (tmp_path / "episodes.csv").open("w", newline="") as file:
        csv.writer(file).writerows([columns, ["input", "sine", "soft", "", "0.0123"]])
    (tmp_path / "config.yaml").write_text("name: testbed\n")
    assert keep(tmp_path, tmp_path).name == "testbed.csv"
    assert read_rows(tmp_path / "testbed.csv")[0]["link_error_rms_rad"] == "0.0123"
    (tmp_path / "config.yaml").write_text("name: mine\n")
    with pytest.raises(
        ConfigurationError, match=r"nothing is kept of the comparison 'mine'.*paper, walker"
    ):
        keep(tmp_path, tmp_path)
