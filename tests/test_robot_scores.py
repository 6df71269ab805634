"""Scores over drawn robots: closed forms, falls, whom they compare, files and report; and ranges
in configurations."""

import csv
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from scipy import stats

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.robots.thormang.config import robot_bank
from elastic_env.world.scenario import TRAINING_RANGES, make_scenario
from tests.cells import METRIC, cell, episode_rows, family, records
from train.commands.compare_config import CompareConfig
from train.evaluate.change_text import HELD_OUT
from train.evaluate.changes import changes
from train.evaluate.conditions import Condition, PolicySpec
from train.evaluate.episodes import evaluate
from train.evaluate.residual_seeds import Origin
from train.evaluate.robots import robot_scores, share_better
from train.evaluate.rollout import make_vector_env
from train.evaluate.statistics import interquartile_mean, mean_of_part, worst_share
from train.learn.train_config import TrainConfig, training_worlds
from train.report.report_text import Results
from train.report.score_tables import print_robots, robots_table, write_robots
from train.report.write import write_report
from train.runs.folders import run_folder

OWN = {"load_kg": [0.0, 2.0]}


@pytest.fixture(autouse=True)
def _folders_of_residuals_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Families are folders in the working directory."""
    monkeypatch.chdir(tmp_path)


# Figures.


def worst_share_mean(values: Array) -> float:
    """The statistic of a sample in which every robot is once."""
    return mean_of_part(worst_share)(values[None], np.ones((1, len(values)))).item()


def test_the_worst_tenth_of_known_numbers() -> None:
    """Catches the best tenth, a quantile, and a value at the edge that counts whole or not at
    all."""
    assert worst_share_mean(np.arange(1.0, 101.0)) == pytest.approx(np.arange(91.0, 101.0).mean())
    assert worst_share_mean(np.array([5.0, 1.0, 9.0])) == 9.0
    numbers = np.arange(1.0, 33.0)  # 3.2 of them
    assert worst_share_mean(numbers) == pytest.approx((32.0 + 31.0 + 30.0 + 0.2 * 29.0) / 3.2)
    assert np.isnan(worst_share_mean(np.zeros(0)))


@pytest.mark.parametrize("law", [stats.uniform(), stats.norm(3.0, 2.0), stats.expon()])
def test_worst_tenth_and_middle_half_are_those_of_known_distributions(law: Any) -> None:
    """Catches another level: of many quantiles the means over levels above 0.9, and between 0.25
    and 0.75."""
    levels = (np.arange(20_000) + 0.5) / 20_000
    values = np.random.default_rng(0).permutation(law.ppf(levels))
    above = law.expect(lambda x: x, lb=law.ppf(0.9), ub=law.ppf(1.0)) / 0.1
    between = law.expect(lambda x: x, lb=law.ppf(0.25), ub=law.ppf(0.75)) / 0.5
    assert worst_share_mean(values) == pytest.approx(above, rel=1e-3)
    assert interquartile_mean(values) == pytest.approx(between, rel=1e-3)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=40))
def test_the_worst_tenth_lies_between_mean_and_highest(values: list[float]) -> None:
    found = worst_share_mean(np.array(values))
    assert np.mean(values) - 1e-9 <= found <= max(values) + 1e-9


def test_a_robot_that_falls_is_worse_off_than_any_other() -> None:
    """Catches falls that are left out, which would flatter who falls on the difficult robots."""
    mine = episode_rows(records([1.0, None, 3.0, None, 2.0]))
    base = episode_rows(records([2.0, 2.0, None, None, 2.0]))
    found = share_better(mine, base, METRIC)
    assert found.value == pytest.approx((1.0 + 0.0 + 1.0 + 0.5 + 0.5) / 5.0)
    assert share_better(base, mine, METRIC).value == pytest.approx(1.0 - found.value)
    assert share_better(mine[::-1], base, METRIC) == found
    assert not share_better(mine, episode_rows(records([1.0], first=50)), METRIC).is_known
    without = [{**record, METRIC: float("nan")} for record in records([1.0])]
    assert (
        share_better(
            episode_rows(without + records([1.0], first=1)),
            episode_rows(records([2.0, 2.0])),
            METRIC,
        ).value
        == 1.0
    )


# Cells.


def test_rows_are_of_cells_that_draw_robots_against_base_and_first() -> None:
    """Catches a row of one robot under noise, the wrong opponent, and training seeds pooled as
    if they were robots."""
    base = cell("base", {"all": [4.0, 4.0, 4.0, 4.0, 8.0, None]}, "spread")
    learned = family([[1.0, 5.0, 3.0, 3.0, 9.0, 1.0], [1.0, 1.0, 1.0, 1.0, 1.0, None]], "spread")
    rows = robot_scores([base, cell("base", {"all": [1.0] * 6}, "nominal"), *learned])
    assert {row.scope for row in rows} == {"spread"}
    ours, theirs = (
        next(r for r in rows if r.policy == p and r.column.metric == METRIC)
        for p in ("learned", "base")
    )
    assert [found.value for found in theirs.scores] == pytest.approx([4.8, 4.0, 8.0])
    assert {found.over for found in theirs.scores} == {"6 robots"}
    assert (theirs.failed, theirs.episodes, theirs.better) == (1, 6, {})
    each = [np.array([1.0, 5.0, 3.0, 3.0, 9.0, 1.0]), np.ones(5)]
    middle = np.mean([interquartile_mean(values) for values in each])
    better = np.mean([4.0 / 6.0, 5.5 / 6.0])
    found = [ours.middle, ours.worst, ours.better["base"]]
    assert [own.value for own in found] == pytest.approx([middle, 5.0, better])
    assert {own.over for own in found} == {"2 training seeds and 6 robots"}
    assert (ours.failed, ours.episodes) == (1, 12)
    assert robot_scores([cell("base", {"all": [1.0] * 3}, "spread")]) == []


def test_file_and_tables_say_what_was_found(tmp_path: Path) -> None:
    """Catches columns in the wrong order or unit."""
    base = cell("base", {"all": [4e-3] * 9 + [14e-3]}, "spread")
    other = cell("[b]other", {"all": [2e-3] * 10}, "spread")
    rows = robot_scores([base, other])
    written = list(
        csv.DictReader(write_robots(rows, tmp_path / "robots.csv").open(encoding="utf-8"))
    )
    first = next(row for row in written if row["metric"] == METRIC)
    assert (first["policy"], first["failed"], first["episodes"], first["against"]) == (
        "base",
        "0",
        "10",
        "",
    )
    found = [float(first[name]) for name in ("mean", "interquartile_mean", "worst_tenth")]
    assert found == pytest.approx([5e-3, 4e-3, 14e-3])
    better = [
        row["better_share"]
        for row in written
        if row["metric"] == METRIC and row["against"] == "base"
    ]
    assert better == ["1.0"]
    table = robots_table(rows)
    shown = {head.title: cell for head, cell in zip(table.heads, table.rows[0].cells, strict=True)}
    assert shown["mean"].startswith("5.00 [4.00, ")
    assert shown["interquartile mean"].startswith("4.00 [4.00, ")
    assert shown["worst tenth"] == "14.00 [4.00, 14.00]"
    assert (shown["falls"], shown["95 % over"]) == ("0/10", "10 robots")
    console = Console(width=140, record=True)
    print_robots(rows, console)
    text = console.export_text()
    figures = ("5.00 [4.00, ", "4.00 [4.00, ", "14.00 [4.00, 14.00]")
    assert all(figure in text for figure in figures)
    assert "[b]other" in text


def test_both_reports_have_a_section_of_drawn_robots() -> None:
    """Catches a table that is computed and not shown, or shown where no robots are drawn."""
    for scenario, is_shown in (("spread", True), ("nominal", False)):
        cells = [
            cell("base", {"all": [4e-3] * 10}, scenario),
            cell("other", {"all": [2e-3] * 10}, scenario),
        ]
        with run_folder("x", {}, 0) as folder:
            robots = robot_scores(cells)
            files = write_report(Results("x", cells, changes(cells), folder, robots=robots))
        for file in files:
            text = file.read_text(encoding="utf-8")
            assert ("Drawn robots" in text) == is_shown
            assert ("base: 100 %" in text) == is_shown


def test_episodes_say_which_robot_was_drawn() -> None:
    """Catches the robot of another world or of the next episode, and columns where no robot is
    drawn from ranges."""
    walk = {"step_period": [0.3, 0.3, 0.3], "num_steps": 1}
    condition = Condition(
        env="walker", policy=PolicySpec(name="zero"), scenario="drawn", reference=walk, episodes=2
    )
    episodes = evaluate(condition, num_threads=1).episodes
    env: Any = make_vector_env(condition, 2)
    env.reset(seed=0)
    robots = [env.unwrapped.task.robot_record(world) for world in range(2)]
    assert [{name: episode[name] for name in robots[0]} for episode in episodes] == robots
    assert len({robot["robot_load_kg"] for robot in robots}) == 2
    assert robots[0]["robot_stiffness"] == pytest.approx(
        env.unwrapped.truth().stiffness[0].mean() / 1001.0
    )
    nominal: Any = make_vector_env(condition.replace(scenario="nominal"), 1)
    assert nominal.unwrapped.task.robot_record(0) == {}


# Ranges in configurations.


def test_a_configuration_names_ranges_for_training_and_evaluation() -> None:
    """Catches ranges that only one of both sees, and robots of evaluation that training meets."""
    config = TrainConfig(env="walker", scenarios=["drawn", "nominal"], ranges=OWN, worlds=4)
    (learned_from,) = training_worlds(config, config.shares, 1).unwrapped.envs  # type: ignore[attr-defined]
    evaluated: Any = make_vector_env(config.condition("drawn", config.base), 2, 1).unwrapped
    trained, nominal = learned_from.task._kinds
    (scored,) = evaluated.task._kinds
    for kind in (trained, scored):
        own = kind.config.scenario
        expected = TRAINING_RANGES.replace(load_kg=(0.0, 2.0))
        assert dict(own.intervals()) == dict(expected.intervals())
        assert own.delay_share == expected.delay_share
        assert max(robot.load_kg for robot in kind.bank) <= 2.0
    assert not set(trained.bank) & set(scored.bank)
    assert nominal.config.scenario == make_scenario("nominal")
    again = TrainConfig(**config.model_dump(mode="json"))
    assert (
        again.condition("drawn", "input").scenario_played
        == config.condition("drawn", "input").scenario_played
    )


def test_a_comparison_plays_its_ranges_and_keeps_those_of_held_out_robots() -> None:
    """Catches ranges that make the robots beyond them ordinary ones."""
    config = CompareConfig(
        name="x", env="walker", scenarios=["drawn", "drawn_beyond"], policies=["zero"], ranges=OWN
    )
    drawn, beyond = (make_scenario(condition.scenario_played) for condition in config.conditions())
    assert drawn.load_kg == (0.0, 2.0)
    assert beyond.mixture == make_scenario("drawn_beyond").mixture


def test_several_ranges_keep_combinations_out_of_training() -> None:
    """Catches loads on slopes among robots that a list of two ranges draws, and a list that
    loses one of its parts."""
    ranges = [{"load_kg": [0.0, 0.0]}, {"slope_rad": [0.0, 0.0]}]
    config = TrainConfig(env="walker", scenarios=["drawn"], ranges=ranges)
    bank = robot_bank(make_scenario(config.condition("drawn", "input").scenario_played), 1)
    assert not [robot for robot in bank if robot.load_kg > 0.0 and robot.slope_rad > 0.0]
    assert (
        sum(robot.load_kg > 0.0 for robot in bank)
        == sum(robot.slope_rad > 0.0 for robot in bank)
        == 128
    )
    assert TrainConfig(**config.model_dump(mode="json")).ranges == ranges


@pytest.mark.parametrize("kind", [TrainConfig, CompareConfig])
@pytest.mark.parametrize(
    ("given_", "message"),
    [
        (
            {"scenarios": ["nominal"], "ranges": OWN},
            "ranges need a scenario whose robots are drawn from them",
        ),
        ({"scenarios": ["drawn"], "ranges": {"load": [0, 1]}}, "load"),
        ({"scenarios": ["drawn"], "ranges": {"load_kg": [1, 0]}}, "lowest, highest"),
        ({"scenarios": ["drawn"], "ranges": [{}, {"load_kg": [1, 0]}]}, "lowest, highest"),
        ({"scenarios": ["drawn"], "ranges": 3}, "ranges"),
    ],
)
def test_ranges_that_do_nothing_are_refused(
    kind: Any, given_: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigurationError, match=message):
        kind(name="x", env="walker", **given_)


@pytest.mark.parametrize(
    ("trained", "played", "is_held_out"),
    list(
        zip(
            *zip(*itertools.product(({}, OWN), ({}, OWN)), strict=True),
            (False, True, True, False),
            strict=True,
        )
    ),
)
def test_other_ranges_than_those_of_training_are_held_out(
    monkeypatch: pytest.MonkeyPatch,
    trained: dict[str, Any],
    played: dict[str, Any],
    is_held_out: bool,
) -> None:
    """Catches a robot beyond the trained ranges under the name of the trained scenario."""
    known = Origin(("drawn",), None, (), (), (), trained)
    monkeypatch.setattr("train.evaluate.table.EpisodeTable.families", {"learned": known})
    cells = [cell("base", {"all": [1.0] * 4}, "drawn"), *family([[1.0] * 4], "drawn")]
    for e in cells:
        e.condition = e.condition.replace(ranges=played)
    row = next(row for row in changes(cells) if row.policy == "learned")
    assert any(mark.startswith(HELD_OUT) for mark in row.marks) == is_held_out


def test_a_condition_of_drawn_robots_is_random() -> None:
    """Catches one episode that stands for all robots."""
    condition = Condition(
        env="walker", policy=PolicySpec(name="input"), scenario="ideal+drawn", reference=3
    )
    assert not condition.environment.is_deterministic(condition.scenario, condition.reference)
    assert not condition.environment.differs_by_noise_alone(condition.scenario, condition.reference)
