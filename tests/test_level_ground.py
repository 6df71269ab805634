"""Attitude and wrenches as on level ground: closed forms, and the slope of the simulation."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.estimation.level_ground import TILT_RAD, VELOCITY_M_PER_S, GroundMemory, LevelGround
from baselines.estimation.model_error import BendingObserver
from elastic_env.core.signals import Array
from tests.ground_contact import zero_moment_point

PERIOD_S = 0.1


def walker(scenario: str, num_envs: int = 4) -> Any:
    """A walk that is only looked at while it stands."""
    return gymnasium.make_vec(
        "elastic_env/WalkInPlace-v0",
        num_envs=num_envs,
        vectorization_mode="vector_entry_point",
        num_threads=1,
        scenario=scenario,
        step_period=1.6,
        num_steps=1,
    )


def force(wrenches: Array) -> Array:
    """On both feet together, (num_envs, 12) to (num_envs, 3) [N]."""
    return wrenches[:, :3] + wrenches[:, 6:9]


def after_a_minute(ground: LevelGround, rows: Array) -> tuple[Array, GroundMemory]:
    """Values and memory for a robot that stands still."""
    values, memory = ground.observe(rows, ground.begin(len(rows)))
    for _ in range(600):
        values, memory = ground.observe(rows, memory)
    return values, memory


def _zmp(wrenches: Array, model: Any) -> Array:
    """Of feet that lie flat on their footholds, (num_envs, 12) to (num_envs, 2) [m]."""
    wrench = wrenches.reshape(-1, 2, 2, 3)
    return zero_moment_point(wrench[:, :, 0], wrench[:, :, 1], model.biped.ankles, 50.0)


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.02, 0.0), (0.0, -0.02), (0.015, 0.01)])
def test_tilted_ground_shows_what_level_ground_would(tilt: tuple[float, float]) -> None:
    """A robot that leans by itself, on ground that does: SciPy turns its weight about the center
    of mass."""
    model = walker("ideal").unwrapped.assumed_model
    ground = LevelGround(model, PERIOD_S)
    generator = np.random.default_rng(0)
    table = model.observation_table
    own = np.array([0.01, -0.02])
    level = generator.normal(0.0, 5.0, size=(1, 4, 3))
    level[:, [0, 2]] = [[0.0, 0.0, 300.0], [0.0, 0.0, 230.0]]
    theta = generator.normal(0.0, 0.2, size=(1, 12))
    com, ankles = model.biped.chains_above_feet.com_and_feet(theta)
    tilted = level.copy()
    for foot, ankle in enumerate(ankles[0]):
        upright = level[0, 2 * foot]
        leaning = Rotation.from_euler("xy", tilt).inv().apply(upright)
        over = np.array([0.0, 0.0, com[0, 2] - ankle[2]])
        tilted[0, 2 * foot : 2 * foot + 2] += [leaning - upright, np.cross(over, leaning - upright)]
    rows = np.zeros((1, len(table)))
    rows[:, table.group("encoder_angle")] = theta
    rows[:, table.group("imu_attitude")] = own
    rows[:, table.group("wrench")] = level.reshape(1, -1)
    bending = BendingObserver(model)
    share = np.array([300.0, 230.0]) / 530.0
    upright = share @ bending.expected_tilt(rows)[0]
    rows[:, table.group("imu_attitude")] += tilt
    rows[:, table.group("wrench")] = tilted.reshape(1, -1)
    rows[:, table.group("imu_attitude")] += (
        share @ bending.expected_tilt(rows)[0] - upright
    )  # it bends further
    values = after_a_minute(ground, rows)[0]
    np.testing.assert_allclose(values[0, :2], own, atol=1e-4)
    np.testing.assert_allclose(values[0, 2:], level.ravel(), atol=0.01)


def test_slope_of_the_simulation_is_taken_off() -> None:
    """Catches a sign, an axis, or left for right: a standing robot on one degree, in directions
    that are drawn."""
    seen = {}
    zmp = {}
    for scenario in ("ideal", "ideal+slope"):
        env = walker(scenario, num_envs=2)
        model = env.unwrapped.assumed_model
        ground = LevelGround(model, PERIOD_S)
        table = model.observation_table
        rows = env.reset(seed=5)[0]
        values, memory = after_a_minute(ground, rows)
        seen[scenario] = (
            values,
            memory.mean,
            rows[:, table.group("imu_attitude")],
            rows[:, table.group("wrench")],
        )
        zmp[scenario] = _zmp(values[:, 2:], model), _zmp(rows[:, table.group("wrench")], model)
    level, none, attitude, wrench = seen["ideal"]
    values, lean, tilted, leaning = seen["ideal+slope"]
    np.testing.assert_allclose(none, 0.0, atol=1e-3)
    np.testing.assert_allclose(np.hypot(*lean.T), np.radians(1.0), atol=1e-3)
    # the attitude follows the ground, and the springs bend further towards where it leans: neither
    # is the robot's own
    further = np.linalg.norm(tilted - attitude - lean, axis=1)
    assert further.min() > 4e-3
    assert (np.linalg.norm(values[:, :2] - level[:, :2], axis=1) < 0.65 * further).all()
    # about y, where both legs bend alike, what is left is the weight of the center of mass that the
    # bending moves
    ahead = np.abs(tilted - attitude - lean)[:, 1]
    assert (np.abs(values - level)[:, 1] < 0.45 * ahead).all()
    assert np.abs(force(leaning) - force(wrench)).max() > 5.0
    np.testing.assert_allclose(force(values[:, 2:]), force(level[:, 2:]), atol=0.5)
    # so does the center of mass: by millimetres, of a centimetre that it lies beside the feet
    # without bending
    ours, measured = (
        np.linalg.norm(zmp["ideal+slope"][i] - zmp["ideal"][i], axis=1) for i in (0, 1)
    )
    assert measured.min() > 8e-3
    assert ours.max() < 0.5 * measured.min()


def test_the_mean_forgets_and_waits_for_feet_that_are_loaded() -> None:
    """The mean of the measurements, then a time constant; nothing while both feet hang, or from
    the first velocity."""
    model = walker("ideal").unwrapped.assumed_model
    ground = LevelGround(model, PERIOD_S, mean_s=1.0)
    wrench = model.observation_table.group("wrench")

    def mean(x: float, z: float, memory: GroundMemory) -> GroundMemory:
        rows = np.zeros((1, len(model.observation_table)))
        rows[:, wrench] = [x, 0.0, z, 0.0, 0.0, 0.0] * 2
        return ground.observe(rows, memory)[1]

    memory = mean(5.0, 300.0, ground.begin(1))
    np.testing.assert_array_equal(np.hstack([part[0] for part in memory]), 0.0)
    hanging = mean(5.0, 10.0, memory)
    np.testing.assert_array_equal(np.hstack([part[0] for part in hanging]), 0.0)
    for number, x in enumerate((3.0, 6.0, 0.0), start=1):
        memory = mean(x, 300.0, memory)
        assert memory.number[0] == number
        np.testing.assert_allclose(
            memory.mean[0], [0.0, -np.mean([3.0, 6.0, 0.0][:number]) / 300.0], atol=1e-15
        )
    for _ in range(200):
        memory = mean(0.0, 300.0, memory)
    before = mean(3.0, 300.0, memory).mean[0, 1]
    np.testing.assert_allclose(before, -(1.0 - np.exp(-0.1)) * 0.01, rtol=1e-6)


def test_acceleration_and_certainty_have_their_closed_forms() -> None:
    """Catches a sign, a factor or an axis of the acceleration, and a first estimate that is
    believed at once."""
    model = walker("ideal").unwrapped.assumed_model
    ground = LevelGround(model, PERIOD_S)
    table = model.observation_table
    chains = model.biped.chains_above_feet
    rates = np.zeros((2, 6))
    rates[:, 1] = 0.3  # both hips roll: the body goes sideways
    rates[:, 2] = 0.2  # and pitch
    ahead, behind = (chains.com_and_feet(step * rates.reshape(1, 12)) for step in (1e-4, -1e-4))
    velocity = ((ahead[0] - ahead[1][:, 0]) - (behind[0] - behind[1][:, 0]))[0, :2] / 2e-4
    rows = np.zeros((2, len(table)))
    rows[1, table.group("encoder_rate")] = rates.ravel()
    direction = velocity / (9.81 * PERIOD_S)
    assert np.abs(direction).min() > 0.01
    rows[:, table.group("wrench")] = [
        300.0 * direction[0],
        300.0 * direction[1],
        300.0,
        0.0,
        0.0,
        0.0,
    ] * 2
    _, memory = ground.observe(rows[:1], ground.begin(1))
    np.testing.assert_allclose(ground.observe(rows[1:], memory)[1].mean[0], 0.0, atol=1e-5)

    tilt = np.array(
        [direction[1], -direction[0]]
    )  # the same force on a robot that stands: the ground leans
    for number in range(1, 20):
        lean, _, memory = ground.upright(rows[:1], memory)
        certainty = 1.0 / (1.0 + (VELOCITY_M_PER_S / (9.81 * number * PERIOD_S * TILT_RAD)) ** 2)
        np.testing.assert_allclose(lean[0], certainty * tilt, rtol=1e-3)


def test_what_accelerates_is_no_slope() -> None:
    """Catches a sway that is taken for a tilt of the ground: in a walk the tilt of level ground
    stays near zero."""
    env = walker("ideal", num_envs=1)
    model = env.unwrapped.assumed_model
    base = baselines.make("input_output", env)
    ground = LevelGround(model, 25 * model.control_period_s)
    observation, _ = env.reset(seed=5)
    state = None
    memory = ground.begin(1)
    tilts = []
    leans = []
    for step in range(env.unwrapped.task.num_steps):
        if step % 25 == 0:
            values, memory = ground.observe(observation, memory)
            tilts.append(
                observation[:, model.observation_table.group("imu_attitude")] - values[:, :2]
            )
            total = force(observation[:, model.observation_table.group("wrench")])
            leans.append(total[:, :2] / total[:, 2:])
        action, state = base.predict(observation, state, np.array([step == 0]))
        observation = env.step(action)[0]
    assert np.abs(leans).max() > 0.03
    assert np.abs(tilts).max() < 0.006
