"""The leaderboard: who is in which track, what a cell holds, who is best, and that all of its
forms agree."""

import csv
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
import yaml
from rich.console import Console

import train.commands.comparison
import train.speed.step_times
from baselines.catalogue import Track
from elastic_env.core.config import load_yaml
from elastic_env.core.errors import ConfigurationError
from tests.cells import METRIC, cell, family, over_seeds
from train.commands.cli import main
from train.commands.compare_config import CompareConfig, Sweep
from train.evaluate.changes import Change, changes
from train.evaluate.conditions import Condition, PolicySpec
from train.evaluate.episodes import Evaluation, evaluate
from train.evaluate.leaderboard_rows import PairedChange, Standing, standings
from train.evaluate.statistics import Estimate
from train.report.leaderboard import (
    claims_table,
    find_published,
    leaderboard_markdown,
    leaderboard_table,
    print_leaderboard,
    read_leaderboard,
    scenarios_table,
    three_digits,
    write_leaderboard,
)
from train.report.report_text import Results
from train.report.tables import Cell, Table, plain_text
from train.report.write import write_report
from train.runs.folders import run_folder
from train.speed.step_times import step_times

ROOT = Path(__file__).parents[1]
GROUPS = {"both": ["soft", "ideal"], "all": ["soft", "ideal", "slope"]}


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every test works in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")


SOFT = [[4.0, 6.0], [3.0, 5.0], [8.0, 8.0], [1.0, 1.0], [2.0, 2.0]]
IDEAL = [[1.0, 1.0]] * 5


def played() -> list[Evaluation]:
    """Two bases, a residual and who reads more, at 3 s in three scenarios and at 1.6 s in one."""
    slow = [
        cell("base", {"all": [8.0, 10.0]}, "soft"),
        cell("base", {"all": [3.0]}, "ideal"),
        cell("base", {"all": [2.0]}, "slope"),
        cell("best", {"all": [4.0, None]}, "soft"),
        cell("best", {"all": [1.0]}, "ideal"),
        cell("best", {"all": [1.0]}, "slope"),
        *family(SOFT, "soft"),
        *family(IDEAL, "ideal"),
        *family([[5.0]] * 5, "slope"),
    ]
    sensor = [
        cell("sensor", {"all": [n]}, s) for n, s in ((7.0, "soft"), (2.0, "ideal"), (1.0, "slope"))
    ]
    named = PolicySpec(name="mine.py:make", label="sensor", track=Track.TORQUE_SENSORS)
    sensor = [Evaluation(e.condition.replace(policy=named), e.episodes) for e in sensor]
    return [*slow, *sensor, cell("base", {"all": [6.0]}, "soft", reference=1.6)]


def rows() -> list[Standing]:
    """The rows of its leaderboard; the intervals take a while, so they are computed once."""
    return list(_ROWS or _ROWS.extend(_rows()) or _ROWS)


_ROWS: list[Standing] = []


@cache
def all_changes() -> list[Change]:
    """Paired changes of all that was played, which take a while too."""
    return changes(played(), GROUPS)


def _rows() -> list[Standing]:
    found = played()
    return standings(found, GROUPS, {"base": 20.4, "best": 31.0, "learned": 45.2})


def row(policy: str, scope: str, reference: str = "3 s") -> Standing:
    """One of them, of the pelvis error."""
    return next(
        s
        for s in rows()
        if (s.policy, s.scope, s.reference, s.metric) == (policy, scope, reference, METRIC)
    )


def change_to(paired: PairedChange | None) -> Estimate:
    """A paired change that is there."""
    assert paired is not None
    return paired.change


def tracks(table: Table) -> dict[str, dict[str, tuple[Cell, ...]]]:
    """Cells of every policy, by track and title."""
    found: dict[str, dict[str, tuple[Cell, ...]]] = {}
    for line in table.rows:
        if line.kind == "heading":
            own = found.setdefault(plain_text(line.cells[0]), {})
        else:
            own[plain_text(line.cells[0])] = line.cells[1:]
    return found


def titles(table: Table) -> list[str]:
    """Titles of the columns, on one line each, without those of policy and totals."""
    return [head.label for head in table.heads if head.leaves]


# Scores.


def test_a_score_is_a_mean_of_scenarios_and_of_training_seeds() -> None:
    """Catches a mean over episodes where scenarios have different numbers, a median, and falls
    averaged in."""
    assert row("base", "both").score == Estimate((9.0 + 3.0) / 2.0)
    assert row("best", "both").score == Estimate((4.0 + 1.0) / 2.0)
    assert (row("best", "both").failed, row("best", "both").episodes) == (1, 3)
    assert row("learned", "both").score == over_seeds(
        [(s + 1.0) / 2.0 for s in (5.0, 4.0, 8.0, 1.0, 2.0)]
    )
    assert (row("learned", "both").training_seeds, row("base", "both").training_seeds) == (5, 0)


def test_changes_to_the_base_are_those_of_the_statistics() -> None:
    """Catches changes of another scope or motion."""
    for scope in ("both", "soft"):
        name = ("learned", scope, "3 s", METRIC)
        (own,) = [
            c for c in all_changes() if (c.policy, c.scope, c.reference, c.column.metric) == name
        ]
        assert row("learned", scope).base == PairedChange("base", own.relative, own.verdict)
    assert (row("base", "both").base, row("base", "both").rival) == (None, None)


def test_a_residual_is_compared_with_the_best_of_each_column() -> None:
    """Catches one rival for all columns, one that falls, one with further sensors, and changes
    of single scenarios."""
    rivals = {scope: row("learned", scope).rival for scope in ("soft", "both", "ideal", "slope")}
    assert {scope: rival and rival.opponent for scope, rival in rivals.items()} == {
        "soft": "base",
        "both": "base",
        "ideal": "best",
        "slope": "best",  # best falls in soft
    }
    assert change_to(rivals["slope"]).value == pytest.approx(4.0)
    assert change_to(rivals["ideal"]).value == pytest.approx(0.0)
    assert rivals["both"] == row("learned", "both").base


def test_columns_are_whole_groups_and_what_is_in_none() -> None:
    """Catches a group that is shown though one of its scenarios is not played, and a scenario
    that nobody sees."""
    assert titles(leaderboard_table(rows())) == ["both, 3 s", "all, 3 s", "soft, 1.6 s"]
    single = scenarios_table(rows())
    assert single is not None
    assert titles(single) == ["soft, 3 s", "ideal, 3 s", "slope, 3 s"]
    found = [e for e in played() if e.condition.reference == 3]
    without = standings(found, {}, {})
    assert titles(leaderboard_table(without)) == titles(single)
    assert scenarios_table(without) is None


# The table.


def test_tracks_hold_those_with_the_same_needs_the_best_first() -> None:
    """Catches a policy of one's own in the wrong track, and an order by name."""
    assert {name: list(own) for name, own in tracks(leaderboard_table(rows())).items()} == {
        str(Track.STANDARD): ["best", "base"],
        str(Track.TORQUE_SENSORS): ["sensor"],
        str(Track.TRAINING): ["learned"],
    }
    condition = Condition(env="walker", policy=PolicySpec(name="mine.py:make"))
    assert condition.track is Track.STANDARD
    with pytest.raises(
        ConfigurationError, match=r"track must be .*joint torque sensors.*got 'torque'"
    ):
        PolicySpec(name="mine.py:make", track="torque")  # type: ignore[arg-type]


def test_the_best_of_a_track_has_the_fewest_falls_first() -> None:
    """Catches a mark for who fell in the hard episodes, and a track without any."""
    standard, sensors, _ = tracks(leaderboard_table(rows())).values()
    best = standard["best"]
    base = standard["base"]
    sensor = sensors["sensor"]
    assert [bolds(cells[0]) for cells in (best, base)] == [[False, False], [True, True]]
    assert [bolds(cell) for cell in sensor[:2]] == [[True, True]] * 2
    assert plain_text(best[0]) == "2500 / 2500 ✕1/3"
    assert plain_text(best[2]) == "not played"
    assert (best[-2:], base[-2:]) == (("1/4", "31"), ("0/5", "20"))
    assert sensor[-1] == "-"


def bolds(cell: Cell) -> list[bool]:
    """Whether each figure of a cell is bold."""
    assert isinstance(cell, tuple)
    return [part.style == "bold" for part in cell[:2]]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (2.481, "2.48"),
        (11.24, "11.2"),
        (10.0, "10.0"),
        (9.999, "10.0"),
        (123.4, "123"),
        (0.5, "0.500"),
        (0.0, "0.00"),
        (1234.0, "1234"),
        (float("nan"), "-"),
    ],
)
def test_figures_have_three_digits(value: float, text: str) -> None:
    """Catches 10 beside 11.2, and digits that nobody measured."""
    assert three_digits(value) == text


# Forms.


def test_all_forms_have_the_same_figures() -> None:
    """Catches a page, a table or a report that says something else than the CSV."""
    found = played()
    with run_folder("x", {}, 0) as folder:
        table, text = write_leaderboard(rows(), folder)
        write_report(Results("x", found, all_changes(), folder, standings=rows()))
    again = read_leaderboard(table)
    (mine,), (theirs,) = (
        [s for s in some if (s.policy, s.scope, s.metric) == ("learned", "soft", METRIC)]
        for some in (again, rows())
    )
    none = {"score": Estimate(0.0), "base": None, "rival": None, "step_us": 0.0}
    assert replace(mine, **none) == replace(theirs, **none)
    for found_again, was in (
        (mine.score, theirs.score),
        (change_to(mine.rival), change_to(theirs.rival)),
    ):
        bounds = [[e.value, e.low, e.high] for e in (found_again, was)]
        assert bounds[0] == pytest.approx(bounds[1], rel=1e-5)
    assert leaderboard_markdown(again) == leaderboard_markdown(rows())
    assert text.read_text() == f"# Leaderboard\n\n{leaderboard_markdown(rows())}"
    markdown = text.read_text()
    assert "| base | **6000** / **6000** | " in markdown
    assert "episodes of a scenario, per training seed: 1 to 2." in markdown
    assert "<br><sub>[" in markdown
    assert leaderboard_markdown(rows()).rstrip() in (folder / "report.md").read_text()
    page = (folder / "report.html").read_text()
    assert re.findall(r"<h2 id=\"s\d+\">([^<]*)</h2>", page)[1] == "Leaderboard"
    assert "<b>6000</b> / <b>6000</b></td>" in page
    assert '2500 / 2500 <span class="falls">✕1/3</span>' in page
    table = claims_table(rows())
    lines = [[plain_text(cell) for cell in line.cells] for line in table.rows]
    assert [head.title for head in table.heads[2:4]] == [
        f"pelvis error rms, against {other}"
        for other in ("its base", "the best policy without learning")
    ]
    assert [line[:2] for line in lines] == [["learned", "both, 3 s"], ["learned", "all, 3 s"]]
    assert (lines[0][2].endswith("(base)"), lines[0][3]) == (True, "the same")
    single = [replace(s, is_column=True) for s in rows() if s.scope == "slope"]
    assert plain_text(claims_table(single).rows[0].cells[3]).endswith("(best)")


def test_the_terminal_has_the_columns_that_it_has_room_for() -> None:
    """Catches figures broken over lines, a column that is lost in silence, and a best that is
    not marked."""
    for width, is_whole in ((100, True), (60, False)):
        console = Console(width=width, record=True, file=StringIO())
        print_leaderboard(rows(), console)
        text = console.export_text(clear=False)
        assert "6000 / 6000" in text
        assert "✕1/3" in text
        assert ("no room for" not in text) == is_whole
        assert ("soft, 1.6 s" in text) != is_whole
        assert "\x1b[1m6000\x1b[0m / \x1b[1m6000" in console.export_text(styles=True)


# The configuration.


def test_a_reference_is_played_in_its_own_scenarios() -> None:
    """Catches a slow motion that is played everywhere, and one whose scenarios are those of
    another."""
    values: dict[str, Any] = {
        "name": "c",
        "env": "walker",
        "references": [3, 1.6],
        "scenarios": ["nominal", "soft"],
        "policies": ["input"],
    }
    config = CompareConfig(**values, reference_scenarios={"1.6 s": ["soft"]})
    assert [(c.reference, c.scenario) for c in config.conditions()] == [
        (3, "nominal"),
        (3, "soft"),
        (1.6, "soft"),
    ]
    for wrong, message in (
        (
            {"1.6": ["soft"]},
            "unknown reference with scenarios of its own '1.6'; choose one of: 3 s, 1.6 s",
        ),
        ({"1.6 s": ["slope"]}, "unknown scenario of '1.6 s' 'slope'"),
        ({"1.6 s": []}, "reference_scenarios.1.6 s must have at least 1 entry"),
        ({"1.6 s": ["soft", "soft"]}, "reference_scenarios.1.6 s: 'soft' stands twice"),
    ):
        with pytest.raises(ConfigurationError, match=re.escape(message)):
            CompareConfig(**values, reference_scenarios=wrong)
    with pytest.raises(
        ConfigurationError, match="a leaderboard is of simulated cells without a sweep"
    ):
        CompareConfig(
            **values, leaderboard=True, sweep=Sweep(option="stiffness_scale", values=[1, 2])
        )


def test_the_leaderboard_of_the_project_has_its_columns() -> None:
    """Catches a group that lost its columns by a scenario that is not played."""
    config = load_yaml(ROOT / "configs" / "leaderboard.yaml", CompareConfig)
    conditions = config.conditions()
    cells = {(c.reference_name, c.scenario) for c in conditions}
    references = {reference for reference, _ in cells}
    assert {r: sum(reference == r for reference, _ in cells) for r in references} == {
        "3 s": 16,
        "3 s num_steps=20": 2,
        "24 s": 1,
        "1.6 s": 5,
        "1.1 s": 5,
    }
    assert {len(scenarios) for scenarios in config.groups.values()} == {5, 3, 6}
    assert {c.episodes for c in conditions if c.scenario == "drawn"} == {32}
    assert {c.track for c in conditions} >= set(Track)


# Time per step.


class Scripted:
    """A policy that takes given times."""

    log: list[str] = []
    spent = {"a": [99.0, 1.0, 7.0, 2.0], "b": [99.0, 5.0, 5.0, 50.0]}

    def __init__(self, condition: Condition) -> None:
        self.title = condition.policy.title
        self.times = iter(self.spent[self.title])

    def play(self, steps: int) -> float:
        """Its next time for 10 steps [s]."""
        assert steps == 10
        self.log.append(self.title)
        return 1e-5 * next(self.times)

    def close(self) -> None:
        """Say so."""
        self.log.append(f"close {self.title}")


def test_times_are_medians_of_rounds_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches one policy after the other, compiling that is timed, a mean, and times of the
    whole round."""
    monkeypatch.setattr(train.speed.step_times, "_Player", Scripted)
    conditions = [
        Condition(env="walker", policy=PolicySpec(name="zero", label=title))
        for title in ("a", "b", "a")
    ]
    assert step_times(conditions, steps=10, rounds=3) == pytest.approx({"a": 2.0, "b": 5.0})
    assert Scripted.log == ["a", "b"] * 4 + ["close a", "close b"]


# elastic compare with a leaderboard.


def write_board(policies: Sequence[Any]) -> None:
    """A configuration of a leaderboard of one step."""
    content = {
        "name": "board",
        "env": "walker",
        "references": [{"step_period": [0.2, 0.3, 0.2], "num_steps": 1}],
        "leaderboard": True,
        "scenarios": ["ideal"],
        "groups": {"mixture": ["ideal"]},
        "policies": policies,
    }
    Path("board.yaml").write_text(yaml.safe_dump(content))


def play_quickly(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Play in this process, without figures and report; the titles of the policies that are
    played."""
    played: list[str] = []

    def run(conditions: Sequence[Condition], console: Console, *_: object) -> list[Evaluation]:
        played.extend(condition.policy.title for condition in conditions)
        return [evaluate(condition, num_threads=1) for condition in conditions]

    monkeypatch.setattr(train.commands.comparison, "run_conditions", run)
    monkeypatch.setattr(
        train.commands.comparison, "step_times", lambda cells: step_times(cells, steps=2, rounds=1)
    )
    for name in ("draw_figures", "write_report"):
        monkeypatch.setattr(train.commands.comparison, name, lambda *_: [])
    return played


def test_a_policy_of_ones_own_gets_a_row_by_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a leaderboard that the command does not write, and a user's policy that is not on
    it.

    Beside published rows also a leaderboard that is played anew, rows that do not say that they
    are published, and ones of another version, another protocol or the same name.
    """
    for name in ("theirs.py", "mine.py"):
        Path(name).write_text(
            "import baselines\n\n\ndef make(env):\n    return baselines.make('zero', env)\n"
        )
    write_board(["zero", {"name": "theirs.py:make", "track": "walks on this robot"}])
    played = play_quickly(monkeypatch)
    main(["compare", "board.yaml", "--output", "theirs"])
    folder = Path("theirs")
    published = folder / "leaderboard.csv"
    with published.open(newline="") as file:
        rows = [r for r in csv.DictReader(file) if r["pooled"] == "True" and r["metric"] == METRIC]
    assert [(r["policy"], r["track"]) for r in rows] == [
        ("zero", "encoders, foot sensors and IMU"),
        ("theirs.py:make", "walks on this robot"),
    ]
    assert rows[0]["mean"] == rows[1]["mean"]
    with (folder / "episodes.csv").open(newline="") as file:
        episodes = [float(r[METRIC]) for r in csv.DictReader(file)]
    assert float(rows[0]["mean"]) == pytest.approx(episodes[0], rel=1e-5)
    assert "**walks on this robot**" in (folder / "leaderboard.md").read_text()

    words = ["compare", "board.yaml", "--published", str(published)]
    mine = [*words, "--policies", "mine.py:make", "--output", "ours"]
    main(mine)
    assert played == ["zero", "theirs.py:make", "mine.py:make"]
    found = read_leaderboard(Path("ours/leaderboard.csv"))
    assert {(row.policy, row.is_published) for row in found} == {
        ("zero", True),
        ("theirs.py:make", True),
        ("mine.py:make", False),
    }
    before = read_leaderboard(published)
    assert [row.score for row in found if row.is_published] == [row.score for row in before]
    assert "zero (published)" in Path("ours/leaderboard.md").read_text()

    def refused(arguments: list[str]) -> str:
        with pytest.raises(SystemExit):
            main(arguments)
        return " ".join(capsys.readouterr().err.split())

    capsys.readouterr()
    assert "'zero' is published already; name your own by --policies" in refused(words)
    more = refused([*mine[:-1], "more", "--episodes", "2"])
    assert "published rows and your own must have the same version and protocol" in more
    text = published.read_text()
    published.write_text(text.replace("mujoco 4", "mujoco 3"))
    assert "got published elastic-env" in refused([*mine[:-1], "other"])
    Path("board.yaml").write_text("name: board\n")
    assert "leaderboard: true" in refused([*mine[:-1], "none"])
    assert len(played) == 3  # all of it was found before anything played


def test_a_table_that_is_none_is_refused_in_a_sentence(tmp_path: Path) -> None:
    """Catches a cell longer than the reader of CSV takes, which is no `ValueError`."""
    path = tmp_path / "leaderboard.csv"
    path.write_text(f"track\n{'a' * 200_000}\n")
    with pytest.raises(ConfigurationError, match=r"is no leaderboard\.csv: .*field limit"):
        read_leaderboard(path)


def test_the_package_brings_a_leaderboard_of_its_version_and_preset() -> None:
    """Catches a file that is not in the package, and one that nobody can append to."""
    preset = load_yaml(ROOT / "configs" / "leaderboard.yaml", CompareConfig)
    found = read_leaderboard(find_published(Path("leaderboard")))
    assert {row.origin for row in found} == {preset.origin}
    with pytest.raises(ConfigurationError, match="name of the published one: leaderboard"):
        find_published(Path("nothing"))
