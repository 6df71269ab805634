"""Walks of a number of steps that is drawn per episode, and physics steps of another length."""

from typing import Any

import numpy as np
import pytest

import baselines
from elastic_env.core.errors import ConfigurationError
from elastic_env.robots.thormang.environment import make as make_walk
from elastic_env.robots.thormang.environment import make_vector as make_walk_vector

STEP_S = 1.1
ROWS = 275
"""Control steps of a step."""
DRAWN: dict[str, Any] = {"step_period": STEP_S, "num_steps": 8, "fewest_steps": 4}
NO_OFFSET = np.zeros(12, np.float32)


def skipped(env: Any) -> Any:
    """Control steps that the present walks leave out."""
    return env.unwrapped.task._bias["skipped"].copy()


def shortest_walk(env: Any) -> int:
    """A seed that draws as few steps as there can be."""
    for seed in range(100):
        env.reset(seed=seed)
        if skipped(env)[0] == 4 * ROWS:
            return seed
    raise AssertionError


@pytest.mark.parametrize(
    "policy", ["input_output", pytest.param("foothold", marks=pytest.mark.slow)]
)
def test_a_shorter_walk_is_that_of_a_plan_of_as_many_steps(policy: str) -> None:
    """Catches a jump to another phase or on another foot, a clock that does not follow, an end at
    another time, and scores against the rows left out."""
    env = make_walk(**DRAWN, scenario="ideal")
    plain = make_walk(step_period=STEP_S, num_steps=4, scenario="ideal")
    seed = shortest_walk(env)
    policies = [baselines.make(policy, one) for one in (env, plain)]
    shown = [one.reset(seed=seed)[0] for one in (env, plain)]
    states: list[Any] = [None, None]
    names = env.unwrapped.task.observation_table.names
    # impacts magnify the last bits, in forces and rates most of all
    apart = ("clock.time", "wrench", "encoder_rate", "imu_rate")
    is_alike = [not name.startswith(apart) for name in names]
    ended = False
    while not ended:
        both = []
        for i, one in enumerate((env, plain)):
            action, states[i] = policies[i].predict(shown[i], states[i])
            both.append(one.step(action))
            shown[i] = both[i][0]
        one, other = both
        np.testing.assert_allclose(one[0][is_alike], other[0][is_alike], rtol=0, atol=3e-4)
        assert one[2:4] == other[2:4]
        ended = one[3]
        for name in ("zmp_reference_x", "zmp_reference_y", "swing", "support", "load_share"):
            assert one[4][name] == pytest.approx(other[4][name], abs=1e-9), name
    found, expected = (result[4]["episode_metrics"] for result in both)
    for name in ("pelvis_error_rms_rad", "zmp_deviation_rms_m", "foot_drift_end_m"):
        assert found[name] == pytest.approx(expected[name], rel=2e-2), name
    assert one[4]["time_s"] == pytest.approx(other[4]["time_s"] + 4 * STEP_S)


def test_numbers_of_steps_are_drawn_per_episode_evenly_and_by_its_seed() -> None:
    """Catches a number that never changes, one of half a stride, and a vector that draws others
    than the scalar environment."""
    env = make_walk_vector(num_envs=200, **DRAWN, scenario="ideal")
    env.reset(seed=0)
    drawn = skipped(env)
    numbers, counts = np.unique(8 - drawn // ROWS, return_counts=True)
    assert numbers.tolist() == [4, 6, 8]
    assert counts.min() > 30
    env.reset()
    assert (skipped(env) != drawn).mean() > 0.6
    env.reset(seed=0)
    np.testing.assert_array_equal(skipped(env), drawn)
    scalar = make_walk(**DRAWN, scenario="ideal")
    for seed in (3, 5):
        scalar.reset(seed=seed)
        assert skipped(scalar)[0] == drawn[seed]
    assert env.unwrapped.task.fewest_control_steps == 500 + 4 * ROWS


def test_the_robot_does_not_depend_on_whether_the_number_of_steps_is_drawn() -> None:
    """Catches a draw in front of the others."""
    robots = []
    for options in (DRAWN, {"step_period": STEP_S, "num_steps": 8}):
        env = make_walk(**options, scenario="spread")
        env.reset(seed=4)
        robots.append(env.unwrapped.task.truth().stiffness)
    np.testing.assert_array_equal(*robots)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_steps": 9}, r"num_steps = 9 less whole strides of two steps, got 4"),
        ({"num_steps": 2}, r"num_steps = 2 less whole strides"),
        ({"fewest_steps": 2}, r"fewest_steps"),
        ({"gait": {"step_length_m": 0.05}}, r"for walks in place"),
    ],
)
def test_a_number_of_steps_that_cannot_be_is_refused(options: dict[str, Any], message: str) -> None:
    """Catches a walk that ends on the other foot, and one that jumps ahead."""
    with pytest.raises(ConfigurationError, match=message):
        make_walk(**{**DRAWN, **options})


def test_a_control_step_of_physics_of_2_ms_is_nearly_that_of_1_ms() -> None:
    """Catches a step that is not refined, or counted twice: from the same states of a walk, the
    joints end within 0.3 mrad of each other, and within 2 % of their motion in the mean."""
    options = {"step_period": STEP_S, "num_steps": 1, "scenario": "nominal"}
    fine = make_walk(**options)
    coarse = make_walk(**options, timestep_s=2e-3)
    assert coarse.unwrapped.task.num_substeps * 2 == fine.unwrapped.task.num_substeps == 4
    for env in (fine, coarse):
        env.reset(seed=0)
    policy = baselines.make("input_output", fine)
    observation, _ = fine.reset(seed=0)
    state = None
    apart = []
    moved = []
    for _ in range(fine.unwrapped.task.num_steps):
        ours, theirs = (env.unwrapped.simulation for env in (fine, coarse))
        for field in ("qpos", "qvel", "act", "qacc_warmstart"):
            theirs.bind(field)[:] = ours.bind(field)
        before = ours.bind("qpos").copy()
        action, state = policy.predict(observation, state)
        observation = fine.step(action)[0]
        theirs.bind("ctrl")[:] = ours.bind("ctrl")
        theirs.advance(2)
        apart.append(np.abs(theirs.bind("qpos") - ours.bind("qpos"))[0, 7:].max())
        moved.append(np.abs(before - ours.bind("qpos"))[0, 7:].max())
    rms = [np.sqrt(np.mean(np.square(values))) for values in (apart, moved)]
    assert np.max(apart) < 3e-4
    assert rms[0] < 0.02 * rms[1]
