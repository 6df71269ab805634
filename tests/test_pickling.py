"""A copy of an environment goes on as the original, whatever made the copy."""

import copy
import os
import pickle
import signal
from collections.abc import Callable
from typing import Any

import cloudpickle
import gymnasium
import numpy as np
import pytest

import elastic_env  # noqa: F401  registers the environments

COPIES: dict[str, Callable[[Any], Any]] = {
    "pickle": lambda env: pickle.loads(pickle.dumps(env)),
    "cloudpickle": lambda env: pickle.loads(cloudpickle.dumps(env)),
    "deepcopy": copy.deepcopy,
}
WORLDS = [
    ("testbed", 1, "sensor"),
    ("testbed", 3, "nominal"),
    ("walker", 1, "spread"),
    ("walker", 3, "push"),
    ("walker", 1, "imu"),
    ("walker", 2, "drawn"),
]
EVERY_COMMIT = [
    ("deepcopy", WORLDS[0]),
    ("pickle", WORLDS[1]),
    ("deepcopy", WORLDS[2]),
    ("deepcopy", WORLDS[4]),
    ("deepcopy", WORLDS[5]),
]
"""Each way but cloudpickle, which takes what pickle takes; each robot alone and among others."""
COPIED = [
    pytest.param(how, *world, marks=[pytest.mark.slow] * ((how, world) not in EVERY_COMMIT))
    for how in COPIES
    for world in WORLDS
]
IDS = {"testbed": "elastic_env/Testbed-v0", "walker": "elastic_env/WalkInPlace-v0"}


def made(robot: str, worlds: int, scenario: str) -> Any:
    if worlds == 1:
        return gymnasium.make(IDS[robot], scenario=scenario)
    return gymnasium.make_vec(
        IDS[robot], num_envs=worlds, vectorization_mode="vector_entry_point", scenario=scenario
    )


def settled(info: dict[str, Any]) -> dict[str, Any]:
    """A plain dictionary, also of what is computed when it is looked at."""
    return {
        key: settled(value) if isinstance(value, dict) else value for key, value in info.items()
    }


@pytest.mark.parametrize(("how", "robot", "worlds", "scenario"), COPIED)
def test_a_copy_in_the_midst_of_an_episode_goes_on_bit_for_bit(
    how: str, robot: str, worlds: int, scenario: str
) -> None:
    """Catches views that stay with the original's physics, lambdas, and a generator or a filter
    that is left out."""
    env = made(robot, worlds, scenario)
    env.reset(seed=3)
    generator = np.random.default_rng(0)
    for _ in range(20):
        env.step(generator.uniform(-0.01, 0.01, env.action_space.shape).astype(np.float32))
    twin = COPIES[how](env)
    for _ in range(40):
        action = generator.uniform(-0.01, 0.01, env.action_space.shape).astype(np.float32)
        *mine, info = env.step(action)
        *same, other = twin.step(action)
        for one, two in zip(mine, same, strict=True):
            np.testing.assert_array_equal(one, two)
        np.testing.assert_equal(settled(info), settled(other))
    one, two = env.reset()[0], twin.reset()[0]
    np.testing.assert_array_equal(one, two)


def test_a_vector_environment_that_was_forked_steps_as_its_parent() -> None:
    """Catches a step that waits for ever for threads that a fork does not copy."""
    env = made("walker", 2, "spread")
    env.reset(seed=3)
    for _ in range(20):
        env.step(np.zeros(env.action_space.shape, dtype=np.float32))
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        signal.alarm(60)  # ends it where it waits for ever
        observation = env.step(np.full(env.action_space.shape, 0.01, dtype=np.float32))[0]
        os.write(writer, observation.tobytes())
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as answers:
        answer = answers.read()
    assert os.waitpid(child, 0)[1] == 0
    expected = env.step(np.full(env.action_space.shape, 0.01, dtype=np.float32))[0]
    np.testing.assert_array_equal(np.frombuffer(answer).reshape(expected.shape), expected)
