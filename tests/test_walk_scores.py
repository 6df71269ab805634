"""What the scores of a walk say: where the ZMP is in the feet and where the feet are, and which
steps count."""

import copy
import tracemalloc
from typing import Any

import numpy as np
import pytest

import baselines
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.joint.joint_names import JointAddresses
from elastic_env.motion.gait import Gait, step_timing
from elastic_env.robots.thormang.environment import make as make_walk
from elastic_env.robots.thormang.environment import make_vector as make_walk_vector
from elastic_env.robots.thormang.model import LEG_JOINTS
from elastic_env.robots.thormang.walk_signals import BLOCK_STEPS
from elastic_env.world.foot_sensors import FootSensors
from tests.ground_contact import foot_drift, ground_wrench, zero_moment_point

FAST: dict[str, Any] = {"step_period": [0.2, 0.3, 0.2]}
STANDING = 250
"""Control steps before the walk."""
MIRROR = np.array([-1, -1, 1, 1, 1, -1])
"""Of the angles of a leg: yaw and roll turn round, pitch does not."""
NO_OFFSET = np.zeros(12, np.float32)


def walked(env: Any) -> list[dict[str, Any]]:
    """Info and reward of every step of a walk on `input_output`."""
    policy = baselines.make("input_output", env)
    observation, _ = env.reset(seed=0)
    state = None
    infos = []
    for _ in range(env.unwrapped.task.num_steps):
        action, state = policy.predict(observation, state)
        observation, reward, terminated, _, info = env.step(action)
        assert not terminated
        infos.append({**info, "reward": reward})
    return infos


def column(infos: list[dict[str, Any]], name: str) -> Array:
    """A signal of all steps."""
    return np.array([info[name] for info in infos])


def vector(info: dict[str, Any], name: str) -> Array:
    """Both parts of a signal in the ground plane."""
    return np.array([info[f"{name}_x"], info[f"{name}_y"]])


def test_feet_count_by_the_force_on_them() -> None:
    """Catches a swing foot that counts, and an average of the feet in place of a weighted one."""
    planned = np.array([[0.0, 0.1, 0.1], [0.0, -0.1, 0.1]])
    away = np.array([[0.01, 0.02, 0.03], [-0.04, 0.0, 0.0]])
    for force, expected in (
        ([500.0, 0.0], [0.01, 0.02]),
        ([0.0, 500.0], [-0.04, 0.0]),
        ([300.0, 100.0], [-0.0025, 0.015]),
    ):
        drift = foot_drift(np.array(force), planned + away, planned)
        np.testing.assert_allclose(drift, expected, atol=1e-15)
    assert np.isnan(foot_drift(np.zeros(2), planned + away, planned)).all()


def test_the_drift_of_a_rigid_shift_is_the_shift_however_the_feet_are_loaded() -> None:
    """Catches weights that do not sum to one."""
    random = np.random.default_rng(0)
    planned = random.normal(size=(5, 2, 3))
    shift = random.normal(size=(5, 1, 3))
    force = random.uniform(1.0, 500.0, (5, 2))
    drift = foot_drift(force, planned + shift, planned)
    np.testing.assert_allclose(drift, shift[:, 0, :2], rtol=1e-12)


def test_the_zmp_in_the_feet_is_that_of_feet_where_they_are_planned() -> None:
    """Catches a drift of another sign or of other weights: the same wrenches on planned ankles
    have this ZMP."""
    env = make_walk(**FAST, num_steps=2, scenario="soft")
    task = env.unwrapped.task
    offsets = np.random.default_rng(1).uniform(-0.01, 0.01, (40, 12)).astype(np.float32)
    env.reset(seed=0)
    model = task.model
    sites = [model.site(f"{side}_ft").id for side in "lr"]
    feet = [model.body(f"{side}_foot").id for side in "lr"]
    sensors = FootSensors(model.body_mass[feet], model.body_ipos[feet], model.opt.gravity)
    moved = 0.0
    for step in range(1, 400):
        _, _, ended, _, info = env.step(offsets[step % len(offsets)])
        assert not ended
        if step < STANDING - 20:
            continue
        R = task.simulation.bind("site_xmat")[:, sites].reshape(1, 2, 3, 3)
        ankles = task.truth().ankles
        ankles[..., :2] = task.plan.ankles[step, :, :2]
        shown = -task.simulation.bind("sensordata")[:, :12].reshape(1, 2, 2, 3)
        force, moment = ground_wrench(sensors, shown, R)
        zmp = zero_moment_point(force, moment, ankles, 1.0)[0] - task.plan.zmp[step]
        np.testing.assert_allclose(vector(info, "zmp_in_feet"), zmp, rtol=0, atol=1e-12)
        parts = vector(info, "zmp_in_feet") + vector(info, "foot_drift")
        np.testing.assert_allclose(parts, vector(info, "zmp_deviation"), rtol=0, atol=1e-15)
        for name in ("zmp_in_feet", "foot_drift"):
            assert info[name] == pytest.approx(np.hypot(*vector(info, name)), rel=1e-14)
        moved = max(moved, float(info["foot_drift"]))
    assert moved > 1e-3


def test_a_robot_that_is_carried_off_drifts_and_keeps_its_zmp_in_the_feet() -> None:
    """Catches a part of a shift in the other figure: 10 mm to the left behind are 10 mm of drift,
    and nothing else."""
    env = make_walk(**FAST, num_steps=2, scenario="ideal")
    env.reset(seed=0)
    for _ in range(STANDING + 60):
        env.step(NO_OFFSET)
    shift = np.array([-0.006, 0.008])
    carried = copy.deepcopy(env)
    carried.unwrapped.task.simulation.qpos[0, :2] += shift
    stayed_info, moved_info = (one.step(NO_OFFSET)[4] for one in (env, carried))
    drift = vector(moved_info, "foot_drift") - vector(stayed_info, "foot_drift")
    np.testing.assert_allclose(drift, shift, atol=1e-9)
    in_feet = [vector(info, "zmp_in_feet") for info in (stayed_info, moved_info)]
    np.testing.assert_allclose(*in_feet, atol=1e-7)


def test_the_mirrored_robot_drifts_to_the_other_side() -> None:
    """Catches feet or signs that are mixed up: of two robots that stand displaced and bent, one is
    the mirror image of the other."""
    env: Any = make_walk_vector(num_envs=2, **FAST, num_steps=1, scenario="ideal")
    env.reset(seed=0)
    bent = np.random.default_rng(3).uniform(-2e-3, 2e-3, 12)
    mirrored = (MIRROR * bent.reshape(2, 6)[::-1]).ravel()
    task = env.unwrapped.task
    qpos = task.simulation.qpos
    addresses = JointAddresses.of(task.model, LEG_JOINTS)
    for world, (offset, side) in enumerate(((bent, 1.0), (mirrored, -1.0))):
        qpos[world, :2] += 0.004, side * 0.007
        for places in (addresses.q, addresses.theta):
            qpos[world, places] += offset
    info = env.step(np.zeros((2, 12), np.float32))[4]
    x = info["foot_drift_x"]
    y = info["foot_drift_y"]
    # the pelvis' center of mass is 0.2 mm beside the middle
    assert x[1] == pytest.approx(x[0], rel=1e-3)
    assert y[1] == pytest.approx(-y[0], rel=1e-3)
    assert y[0] == pytest.approx(0.007, rel=0.2)
    assert info["foot_drift"][1] == pytest.approx(info["foot_drift"][0], rel=1e-3)


def test_the_reward_has_the_zmp_in_the_feet_and_the_drift_as_terms_of_their_own() -> None:
    """Catches a term of the other figure, of squares, without its weight, and one that counts
    where a weight is zero."""
    weights = {"zmp": 0.0, "zmp_in_feet": 150.0, "foot_drift": 40.0, "standing": 0.25}
    env = make_walk(**FAST, num_steps=1, scenario="soft", reward=weights)
    plain = make_walk(**FAST, num_steps=1, scenario="soft")
    walking = env.unwrapped.task.plan.timing.walking[1:]
    infos = walked(env)
    plain.reset(seed=0)
    plain_infos = [plain.step(NO_OFFSET)[4] for _ in range(STANDING + 60)]
    factor = np.where(walking, 1.0, 0.25)
    for name, weight in (("zmp_in_feet", 150.0), ("foot_drift", 40.0)):
        found = np.array([info["reward_terms"][name] for info in infos])
        np.testing.assert_allclose(found, -weight * factor * column(infos, name), rtol=1e-12)
        assert all(info["reward_terms"][name] == 0.0 for info in plain_infos)
    assert column(infos, "foot_drift").max() > 1e-3
    assert all(info["reward_terms"]["zmp"] == 0.0 for info in infos)
    sums = [sum(info["reward_terms"].values()) for info in infos]
    np.testing.assert_allclose(column(infos, "reward"), sums, rtol=1e-14)


def test_a_gait_of_named_steps_is_scored_behind_its_settling_steps() -> None:
    """Catches a settling step in the scores, and standing."""
    gait = Gait(
        double_support_s=0.2,
        single_support_s=0.3,
        last_double_support_s=0.2,
        num_steps=7,
        settling_steps=2,
    )
    timing = step_timing(gait, 0.004)
    per_step = 175
    begin = STANDING + 1
    expected = np.zeros(len(timing.time), np.bool_)
    expected[begin + 2 * per_step : begin + 7 * per_step] = True
    np.testing.assert_array_equal(timing.scored, expected)
    assert timing.walking.sum() == 7 * per_step
    np.testing.assert_array_equal(np.unique(timing.step), np.arange(7))
    np.testing.assert_array_equal(timing.support, timing.step % 2)


def test_without_settling_steps_the_whole_walk_is_scored() -> None:
    """Catches another default than that of before."""
    timing = step_timing(Gait(num_steps=3), 0.004)
    np.testing.assert_array_equal(timing.scored, timing.walking)


@pytest.mark.parametrize("settling_steps", [2, 5])
def test_a_walk_that_only_settles_is_refused(settling_steps: int) -> None:
    """Catches an episode without a figure."""
    with pytest.raises(ConfigurationError, match=r"less than num_steps = 2.*take more steps"):
        make_walk(**FAST, num_steps=2, gait={"settling_steps": settling_steps})


def test_blocks_are_the_first_and_the_last_scored_steps() -> None:
    """Catches blocks of another length or of unscored steps, and another last value."""
    env = make_walk(**FAST, num_steps=6, gait={"settling_steps": 1}, scenario="nominal")
    infos = walked(env)
    metrics = infos[-1]["episode_metrics"]
    timing = env.unwrapped.task.plan.timing
    number = timing.step[1:]
    scored = timing.scored[1:] & ~np.isnan(column(infos, "zmp_x"))
    blocks = {
        "first_steps": scored & (number < 1 + BLOCK_STEPS),
        "last_steps": scored & (number >= 6 - BLOCK_STEPS),
    }
    for block, mask in blocks.items():
        for signal, unit in (
            ("pelvis_error", "rad"),
            ("zmp_deviation", "m"),
            ("zmp_in_feet", "m"),
            ("foot_drift", "m"),
        ):
            values = column(infos, signal)[mask]
            expected = np.sqrt(np.mean(values**2))
            found = metrics[f"{signal}_{block}_rms_{unit}"]
            assert found == pytest.approx(expected, rel=1e-12), (block, signal)
    drift = column(infos, "foot_drift")[scored]
    assert metrics["foot_drift_end_m"] == drift[-1]
    assert metrics["foot_drift_peak_m"] == drift.max()


def test_settling_steps_change_no_motion_and_no_reward() -> None:
    """Catches a walk that differs in more than its scores."""
    runs = []
    for settling_steps in (0, 1):
        env = make_walk(**FAST, num_steps=2, gait={"settling_steps": settling_steps})
        env.reset(seed=3)
        runs.append([env.step(NO_OFFSET)[:2] for _ in range(350)])
    for (seen, reward), (other, same) in zip(*runs, strict=True):
        np.testing.assert_array_equal(seen, other)
        assert reward == same


@pytest.mark.slow
def test_a_long_walk_takes_no_more_memory_than_a_short_one() -> None:
    """Catches records that pile up step by step."""
    env: Any = make_walk_vector(num_envs=1, **FAST, num_steps=40, scenario="ideal")
    env.reset(seed=0)
    action = np.zeros((1, 12), np.float32)
    tracemalloc.start()
    for _ in range(2000):
        env.step(action)
    begun, _ = tracemalloc.get_traced_memory()
    for _ in range(4000):
        env.step(action)
    now, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert now - begun < 200_000
