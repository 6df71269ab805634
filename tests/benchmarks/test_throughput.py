"""Control steps of the vector environments, their scalar ones and raw physics, as pytest-benchmark
groups.

Compare within a group of one run only. `elastic speed` interleaves the same contenders and reports
ratios.
"""

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from train.speed.contenders import RawWorlds, ScalarLoop, VectorLoop

STEPS = 20
CASES = [
    ("walker", "input_wrench", 64),
    ("walker", "input_wrench", 256),
    ("testbed", "input", 64),
    ("testbed", "input", 1024),
]


@pytest.fixture(params=CASES, ids=lambda case: f"{case[0]}-{case[2]}")
def case(request: pytest.FixtureRequest) -> tuple[str, str, int]:
    """Environment, policy and number of worlds."""
    return request.param


def test_raw_physics(benchmark: BenchmarkFixture, case: tuple[str, str, int]) -> None:
    """mj_step alone, on two threads."""
    env, _, worlds = case
    benchmark.group = f"{env}, {worlds} worlds"
    loop = VectorLoop(env, worlds, 2)
    loop.run(STEPS)
    benchmark(RawWorlds(loop, 2).run, STEPS)


def test_vector_env(benchmark: BenchmarkFixture, case: tuple[str, str, int]) -> None:
    """Observation, reward, metrics and restarts on top."""
    env, _, worlds = case
    benchmark.group = f"{env}, {worlds} worlds"
    benchmark(VectorLoop(env, worlds, 2).run, STEPS)


def test_vector_env_with_policy(benchmark: BenchmarkFixture, case: tuple[str, str, int]) -> None:
    """And a compensating policy in the loop."""
    env, policy, worlds = case
    benchmark.group = f"{env}, {worlds} worlds"
    benchmark(VectorLoop(env, worlds, 2, policy).run, STEPS)


def test_vector_env_with_residual(benchmark: BenchmarkFixture, case: tuple[str, str, int]) -> None:
    """And a residual network."""
    env, policy, worlds = case
    benchmark.group = f"{env}, {worlds} worlds"
    benchmark(VectorLoop(env, worlds, 2, policy, residual=True).run, STEPS)


@pytest.mark.parametrize("env", ["walker", "testbed"])
@pytest.mark.parametrize("is_raw", [True, False])
def test_one_world(benchmark: BenchmarkFixture, env: str, is_raw: bool) -> None:
    """The scalar environment, and a loop of mj_step with its servo inputs."""
    benchmark.group = f"{env}, one world"
    loop = ScalarLoop(env)
    loop.run(STEPS)
    benchmark(RawWorlds(loop, 1).run if is_raw else loop.run, STEPS)
