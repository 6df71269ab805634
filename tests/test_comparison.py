"""Families of residuals, statistics over training seeds, paired changes with their sentences,
and the report."""

import csv
import html
import itertools
import json
import re
import shutil
from collections.abc import Sequence
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

import train.commands.comparison
from baselines.catalogue import BEST_ON_THE_WALKER
from baselines.residual.residual_folder import read_description
from elastic_env.core.config import load_yaml
from elastic_env.core.errors import ConfigurationError, MissingExtraError
from tests.cells import METRIC, cell, describe, episode_rows, family, over_seeds, records
from train.commands.cli import main
from train.commands.compare_config import CompareConfig
from train.commands.comparison import _distinct_conditions
from train.evaluate.change_text import CEILING, SAME_ROBOT, percent_interval
from train.evaluate.changes import Change, changes
from train.evaluate.conditions import Condition, Member, PolicySpec
from train.evaluate.episodes import Evaluation, evaluate, merge_seeds
from train.evaluate.learning_curves import learning_curves
from train.evaluate.residual_seeds import expand
from train.evaluate.scores import match_episodes, pair, score
from train.evaluate.statistics import (
    Estimate,
    beats,
    change,
    improvement,
    interquartile_mean,
)
from train.evaluate.table import EpisodeTable
from train.figures.comparison_figures import has_swept_references
from train.report.change_tables import cells_table, changes_table, print_changes, write_statistics
from train.report.page import Page
from train.report.report_text import Results, sentences
from train.report.terminal import to_terminal
from train.report.write import require_libraries, require_plotly, write_report
from train.runs.folders import run_folder

SHIPPED = Path(__file__).parents[1] / "baselines" / "trained" / "testbed"
SINE = {"kind": "sine", "amplitude": 0.05, "duration_s": 0.3, "onset_s": 0.2}
POSITIVE = st.floats(1e-3, 1e3)


# Figures over training seeds.


def test_interquartile_mean_of_known_numbers() -> None:
    """Catches a mean of all, a median, and a cut that rounds up: of ten seeds two go at each
    end, of five one."""
    assert interquartile_mean(np.array([100.0, 1.0, 2.0, 3.0, -50.0])) == 2.0
    assert interquartile_mean(np.array([0.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 99.0, 99.0])) == 3.5
    assert interquartile_mean(np.array([1.0, 2.0, 6.0])) == 3.0


@settings(max_examples=10, deadline=None)
@given(st.lists(st.floats(-1.0, 5.0), min_size=2, max_size=10))
def test_interval_repeats_and_does_not_know_the_order_of_the_seeds(values: list[float]) -> None:
    """Catches an interval that changes from run to run or with the order of the files, or that
    is extrapolated."""
    first = over_seeds(values)
    assert over_seeds(values[::-1]) == first
    assert first.low is not None
    assert first.high is not None
    assert min(values) - 1e-9 <= first.low <= first.high <= max(values) + 1e-9


def test_interval_of_two_seeds_is_that_of_all_resamples() -> None:
    """Catches a wrong level: of two seeds a quarter of the resamples is twice the lower, so the
    ends are the seeds."""
    assert over_seeds([0.2, 0.4]) == Estimate(pytest.approx(0.3), 0.2, 0.4)  # type: ignore[arg-type]


def test_interval_agrees_with_the_distribution_of_all_resamples() -> None:
    """Catches resampling without replacement, or of the trimmed values: all 4⁴ resamples are
    listed here."""
    values = [1.0, 2.0, 4.0, 8.0]
    every = [interquartile_mean(np.array(some)) for some in itertools.product(values, repeat=4)]
    found = over_seeds(values)
    assert (found.low, found.high) == tuple(np.quantile(every, [0.025, 0.975], method="nearest"))


def test_one_training_seed_has_no_interval() -> None:
    """Catches an interval over episodes in the place of one over training seeds."""
    assert over_seeds([0.5]) == Estimate(0.5)
    assert not over_seeds([0.5, float("nan")]).has_interval
    assert np.isnan(over_seeds([]).value)
    assert not improvement([np.array([[2.0]])], [np.array([[3]])]).has_interval


# Pairs.


def test_pairs_are_found_by_the_seed_of_the_episode() -> None:
    """Catches pairing by position: shuffled episodes belong together as before."""
    mine = records([1.0, 2.0, 3.0])
    base = records([10.0, 20.0, 30.0])
    shuffled = paired(episode_rows([mine[2], mine[0], mine[1]]), episode_rows(base))
    np.testing.assert_array_equal(shuffled["mine"] / shuffled["base"], [0.1, 0.1, 0.1])
    with pytest.raises(ValueError, match="seed of its own"):
        match_episodes(episode_rows([*mine, mine[0]]), episode_rows(base))
    with pytest.raises(ValueError, match="seed of its own"):
        match_episodes(episode_rows(mine), episode_rows([*base, base[0]]))


def paired(mine: pd.DataFrame, base: pd.DataFrame) -> pd.DataFrame:
    """The metric in the episodes of both."""
    return pair(mine, match_episodes(mine, base), METRIC).dropna()


def test_an_episode_in_which_either_fell_is_left_out_of_both() -> None:
    """Catches a fall that is averaged in, and a base that is averaged over other episodes than
    the policy."""
    mine = episode_rows(records([1.0, None, 3.0, 4.0]))
    found = paired(mine, episode_rows(records([2.0, 2.0, None, 8.0])))
    assert (found["mine"].tolist(), found["base"].tolist()) == ([1.0, 4.0], [2.0, 8.0])
    mine = episode_rows(records([1.0, 2.0]))
    only_here = paired(mine, episode_rows(records([2.0, 4.0], first=1)))
    assert (only_here["mine"].tolist(), only_here["base"].tolist()) == ([2.0], [2.0])


def test_change_pools_means_of_scenarios_and_not_episodes_or_ratios() -> None:
    """Catches a scenario that weighs more because it has more episodes, and a mean of ratios."""
    base = [cell("base", {"all": [2.0] * 9}, "soft"), cell("base", {"all": [10.0]}, "ideal")]
    other = [cell("other", {"all": [1.0] * 9}, "soft"), cell("other", {"all": [9.0]}, "ideal")]
    pooled = next(
        row for row in changes([*base, *other], {"both": ["soft", "ideal"]}) if row.is_group
    )
    assert pooled.relative.value == pytest.approx((1.0 + 9.0) / (2.0 + 10.0) - 1.0)
    assert change(np.array([[1.0, 9.0]]), np.array([[2.0, 10.0]])) == pytest.approx(
        (1.0 + 9.0) / (2.0 + 10.0) - 1.0
    )
    assert np.isnan(change(np.array([[1.0, np.nan]]), np.array([[2.0, np.nan]]))).all()


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(POSITIVE, POSITIVE), min_size=1, max_size=8), POSITIVE)
def test_change_does_not_depend_on_the_unit(values: list[tuple[float, float]], unit: float) -> None:
    """Catches a difference in the place of a ratio."""
    mine, base = np.array(values).T
    np.testing.assert_allclose(change(unit * mine, unit * base), change(mine, base), atol=1e-9)


def test_probability_of_improvement_counts_all_pairs_of_seed_and_episode() -> None:
    """Catches a share of seeds, larger taken for better, and ties that count as wins."""
    seeds = [([1.0, 3.0], [2.0, 2.0]), ([1.0, 2.0], [2.0, 2.0]), ([1.0], [2.0]), ([], [])]
    won = np.array([[beats(np.array(mine), np.array(base)).sum()] for mine, base in seeds])
    found = improvement([won], [np.array([[len(mine)] for mine, _ in seeds])])
    assert found.value == pytest.approx((1 + 1.5 + 1) / 5)
    assert found.low is not None
    assert found.low == pytest.approx(0.5)
    assert found.high == 1.0


# Families.


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every test works in a folder of its own, on a wide terminal without colours."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")


FAMILY = PolicySpec(name="residual:run/seed_*/last", label="learned")


@pytest.mark.parametrize("absolute", [False, True])
def test_a_pattern_stands_for_all_training_seeds_in_natural_order_with_their_base(
    absolute: bool,
) -> None:
    """Catches seed_10 before seed_2, a seed that is lost, and a family without what it is
    compared with."""
    for seed in (10, 2, 1):
        describe(
            Path(f"run/seed_{seed}/last"), seed if seed != 2 else None
        )  # one says it by its folder alone
    (Path("run") / "seed_0.txt").write_text("no folder")
    name = f"residual:{Path.cwd()}/run/seed_*/last" if absolute else FAMILY.name
    found = expand([PolicySpec(name="zero"), FAMILY.replace(name=name)])
    titles = [entrant.policy.title for entrant in found]
    assert titles == ["zero", "input_output", BEST_ON_THE_WALKER, "learned", "learned", "learned"]
    members = [entrant.member for entrant in found if entrant.member is not None]
    assert [member.training_seed for member in members] == [1, 2, 10]
    assert {(member.base, member.rival) for member in members} == {
        ("input_output", BEST_ON_THE_WALKER)
    }
    assert [entrant.policy.name for entrant in found][3:] == [
        f"residual:{member.folder}" for member in members
    ]
    alone = expand([FAMILY.replace(name=name)], with_bases=False)
    assert [entrant.member.rival for entrant in alone if entrant.member] == [None] * 3


def test_a_base_is_the_policy_with_the_same_options() -> None:
    """Catches a residual compared with another policy of the base's name, and a base that plays
    twice."""
    describe(Path("one"), 1, base_options={"stiffness_scale": 0.9})
    residual = PolicySpec(name="residual:one")
    other = PolicySpec(name="input_output")
    same = PolicySpec(name="input_output", label="weak", options={"stiffness_scale": 0.9})
    found = expand([residual, same])
    assert (found[0].policy.name, found[0].policy.options) == (BEST_ON_THE_WALKER, same.options)
    assert [e.policy for e in found][2:] == [same]
    assert found[1].member == Member(
        folder="one", training_seed=1, base="weak", rival=BEST_ON_THE_WALKER
    )
    added = expand([other, residual])[1].policy
    assert (added.title, added.options) == ("input_output (base of residual:one)", same.options)
    given_anew = expand([residual.replace(options={"stiffness_scale": 0.5})])
    assert [e.policy.options for e in given_anew] == [{"stiffness_scale": 0.5}] * 3


def test_the_best_policy_without_learning_is_the_one_that_the_user_names() -> None:
    """Catches a rival that plays twice, one that assumes another stiffness, and a base that is
    its own rival."""
    describe(Path("one"), 1)
    residual = PolicySpec(name="residual:one")
    tuned = PolicySpec(name=str(BEST_ON_THE_WALKER), label="tuned", options={"ramp_s": 2.0})
    found = expand([residual, tuned])
    assert [e.policy.title for e in found] == ["input_output", "residual:one", "tuned"]
    assert found[1].member == Member(
        folder="one", training_seed=1, base="input_output", rival="tuned"
    )
    wrong = tuned.replace(label=BEST_ON_THE_WALKER, options={"stiffness_scale": 0.9})
    added = expand([wrong, residual])[2].policy
    assert (added.title, added.options) == (f"{BEST_ON_THE_WALKER} (best analytic)", {})
    describe(Path("two"), 1, base=BEST_ON_THE_WALKER)
    assert [e.member.rival for e in expand([PolicySpec(name="residual:two")]) if e.member] == [None]
    plain = PolicySpec(name=str(BEST_ON_THE_WALKER))
    assert [
        e.member.rival for e in expand([plain, tuned, PolicySpec(name="residual:two")]) if e.member
    ] == [None]
    describe(Path("three"), 1, base=BEST_ON_THE_WALKER, base_options=tuned.options)
    for listed, rival in (([tuned], None), ([tuned, plain], BEST_ON_THE_WALKER)):
        members = [
            e.member for e in expand([*listed, PolicySpec(name="residual:three")]) if e.member
        ]
        assert [(member.base, member.rival) for member in members] == [("tuned", rival)]


def test_shipped_policies_are_a_family_wherever_one_works() -> None:
    """Catches a comparison of what is shipped that runs in the project's own folder alone, and
    one's own overruled."""
    members = [
        entrant.member for entrant in expand([PolicySpec(name="residual:testbed/seed_*")])[1:]
    ]
    assert [member.folder for member in members if member] == [
        f"testbed/seed_{seed}" for seed in range(5)
    ]
    describe(Path("testbed/seed_7"), 7)
    assert [
        e.member.training_seed
        for e in expand([PolicySpec(name="residual:testbed/seed_*")])[1:]
        if e.member
    ] == [7]


def test_a_residual_that_is_called_like_its_base_is_not_taken_for_it() -> None:
    """Catches both under one title, whose episodes would then be averaged together."""
    describe(Path("one"), 1)
    titles = [
        entrant.policy.title
        for entrant in expand([PolicySpec(name="residual:one", label="input_output")])
    ]
    assert titles == ["input_output (base of input_output)", BEST_ON_THE_WALKER, "input_output"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scenarios": ["nominal", "soft", "nominal"]}, "scenarios: 'nominal' stands twice"),
        ({"references": [3, 1.6, {"step_period": 3.0}]}, "the reference '3 s' stands twice"),
        (
            {"sweep": {"option": "stiffness_scale", "values": [1, 1]}},
            "sweep.values: 1.0 stands twice",
        ),
        (
            {
                "sweep": {"option": "stiffness_scale", "values": [1, 2]},
                "policies": [{"name": "input", "level": True}],
            },
            "a sweep needs a policy that it varies",
        ),
    ],
)
def test_what_would_count_double_is_refused(changes: dict[str, Any], message: str) -> None:
    """Catches an interval that gets narrower by naming a scenario twice."""
    with pytest.raises(ConfigurationError, match=message):
        CompareConfig(
            **{"name": "x", "env": "walker", "references": [3], "policies": ["input"], **changes}
        )


def test_references_of_one_number_are_no_sweep() -> None:
    """Catches two walks of the same step period taken for one point of a curve."""
    walks: list[Any] = [3, 1.6, 1.1, {"step_period": 3, "num_steps": 2}]
    cells = [cell("base", {"all": [1.0]}, "soft", reference=reference) for reference in walks]
    assert has_swept_references(cells[:3])
    assert not has_swept_references(cells)


def test_a_group_without_a_pair_in_one_of_its_scenarios_has_no_figures() -> None:
    """Catches means and probabilities of a pooled row that are of other scenarios than it says."""
    fallen = [[None, None]] * 5
    fine = [[1.0, 1.0]] * 5
    base = [cell("base", {"all": [2.0, 2.0]}, scenario) for scenario in ("ideal", "soft")]
    learned = [*family(fine, "ideal"), *family(fallen, "soft")]
    rows = changes([*base, *learned], {"both": ["ideal", "soft"]})
    pooled = next(row for row in rows if row.is_group)
    assert not np.isfinite([pooled.relative.value, pooled.improvement.value, pooled.mine]).any()
    assert pooled.sentence.startswith(
        "nothing to compare: in one of the scenarios there is no episode in which both"
    )
    page = Page("x", "")
    page.section("Changes")
    page.add("table", changes_table([pooled], {"learned": "red"}))
    assert "nan" not in (html := page.html(plotly_js=""))
    assert pooled.sentence in html


def test_folders_that_are_no_family_are_refused() -> None:
    """Catches an interval over things that are not training seeds of one configuration."""
    Path("rnu/other").mkdir(parents=True)
    with pytest.raises(
        ConfigurationError, match=r"no folder matches 'run/seed_\*/last'; this folder has rnu"
    ):
        expand([FAMILY])
    describe(Path("run/seed_1/last"), 1)
    describe(Path("run/seed_2/last"), 1)
    with pytest.raises(
        ConfigurationError, match="training seed 1 twice: run/seed_1/last and run/seed_2/last"
    ):
        expand([FAMILY])
    shutil.rmtree("run/seed_2")
    describe(Path("run/seed_2/last"), 2, base="input")
    with pytest.raises(
        ConfigurationError,
        match="base of run/seed_2/last is 'input' and of run/seed_1/last 'input_o",
    ):
        expand([FAMILY])
    shutil.rmtree("run/seed_2")
    describe(Path("run/seed_2/last"), 2, config={"decisions": 10})
    with pytest.raises(
        ConfigurationError, match=r"the trained decisions of run/seed_2/last is 10 and of .* None"
    ):
        expand([FAMILY])
    shutil.rmtree("run/seed_2")
    Path("run/seed_2/last").mkdir(parents=True)
    with pytest.raises(ConfigurationError, match="no residual at run/seed_2/last"):
        expand([FAMILY])


def test_a_residual_on_a_residual_is_refused() -> None:
    """Catches the endless recursion of a residual that names itself as its base."""
    folder = describe(Path("loop"))
    content = json.loads((folder / "residual.json").read_text())
    (folder / "residual.json").write_text(json.dumps({**content, "base": "residual:loop"}))
    with pytest.raises(ConfigurationError, match="must be no residual itself, got 'residual:loop'"):
        read_description(folder)


def test_the_base_of_a_residual_is_no_code() -> None:
    """Catches a comparison with a residual from elsewhere that imports what its description
    names."""
    folder = describe(Path("door"))
    Path("evil.py").write_text("raise SystemExit('imported')\n")
    content = json.loads((folder / "residual.json").read_text())
    for base in ("evil.py:make", "evil:make"):
        (folder / "residual.json").write_text(json.dumps({**content, "base": base}))
        with pytest.raises(ConfigurationError, match=f"no residual and no code, got '{base}'"):
            expand([PolicySpec(name="residual:door")])


# Changes and their sentences.


def only(rows: Sequence[Change], policy: str = "learned") -> Change:
    """The first row of a policy."""
    return next(row for row in rows if row.policy == policy)


def test_a_pattern_does_not_search_the_disk() -> None:
    """Catches a configuration that has all folders of a computer read, and one whose name is too
    long for a folder."""
    with pytest.raises(ConfigurationError, match="stands for one part of a path"):
        expand([PolicySpec(name="residual:/**/last")])
    for name in ("a" * 300 + "/*", "a" * 900):
        with pytest.raises(ConfigurationError, match=r"no folder matches|no residual at"):
            expand([PolicySpec(name=f"residual:{name}")])


def test_change_of_a_family_is_paired_per_training_seed() -> None:
    """Catches a mean over seeds before the ratio, the wrong base, and lost falls."""
    base = cell("base", {"all": [2.0, 4.0, None]}, "soft")
    other = cell("other", {"all": [3.0, 3.0, 3.0]}, "soft")
    row = only(
        rows := changes(
            [base, other, *family([[1.0, 2.0, 1.0], [1.0, 1.0, None], [None, 2.0, 1.0]])]
        )
    )
    np.testing.assert_allclose(row.per_seed, [-0.5, 2.0 / 6.0 - 1.0, -0.5])
    assert (row.base, row.num_seeds, row.num_pairs) == ("base", 3, 5)
    assert (row.falls, row.episodes, row.base_falls, row.base_episodes) == (2, 9, 1, 3)
    assert row.falls_less
    assert row.relative == over_seeds(row.per_seed.tolist())
    against = only(rows, "other")
    assert (against.base, against.is_family, against.relative.value) == ("base", False, 0.0)
    few = "no change with 3 episodes: too few to tell it from chance"
    assert against.sentence == f"{few}; fewer falls than base"


def test_a_residual_is_compared_with_its_base_and_with_the_best_policy_without_learning() -> None:
    """Catches a claim against the weaker of both alone, both under one heading, and the wrong
    one called its base."""
    base = cell("base", {"all": [4.0, 4.0]}, "soft")
    best = cell("best", {"all": [1.0, 1.0]}, "soft")
    learned = [
        Evaluation(
            e.condition.replace(member=e.condition.member.replace(rival="best")),
            e.episodes,
            e.trace,
        )
        for e in family([[2.0, 2.0]] * 5)
        if e.condition.member is not None
    ]
    evaluations = [base, best, *learned]
    rows = [
        row
        for row in changes(evaluations)
        if row.policy == "learned" and row.column.metric == METRIC
    ]
    assert [(row.base, row.is_rival, row.relative.value) for row in rows] == [
        ("base", False, -0.5),
        ("best", True, 1.0),
    ]
    page = report_of(evaluations)
    sentence = (
        "learned, pelvis error rms, soft (trained robot): 50 % lower than base, its base [−50,"
        " −50]; 100 % higher than best, the best policy without learning [+100, +100]."
    )
    assert sentence in page
    assert sentence in Path("runs/x/report.md").read_text()
    headings = re.findall(r"<h2 id=\"s\d+\">([^<]*)</h2>", page)
    assert headings[2:5] == [
        "Residuals against their base",
        "Residuals against the best policy without learning",
        "Baselines against one another",
    ]
    with write_statistics(changes(evaluations), Path("s.csv")).open(newline="") as file:
        roles = {(row["policy"], row["base"]): row["base_is"] for row in csv.DictReader(file)}
    assert roles["learned", "base"] == "base of the residual"
    assert roles["learned", "best"] == "best policy without learning"


SENTENCES: dict[str, tuple[Sequence[Sequence[float | None]], str]] = {
    "lower": (
        [[1.0, 1.0], [1.2, 1.0], [1.0, 1.2], [1.2, 1.0], [1.0, 1.2]],
        "45 % lower; fewer falls than base",
    ),
    "higher": (
        [[3.0, 3.0], [3.2, 3.0], [3.0, 3.2], [3.2, 3.0], [3.0, 3.2]],
        "55 % higher; fewer falls than base",
    ),
    "includes zero": (
        [[1.0, 1.0], [3.0, 3.0], [1.5, 1.5], [2.5, 2.5], [2.1, 2.1]],
        "the interval includes zero: no difference shown; fewer",
    ),
    "zero": ([[2.0, 2.0]] * 5, "the interval includes zero: no difference shown; fewer"),
    "one seed": ([[1.0, 1.0]], "50 % lower with one training seed: no interval; fewer"),
    "four seeds": (
        [[1.0, 1.0]] * 4,
        "50 % lower with 4 training seeds: too few to tell it from chance; fewer",
    ),
    "falls": ([[1.0, None, None]] * 5, "50 % lower; MORE FALLS than base"),
    "all fall": ([[None, None], [None, None]], "nothing to compare"),
    "a seed falls": (
        [[1.0, 1.0], [None, None], *[[1.0, 1.0]] * 4],
        "50 % lower; 1 of 6 training seeds have",
    ),
}


@pytest.mark.parametrize("case", SENTENCES)
def test_every_row_says_what_it_shows(case: str) -> None:
    """Catches a claim where the interval includes zero or is none, and falls that nobody hears
    of."""
    values, sentence = SENTENCES[case]
    base = cell("base", {"all": [2.0, 2.0, None]}, "soft")
    assert only(changes([base, *family(values)])).sentence.startswith(sentence)


def test_conditions_are_marked_by_what_training_has_seen() -> None:
    """Catches a ceiling sold as a proof, and a held-out scenario, step period or group that is
    not called so."""
    marks: list[tuple[str, Any, tuple[str, ...]]] = [
        ("ideal", 3, (CEILING,)),
        ("ideal+soft", 3, (CEILING,)),
        ("ideal+spread", 3, ()),
        ("soft", {"step_period": 3, "num_steps": 2}, (SAME_ROBOT,)),
        ("slope", 3, ("held out",)),
        ("ideal", 1.6, ("held out step period",)),
        ("slope", 1.6, ("held out scenario and step period",)),
    ]
    for scenario, reference, expected in marks:
        base = cell("base", {"all": [2.0]}, scenario, reference=reference)
        row = only(changes([base, *family([[1.0], [1.0]], scenario, reference=reference)]))
        assert row.marks == expected
    cells = [cell("base", {"all": [2.0]}, s) for s in ("ideal", "slope")]
    learned = [e for s in ("ideal", "slope") for e in family([[1.0], [1.5]], s)]
    rows = changes([*cells, *learned], {"both": ["ideal", "slope"]})
    pooled = [row for row in rows if row.is_group and row.is_judged]
    assert [row.marks for row in pooled] == [("partly held out: slope",)] * 2
    np.testing.assert_allclose(pooled[0].per_seed, [-0.5, -0.25])


def test_roll_and_pitch_stand_in_the_tables_and_do_not_judge() -> None:
    """Catches figures that a reader of the walk looks for and does not find, and a verdict
    counted twice."""
    base = cell("base", {"all": [2.0]}, "soft")
    for e in (learned := family([[1.0]])) + [base]:
        e.episodes[0]["pelvis_roll_rms_rad"] = 4.0 if e is base else 1.0
    rows = {row.column.metric: row for row in changes([base, *learned]) if row.policy == "learned"}
    assert [name for name, row in rows.items() if row.is_judged] == [
        "pelvis_error_rms_rad",
        "zmp_deviation_rms_m",
    ]
    assert rows["pelvis_roll_rms_rad"].relative.value == -0.75
    assert "nothing to compare" in rows["pelvis_pitch_rms_rad"].sentence


def test_a_residual_of_unknown_training_is_called_so() -> None:
    """Catches a scenario taken for trained on because the files are silent."""
    describe(Path("seed_0"), training={})
    rows = changes([cell("base", {"all": [2.0]}, "ideal"), *family([[1.0]], "ideal")])
    assert only(rows).marks == ("training condition unknown",)


def test_a_swept_residual_is_compared_with_its_base_at_the_same_value() -> None:
    """Catches a base at another stiffness, and a level that is left alone."""
    evaluations = []
    for value, base, mine in ((0.5, 4.0, 3.0), (1.0, 2.0, 1.0)):
        for e, own in (
            (cell("base", {"all": [base]}, "ideal"), base),
            (*family([[mine]], "ideal"), mine),
        ):
            assert own
            evaluations.append(
                Evaluation(
                    e.condition.replace(swept={"stiffness_scale": value}), e.episodes, e.trace
                )
            )
    rows = [
        row
        for row in changes(evaluations)
        if row.policy == "learned" and row.column.metric == METRIC
    ]
    assert [(row.swept["stiffness_scale"], row.relative.value) for row in rows] == [
        (0.5, -0.25),
        (1.0, -0.5),
    ]
    assert rows[0].marks == ()


def test_levels_and_merged_cells_keep_every_training_seed() -> None:
    """Catches a family that shows its first seed alone: in the ladder, and in the summary."""
    cells = family([[1.0, 3.0], [4.0, None], [6.0, 6.0]])
    found = score(EpisodeTable(cells).rows, cells[0].condition.environment.judged[0])
    assert found.value == pytest.approx((2.0 + 4.0 + 6.0) / 3.0)
    together = merge_seeds([cell("base", {"all": [2.0]}, "soft"), *cells])
    assert [(e.condition.policy.title, len(e.episodes), e.num_failed) for e in together] == [
        ("base", 1, 0),
        ("learned", 6, 1),
    ]
    assert [len(e.episodes) for e in cells] == [2, 2, 2]


def test_percent_does_not_round_a_bound_to_zero() -> None:
    """Catches an interval that seems to touch zero, or not to."""
    assert percent_interval(Estimate(0.15, 0.003, 0.29)) == "+15.0 % [+0.3, +29.0]"
    assert percent_interval(Estimate(-0.4, -0.45, -0.33)) == "−40 % [−45, −33]"


# The report.

_LOADS = re.compile(
    r"<(?:script|link|img|iframe|source|object)\b[^>]*(?:src|href|data)\s*=|@import|url\(",
    re.IGNORECASE,
)


def page_without_plotly(path: Path) -> str:
    """A report's own text: plotly.js, which it must hold exactly once, is cut out."""
    parts = path.read_text(encoding="utf-8").split(require_plotly())
    assert len(parts) == 2
    return "".join(parts)


GROUPS = {"both": ["soft", "ideal"]}


def report_of(evaluations: list[Evaluation], swept: str | None = None) -> str:
    """Page of a comparison, without plotly.js."""
    with run_folder("x", {}, 0) as folder:
        results = Results("x", evaluations, changes(evaluations, GROUPS), folder, swept)
        write_report(results)
    return page_without_plotly(folder / "report.html")


def headline_of(evaluations: list[Evaluation]) -> str:
    """First paragraph of that page."""
    with run_folder("x", {}, 0) as folder:
        results = Results("x", evaluations, changes(evaluations, GROUPS), folder)
        return sentences("headline", results)[0]


def test_report_needs_nothing_from_outside_and_shows_every_part() -> None:
    """Catches a page that is blank without a network or does not begin with the headline, a chart
    that is no JSON, names that become markup."""
    evil = "<script>alert(1)</script>"
    evaluations = [
        e
        for reference, scenario in ((3, "soft"), (3, "ideal"), (1.6, "soft"), (1.1, "soft"))
        for e in [
            cell("base", {"all": [2.0, 2.0]}, scenario, reference=reference),
            cell(evil, {"all": [None, None]}, scenario, reference=reference, time=120),
            cell("policy", {"all": [1.0, 2.0]}, scenario, reference=reference),
            *family([[1.0, None], [1.5, 1.2]], scenario, reference=reference),
        ]
    ]
    for seed in (0, 1):  # as in a training run
        describe(Path(f"run/seed_{seed}/last"), seed)
        shutil.rmtree(f"seed_{seed}")
        Path(f"seed_{seed}").symlink_to(f"run/seed_{seed}/last")
        Path(f"run/seed_{seed}/progress.csv").write_text(
            "decisions,scenario,pelvis_error_rms_rad,zmp_deviation_rms_m,base_pelvis_error_rms_rad,"
            "base_zmp_deviation_rms_m,failed,base_failed\n0,soft,2,2,2,2,0,0\n100,soft,1,nan,2,2,0,0\n"
        )
    page = report_of(evaluations)
    assert _LOADS.search(page) is None
    assert "http" not in page
    assert re.findall(r"<p>(.*?)</p>", page)[0] == html.escape(
        headline_of(evaluations), quote=False
    )
    assert evil not in page.replace(json.dumps(evil), "")
    headings = re.findall(r"<h2 id=\"(s\d+)\">([^<]*)</h2>", page)
    wanted = [
        "What was compared",
        "Ladder of policies",
        "Residuals against their base",
        "Baselines against one another",
        "By phase, rms",
        "Curves over time",
        "Sweeps",
        "Learning curves",
        "Notes",
    ]
    assert [title for _, title in headings] == wanted
    assert all(f'href="#{anchor}"' in page for anchor, _ in headings)
    specs = re.findall(r'<script type="application/json" id="(c\d+)-spec">(.*?)</script>', page)
    assert len(specs) == 3 + 1 + 4 + 1 + 1
    for name, spec in specs:
        assert f'id="{name}"' in page
        assert any(trace.get("x") or trace.get("y") for trace in json.loads(spec)["data"])
    text = Path("runs/x/report.md").read_text()
    assert all(f"## {title}" in text for title in ("In short", *wanted[2:5], "Notes"))


def test_report_begins_with_three_sentences() -> None:
    """Catches a headline without figures, one that praises who falls, and a verdict of too few
    training seeds."""
    cells = [
        cell(policy, {"all": values}, scenario)
        for scenario in ("soft", "ideal")
        for policy, values in (("base", [2.0, 4.0]), ("better", [1.0, None]))
    ]
    assert (
        headline_of(cells)
        == "2 policies played 8 episodes in 2 scenarios, of which 2 failed. The lowest pelvis error"
        " rms is that of base, a mean of 3000.00 mrad; it is ahead in 2 of 2 cells. better comes"
        " last, with 1000.00 mrad."
    )
    apart = [
        cell(policy, {"all": [value, value]}, scenario)
        for policy, values in (("base", (2.0, 9.0)), ("tuned to soft", (8.0, 1.0)))
        for scenario, value in zip(("ideal", "soft"), values, strict=True)
    ]
    assert (
        "is that of tuned to soft, a mean of 4500.00 mrad; it is ahead in 1 of 2 cells."
        in headline_of(apart)
    )
    few = [
        e
        for s in ("soft", "ideal")
        for e in (cell("base", {"all": [2.0, 2.0]}, s), *family([[1.0, 1.0], [1.0, 1.0]], s))
    ]
    chance = "by −50 %; 2 training seeds cannot tell that from chance, 5 are needed."
    assert chance in headline_of(few)


def test_report_of_a_sweep_draws_curves_and_falls() -> None:
    """Catches a sweep shown as one bar per value, and policies that fail unseen."""
    evaluations = [
        Evaluation(e.condition.replace(swept={"stiffness_scale": value}), e.episodes, e.trace)
        for value in (0.5, 1.0, 2.0)
        for e in [
            cell("base", {"all": [2.0, None if value > 1 else 2.0]}, "soft"),
            *family([[1.0, 1.5], [1.5, 1.2]]),
        ]
    ]
    page = report_of(
        [*evaluations, cell("oracle", {"all": [0.5, 0.5]}, "soft")], "assumed over true stiffness"
    )
    assert "Ladder of policies" not in page
    (spec,) = (json.loads(s) for s in re.findall(r'id="c\d+-spec">(.*?)</script>', page))
    assert spec["layout"]["xaxis"]["title"]["text"] == "assumed over true stiffness"
    bands = [trace for trace in spec["data"] if trace.get("fill") == "tonexty"]
    assert [trace["legendgroup"] for trace in bands] == ["learned"] * 2
    (crosses,) = [trace for trace in spec["data"] if trace["mode"] == "markers"]
    assert (crosses["x"], crosses["marker"]["symbol"]) == ([2.0], ["x-open"])


def test_learning_curves_are_shares_of_the_base_and_gaps_where_a_scenario_failed() -> None:
    """Catches a mean over fewer scenarios where one fell, and curves of a policy that lies
    elsewhere."""
    folder = describe(Path("run/seed_0/best"), 0)
    columns = Condition(env="walker", policy=PolicySpec(name="zero")).environment.judged[:1]
    assert learning_curves([str(folder)], columns) is None
    Path("run/seed_0/progress.csv").write_text(
        "decisions,scenario,pelvis_error_rms_rad,base_pelvis_error_rms_rad\n0,a,2,2\n0,b,4,4\n50,a,1,2\n50,b,1,4\n"
        "100,a,1,2\n100,b,nan,4\n"
    )
    found = learning_curves([str(folder)], columns)
    assert found is not None
    assert found.decisions.tolist() == [0, 50, 100]
    np.testing.assert_array_equal(found.ratios["pelvis_error_rms_rad"], [[1.0, 0.375, np.nan]])


@pytest.mark.parametrize("module", ["plotly.offline", "jinja2"])
def test_without_its_packages_the_comparison_says_what_to_install(
    module: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches minutes of work that end in an import error."""
    monkeypatch.setitem(__import__("sys").modules, module, None)
    with pytest.raises(
        MissingExtraError, match=rf"report needs the package {module[:6]}; .*'\.\[report\]'"
    ):
        require_libraries()


def test_a_change_is_of_the_means_over_scenarios() -> None:
    """Catches a median, which one bad scenario of three would not move."""
    mine = np.array([[1.0, 2.0, 6.0]])
    assert change(mine, np.full((1, 3), 2.0)).tolist() == [0.5]


# elastic compare with residuals.


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Folder of `elastic compare` with two shipped training seeds, played for real but without
    pictures, and what it printed."""
    root = tmp_path_factory.mktemp("families")
    content = {
        "name": "two",
        "references": [SINE],
        "scenarios": ["nominal"],
        "episodes": 2,
        "policies": [
            "uncompensated",
            {"name": f"residual:{SHIPPED}/seed_[01]", "label": "learned"},
        ],
    }
    (root / "two.yaml").write_text(yaml.safe_dump(content))

    def run(conditions: Sequence[Condition], console: Console, *_: object) -> list[Evaluation]:
        return [evaluate(condition, num_threads=1) for condition in conditions]

    with pytest.MonkeyPatch.context() as patch, (root / "printed.txt").open("w") as file:
        patch.chdir(root)
        patch.setattr(train.commands.comparison, "run_conditions", run)
        patch.setattr(train.commands.comparison, "draw_figures", lambda *_: [])
        patch.setattr("train.commands.cli.CONSOLE", Console(width=160, file=file))
        main(["compare", "two.yaml"])
    return root / "runs" / "two", (root / "printed.txt").read_text()


@pytest.mark.slow
def test_compare_plays_every_training_seed_its_base_and_the_rival(
    compared: tuple[Path, str],
) -> None:
    """Catches rows that cannot be told apart, a base that is missing, and a statistic that the
    episodes do not bear."""
    folder, printed = compared
    with (folder / "episodes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {(row["policy"], row["training_seed"], row["base"]) for row in rows} == {
        ("uncompensated", "", ""),
        ("input", "", ""),
        ("friction", "", ""),
        ("learned", "0", "input"),
        ("learned", "1", "input"),
    }
    assert len(rows) == 5 * 2
    mean = {
        seed: np.mean(
            [
                float(r["link_error_rms_rad"])
                for r in rows
                if r["scenario"] == "nominal"
                and (r["training_seed"] == seed and r["policy"] in ("learned", "input"))
            ]
        )
        for seed in ("", "0", "1")
    }
    with (folder / "statistics.csv").open(newline="") as file:
        found = next(
            row
            for row in csv.DictReader(file)
            if row["policy"] == "learned" and row["scope"] == "nominal"
        )
    expected = [mean[seed] / mean[""] - 1.0 for seed in ("0", "1")]
    np.testing.assert_allclose(
        [float(v) for v in found["change_per_training_seed"].split()], expected, rtol=1e-4
    )
    assert float(found["change"]) == pytest.approx(np.mean(expected))
    assert (found["base"], found["training_seeds"], found["pairs"]) == ("input", "2", "4")
    assert found["marks"] == "held out reference"
    assert "interquartile mean with interval, 95 % over 2 training seeds" in " ".join(
        printed.split()
    )
    for name in ("report.html", "report.md", "statistics.csv"):
        assert f"runs/two/{name}" in printed
    assert load_yaml(folder / "config.yaml", CompareConfig).policies[1].name.endswith("seed_[01]")
    page_without_plotly(folder / "report.html")


def test_each_environment_and_each_policy_is_tried_out() -> None:
    """Catches an environment or a policy that first fails when its turn comes, and pairs that
    are all tried."""
    named = {"policies": ["input", "dynamic"], "scenarios": ["soft", "stiff", "sensor"]}
    conditions = CompareConfig(name="c", env="walker", references=[3, 1.6], **named).conditions()  # type: ignore[arg-type]
    tried = list(_distinct_conditions(conditions))
    assert len(tried) == 2 * (3 + 1) < len(conditions)
    for key in (lambda c: repr(c.arguments), lambda c: (c.policy.name, c.reference)):
        assert {key(c) for c in tried} == {key(c) for c in conditions}


def test_a_policy_with_sensors_of_its_own_is_tried_out_once_at_a_motion() -> None:
    """Catches that each such policy has all environments made anew: 87 of the leaderboard's in
    place of 39."""
    config = load_yaml(Path(__file__).parents[1] / "configs" / "leaderboard.yaml", CompareConfig)
    conditions = config.conditions()
    tried = list(_distinct_conditions(conditions))
    assert len({repr(c.arguments) for c in tried}) == 39
    for key in (lambda c: c.cell, lambda c: (c.policy.title, c.reference_name)):
        assert {key(c) for c in tried} == {key(c) for c in conditions}


def test_words_are_whole_where_there_are_two_residuals() -> None:
    """Catches names of policies and scenarios that are broken where they need not be."""
    base = cell("base", {"all": [2.0]}, "payload")
    others = [
        Evaluation(
            e.condition.replace(policy=e.condition.policy.replace(label="residual")), e.episodes
        )
        for e in family([[1.0], [3.0]], "payload")
    ]
    rows = [
        row
        for row in changes([base, *family([[1.0], [3.0]], "payload"), *others])
        if row.is_family and row.is_judged
    ]
    for width, has_room in ((84, True), (64, False)):
        console = Console(width=width, record=True, file=StringIO())
        print_changes(rows, console)
        text = console.export_text()
        assert {"learned", "residual", "reference", "scenario", "payload"} <= set(text.split())
        assert "0/2 (0/1)" in text  # the last column
        hint = "no room for 'ZMP deviation rms': widen the terminal, or see statistics.csv"
        assert (hint in " ".join(text.split())) != has_room


def test_no_word_of_the_table_of_one_residual_is_broken() -> None:
    """Catches mixtu/re and sprea/d on a terminal of the usual width, and on narrower ones."""
    rows = []
    for scenario in ("spread", "payload"):
        base = cell("base", {"all": [2.0] * 10}, scenario)
        rows += [base, *family([[0.1 * seed] * 10 for seed in range(1, 12)], scenario)]
    shown = changes(rows, {"mixture of both": ["spread", "payload"]})
    for width in (80, 72, 60, 50):
        console = Console(width=width, record=True, file=StringIO())
        print_changes(shown, console)
        lines = console.export_text().splitlines()
        assert {"scenario", "mixture", "spread", "payload", "learned"} <= {
            word.strip(":,") for line in lines for word in line.split()
        }
        assert all(
            "/" in line for line in lines if "spread" in line or "payload" in line
        )  # falls stand in the same line
        assert max(map(len, lines)) <= width


def test_groups_name_scenarios_that_are_played() -> None:
    """Catches a group that is silently smaller than it says, and one whose name is a scenario's."""
    with pytest.raises(ConfigurationError, match="'sof'"):
        CompareConfig(name="c", groups={"held out": ["sof"]})
    with pytest.raises(ConfigurationError, match="'nominal' must have a name that no scenario has"):
        CompareConfig(name="c", groups={"nominal": ["nominal"]})


def test_tables_tell_falls_and_intervals_that_include_zero() -> None:
    """Catches a table from which a reader takes more than the statistics bear."""
    base = cell("base", {"all": [2.0, 2.0]}, "soft")
    few = [[1.0, None], [3.0, 3.0], [2.1, 2.1]]
    for seeds, expected in ((few, "? "), ([*few, [1.0, 1.0], [3.0, 3.0]], "* ")):
        rows = changes([base, *family(seeds)])
        console = Console(width=160, record=True, file=StringIO())
        console.print(to_terminal(cells_table([row for row in rows if row.is_family])))
        text = console.export_text()
        assert f"! 1/{2 * len(seeds)} (0/2)" in text
        row = next(row for row in rows if row.is_family and row.is_judged)
        assert row.mine == interquartile_mean(
            np.array([np.mean([v for v in own if v is not None]) for own in seeds])
        )
        assert f"[−50, +50] {expected}" in text
    content = write_statistics(rows, Path("statistics.csv")).read_text(encoding="utf-8")
    assert "MORE FALLS than base" in content
