"""Force-torque sensors of the feet that lie, and a floor that lets them slide."""

from typing import Any

import numpy as np
import pytest

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.robots.testbed.environment import make as make_testbed
from elastic_env.robots.thormang.config import robot_bank
from elastic_env.robots.thormang.environment import make_vector as make_walk_vector
from elastic_env.world.foot_sensors import cross_talk_matrix
from elastic_env.world.robot_ranges import FOOT_ERRORS, RobotRanges, draw_robots
from elastic_env.world.scenario import GROUNDS, TRAINING_RANGES, Scenario, make_scenario
from train.evaluate.conditions import Condition, PolicySpec

SHORT: dict[str, Any] = {"step_period": [0.2, 0.3, 0.2], "num_steps": 1}
PERIOD_S = 0.004
FOOT_SCENARIO = make_scenario("foot_sensors")


def ideal(**changes: Any) -> Scenario:
    """A scenario without noise."""
    return GROUNDS["ideal"].replace(**changes)


def walkers(scenario: str | Scenario, num_envs: int = 2, **options: Any) -> Any:
    """A vector environment of a short walk."""
    return make_walk_vector(num_envs=num_envs, num_threads=1, **SHORT, scenario=scenario, **options)


def errors_of(env: Any, steps: int, seed: int = 0, **options: Any) -> tuple[Array, Array]:
    """Shown less true wrenches, and true ones, (steps + 1, worlds, 2, 6), from the reset on."""
    table = env.unwrapped.task.observation_table
    columns = table.group("wrench")
    offsets = np.random.default_rng(9).uniform(-0.02, 0.02, (steps, 1, 12)).astype(np.float32)
    observed, _ = env.reset(seed=seed, **options)
    shown = []
    true = []
    for step in range(steps + 1):
        if step > 0:
            observed, *_ = env.step(np.repeat(offsets[step - 1], env.num_envs, axis=0))
        shown.append(observed[:, columns].reshape(-1, 2, 6))
        true.append(env.unwrapped.task.sample().worlds["truth"]["wrench"].reshape(-1, 2, 6).copy())
    return np.array(shown) - np.array(true), np.array(true)


def test_cross_talk_is_a_share_of_the_full_scale_of_each_axis() -> None:
    """Catches shares of newtons in newton meters: 1 % of every pair of axes is 1 % of what the
    other axis can show."""
    ranges = np.repeat([200.0, 8.0], 3)
    matrix = cross_talk_matrix(np.full(30, 0.01))
    np.testing.assert_array_equal(matrix.diagonal(), 0.0)
    for axis, full in enumerate(ranges):
        shown = matrix @ (full * np.eye(6)[axis])
        others = np.arange(6) != axis
        np.testing.assert_allclose(shown[others], 0.01 * ranges[others], rtol=1e-12)


def test_a_bias_stays_for_an_episode_and_is_of_every_foot_and_axis_its_own() -> None:
    """Catches a bias that is drawn at every step, or once for all axes, feet or worlds."""
    env = walkers(ideal(force_bias_n=(-5.0, 5.0), moment_bias_nm=(-0.15, 0.15)))
    errors, _ = errors_of(env, 20)
    np.testing.assert_allclose(errors, np.broadcast_to(errors[:1], errors.shape), atol=1e-12)
    assert np.abs(errors[..., :3]).max() <= 5.0
    assert np.abs(errors[..., 3:]).max() <= 0.15
    assert len(np.unique(errors[0])) == errors[0].size
    others, _ = errors_of(env, 1, seed=1)
    assert not np.isclose(errors[0], others[0]).any()


def test_biases_fill_their_width_evenly() -> None:
    """Catches a width for a half-width."""
    env = walkers(ideal(force_bias_n=(-5.0, 5.0)), num_envs=64)
    errors, _ = errors_of(env, 0)
    drawn = errors[0, :, :, :3].ravel()
    assert drawn.std() == pytest.approx(5.0 / np.sqrt(3.0), rel=0.1)
    assert drawn.min() < -4.7
    assert drawn.max() > 4.7
    np.testing.assert_array_equal(errors[0, :, :, 3:], 0.0)


def test_a_drift_begins_at_nothing_and_grows_with_time() -> None:
    """Catches a drift per control step, and one that begins before the episode."""
    env = walkers(ideal(force_drift_n_s=(-2.0, 2.0), moment_drift_nm_s=(-0.1, 0.1)))
    errors, _ = errors_of(env, 30)
    np.testing.assert_array_equal(errors[0], 0.0)
    seconds = PERIOD_S * np.arange(31)
    rate = errors[-1] / seconds[-1]
    expected = seconds[:, None, None, None] * rate
    np.testing.assert_allclose(errors, expected, atol=1e-12)
    assert 1.0 < np.abs(rate[..., :3]).max() <= 2.0
    assert 0.05 < np.abs(rate[..., 3:]).max() <= 0.1


def test_cross_talk_follows_the_true_wrench() -> None:
    """Catches an axis that talks to itself, and a measured wrench in the place of the true one: the
    matrix found by regression is one of cross-talk."""
    env = walkers(ideal(cross_talk=(-0.01, 0.01)), num_envs=1)
    errors, true = errors_of(env, 60)
    for foot in range(2):
        found = np.linalg.lstsq(true[:, 0, foot], errors[:, 0, foot], rcond=None)[0].T
        np.testing.assert_allclose(found @ true[-1, 0, foot], errors[-1, 0, foot], atol=1e-9)
        np.testing.assert_allclose(found.diagonal(), 0.0, atol=1e-6)
        ranges = np.repeat([200.0, 8.0], 3)
        shares = found / ranges[:, None] * ranges
        assert 0.005 < np.abs(shares).max() <= 0.01 + 1e-6


def test_errors_of_the_feet_change_nothing_else() -> None:
    """Catches a draw between those of before: the robot, its noise and its other sensors are the
    same with errors of the feet and without."""
    seen = []
    exact: dict[str, Any] = dict.fromkeys(FOOT_ERRORS, 0.0)
    for changes in (exact, {}):
        scenario = make_scenario("sensor").replace(**changes)
        env = walkers(scenario, 1, sensors=["link_encoder", "joint_torque"])
        first, _ = env.reset(seed=3)
        rows = [env.step(np.zeros((1, 12), np.float32))[0] for _ in range(5)]
        again, _ = env.reset()
        seen.append(np.array([first, *rows, again]))
    columns = env.unwrapped.task.observation_table.group("wrench")
    assert not np.isclose(seen[0][..., columns], seen[1][..., columns]).any(axis=(0, 1)).all()
    for rows in seen:
        rows[..., columns] = 0.0
    np.testing.assert_array_equal(*seen)


def test_a_robot_keeps_its_biases_in_all_its_trials() -> None:
    """Catches sensors that are other ones as soon as a robot walks again."""
    env = walkers(ideal(force_bias_n=(-5.0, 5.0)))
    first, _ = errors_of(env, 0, seed=5)
    again, _ = errors_of(env, 0, seed=8, options={"robot_seed": [5, 6]})
    np.testing.assert_allclose(first, again, atol=1e-12)


def test_drawn_robots_have_feet_of_their_own_and_are_else_the_same() -> None:
    """Catches an interval of the feet that draws the rest of a robot anew."""
    ranges = TRAINING_RANGES.replace(
        force_bias_n=(-15.0, 15.0), moment_bias_nm=(-0.45, 0.45), cross_talk=(0.0, 0.02)
    )
    exact = ranges.replace(**dict.fromkeys(FOOT_ERRORS, (0.0, 0.0)))
    plain, lying = (draw_robots([own], 16, 12, [0]) for own in (exact, ranges))
    for robot, other in zip(plain, lying, strict=True):
        same = {name: getattr(robot, name) for name in vars(robot) if name not in FOOT_ERRORS}
        assert same == {name: getattr(other, name) for name in same}
        assert all(not any(getattr(robot, name)) for name in FOOT_ERRORS)
    force = np.array([robot.force_bias_n for robot in lying])
    assert force.shape == (16, 6)
    # a Latin hypercube: one robot in each 16th of the range
    order = np.sort(np.floor((force + 15.0) / 30.0 * 16), axis=0)
    np.testing.assert_array_equal(order, np.arange(16)[:, None].repeat(6, axis=1))
    shares = np.array([robot.cross_talk for robot in lying])
    assert shares.shape == (16, 60)
    assert 0.0 <= shares.min() < 0.001 < 0.019 < shares.max() <= 0.02
    assert lying[0].record()["robot_force_bias_rms_n"] == pytest.approx(
        np.sqrt(np.mean(force[0] ** 2))
    )


def test_a_drawn_bias_is_what_the_sensor_shows() -> None:
    """Catches feet or axes in another order than the robot has them."""
    ranges = RobotRanges(force_bias_n=(-15.0, 15.0), moment_bias_nm=(0.1, 0.2))
    env = walkers(ideal(mixture=[ranges]), num_envs=1)
    errors, _ = errors_of(env, 0)
    robot = env.unwrapped.task._robots[0]
    np.testing.assert_allclose(errors[0, 0, :, :3].ravel(), robot.force_bias_n, atol=1e-12)
    np.testing.assert_allclose(errors[0, 0, :, 3:].ravel(), robot.moment_bias_nm, atol=1e-12)


def test_sensor_and_drawn_have_the_errors_of_foot_sensors() -> None:
    """Catches a half-width that becomes a width or an end, and scenarios whose feet are exact."""
    half_widths = {name: getattr(FOOT_SCENARIO, name)[1] for name in FOOT_ERRORS}
    assert all(half_widths.values())
    bank = robot_bank(make_scenario("drawn"), 1)
    for name, half_width in half_widths.items():
        interval = (-half_width, half_width)
        for ranges in (FOOT_SCENARIO, make_scenario("sensor"), TRAINING_RANGES):
            assert getattr(ranges, name) == interval
        drawn = np.array([getattr(robot, name) for robot in bank])
        # a Latin hypercube of 256 robots: one in the first and the last 256th of every column
        assert (drawn.min(axis=0) < half_width * (2.0 / 256 - 1.0)).all()
        assert (drawn.max(axis=0) > half_width * (1.0 - 2.0 / 256)).all()
        assert np.abs(drawn).max() <= half_width


def test_a_robot_that_does_not_walk_has_sensor_without_feet() -> None:
    """Catches a `sensor` that is refused on the testbed, and a push that is dropped there in
    silence."""
    plain = make_scenario("sensor", walks=False)
    assert all(getattr(plain, name) == (0.0, 0.0) for name in FOOT_ERRORS)
    assert plain.homing_rad == make_scenario("sensor").homing_rad
    joined: Any = make_testbed(scenario="sensor+soft").unwrapped
    assert joined.task.config.scenario == make_scenario("sensor+soft", walks=False)
    with pytest.raises(ConfigurationError, match="which only a walker knows"):
        make_testbed(scenario="sensor+push")
    swept = Condition(env="testbed", policy=PolicySpec(name="input"), scenario="sensor")
    swept = swept.replace(swept={"scenario.stiffness": 0.7})
    assert make_testbed(scenario=swept.scenario_played) is not None


def test_the_named_change_is_of_walkers_and_draws() -> None:
    """Catches a testbed that takes errors of feet that it has not, and one and the same walk in
    all episodes."""
    assert FOOT_SCENARIO.draws_robots
    assert make_scenario("ideal+foot_sensors").is_random
    for name in ("foot_sensors", "slip"):
        with pytest.raises(ConfigurationError, match="which only a walker knows"):
            make_testbed(scenario=name)
    with pytest.raises(ConfigurationError, match=r"'drawn' sets cross_talk, .* a second time"):
        make_scenario("foot_sensors+drawn")


SLIDING = 0.3


def pushed_foot(friction: float, force_n: float) -> float:
    """How far a foot is moved by a sideways force for 0.2 s while the robot stands [m]."""
    env = walkers(ideal(floor_friction=friction), num_envs=1)
    env.reset(seed=0)
    task = env.unwrapped.task
    foot = task.model.body("l_foot").id
    # on the floor, so that it does not tilt the foot
    lever = task.simulation.bind("xipos")[0, foot, 2]
    begun = task.truth().ankles[0, 0, 1]
    wrench = task.simulation.bind("xfrc_applied")
    for _ in range(50):
        wrench[0, foot, 1] = force_n
        wrench[0, foot, 3] = lever * force_n
        env.step(np.zeros((1, 12), np.float32))
    return float(task.truth().ankles[0, 0, 1] - begun)


def test_a_foot_slides_where_it_is_pushed_harder_than_friction_holds_it() -> None:
    """Catches a friction of the floor that the soles' own one overrides: half the weight is 280 N,
    of which 0.3 hold 84 N."""
    held_n = SLIDING * 0.5 * 57.0 * 9.81
    assert abs(pushed_foot(SLIDING, 0.5 * held_n)) < 1e-3
    assert pushed_foot(SLIDING, 2.0 * held_n) > 5e-3
    assert abs(pushed_foot(1.0, 2.0 * held_n)) < 1e-3


def test_slip_is_in_the_plant_and_neither_in_the_plan_nor_in_the_torques() -> None:
    """Catches a policy that knows the floor."""
    usual, slippery = (walkers(name, num_envs=1).unwrapped for name in ("nominal", "slip"))
    for env, friction in ((usual, 1.0), (slippery, 0.3)):
        env.reset(seed=0)
        plant = env.simulation.model_of(0)
        assert [plant.geom(f"{side}_sole").friction[0] for side in "lr"] == [friction] * 2
        assert env.task.config.robot.friction == 1.0
    np.testing.assert_array_equal(usual.task.plan.torque, slippery.task.plan.torque)
