"""Which scenarios draw something, held against the episodes themselves."""

from typing import Any

import gymnasium
import numpy as np
import pytest

import elastic_env  # noqa: F401  registers the environments
from elastic_env.robots.thormang.environment import make_vector as make_walk_vector
from elastic_env.world.scenario import Scenario, make_scenario
from elastic_env.world.sensors import AttitudeSensor


@pytest.mark.parametrize(
    "scenario", ["ideal", "nominal", "ideal+soft", "ideal+payload+backlash", "ideal+sensor"]
)
def test_scenarios_that_draw_nothing_are_known_by_their_episodes(scenario: str) -> None:
    """Catches a ceiling that is none, and identical episodes that count as many."""
    envs = [
        gymnasium.make(
            "elastic_env/Testbed-v0", scenario=scenario, reference="sine", observe_link=True
        )
        for _ in range(2)
    ]
    runs = []
    for seed, env in enumerate(envs):
        seen = [env.reset(seed=seed)[0]]
        seen += [env.step(np.full(1, 0.01, np.float32))[0] for _ in range(60)]
        runs.append(np.array(seen))
    assert make_scenario(scenario).is_random == (not np.array_equal(*runs))


@pytest.mark.parametrize(
    "alone",
    [
        {"pelvis_imu": AttitudeSensor(noise_rad=1e-3)},
        {"mounting_rad": (0.0, 1e-3)},
        {"gyro_noise_rad_s": 1e-3},
        {"force_noise_n": 1.0},
        {"moment_noise_nm": 0.1},
        {"force_bias_n": (0.0, 5.0)},
        {"moment_drift_nm_s": (0.0, 0.1)},
        {"cross_talk": (0.0, 0.01)},
        {"force_bias_n": 5.0},
        {"mounting_rad": 1e-3},
        {"floor_friction": 0.3},
        {"homing_rad": (-1e-3, 1e-3)},
        pytest.param({"joint_stiffness": (0.7, 1.3)}, marks=pytest.mark.slow),
        pytest.param({"floor_friction": (0.3, 1.0)}, marks=pytest.mark.slow),
        {"load_kg": (1.0, 2.0)},
        {"delay_share": 0.5},
        {"slope_rad": 0.01},
        {"delay_share": 1.0},
        {"pelvis_imu": AttitudeSensor(bias_rad=1e-3)},
        {"inertial_share": 1.0},
    ],
    ids="-".join,
)
def test_whatever_a_walk_draws_makes_its_scenario_random(alone: dict[str, Any]) -> None:
    """Catches a kind of noise or a drawn robot that is forgotten where ceilings are told from
    samples."""
    scenario = Scenario(friction_scale=0.0, encoder_counts=False, **alone)
    env = make_walk_vector(num_envs=2, scenario=scenario, step_period=[0.2, 0.3, 0.2], num_steps=1)
    env.reset(seed=[0, 1])
    seen = np.array([env.step(np.zeros((2, 12), np.float32))[0] for _ in range(5)])
    assert scenario.is_random == (not np.array_equal(seen[:, 0], seen[:, 1]))


def test_an_imu_alone_makes_a_scenario_of_the_testbed_random() -> None:
    """Catches its sensor forgotten."""
    assert Scenario(imu=AttitudeSensor(noise_rad=1e-3)).is_random
    assert not Scenario(imu=AttitudeSensor(bias_rad=1e-3)).is_random


def test_pushes_are_drawn() -> None:
    """Catches a walker's condition taken for one and the same walk."""
    assert make_scenario("ideal+push").is_random
    assert not make_scenario("ideal+stiff").is_random
