"""Attitude and wrenches as on level ground: closed forms, and the slope of the simulation."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import elastic_env  # noqa: F401  registers the environments
from baselines.ground_level import GroundLevel
from elastic_env.signals import Array

PERIOD_S = 0.1


def walker(scenario: str, num_envs: int = 4) -> Any:
    """A walk that is only looked at while it stands."""
    return gymnasium.make_vec(
        "elastic_env/WalkInPlace-v0", num_envs=num_envs, vectorization_mode="vector_entry_point", num_threads=1,
        scenario=scenario, step_period=1.6, num_steps=1,
    )  # fmt: skip


def force(wrenches: Array) -> Array:
    """On both feet together, (num_envs, 12) to (num_envs, 3) [N]."""
    return wrenches[:, :3] + wrenches[:, 6:9]


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.02, 0.0), (0.0, -0.02), (0.015, 0.01)])
def test_tilted_ground_shows_what_level_ground_would(tilt: tuple[float, float]) -> None:
    """A robot that leans by itself, on ground that does: SciPy turns what its sensors show."""
    model = walker("ideal").unwrapped.assumed_model
    ground, generator = GroundLevel(model, PERIOD_S), np.random.default_rng(0)
    table, own = model.observation_table, np.array([0.01, -0.02])
    level = generator.normal(0.0, 5.0, size=(1, 4, 3))
    level[:, [0, 2]] = [[0.0, 0.0, 300.0], [0.0, 0.0, 230.0]]
    rows = np.zeros((1, len(table)))
    rows[:, table.group("imu_attitude")] = own + tilt
    rows[:, table.group("wrench")] = Rotation.from_euler("xy", tilt).inv().apply(level[0]).reshape(1, -1)
    values, _ = ground.observe(rows, ground.begin(1))
    np.testing.assert_allclose(values[0, :2], own, atol=1e-5)
    np.testing.assert_allclose(values[0, 2:], level.ravel(), atol=0.01)


def test_slope_of_the_simulation_is_taken_off() -> None:
    """Catches a sign, an axis, or left for right: a standing robot on one degree, in directions that are drawn."""
    seen = {}
    for scenario in ("ideal", "ideal+slope"):
        env = walker(scenario)
        model = env.unwrapped.assumed_model
        ground, table = GroundLevel(model, PERIOD_S), model.observation_table
        rows = env.reset(seed=5)[0]
        values, memory = ground.observe(rows, ground.begin(4))
        seen[scenario] = values, memory[:, 1:], rows[:, table.group("imu_attitude")], rows[:, table.group("wrench")]
    (level, none, attitude, wrench), (values, lean, tilted, leaning) = seen["ideal"], seen["ideal+slope"]
    np.testing.assert_allclose(none, 0.0, atol=1e-3)
    np.testing.assert_allclose(np.hypot(*lean.T), np.radians(1.0), atol=1e-3)
    # the attitude follows the ground, and bends a little more towards where it leans
    np.testing.assert_allclose(tilted - attitude, lean, atol=0.6 * np.radians(1.0))
    assert np.abs(force(leaning) - force(wrench)).max() > 5.0
    np.testing.assert_allclose(force(values[:, 2:]), force(level[:, 2:]), atol=0.5)


def test_the_mean_forgets_and_waits_for_feet_that_are_loaded() -> None:
    """The mean of the first measurements, then a time constant; nothing while both feet hang."""
    model = walker("ideal").unwrapped.assumed_model
    ground, wrench = GroundLevel(model, PERIOD_S, mean_s=1.0), model.observation_table.group("wrench")

    def lean(x: float, z: float, memory: Array) -> Array:
        rows = np.zeros((1, len(model.observation_table)))
        rows[:, wrench] = [x, 0.0, z, 0.0, 0.0, 0.0] * 2
        return ground.observe(rows, memory)[1]

    memory = lean(5.0, 10.0, ground.begin(1))
    np.testing.assert_array_equal(memory, ground.begin(1))
    for number, x in enumerate((3.0, 6.0, 0.0), start=1):
        memory = lean(x, 300.0, memory)
        np.testing.assert_allclose(memory[0], [number, 0.0, -np.mean([3.0, 6.0, 0.0][:number]) / 300.0], atol=1e-15)
    for _ in range(200):
        memory = lean(0.0, 300.0, memory)
    before = lean(3.0, 300.0, memory)[0, 2]
    np.testing.assert_allclose(before, -(1.0 - np.exp(-0.1)) * 0.01, rtol=1e-6)
