"""The testbed environment: what any user of Gymnasium may rely on, and the physics that it promises."""

import copy
import json
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from hypothesis import given, settings
from hypothesis import strategies as st

import elastic_env  # noqa: F401  registers the environments
from elastic_env.elasticity import Servo
from elastic_env.envs import ElasticEnv, ElasticVectorEnv, make_testbed, make_testbed_vector
from elastic_env.errors import ActionError, ConfigurationError
from elastic_env.references import STAND_S, Hold, Sine
from elastic_env.robots.dynamixel import ENCODER_COUNTS_PER_TURN, H54_200_S500_R
from elastic_env.robots.testbed import Pendulum
from elastic_env.scenario import make_scenario, scenario_names
from elastic_env.signals import Array
from elastic_env.tasks import testbed
from elastic_env.tasks.testbed import TestbedConfig

ID = "elastic_env/Testbed-v0"
PERIOD_S = TestbedConfig().control_period_s
SHORT: dict[str, dict[str, Any]] = {
    "hold": {"kind": "hold", "positions": 2, "rate": 3.0, "settle_s": 0.02, "measure_s": 0.02},
    "sine": {"kind": "sine", "amplitude": 0.3, "duration_s": 0.1, "onset_s": 0.1},
    "multisine": {"kind": "multisine", "amplitude": 0.2, "highest_hz": 0.6, "duration_s": 0.3, "onset_s": 0.2},
    "steps": {"kind": "steps", "amplitude": 0.2, "move_s": 0.5, "rest_s": 0.05, "moves": 1},
}
"""References as short as can be: a second of standing, then a moment of motion."""
INFO_KEYS = {
    "time_s", "reference_angle", "link_angle", "link_angle_imu", "link_error", "link_error_imu", "deflection",
    "joint_torque", "servo_error", "command_rate", "rest", "clipped", "reward_terms", "termination",
}  # fmt: skip


def random_actions(steps: int, worlds: int, seed: int = 0) -> Array:
    """Offsets that change at every step and sometimes exceed the bounds, (steps, worlds, 1)."""
    return np.random.default_rng(seed).uniform(-0.02, 0.02, (steps, worlds, 1)).astype(np.float32)


def episode(env: ElasticEnv, seed: int, actions: Array) -> list[tuple[Any, ...]]:
    """Reset, then steps until the end or until the actions are used up; what each of them returned."""
    log: list[tuple[Any, ...]] = [env.reset(seed=seed)]
    for action in actions:
        log.append(env.step(action))
        if log[-1][2] or log[-1][3]:
            break
    return log


def break_world(env: Any, world: int = 0, value: float = np.nan) -> None:
    """Put a bad number where MuJoCo will find it."""
    env.unwrapped._worlds.simulation.qvel[world, -1] = value


# ---------------------------------------------------------------------------------------------------------------------
# Contracts of Gymnasium and Stable-Baselines3
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("arguments", [{}, {"observe_link": True, "scenario": "sensor", "reference": "multisine"}])
def test_gymnasium_check_env(arguments: dict[str, Any]) -> None:
    """Catches spaces, dtypes, seeding and return types that are not Gymnasium's."""
    check_env(gymnasium.make(ID, **arguments).unwrapped, skip_render_check=True)


def test_stable_baselines3_check_env() -> None:
    """Catches what Stable-Baselines3 cannot train on, although Gymnasium takes it."""
    from stable_baselines3.common.env_checker import check_env as check_sb3_env

    check_sb3_env(gymnasium.make(ID, reference=SHORT["sine"]).unwrapped, skip_render_check=True)


@pytest.mark.parametrize("scenario", ["nominal", "sensor"])
@pytest.mark.parametrize("reference", list(SHORT))
def test_same_seed_same_rollout_and_other_seed_another(reference: str, scenario: str) -> None:
    """Catches randomness outside the seed, and a seed that is ignored."""
    actions = random_actions(300, 1)[:, 0]
    first, again, other = (
        episode(make_testbed(reference=SHORT[reference], scenario=scenario, observe_link=True), seed, actions)
        for seed in (3, 3, 4)
    )
    assert_equal(first, again)
    assert any(not np.array_equal(a[0], b[0]) for a, b in zip(first, other, strict=False))


def test_episodes_of_one_environment_follow_from_its_first_seed() -> None:
    """Catches a second episode that depends on how the first one ended, or that repeats it."""
    logs = []
    for steps in (5, 90):
        env = make_testbed(reference=SHORT["multisine"], scenario="sensor")
        episode(env, 7, random_actions(steps, 1)[:, 0])
        logs.append(env.reset())
    assert_equal(logs[0], logs[1])
    assert not np.array_equal(logs[0][0], make_testbed(reference=SHORT["multisine"], scenario="sensor").reset(seed=7)[0])


def assert_equal(a: Any, b: Any, path: str = "") -> None:
    """Exact equality of nested results, nan equal to nan."""
    if isinstance(a, dict):
        assert a.keys() == b.keys(), path
        for key in a:
            assert_equal(a[key], b[key], f"{path}[{key!r}]")
    elif isinstance(a, list | tuple):
        assert len(a) == len(b), path
        for i in range(len(a)):
            assert_equal(a[i], b[i], f"{path}[{i}]")
    else:
        np.testing.assert_array_equal(a, b, err_msg=path)


@pytest.mark.parametrize("vector", [False, True])
def test_spaces_describe_what_the_environment_takes_and_gives(vector: bool) -> None:
    """Catches a dtype or shape that changes between space, reset and step."""
    arguments = {"reference": SHORT["sine"], "observe_link": True}
    env: Any = make_testbed_vector(num_envs=3, **arguments) if vector else make_testbed(**arguments)
    observation, _ = env.reset(seed=0)
    assert env.action_space.dtype == np.float32
    np.testing.assert_allclose(np.abs([env.action_space.low, env.action_space.high]), 0.3, rtol=1e-6)
    for _ in range(3):
        assert observation.dtype == np.float64
        assert env.observation_space.contains(observation)
        assert np.isfinite(observation).all()
        observation, reward, terminated, truncated, _ = env.step(env.action_space.sample())
    if vector:
        assert reward.shape == terminated.shape == truncated.shape == (3,)
        assert terminated.dtype == truncated.dtype == np.bool_
    else:
        assert (type(reward), type(terminated), type(truncated)) == (float, bool, bool)


@pytest.mark.parametrize("vector", [False, True])
def test_results_are_fresh_and_writing_to_them_changes_nothing(vector: bool) -> None:
    """Catches observations, infos or truths that are views of the live state."""
    make: Any = (lambda **a: make_testbed_vector(num_envs=2, **a)) if vector else make_testbed
    actions = random_actions(20, 2)
    logs = []
    for spoil in (False, True):
        env = make(reference=SHORT["sine"], scenario="sensor", observe_link=True)
        results: list[Any] = [env.reset(seed=0)]
        kept: list[Any] = []
        for action in actions if vector else actions[:, 0]:
            kept.append(copy.deepcopy(results[-1]))
            given, truth = action.copy(), env.truth()
            results.append(env.step(given))
            assert_equal(results[-2], kept[-1])
            if spoil:
                _spoil(results[-1], given, kept, truth)
        kept.append(kept.pop() if spoil else copy.deepcopy(results[-1]))
        logs.append(kept)
    assert_equal(logs[0][:-1], logs[1][:-1])


def _spoil(result: Any, given: Array, kept: list[Any], truth: Any) -> None:
    """Overwrite everything an environment handed out, after a copy of it was kept."""
    kept.append(copy.deepcopy(result))
    for array in (result[0], given, *(value for value in vars(truth).values() if isinstance(value, np.ndarray))):
        array[...] = np.nan
    for value in result[-1].values():
        if isinstance(value, np.ndarray) and value.dtype == np.float64:
            value[...] = np.nan
    kept.pop()
    result[0][...] = kept[-1][0] if False else result[0]


def test_no_column_of_the_observation_is_constant() -> None:
    """Catches a column that is never filled, or always the same."""
    env = make_testbed(reference=SHORT["multisine"], observe_link=True)
    log = episode(env, 0, random_actions(400, 1)[:, 0])
    columns = np.array([entry[0] for entry in log])
    names = env.task.observation_table.names
    assert [name for name, spread in zip(names, np.ptp(columns, axis=0), strict=True) if spread == 0.0] == []
