"""Bootstrap intervals over training seeds and robots: against scipy's, and against the truth of
known distributions."""

from typing import Any

import numpy as np
import pytest
from scipy import stats

from elastic_env.core.signals import Array
from tests.cells import METRIC, cell, family, over_seeds
from train.evaluate import statistics
from train.evaluate.changes import changes
from train.evaluate.scores import over_cells, per_robot, score
from train.evaluate.statistics import (
    CONFIDENCE,
    RESAMPLES,
    Counts,
    Estimate,
    Part,
    estimate,
    interquartile_mean,
    mean_of_part,
    mean_of_robots,
    middle,
    middle_half,
    worst_share,
)
from train.evaluate.table import EpisodeTable
from train.report.score_tables import scores_table

BOOTSTRAP: dict[str, Any] = {
    "n_resamples": RESAMPLES,
    "confidence_level": CONFIDENCE,
    "method": "percentile",
    "vectorized": True,
}
COVERAGES = 200


@pytest.fixture(autouse=True)
def _folders_of_residuals_elsewhere(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Families are folders in the working directory."""
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("number", [2, 5, 10])
def test_an_interval_over_seeds_is_that_of_scipy(number: int) -> None:
    """Catches another resampling, level or percentile: one level is scipy's, to the bit."""
    values = np.sort(np.random.default_rng(number).normal(size=number))
    found = over_seeds(values)
    rng = np.random.default_rng(0)
    known = stats.bootstrap((values,), interquartile_mean, rng=rng, **BOOTSTRAP)
    assert (found.low, found.high) == tuple(known.confidence_interval)
    assert (found.seeds, found.robots, found.over) == (number, 0, f"{number} training seeds")


def test_an_interval_over_robots_is_that_of_scipy() -> None:
    """Catches robots that are resampled otherwise than seeds: a mean over robots alone has scipy's
    interval, but for the resamples that were drawn."""
    values = np.random.default_rng(1).exponential(size=40)
    found = over_cells([values[None]])
    known = stats.bootstrap((values,), np.mean, rng=np.random.default_rng(9), **BOOTSTRAP)
    assert found.value == pytest.approx(values.mean())
    np.testing.assert_allclose(found.ends, known.confidence_interval, rtol=0.02)
    assert (found.seeds, found.robots, found.over) == (0, 40, "40 robots")


def worst_tenth_mean(values: Array) -> float:
    """Mean of the highest tenth, of which the value at the edge counts in part."""
    counted = max(0.1 * len(values), 1.0)
    weights = np.clip(counted - np.arange(len(values)), 0.0, 1.0)
    return float(weights @ np.sort(values)[::-1] / counted)


def test_means_of_resamples_are_those_of_the_repeated_robots() -> None:
    """Catches weights of other robots, figures that are missing, and another middle half or worst
    tenth than of the sample itself."""
    rng = np.random.default_rng(2)
    values = rng.normal(size=(3, 13))
    values[1, [0, 5]] = np.nan
    drawn = rng.integers(0, 13, (20, 13))
    counts = np.array([np.bincount(own, minlength=13) for own in drawn], dtype=np.float64)
    for mean, known in (
        (mean_of_robots, np.mean),
        (mean_of_part(middle), np.median),
        (mean_of_part(middle_half), interquartile_mean),
        (mean_of_part(worst_share), worst_tenth_mean),
    ):
        found = mean(values, counts)
        assert found.shape == (20, 3)
        for row, robots in enumerate(drawn):
            for seed, own in enumerate(values[:, robots]):
                expected = known(own[np.isfinite(own)])
                assert found[row, seed] == pytest.approx(expected, rel=1e-12)
    nothing = np.full((1, 13), np.nan)
    assert np.isnan(mean_of_robots(nothing, counts)).all()
    assert np.isnan(mean_of_part(middle_half)(nothing, counts)).all()


def covered(draw: Any, truth: float, repetitions: int = COVERAGES) -> float:
    """Share of intervals that hold the truth; `draw` gives the robots of the cells of all seeds."""
    rng = np.random.default_rng(4)
    found = [over_cells(draw(rng)) for _ in range(repetitions)]
    return float(np.mean([low <= truth <= high for low, high in (own.ends for own in found)]))


def test_intervals_over_robots_hold_the_truth_in_95_percent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Catches an interval that is too narrow or too wide. Of 200 intervals at 95 % less than 90 or
    more than 98.5 % hold the truth once in a thousand cases."""
    monkeypatch.setattr(statistics, "RESAMPLES", 499)
    statistics._resamples.cache_clear()

    def robots(rng: np.random.Generator) -> list[Array]:
        return [rng.normal(3.0, 1.0, (1, 64))]

    assert 0.90 <= covered(robots, 3.0) <= 0.985
    statistics._resamples.cache_clear()


def test_intervals_over_seeds_and_robots_hold_the_truth_in_95_percent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Catches robots that are drawn anew for every seed: what all seeds share of a robot would then
    average out, and far less than 95 % would hold the truth; and an interval over seeds alone."""
    monkeypatch.setattr(statistics, "RESAMPLES", 499)
    statistics._resamples.cache_clear()

    def crossed(rng: np.random.Generator) -> list[Array]:
        seeds = rng.normal(0.0, 0.3, (10, 1))
        return [3.0 + seeds + rng.normal(size=(1, 32)) + rng.normal(0.0, 0.2, (10, 32))]

    assert 0.90 <= covered(crossed, 3.0) <= 0.985

    def over_seeds_alone(rng: np.random.Generator) -> list[Array]:
        return [crossed(rng)[0].mean(axis=1, keepdims=True)]

    assert covered(over_seeds_alone, 3.0) < 0.8
    statistics._resamples.cache_clear()


def test_the_order_of_seeds_makes_no_difference_to_an_interval() -> None:
    """Catches an interval that changes with the order of the folders."""
    values = np.random.default_rng(5).normal(size=(6, 12))
    found, other = (over_cells([own]) for own in (values, values[::-1]))
    figures = [(own.value, *own.ends) for own in (found, other)]
    np.testing.assert_allclose(*figures, rtol=1e-12)


def test_every_cell_draws_its_own_robots() -> None:
    """Catches one draw of robots for all cells: of two cells whose robots are mirror images the
    mean would not vary."""
    values = np.random.default_rng(6).normal(size=(1, 30))
    found = over_cells([values, -values])
    alone = over_cells([values])
    assert found.value == pytest.approx(0.0, abs=1e-12)
    width, single = (own.ends[1] - own.ends[0] for own in (found, alone))
    assert width == pytest.approx(single / np.sqrt(2.0), rel=0.05)
    assert found.over == "60 robots"


@pytest.mark.parametrize("part", [middle, middle_half, worst_share])
def test_a_resample_of_failures_alone_has_no_figure(part: Part) -> None:
    """Catches an interval down to zero, because a resample drew none that has a figure."""
    values = np.array([[2.0, np.nan, 4.0]])
    found = mean_of_part(part)(values, np.array([[0.0, 3.0, 0.0], [3.0, 0.0, 0.0]]))
    assert np.isnan(found[0, 0])
    assert found[1, 0] == 2.0


def test_many_episodes_are_resampled_less_often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches resamples of a hundred thousand episodes that fill the memory."""
    monkeypatch.setattr(statistics, "MOST_DRAWS", 41_000)
    asked = []
    found = estimate(lambda counts: asked.append(counts[0].shape) or np.ones((1, 1)), [41])
    assert asked == [(1, 41), (1000, 41)]
    assert found.ends == (1.0, 1.0)


def test_one_robot_and_one_seed_have_no_interval() -> None:
    """Catches an interval over noise."""
    assert over_cells([np.array([[2.0]])]) == Estimate(2.0)
    assert not estimate(lambda _: np.array([[1.0, np.nan]]), ()).has_interval


def test_a_figure_of_resamples_without_any_pair_is_left_out() -> None:
    """Catches an interval that is lost by a resample which draws only robots that fell."""
    values = np.array([[1.0, np.nan, np.nan]])
    found = over_cells([values])
    assert (found.value, found.low, found.high) == (1.0, 1.0, 1.0)


# Tables.


def test_the_robot_is_the_unit_and_not_the_episode() -> None:
    """Catches episodes of one robot that count as several robots."""
    own = cell("base", {"all": [1.0, 3.0, 5.0, 5.0]}, "drawn")
    for episode, load in zip(own.episodes, (1.0, 1.0, 2.0, 3.0), strict=True):
        episode["robot_load_kg"] = load
    table = EpisodeTable([own])
    (values,) = per_robot(table.rows, METRIC)
    np.testing.assert_array_equal(values, [[2.0, 5.0, 5.0]])
    column = table.environment.judged[0]
    found = score(table.rows, column)
    assert found.value == pytest.approx(4.0)
    assert found.over == "3 robots"


def test_one_robot_under_noise_is_one_unit() -> None:
    """Catches an interval over episodes that differ by noise alone."""
    table = EpisodeTable([cell("base", {"all": [1.0, 3.0, 5.0]}, "soft")])
    assert score(table.rows, table.environment.judged[0]) == Estimate(3.0)


def test_a_policy_that_was_not_trained_is_compared_over_robots() -> None:
    """Catches a rival without an interval, and pairs that are torn: the change of a policy that is
    a fifth better with every robot has no width."""
    robots = np.random.default_rng(7).uniform(1.0, 9.0, 16)
    base = cell("base", {"all": robots.tolist()}, "spread")
    other = cell("other", {"all": (0.8 * robots).tolist()}, "spread")
    row = next(row for row in changes([base, other]) if row.policy == "other")
    np.testing.assert_allclose((row.relative.value, *row.relative.ends), -0.2)
    assert row.relative.over == "16 robots"
    assert row.verdict == "lower"
    assert (row.improvement.value, *row.improvement.ends) == (1.0, 1.0, 1.0)
    assert "20 % lower" in row.sentence
    assert score(EpisodeTable([base]).rows, row.column).ends[0] < robots.mean()


def test_a_residual_is_compared_over_seeds_and_robots() -> None:
    """Catches one of the two that is left out: robots that react differently widen the interval."""
    rng = np.random.default_rng(8)
    base = cell("base", {"all": [4.0] * 12}, "spread")
    robots = rng.uniform(1.0, 4.0, 12)
    seeds = [(robots + shift).tolist() for shift in rng.uniform(-0.1, 0.1, 5)]
    row = next(row for row in changes([base, *family(seeds, "spread")]) if row.is_family)
    assert row.relative.over == "5 training seeds and 12 robots"
    alone = over_seeds(row.per_seed)
    assert row.relative.value == pytest.approx(alone.value)
    assert np.ptp(row.relative.ends) > 3.0 * np.ptp(alone.ends)


def test_figures_are_asked_for_all_resamples_at_once() -> None:
    """Catches resamples of another number than the seeds are drawn for."""
    asked: list[int] = []

    def figures(counts: Counts) -> Array:
        asked.append(len(counts[0]))
        return mean_of_robots(np.arange(4.0)[None], counts[0])

    estimate(figures, [4])
    assert asked == [1, RESAMPLES]


def test_without_training_episodes_of_one_robot_have_an_interval() -> None:
    """Catches one over single episodes in the place of pairs, one of a scenario in which nothing
    is random, and one of a residual, whose seeds it would hide."""
    theirs = np.array([2.0, 9.0, 4.0, 3.0, 8.0, 5.0])
    gain = np.array([0.5, 0.6, 0.4, 0.7, 0.5, 0.3])
    played = [
        cell("base", {"all": list(theirs)}, "payload"),
        cell("base", {"all": [2.0]}, "ideal"),
        cell("mine", {"all": list(gain * theirs)}, "payload"),
        cell("mine", {"all": [1.0]}, "ideal"),
    ]
    rows = {row.scope: row for row in changes(played) if row.column.metric == METRIC}
    found = rows["payload"].relative
    assert found.value == pytest.approx((gain @ theirs) / theirs.sum() - 1.0)
    known = stats.bootstrap(
        (gain * theirs, theirs),
        lambda mine, base, axis=-1: mine.mean(axis=axis) / base.mean(axis=axis) - 1.0,
        paired=True,
        rng=np.random.default_rng(9),
        **BOOTSTRAP,
    )
    np.testing.assert_allclose(found.ends, known.confidence_interval, rtol=0.03)
    assert (found.over, found.robots, rows["payload"].verdict) == ("6 episodes", 0, "lower")
    assert not rows["ideal"].relative.has_interval
    assert rows["ideal"].verdict == "unclear"


def test_drawn_robots_and_episodes_of_one_robot_are_told_apart() -> None:
    """Catches episodes that are called robots in a group that has both."""
    played = [
        cell(title, {"all": [own, own + 1.0, own + 3.0]}, scenario)
        for title, own in (("base", 4.0), ("mine", 2.0))
        for scenario in ("drawn", "payload")
    ]
    (row, *_) = [r for r in changes(played, {"both": ["drawn", "payload"]}) if r.is_group]
    assert row.relative.over == "3 robots and 3 episodes"
    assert row.verdict == "lower"


def test_scores_of_a_policy_alone_have_intervals_over_its_episodes() -> None:
    """Catches a score that nobody compares without an interval, and one of equal episodes."""
    played = [
        cell("alone", {"all": [2.0, 4.0, 9.0]}, "payload"),
        cell("alone", {"all": [2.0, 2.0]}, "ideal"),
        cell("alone", {"all": [2.0, 4.0, 9.0]}, "drawn"),
    ]
    table = EpisodeTable(played)
    columns = [column for column in table.environment.judged if column.metric == METRIC]
    shown = {row.cells[1]: row.cells[3:] for row in scores_table(table, columns).rows}
    assert shown["payload"][1:] == ("3 episodes",)
    assert shown["drawn"][1:] == ("3 robots",)
    assert shown["ideal"][1:] == ("-",)
    assert shown["payload"][0] == shown["drawn"][0]
    assert "[" in str(shown["payload"][0])
    assert "[" not in str(shown["ideal"][0])
