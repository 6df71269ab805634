"""Running statistics against NumPy on the recorded samples."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from elastic_env.core.signals import Array, BoolArray
from elastic_env.world.metrics import EpisodeMetrics, Metric, Statistic

STATISTICS: dict[Statistic, Callable[[Array], Any]] = {
    "rms": lambda x: np.sqrt(np.mean(x**2)),
    "mean": np.mean,
    "min": np.min,
    "max": np.max,
    "peak": lambda x: np.abs(x).max(),
    "last": lambda x: x[-1],
    "count": len,
}
METRICS = [Metric(f"x_{s}_rad", "x", s) for s in STATISTICS] + [
    Metric("y_rms_rad", "y", "rms", over="all"),
    Metric("x_all_mean_rad", "x", "mean", over="all"),
]

logs = st.tuples(st.integers(1, 12), st.integers(1, 4)).flatmap(
    lambda shape: st.tuples(
        hnp.arrays(np.float64, shape, elements=st.floats(-100.0, 100.0, allow_subnormal=False)),
        hnp.arrays(np.bool_, shape),
    )
)


def masks(scored: Sequence[bool] | BoolArray) -> dict[str, BoolArray]:
    """Masks of a step."""
    return {"scored": np.array(scored, dtype=bool), "all": np.ones(len(scored), dtype=bool)}


def one_by_one(values: Array, sampled: BoolArray) -> EpisodeMetrics:
    """Every statistic of a log, (steps, worlds), whose steps are taken one by one."""
    metrics = EpisodeMetrics([Metric(s, "x", s) for s in STATISTICS], values.shape[1])
    for row, mask in zip(values, sampled, strict=True):
        metrics.update({"x": row}, {"scored": mask})
    return metrics


@given(log=logs)
def test_running_statistics_are_those_of_the_samples(log: tuple[Array, BoolArray]) -> None:
    """Catches a statistic under the wrong name, samples of other worlds, and zero where nothing
    was sampled."""
    values, sampled = log
    results = one_by_one(values, sampled).values()
    for name, function in STATISTICS.items():
        for world, result in enumerate(results[name]):
            chosen = values[sampled[:, world], world]
            expected = function(chosen) if len(chosen) or name == "count" else np.nan
            np.testing.assert_allclose(result, expected, rtol=1e-12, atol=1e-12, err_msg=name)


def test_nan_is_forgotten_by_the_last_value_alone() -> None:
    """Catches a minimum that steps over a nan, and a nan outside of the mask that counts."""
    values = np.array([[2.0, 2.0], [np.nan, np.nan], [1.0, 1.0]])
    sampled = np.array([[True, True], [True, False], [True, True]])
    found = one_by_one(values, sampled).values()
    for name in ("rms", "mean", "min", "max", "peak"):
        assert np.isnan(found[name][0]), name
        assert np.isfinite(found[name][1]), name
    np.testing.assert_array_equal(found["last"], [1.0, 1.0])
    np.testing.assert_array_equal(found["count"], [3.0, 2.0])


def test_scored_and_all_steps_are_kept_apart() -> None:
    """Catches a metric of all steps that leaves out the standing, and one of scored steps that
    does not."""
    metrics = EpisodeMetrics(METRICS, 1)
    for k, scored in enumerate([False, True, True, False]):
        metrics.update({"x": np.array([float(k)]), "y": np.array([-2.0 * k])}, masks([scored]))
    values = {name: value[0] for name, value in metrics.values().items()}
    assert list(values) == [metric.name for metric in METRICS]
    assert (values["x_mean_rad"], values["x_min_rad"], values["x_max_rad"]) == (1.5, 1.0, 2.0)
    assert values["x_all_mean_rad"] == 1.5
    assert values["y_rms_rad"] == pytest.approx(np.sqrt((0 + 4 + 16 + 36) / 4))


def test_an_episode_begins_without_the_samples_of_the_last_one() -> None:
    """Catches a restart that forgets only the sums, or that forgets the other worlds too."""
    metrics = EpisodeMetrics(METRICS, 2)
    everyone = np.ones(2, dtype=bool)
    metrics.update({"x": np.array([-7.0, -7.0]), "y": np.zeros(2)}, masks(everyone))
    metrics.restart(np.array([True, False]))
    assert np.isnan(metrics.values()["x_peak_rad"][0])
    metrics.update({"x": np.array([3.0, 3.0]), "y": np.zeros(2)}, masks(everyone))
    values = metrics.values()
    np.testing.assert_array_equal(values["x_peak_rad"], [3.0, 7.0])
    np.testing.assert_array_equal(values["x_min_rad"], [3.0, -7.0])
    np.testing.assert_array_equal(values["x_mean_rad"], [3.0, -2.0])
    np.testing.assert_allclose(values["x_rms_rad"], [3.0, np.sqrt((49 + 9) / 2)], rtol=1e-15)


def test_values_do_not_share_memory_with_what_comes_later() -> None:
    """Catches metrics of an ended episode that change while the next one runs."""
    metrics = EpisodeMetrics(METRICS, 1)
    metrics.update({"x": np.ones(1), "y": np.ones(1)}, masks([True]))
    values = metrics.values()
    metrics.update({"x": np.full(1, 9.0), "y": np.ones(1)}, masks([True]))
    assert all(value[0] == 1.0 for value in values.values())


@given(log=logs, split=st.integers(0, 12))
def test_how_many_steps_are_taken_at_once_does_not_matter(
    log: tuple[Array, BoolArray], split: int
) -> None:
    """Catches sums that depend on the grouping of steps, and so on when other worlds end: equal
    to the last bit."""
    values, sampled = log
    expected = one_by_one(values, sampled).values()
    grouped = EpisodeMetrics([Metric(s, "x", s) for s in STATISTICS], values.shape[1])
    for part in (slice(None, split), slice(split, None)):
        grouped.update({"x": values[part]}, {"scored": sampled[part]})
    for name, value in grouped.values().items():
        np.testing.assert_array_equal(value, expected[name], err_msg=name)
