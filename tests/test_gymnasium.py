"""Contracts of Gymnasium and Stable-Baselines3, on every registered simulation; hardware has its
own test."""

import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, data_equivalence
from stable_baselines3.common.env_checker import check_env as check_sb3_env
from stable_baselines3.common.vec_env import SubprocVecEnv

from baselines import ResidualVectorWrapper, ResidualWrapper
from elastic_env.world.env import ElasticEnv
from elastic_env.world.vector_env import ElasticVectorEnv

SIMULATIONS = {
    "elastic_env/Testbed-v0": {
        "reference": {"kind": "sine", "duration_s": 0.4, "onset_s": 0.4, "amplitude": 0.1}
    },
    "elastic_env/Robot-v0": {
        "reference": {"kind": "sine", "duration_s": 0.4, "onset_s": 0.4, "amplitude": 0.1}
    },
    "elastic_env/WalkInPlace-v0": {"step_period": [0.3, 0.4, 0.3], "num_steps": 1},
}
IDS = sorted(SIMULATIONS)
ROBOT_AT_NIGHT = pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] * ("Robot" in n)) for n in IDS]
)
"""One class makes it and the testbed."""


def make(name: str, **arguments: Any) -> Any:
    return gymnasium.make(name, **{**SIMULATIONS[name], **arguments})


def make_vec(name: str, num_envs: int, **arguments: Any) -> Any:
    return gymnasium.make_vec(
        name,
        num_envs=num_envs,
        vectorization_mode="vector_entry_point",
        **{**SIMULATIONS[name], **arguments},
    )


def test_every_id_is_here_or_is_hardware() -> None:
    """Catches an environment that is registered and not checked."""
    # those of the package name their module; a test may have registered a robot of its own
    ours = [
        name
        for name, spec in gymnasium.registry.items()
        if str(spec.entry_point).startswith("elastic_env.")
    ]
    assert sorted([*SIMULATIONS, "elastic_env/HardwareTestbed-v0"]) == sorted(ours)


@pytest.mark.parametrize("name", IDS)
def test_gymnasiums_checker_finds_nothing(name: str) -> None:
    """Catches spaces, dtypes, seeding and return types that are not Gymnasium's."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings(
            "ignore", message=".*recommended way of making.*|.*A Box observation space.*"
        )
        warnings.filterwarnings(
            "ignore", message=".*observation space (min|max)imum value is -?infinity.*"
        )
        warnings.filterwarnings(
            "ignore", message=".*recommended to use a symmetric and normalized.*"
        )
        check_env(make(name).unwrapped, skip_render_check=True)  # which opens windows


@pytest.mark.parametrize("name", IDS)
def test_stable_baselines3s_checker_finds_nothing(name: str) -> None:
    """Catches what Stable-Baselines3 cannot train on, although Gymnasium takes it."""
    check_sb3_env(make(name).unwrapped, skip_render_check=True)


@ROBOT_AT_NIGHT
def test_rollouts_of_one_seed_are_equal(name: str) -> None:
    """Catches an environment that remembers the one before, in values and in types; as Gymnasium
    tests its own."""
    one = make(name)
    other = make(name)
    for _ in range(2):
        assert data_equivalence(one.reset(seed=4), other.reset(seed=4), exact=True)
        one.action_space.seed(4)
        for _ in range(60):
            action = one.action_space.sample()
            assert data_equivalence(one.step(action), other.step(action), exact=True)


@pytest.mark.parametrize(
    ("name", "start_method"),
    [
        (IDS[0], "fork"),
        *(pytest.param(IDS[1], start, marks=pytest.mark.slow) for start in ("fork", "spawn")),
    ],
)
def test_processes_of_stable_baselines3_play_as_this_one(name: str, start_method: str) -> None:
    """Catches an environment that does not survive the way into a process, with threads that a
    fork leaves behind."""
    # one is made before the fork
    env = make(name)
    made = make(name)
    worlds = SubprocVecEnv(
        [lambda: made if start_method == "fork" else make(name)] * 2, start_method=start_method
    )
    try:
        worlds.seed(5)
        first = worlds.reset()
        for world in range(2):
            np.testing.assert_array_equal(
                first[world], env.reset(seed=5 + world)[0].astype(first.dtype)
            )
        action = np.full(env.action_space.shape, 0.01, dtype=np.float32)
        for _ in range(20):
            observation = worlds.step(np.stack([action, action]))[0]
            mine = env.step(action)[0]
            np.testing.assert_array_equal(observation[1], mine.astype(observation.dtype))
    finally:
        worlds.close()


@ROBOT_AT_NIGHT
def test_the_specification_tells_the_length_of_an_episode(name: str) -> None:
    """Catches wrappers and libraries that ask for it and find None; a shorter one that is asked
    for stays."""
    env = make(name)
    assert isinstance(env.unwrapped, ElasticEnv)
    assert env.spec.max_episode_steps == env.unwrapped.task.num_steps
    many = make_vec(name, 2)
    assert isinstance(many.unwrapped, ElasticVectorEnv)
    assert many.spec.max_episode_steps == env.unwrapped.task.num_steps
    assert make(name, max_episode_steps=7).spec.max_episode_steps == 7
    again = gymnasium.make(env.spec)
    assert again.unwrapped.task.num_steps == env.unwrapped.task.num_steps


@ROBOT_AT_NIGHT
def test_a_step_before_the_reset_is_refused(name: str) -> None:
    """Catches a robot that moves before its equilibrium, also as one world of several, and under
    a residual."""
    many = make_vec(name, 3)
    envs = many, make(name).unwrapped, ResidualWrapper(make(name).unwrapped, "input")
    for env in (*envs, ResidualVectorWrapper(make_vec(name, 2), "input")):
        with pytest.raises(
            gymnasium.error.ResetNeeded, match=r"reset\(\) comes before the first step"
        ):
            env.step(np.zeros(env.action_space.shape, dtype=np.float32))
    many.reset(seed=0, options={"reset_mask": np.array([False, True, False])})
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"of the worlds \[0, 2\] too"):
        many.step(np.zeros(many.action_space.shape, dtype=np.float32))
    many.reset(seed=0, options={"reset_mask": np.array([True, False, True])})
    many.step(np.zeros(many.action_space.shape, dtype=np.float32))


@pytest.mark.parametrize(
    "name",  # all are drawn by one class
    [pytest.param(n, marks=[pytest.mark.slow] * ("Testbed" not in n)) for n in IDS],
)
@pytest.mark.filterwarnings("error")
def test_a_vector_environment_draws_its_worlds(name: str) -> None:
    """Catches frames that all show the first world, and a warning of Gymnasium, MuJoCo or the
    renderer where an environment is drawn."""
    env = make_vec(name, 2, render_mode="rgb_array", scenario="nominal")
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape, dtype=np.float32)
    action[1] = 0.03
    for _ in range(30):
        env.step(action)
    first, second = env.render()
    env.close()
    assert first.shape == second.shape == (first.shape[0], first.shape[1], 3)
    assert not np.array_equal(first, second)
    alone = make(name, render_mode="rgb_array", scenario="nominal")
    alone.reset(seed=1)
    for _ in range(30):
        alone.step(action[1])
    shown = np.asarray(alone.render(), dtype=np.float64)
    assert np.abs(shown - second).max() <= 1.0  # another renderer may round another way
    assert np.abs(shown - first).max() > 50.0
    alone.close()
    assert make_vec(name, 2).render() is None
